"""Intensity capping [1]_: a limit of the brightest pixels makes bright particles more like the others.

A particle's brightness differs between cameras, because they see light scattered at different angles, and between
particles. A volume has one brightness per particle. Additional light in a camera becomes ghosts along its lines of
sight, most of it from the brightest particles. The limit is a multiple of the typical peak: the brightest pixel of each
lit microimage, median over microimages. A few bright particles do not change it.

Equally bright particles need no limit. It cuts the light of particles behind each other, and makes ghosts instead. So
the scatter of the particles' brightness is measured first (`ParticleSizer.brightness_scatter`).

.. [1] U. Shavit, R. J. Lowe, J. V. Steinbuck, "Intensity capping: a simple method to improve cross-correlation PIV
   results", Exp. Fluids 42 (2007) 225-240, doi:10.1007/s00348-006-0233-7.
"""

from __future__ import annotations

import numpy as np

POINT_CAP = 1.0
"""Limit for particles smaller than voxels, as a multiple of the typical peak. Their images have no shape to lose."""
CAP = 2.0
"""Limit for larger particles. It cuts 1 % of their light if they are equally bright, and keeps their shape."""
PEAK_SIGMA = 5.0
"""A microimage is lit if its brightest pixel exceeds this [standard deviation of the noise]."""


def typical_peak(image: np.ndarray, microimage_px: float, noise: float) -> float:
    """Return the median over lit microimages of their brightest pixel [counts].

    The image is divided into squares as large as a microimage, whatever the places of the microimages.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Counts without background; 0 in pixels that do not count.
    microimage_px : float
        Distance of the microimages [pixel].
    noise : float
        Standard deviation of the background [counts].

    Returns
    -------
    float
        Infinite if no square is lit.
    """
    edge = max(1, round(microimage_px))
    rows, columns = (n // edge for n in image.shape)
    squares = image[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge)
    peaks = squares.max(axis=(1, 3))
    peaks = peaks[peaks > PEAK_SIGMA * noise]
    return float(np.median(peaks)) if peaks.size else np.inf
