"""A field of displacements between two passes: from window centres to the points of the deformation, and its means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from lfpiv_kernels.correlation import deform

CONTROL_SPACING = 4
"""Largest distance of the points between which a deformation field is linear [voxel]."""


class Predictor:
    """Displacement field between window centres, as the deformation applies it.

    It is not smoothed: it consists of window means, so iterating is stable without (five iterations at 75 % overlap
    were), and smoothing it over neighbouring windows raised the error in a vortex ring by half.
    """

    def __init__(self, field: np.ndarray, nodes: Sequence[np.ndarray], shape: tuple[int, int, int]):
        """`field`, shape (z, y, x, 3) [voxel], is known at `nodes` along each axis of a volume of `shape` [voxel]."""
        counts = [max(2, math.ceil((n - 1) / CONTROL_SPACING) + 1) for n in shape]
        self.points = [np.linspace(0, max(n - 1, 1), count) for n, count in zip(shape, counts, strict=True)]
        """Control points along each axis [voxel]."""
        z, y, x = (float(p[1] - p[0]) for p in self.points)
        self.spacing = (z, y, x)
        for axis in range(3):
            field = _along(_spline_matrix(nodes[axis], self.points[axis]), field, axis)
        self.field = field.astype(np.float32)
        """Displacements at the control points, shape (z, y, x, 3) [voxel]."""
        self._shape = shape

    def window_means(
        self,
        origin: tuple[int, int, int],
        step: tuple[int, int, int],
        count: tuple[int, int, int],
        window: tuple[int, int, int],
    ) -> np.ndarray:
        """Mean displacement over the windows, shape (z, y, x, 3) [voxel]."""
        means = self.field.astype(float)
        for axis in range(3):
            linear = _linear_matrix(self.points[axis], deform.OFFSET + np.arange(self._shape[axis]))
            first = origin[axis] + step[axis] * np.arange(count[axis])
            matrix = np.stack([linear[start : start + window[axis]].mean(0) for start in first])
            means = _along(matrix, means, axis)
        return means


def _along(matrix: np.ndarray, field: np.ndarray, axis: int) -> np.ndarray:
    """Apply a matrix along one axis."""
    return np.moveaxis(np.tensordot(matrix, field, (1, axis)), 0, axis)


def _spline_matrix(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Matrix from values at nodes to values at points: natural cubic spline, straight on beyond the outer nodes."""
    if len(nodes) == 1:
        return np.ones((len(points), 1))
    spline = CubicSpline(nodes, np.eye(len(nodes)), bc_type="natural")
    inside = np.clip(points, nodes[0], nodes[-1])
    matrix: np.ndarray = spline(inside) + spline(inside, 1) * (points - inside)[:, None]
    return matrix


def _linear_matrix(points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Matrix from values at evenly spaced points to values at positions, linear between and beyond the points."""
    place = (positions - points[0]) / (points[1] - points[0])
    cell = np.clip(place.astype(int), 0, len(points) - 2)
    rows = np.arange(len(positions))
    matrix = np.zeros((len(positions), len(points)))
    matrix[rows, cell], matrix[rows, cell + 1] = 1 - (place - cell), place - cell
    return matrix
