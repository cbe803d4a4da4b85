"""Figures of merit of weights, volumes, particles, board dots and vectors, compared with the truth or each other.

Equation numbers are the paper's. sigma_nor (Eq. 8) is `lfpiv.calibration.network.sigma_nor`, the swirl number (Eq. 17)
is in `lfpiv.simulation.swirl`.
"""

from lfpiv.metrics.agreement import (
    ErrorCurve,
    LinearResponse,
    UncertaintyCalibration,
    error_curve,
    linear_response,
    uncertainty_calibration,
    weighted_quantile,
)
from lfpiv.metrics.confidence import RESAMPLES, Estimate, block_bootstrap
from lfpiv.metrics.images_and_volumes import DotError, dot_error, reconstruction_quality, relative_l2, weight_ssim
from lfpiv.metrics.particles import (
    ParticleQuality,
    Particles,
    elongation,
    find_particles,
    match_particles,
    particle_quality,
    reconstruction_accuracy,
    truth_volume,
)
from lfpiv.metrics.vector_fields import DisplacementError, displacement_difference, displacement_error, empirical_cdf

__all__ = [
    "RESAMPLES",
    "DisplacementError",
    "DotError",
    "ErrorCurve",
    "Estimate",
    "LinearResponse",
    "ParticleQuality",
    "Particles",
    "UncertaintyCalibration",
    "block_bootstrap",
    "displacement_difference",
    "displacement_error",
    "dot_error",
    "elongation",
    "empirical_cdf",
    "error_curve",
    "find_particles",
    "linear_response",
    "match_particles",
    "particle_quality",
    "reconstruction_accuracy",
    "reconstruction_quality",
    "relative_l2",
    "truth_volume",
    "uncertainty_calibration",
    "weight_ssim",
    "weighted_quantile",
]
