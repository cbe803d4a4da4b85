"""Motion between two frames, measured by `lfpiv.correlate`, and volumes carried along it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.predictor import Predictor
from lfpiv.velocity.validation import fill
from lfpiv_kernels.correlation.carry import carry, followed

LARGEST_GAIN = 3.0
"""Largest factor by which the other frame brightens a voxel."""
FAINTEST = 1e-6
"""Least light of a voxel in the first guess, as a share of the brightest one. SMART can raise it; it cannot raise 0."""

LEAST_VALID = 0.3
"""Least share of valid vectors, of those that can be measured, with which the motion is followed."""

MATRICES = 6
"""Number of matrices of `_linear` that are kept: those of the axes of two fields."""


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
        """Carry a volume, given by its spline coefficients, to the frame `steps` frames before its own.

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
