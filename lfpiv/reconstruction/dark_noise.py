"""Measure the noise of an image where it is dark, also of an image that is cut off at 0 counts.

Many cameras store no counts below 0, and have no offset that lifts their noise above 0. Their images then have the
upper half of the noise only. So the noise is the root mean square of the positive counts whose neighbours are all dark.
Neighbouring pixels have independent noise, so the choice does not change it. Light reaches over several pixels, so lit
pixels have lit neighbours. Pixels of 0 counts have no weight: dead ones, or those that were set to 0.
"""

from __future__ import annotations

import numpy as np

HOT_SIGMA = 5.0
"""Least count of a hot pixel [standard deviation of the noise]."""
LEAST_PIXELS = 100
"""Least number of pixels that the noise is measured from. They give it to 7 %."""


def dark_noise(image: np.ndarray) -> float:
    """Return the standard deviation of the noise of dark pixels [counts]; 0 where too few pixels are dark.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Counts without background, perhaps cut off at 0.
    """
    positive = _positive(_with_dark_neighbours(image))
    return float(np.sqrt(np.square(positive).mean())) if positive.size else 0.0


def light_cut_off(image: np.ndarray) -> float:
    """Return the mean count that a pixel of 0 counts had before the image was cut off at 0, <= 0; 0 for other images.

    Positive and negative noise of dark pixels cancel, so the counts cut off are the positive ones over the zeros.
    """
    if image.min() < 0:
        return 0.0
    dark = _with_dark_neighbours(image)
    return -float(_positive(dark).sum()) / max(int(np.count_nonzero(dark == 0)), 1)


def _with_dark_neighbours(image: np.ndarray) -> np.ndarray:
    """Return the counts of the pixels whose neighbours in rows and columns are all dark."""
    dark = image <= 0
    return image[1:-1, 1:-1][dark[:-2, 1:-1] & dark[2:, 1:-1] & dark[1:-1, :-2] & dark[1:-1, 2:]]


def _positive(counts: np.ndarray) -> np.ndarray:
    """Return the positive counts without those of hot pixels, float64; none where they are too few."""
    positive = counts[counts > 0].astype(np.float64)
    while positive.size >= LEAST_PIXELS:
        cold = positive <= HOT_SIGMA * np.sqrt(np.square(positive).mean())
        if cold.all():
            return positive
        positive = positive[cold]
    return positive[:0]
