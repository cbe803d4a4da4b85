"""`ImposedField`: a smooth displacement field whose means over the windows are those of given vectors.

Vectors are means over windows that overlap. A spline through them would be smoother than the flow that they are means
of. So its nodes are chosen such that the means of the spline over the windows come close to the vectors.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.predictor import spline_matrix
from lfpiv.velocity.settings import CorrelationSettings

KEPT = 0.02
"""Weight of the difference between the spline's nodes and the vectors, against that between means and vectors. Without
it fluctuations shorter than a window, whose means are nearly zero, would grow without limit."""


class ImposedField:
    """Displacement at any place: a cubic spline between the outermost vectors, constant beyond them.

    Parameters
    ----------
    vectors : Dataset
        From `lfpiv.correlate`: places and windows.
    displacement : ndarray, shape (z, y, x, 3)
        Displacement along (z, y, x) that the means over the windows should have [voxel], finite.
    """

    def __init__(self, vectors: xr.Dataset, displacement: np.ndarray):
        window = CorrelationSettings.of(vectors).windows[-1]
        self._voxel_mm = np.asarray(vectors.attrs["voxel_mm"], float)
        self._first_mm, nodes, self.window_means = [], displacement, np.empty(0)
        splines, means = [], []
        for axis, edge, voxel_mm in zip(AXES, window, self._voxel_mm, strict=True):
            centres = (vectors[axis].values - vectors[axis].values[0]) / voxel_mm + (edge - 1) / 2  # from first voxel
            self._first_mm.append(float(vectors[axis].values[0]) - (edge - 1) / 2 * voxel_mm)
            starts = np.round(centres - (edge - 1) / 2).astype(int)
            places = np.clip(np.arange(starts[-1] + edge), centres[0], centres[-1])
            spline = spline_matrix(centres, places)
            splines.append(spline)
            means.append(np.stack([spline[start : start + edge].mean(0) for start in starts]))
        for number, mean in enumerate(means):
            kept = KEPT * np.eye(len(mean))
            nodes = _apply(np.linalg.solve(mean.T @ mean + kept, mean.T + kept), nodes, number)
        dense = self.window_means = nodes
        for number in range(3):
            dense = _apply(splines[number], dense, number)
            self.window_means = _apply(means[number], self.window_means, number)
        """Means over the windows, shape (z, y, x, 3), components along (z, y, x) [voxel]."""
        self._dense = dense

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (x, y, z) at points (x, y, z) [mm], shape (point, 3)."""
        places = ((points_mm[:, ::-1] - self._first_mm) / self._voxel_mm).T
        moved = [ndimage.map_coordinates(self._dense[..., axis], places, order=1, mode="nearest") for axis in range(3)]
        return np.stack([part * edge for part, edge in zip(moved, self._voxel_mm, strict=True)][::-1], axis=1)


def _apply(matrix: np.ndarray, field: np.ndarray, axis: int) -> np.ndarray:
    return np.moveaxis(np.tensordot(matrix, field, (1, axis)), 0, axis)
