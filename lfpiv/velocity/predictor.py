"""Displacement field between two passes: from window centres to the control points of the deformation, and back.

A cubic spline interpolates the field from the window centres to the control points. Between these it is linear. Means
over windows are those of the linear field. The field is not smoothed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation import deform
from lfpiv_kernels.correlation.interpolation import from_control_points, to_control_points
from lfpiv_kernels.transfer import Values, to_host

CONTROL_SPACING = 4
"""Largest distance of control points [voxel]."""
MATRICES = 12
"""Number of matrices between nodes and points that are kept: those of the axes of the passes of a pair."""


@dataclass(frozen=True, kw_only=True)
class Predictor:
    """Displacement field on evenly spaced control points, linear between them."""

    points: tuple[np.ndarray, ...]
    """Control points along each axis (z, y, x) [voxel]."""
    control: Values
    """Displacement (z, y, x) at the control points, shape (z, y, x), vectors of float32 on the device [voxel]."""
    shape: tuple[int, int, int]
    """Shape of the volume [voxel]."""

    @classmethod
    def between(cls, nodes: Sequence[np.ndarray], field: np.ndarray, shape: tuple[int, int, int]) -> Predictor:
        """Interpolate a field of shape (z, y, x, 3) [voxel], known at `nodes` along each axis of a volume."""
        counts = [max(2, math.ceil((n - 1) / CONTROL_SPACING) + 1) for n in shape]
        points = tuple(np.linspace(0, max(n - 1, 1), count) for n, count in zip(shape, counts, strict=True))
        matrices = [spline_matrix(tuple(at), tuple(to)) for at, to in zip(nodes, points, strict=True)]
        return cls(points=points, control=to_control_points(matrices, field), shape=shape)

    @property
    def field(self) -> np.ndarray:
        """Displacement (z, y, x) at the control points, shape (z, y, x, 3), float32, on the host [voxel]."""
        return to_host(self.control)

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Distance of the control points (z, y, x) [voxel]."""
        z, y, x = (float(points[1] - points[0]) for points in self.points)
        return z, y, x

    def window_means(self, windows: Windows) -> np.ndarray:
        """Return the displacement averaged over windows, shape (z, y, x, 3) [voxel]."""
        matrices = []
        for axis in range(3):
            points, positions = self.points[axis], deform.OFFSET + np.arange(self.shape[axis])
            linear = make_interp_spline(points, np.eye(len(points)), k=1)(positions)  # extends beyond the last point
            edge, first = windows.window[axis], windows.first_voxels[axis]
            matrices.append(np.stack([linear[start : start + edge].mean(0) for start in first]))
        return from_control_points(matrices, self.control)


@lru_cache(MATRICES)
def spline_matrix(nodes: tuple[float, ...], points: tuple[float, ...]) -> np.ndarray:
    """Return the matrix from values at nodes to values at points: natural cubic spline, linear beyond the nodes."""
    if len(nodes) == 1:
        return np.ones((len(points), 1))
    spline = CubicSpline(nodes, np.eye(len(nodes)), bc_type="natural")
    inside = np.clip(points, nodes[0], nodes[-1])
    matrix: np.ndarray = spline(inside) + spline(inside, 1) * (np.asarray(points) - inside)[:, None]
    matrix.flags.writeable = False  # callers share it
    return matrix
