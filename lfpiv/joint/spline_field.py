"""Displacement field on the nodes of a cubic B-spline: values, their adjoint, means over windows, fit to vectors.

Values belong to voxels midway in time. Fields have shape (3, z, y, x), order of components (z, y, x), in voxels of the
reconstructed grid. All maps are products of one matrix per axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import xarray as xr
from scipy.interpolate import BSpline

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.joint.conjugate_gradients import conjugate_gradients
from lfpiv.velocity.settings import CorrelationSettings

SPACING_VOXEL = 7.0
"""Distance of the nodes [voxel of the measured volume]."""
ROUGH_START = 0.02
"""Weight of the squared second differences of the nodes in a fit to vectors, each of which has a weight of 1."""
REPLACED = 0.2
"""Weight of a vector that validation replaced."""
STEPS_OF_FIT = 300
"""Largest number of conjugate gradient steps of a fit to vectors."""
SMALL = 1e-6
"""Weight of the squared nodes in a fit to vectors, which makes it unique, and its relative tolerance."""


class SplineField:
    """Nodes of a displacement field over a grid.

    Parameters
    ----------
    grid : Grid
        Voxels midway in time.
    spacing_voxel : float
        Distance of the nodes [voxel of the grid].
    """

    def __init__(self, grid: Grid, spacing_voxel: float = SPACING_VOXEL):
        self.grid, self.spacing_voxel = grid, spacing_voxel
        self._cells = [max(1, round((n - 1) / spacing_voxel)) for n in grid.shape]
        self.count = tuple(cells + 3 for cells in self._cells)
        """Nodes along each axis."""
        self._rough = []
        for nodes in self.count:
            second = np.diff(np.eye(nodes), 2, axis=0)
            self._rough.append(second.T @ second)

    @cached_property
    def _voxels(self) -> list[np.ndarray]:
        """Matrix of each axis from nodes to voxels."""
        return [self._matrix(axis, np.arange(n)) for axis, n in enumerate(self.grid.shape)]

    def _matrix(self, axis: int, places: np.ndarray) -> np.ndarray:
        """Return the matrix from nodes to places [voxel]; outside the grid the field is constant."""
        last, cells = self.grid.shape[axis] - 1, self._cells[axis]
        edge = last / cells if last else 1.0
        knots = (np.arange(cells + 7) - 3) * edge
        within = np.clip(places, 0, cells * edge * (1 - 1e-12))
        return BSpline.design_matrix(within, knots, 3).toarray()

    def values(self, nodes: np.ndarray) -> np.ndarray:
        """Return the displacement of each voxel, shape (3, z, y, x), float32."""
        z, y, x = self._voxels
        rows = _along_axes([z, y], nodes).astype(np.float32)
        return np.ascontiguousarray(rows @ x.T.astype(np.float32))

    def adjoint(self, values: np.ndarray) -> np.ndarray:
        """Return the adjoint of `values`, shape of the nodes."""
        z, y, x = self._voxels
        rows = values.astype(np.float32, copy=False) @ x.astype(np.float32)
        return _along_axes([z.T, y.T], rows.astype(np.float64))

    def values_on(self, nodes: np.ndarray, grid: Grid) -> np.ndarray:
        """Return the displacement at the voxels of another grid [voxel of that grid], shape (3, z, y, x), float32."""
        own, matrices = self.grid, []
        for axis in range(3):
            places = (grid.axis_mm(axis) - own.first_centre_mm[axis]) / own.voxel_mm
            matrices.append(self._matrix(axis, places))
        return (_along_axes(matrices, nodes) * (own.voxel_mm / grid.voxel_mm)).astype(np.float32)

    def penalty(self, nodes: np.ndarray, weights: np.ndarray | float = 1.0) -> np.ndarray:
        """Return the gradient of half the sum of the squared second differences along each axis.

        `weights` of a component along an axis have the shape (3, 3), or are one number.
        """
        weights = np.broadcast_to(weights, (3, 3))[..., None, None, None]
        z, y, x = self._rough
        total: np.ndarray = weights[:, 0] * np.einsum("ab,ibcd->iacd", z, nodes)
        total = total + weights[:, 1] * np.einsum("bc,iacd->iabd", y, nodes)
        total = total + weights[:, 2] * np.einsum("cd,iabd->iabc", x, nodes)
        return total

    def bends(self, nodes: np.ndarray) -> np.ndarray:
        """Return the mean squared second differences of each component along each axis, shape (3, 3)."""
        return np.stack([(np.diff(nodes, 2, axis=axis) ** 2).mean((1, 2, 3)) for axis in (1, 2, 3)], 1)

    def fitted_to(self, vectors: xr.Dataset) -> np.ndarray:
        """Return smooth nodes whose means over the windows are the vectors, so that windows do not damp the field.

        Vectors that were replaced count little, masked ones not at all.
        """
        edges = np.asarray(vectors.attrs["voxel_mm"], float)
        window = CorrelationSettings.from_vectors(vectors).windows[-1]
        means = []
        for axis, name in enumerate(AXES):
            share = window_shares(self.grid.axes_mm[axis], vectors[name].values, window[axis] * edges[axis])
            means.append(share @ self._voxels[axis])
        scale = (edges / self.grid.voxel_mm)[:, None, None, None]
        given = np.stack([vectors[f"displacement_{axis}"].values for axis in AXES]).astype(float) * scale
        weight = np.where(vectors["valid"].values, 1.0, REPLACED) * np.isfinite(given).all(0)
        given = np.where(weight > 0, given, 0.0)
        back = [matrix.T for matrix in means]

        def normal(nodes: np.ndarray) -> np.ndarray:
            fitted = _along_axes(back, weight * _along_axes(means, nodes))
            return fitted + ROUGH_START * self.penalty(nodes) + SMALL * nodes

        return conjugate_gradients(normal, _along_axes(back, weight * given), steps=STEPS_OF_FIT, tolerance=SMALL**2)


def window_shares(voxels_mm: np.ndarray, centres_mm: np.ndarray, edge_mm: float) -> np.ndarray:
    """Return the matrix from values of voxels along an axis to their means over windows, shape (window, voxel)."""
    voxel_mm = (voxels_mm[-1] - voxels_mm[0]) / (len(voxels_mm) - 1) if len(voxels_mm) > 1 else edge_mm
    reach = (edge_mm + voxel_mm) / 2 - np.abs(voxels_mm - np.asarray(centres_mm)[:, None])
    share = np.clip(reach / voxel_mm, 0, 1)
    return share / share.sum(axis=1, keepdims=True)


def _along_axes(matrices: Sequence[np.ndarray], values: np.ndarray) -> np.ndarray:
    """Apply a matrix along each of the first axes z, y, x of values, shape (3, z, y, x)."""
    for axis, matrix in enumerate(matrices, start=1):
        values = np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)
    return values
