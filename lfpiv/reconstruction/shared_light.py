"""First guesses of both frames of a pair from the light that their volumes share along the motion between them.

Each volume is carried along the measured displacement to the other frame's instant. A volume keeps its own particles in
their places; only their brightness changes, by the ratio of the two volumes after both were smoothed. Ghosts that do
not move as the particles do fade.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.predictor import Predictor
from lfpiv.velocity.validation import fill
from lfpiv_kernels.correlation import deform, light
from lfpiv_kernels.correlation.carry import carry, followed

SMOOTHING_VOXEL = 0.7
"""Standard deviation of the Gaussian that smooths both volumes before they are compared [voxel]: about the size of a
particle."""
DARK_SHARE = 0.02
"""Light added to both volumes before their ratio is taken, as a share of the smoothed volume's brightness,
sum E^2 / sum E. Voxels as dark as that are changed little."""
LARGEST_GAIN = 3.0
"""Largest factor by which the other frame brightens a voxel."""
FAINTEST = 1e-6
"""Least light of a voxel in the first guess, as a share of the brightest one. SMART can raise it; it cannot raise 0."""

MATRICES = 6
"""Number of matrices of `_linear` that are kept: those of the axes of two fields."""


def shared_guesses(volumes: Sequence[xr.DataArray], vectors: xr.Dataset) -> list[np.ndarray]:
    """Return first guesses of both frames from what their volumes share along measured displacements.

    With E and E' the two volumes, d the displacement from one to the other, G a Gaussian of `SMOOTHING_VOXEL` and e the
    light of `DARK_SHARE`, the guess of one frame is ``E min((G E'(x + d) + e) / (G E + e), LARGEST_GAIN)``, both
    volumes scaled to the same light. Where vectors were replaced by the validation, or particles left the volume, the
    factor is 1. In between its logarithm is interpolated.

    Parameters
    ----------
    volumes : sequence of two DataArrays, shape (z, y, x)
        Both frames, >= 0, with coordinates in mm.
    vectors : Dataset
        From `correlate` of the two: displacements midway in time.

    Returns
    -------
    list of two ndarrays, shape (z, y, x), float32
        Each with the light of its volume, zero where that is zero.
    """
    values = [np.asarray(volume.values, np.float32) for volume in volumes]
    total = [float(value.sum(dtype=np.float64)) for value in values]
    coefficients = [deform.spline_coefficients(value) for value in values]
    motion = MotionField([volumes[0][axis].values for axis in AXES], vectors)
    guesses = []
    for number, own in enumerate(values):
        partner, inside = motion.carried(coefficients[1 - number], 1 if number == 0 else -1)
        partner *= np.float32(total[number] / total[1 - number])
        guess = own * _gain(own, np.maximum(partner, 0)) ** (motion.trust * inside)
        np.maximum(guess, FAINTEST * guess.max(), out=guess, where=own > 0)
        guesses.append(guess * np.float32(total[number] / guess.sum(dtype=np.float64)))
    return guesses


def _gain(own: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Return the factor that changes a volume's brightness; `partner` is the other one, carried to its instant."""
    own, partner = (light.smoothed(volume, SMOOTHING_VOXEL) for volume in (own, partner))
    dark = np.float32(DARK_SHARE * np.square(own, dtype=np.float64).sum() / own.sum(dtype=np.float64))
    return np.minimum((partner + dark) / (own + dark), np.float32(LARGEST_GAIN))


class MotionField:
    """Motion between two frames, midway in time, on control points between which it is linear [voxel].

    Parameters
    ----------
    centres_mm : sequence of three ndarrays
        Voxel centres of the frames along z, y, x [mm].
    vectors : Dataset
        From `correlate`, of volumes whose voxels may have another size.
    """

    def __init__(self, centres_mm: Sequence[np.ndarray], vectors: xr.Dataset):
        axes = [(own.astype(float), vectors[axis].values) for axis, own in zip(AXES, centres_mm, strict=True)]
        self.nodes = [(centres - own[0]) * (len(own) - 1) / (own[-1] - own[0]) for own, centres in axes]
        """Positions of the vectors along each axis [voxel]."""
        nz, ny, nx = (len(own) for own, _ in axes)
        displacement = np.stack([vectors[f"displacement_{axis}"].values for axis in "zyx"], axis=-1).astype(float)
        displacement = fill(displacement, np.isfinite(displacement).all(-1))  # masked vectors have none
        edges = [(own[-1] - own[0]) / (len(own) - 1) for own, _ in axes]
        displacement *= np.asarray(vectors.attrs["voxel_mm"]) / edges
        self.midway = Predictor.between(self.nodes, displacement, (nz, ny, nx))
        """Displacement of what is at a control point midway in time."""
        trust = vectors["valid"].values.astype(float)
        for axis, (nodes, count) in enumerate(zip(self.nodes, (nz, ny, nx), strict=True)):
            trust = np.moveaxis(np.tensordot(_linear(tuple(nodes), count), trust, (1, axis)), 0, axis)
        self.trust = trust.astype(np.float32)
        """1 among valid vectors, 0 among replaced ones, shape (z, y, x)."""

    def carried(
        self, coefficients: np.ndarray, steps: int, wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Carry a volume, given by its spline coefficients, to the instant of a frame `steps` frames before its own.

        `steps` is negative for a frame after it. Returns the volume's light at the places of that frame's particles, 0
        outside, and how far inside the volume the place is: 1 inside, 0 a voxel beyond it. With `wanted`, flat indices
        of voxels, both are those of these voxels alone, shape (voxel,).
        """
        field = followed(self.midway.control, self.midway.spacing, steps)
        return carry(coefficients, field, self.midway.spacing, wanted)


@lru_cache(MATRICES)
def _linear(nodes: tuple[float, ...], count: int) -> np.ndarray:
    """Return the matrix from values at nodes to values at voxels: linear, constant beyond the outer nodes."""
    matrix = np.stack([np.interp(np.arange(count), nodes, unit) for unit in np.eye(len(nodes))], axis=1)
    matrix.flags.writeable = False  # callers share it
    return matrix
