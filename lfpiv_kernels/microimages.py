"""The light of a sensor's pixels as rays, block by block of microimages; ``raymap`` maps the two to each other."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Microimages:
    """How the rays of a camera's lenses lie in memory: blocks of edge x edge pixels, row by row.

    Every row of lenses comes in layers, of which each holds a block per lens, see ``footprint_source.LAYERS``.
    """

    first_lens: tuple[int, int]
    """Lattice indices (i, j) of the first lens; i runs fastest."""
    corner: np.ndarray
    """First pixel (column, row) of each lens's block, shape (lenses along j, lenses along i, 2), int32."""
    edge: int
    """Pixels along each side of a block."""
    pixel: np.ndarray
    """Sensor pixel of each ray, row by row; -1 outside the sensor. Shape (ray,), int32, some rays more than blocks."""
    share: np.ndarray
    """Fraction of the pixel's cell inside the pupil, shape (ray,), float32."""
    sensor_shape: tuple[int, int]
    """Rows and columns of the sensor [pixel]."""

    @property
    def size(self) -> int:
        """Number of rays, padding included."""
        return len(self.pixel)
