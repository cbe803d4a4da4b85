"""Standard deviation of measured displacements from the statistics of the correlation, after Wieneke (2015) [1]_.

For two volumes that are deformed onto each other, the correlation at lags +1 and -1 along an axis differs only by what
does not match: noise, ghosts, lost particles, gradients inside the window. The difference is a sum over voxels. Its
variance follows from the scatter of its terms and their neighbours, and the slope of the peak fit turns it into voxels.

References
----------
.. [1] B. Wieneke, "PIV uncertainty quantification from correlation statistics", Meas. Sci. Technol. 26 (2015) 074002,
   doi:10.1088/0957-0233/26/7/074002.
"""

import math
from collections.abc import Callable

import numpy as np

from lfpiv_kernels.correlation.box_sum import box_sum
from lfpiv_kernels.correlation.plan import Triple

REACH = 4
"""Edge of the cubes whose sums of terms are squared [voxel]: nearer terms count as correlated."""
_FLATTEST = 1.02
"""Least ratio of the peak to its neighbours; a window with a flatter peak is treated as if it had this one."""


def displacement_deviation(
    first: np.ndarray,
    second: np.ndarray,
    *,
    window: Triple,
    origin: Triple,
    step: Triple,
    count: Triple,
) -> np.ndarray:
    """Estimate the standard deviation of each window's displacement.

    Parameters
    ----------
    first, second : ndarray, shape (z, y, x), float32
        Volumes deformed onto each other, so that a fraction of a voxel of displacement remains in each window.
    window, origin, step, count : tuple of int
        Window edges, first voxel of the first window, distance and number of windows, order (z, y, x).

    Returns
    -------
    ndarray, shape (*count, 3)
        Standard deviation of the displacement, order (z, y, x) [voxel]; NaN where the correlation has no peak at lag 0.
    """
    keep = tuple(slice(o, o + (c - 1) * s + 1, s) for o, c, s in zip(origin, count, step, strict=True))
    voxels = math.prod(window)

    def window_sum(volume: np.ndarray) -> np.ndarray:
        return box_sum(volume, window, keep).astype(float)

    mean_product = window_sum(first) * window_sum(second) / voxels
    peak = window_sum(first * second) - mean_product
    deviation = np.full((*count, 3), np.nan)
    for axis in range(3):
        ahead = [np.zeros_like(volume) for volume in (first, second)]
        inner = (slice(None),) * axis + (slice(None, -1),)
        for moved, volume in zip(ahead, (first, second), strict=True):
            moved[inner] = volume[(slice(None),) * axis + (slice(1, None),)]
        plus, minus = first * ahead[1], ahead[0] * second
        side = 0.5 * (window_sum(plus) + window_sum(minus)) - mean_product
        difference = plus - minus
        about_zero = _variance_of_sum(difference, window_sum)
        about_mean = about_zero - window_sum(difference) ** 2 * REACH**3 / voxels
        variance = np.maximum(about_mean, 0.5 * about_zero)  # a small window's mean holds part of the noise
        with np.errstate(divide="ignore", invalid="ignore"):
            sharpness = np.log(np.maximum(peak / side, _FLATTEST))
            sigma = np.sqrt(variance) / (4 * side * sharpness)
        deviation[..., axis] = np.where((side > 0) & (peak > 0), sigma, np.nan)
    return deviation


def _variance_of_sum(terms: np.ndarray, window_sum: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Estimate the variance of the sum of correlated terms over windows.

    It is the sum over pairs of terms of their product times the overlap of two cubes around them, which is 1 for a term
    with itself and 0 beyond `REACH`. Unlike a sum of estimated covariances it is never negative.
    """
    cubes = box_sum(terms, (REACH,) * 3)
    centred = np.zeros_like(cubes)  # box_sum starts at a voxel: move each cube's sum to its middle
    shift = REACH // 2
    centred[shift:, shift:, shift:] = cubes[: -shift or None, : -shift or None, : -shift or None]
    return window_sum(centred * centred) / REACH**3
