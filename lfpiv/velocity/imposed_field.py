"""`ImposedField`: a smooth displacement field whose means over the windows are those of given vectors.

Vectors are means over windows that overlap. A spline through them would be smoother than the flow that they are means
of. So the field is their best linear predictor, kriging of block averages [1]_: the flow is taken for a random one
about an unknown constant, with the Matern covariance of smoothness 3/2 and of a length in proportion to the windows.

References
----------
.. [1] N. A. C. Cressie, "Statistics for Spatial Data", Wiley, 1993, section 3.4.5 and chapter 5.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.settings import CorrelationSettings

LENGTH = 0.75
"""Length of the covariance over the edge of a window."""
ERROR = 0.003
"""Variance of the errors of vectors over that of the flow. Without errors fluctuations shorter than a window, whose
means are nearly zero, would grow without limit."""
LEVEL = 1e6
"""Variance of the unknown constant over that of the flow."""


class ImposedField:
    """Displacement inside the windows; constant extrapolation outside.

    Parameters
    ----------
    vectors : Dataset
        From `lfpiv.correlate`: places and windows.
    displacement : ndarray, shape (z, y, x, 3)
        Displacement along (z, y, x) that the means over the windows should have [voxel], finite.
    """

    def __init__(self, vectors: xr.Dataset, displacement: np.ndarray):
        window = CorrelationSettings.from_vectors(vectors).windows[-1]
        self._voxel_mm = np.asarray(vectors.attrs["voxel_mm"], float)
        self._first_mm, dense, averages = [], displacement, []
        for number, (axis, edge, voxel_mm) in enumerate(zip(AXES, window, self._voxel_mm, strict=True)):
            first_mm = float(vectors[axis].values[0]) - (edge - 1) / 2 * voxel_mm
            starts = np.round((vectors[axis].values - vectors[axis].values[0]) / voxel_mm).astype(int)
            average = _averages(starts, edge)
            dense = _apply(_predictor(average, LENGTH * edge), dense, number)
            self._first_mm.append(first_mm)
            averages.append(average)
        self._dense = means = dense
        for number, average in enumerate(averages):
            means = _apply(average, means, number)
        self.window_means = means
        """Means over the windows, shape (z, y, x, 3), components along (z, y, x) [voxel]."""

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (x, y, z) at points (x, y, z) [mm], shape (point, 3)."""
        places = ((points_mm[:, ::-1] - self._first_mm) / self._voxel_mm).T
        moved = [ndimage.map_coordinates(self._dense[..., axis], places, order=1, mode="nearest") for axis in range(3)]
        return np.stack([part * edge for part, edge in zip(moved, self._voxel_mm, strict=True)][::-1], axis=1)


def _averages(starts: np.ndarray, edge: int) -> np.ndarray:
    """Return the matrix (window, voxel) of the means over windows along an axis, given their first voxels."""
    voxels = np.arange(starts[-1] + edge)
    inside = (voxels >= starts[:, None]) & (voxels < starts[:, None] + edge)
    return inside / edge


def _predictor(averages: np.ndarray, length: float) -> np.ndarray:
    """Return the matrix (voxel, window) of the best linear predictor of a flow from its averages."""
    voxels = np.arange(averages.shape[1])
    distance = np.sqrt(3) * np.abs(voxels[:, None] - voxels) / length
    together = ((1 + distance) * np.exp(-distance) + LEVEL) @ averages.T
    return np.linalg.solve(averages @ together + ERROR * np.eye(len(averages)), together.T).T


def _apply(matrix: np.ndarray, field: np.ndarray, axis: int) -> np.ndarray:
    return np.moveaxis(np.tensordot(matrix, field, (1, axis)), 0, axis)
