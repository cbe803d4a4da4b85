"""Means and fluctuations over the pairs of a run, with standard errors."""

from lfpiv.velocity.statistics import mean, reynolds_stresses, rms, standard_error, turbulent_kinetic_energy

__all__ = ["mean", "reynolds_stresses", "rms", "standard_error", "turbulent_kinetic_energy"]
