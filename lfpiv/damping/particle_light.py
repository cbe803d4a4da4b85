"""`LightField`: how bright particles are where, from a volume of some frame."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import lies_in, voxel_place

REACH = 1 / 6
"""Standard deviation of the Gaussian that smooths a volume, as a share of its edges. Many particles are within it."""


class LightField:
    """Relative light of a particle at any place: a smoothed volume of some frame, or the same everywhere.

    Particles may end within the grid, whose outer layers pad the volume. So the volume is smoothed only where it is
    lit, and its dark rim stays dark. Along each axis a layer is lit by the share of the median layer that the layers
    from the face to it have reached.

    Parameters
    ----------
    grid : Grid
        Voxels. Beyond them there is no light.
    volume : ndarray, shape (z, y, x), optional
        Reconstructed intensities.
    """

    def __init__(self, grid: Grid, volume: np.ndarray | None = None):
        self._grid = grid
        self._light = None
        if volume is not None and volume.mean(dtype=np.float64) > 0:
            lit = _lit(volume)
            reach = [REACH * edge for edge in volume.shape]
            above, below = (ndimage.gaussian_filter(part, reach, mode="constant") for part in (volume * lit, lit * lit))
            light = lit * above / np.maximum(below, np.finfo(np.float32).tiny)
            self._light = (light / light.mean(dtype=np.float64)).astype(np.float32)

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the light at points (x, y, z) [mm], shape (point,)."""
        inside = lies_in(points_mm, self._grid)
        if self._light is None:
            return inside.astype(float)
        places = voxel_place(points_mm, self._grid).T
        return ndimage.map_coordinates(self._light, places, order=1, mode="nearest") * inside


def _lit(volume: np.ndarray) -> np.ndarray:
    """Return how far each voxel is lit, 0 in a dark rim to 1, shape (z, y, x), float32."""
    lit = np.ones(volume.shape, np.float32)
    for axis in range(3):
        layers = volume.mean(tuple(other for other in range(3) if other != axis), dtype=np.float64)
        if (median := float(np.median(layers))) > 0:
            shares = np.minimum(layers / median, 1)
            shares = np.minimum(np.maximum.accumulate(shares), np.maximum.accumulate(shares[::-1])[::-1])
            lit *= np.expand_dims(shares, [other for other in range(3) if other != axis]).astype(np.float32)
    return lit
