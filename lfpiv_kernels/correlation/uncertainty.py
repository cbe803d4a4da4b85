"""Standard deviation of measured displacements from the statistics of the correlation, after Wieneke (2015) [1]_.

For two volumes that are deformed onto each other, the correlation at lags +1 and -1 along an axis differs only by what
does not match: noise, ghosts, lost particles, gradients inside the window. The difference is a sum over voxels. Its
variance follows from the scatter of its terms and their neighbours, and the slope of the peak fit turns it into voxels.

A window with few particles has a peak of odd width by chance. Particles are equally wide everywhere, and so are peaks.
The slope is therefore limited by the typical autocorrelation of the windows.

References
----------
.. [1] B. Wieneke, "PIV uncertainty quantification from correlation statistics", Meas. Sci. Technol. 26 (2015) 074002,
   doi:10.1088/0957-0233/26/7/074002.
"""

import math
from collections.abc import Iterator

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import uncertainty_gpu
from lfpiv_kernels.correlation.box_sum import box_sum
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.correlation.plan import Triple
from lfpiv_kernels.transfer import Values, to_host

REACH = 4
"""Edge of the cubes whose sums of terms are squared [voxel]: nearer terms count as correlated."""
FLATTEST = 0.5
"""Least logarithm of the ratio of a peak to its neighbours, relative to that of the typical autocorrelation."""
_LEAST_RATIO = 1.02
"""Least ratio of the typical autocorrelation at lag 0 to that at lag 1."""


def displacement_deviation(
    first: Values,
    second: Values,
    *,
    window: Triple,
    origin: Triple,
    step: Triple,
    count: Triple,
) -> np.ndarray:
    """Estimate the standard deviation of each window's displacement.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
        Volumes deformed onto each other, so that a fraction of a voxel of displacement remains in each window.
    window, origin, step, count : tuple of int
        Window edges, first voxel of the first window, distance and number of windows, order (z, y, x).

    Returns
    -------
    ndarray, shape (*count, 3)
        Standard deviation of the displacement, order (z, y, x) [voxel]; NaN where the correlation at lag 0 is not
        positive.
    """
    layout = window, origin, step, count
    if runtime.device().form == "gpu":
        totals, terms = uncertainty_gpu.window_sums(on_device(first), on_device(second), *layout, REACH)
    else:
        totals, terms = _window_sums(to_host(first), to_host(second), *layout)
    voxels = math.prod(window)
    mean_product, mean_squares = totals[0] * totals[1] / voxels, (totals[0] ** 2 + totals[1] ** 2) / voxels
    peak, own_peak = totals[2] - mean_product, totals[3] - mean_squares
    deviation = np.full((*count, 3), np.nan)
    for axis, (plus, minus, difference, squares, own) in enumerate(terms):
        side = 0.5 * (plus + minus) - mean_product
        # The sum over pairs of terms of their product times the overlap of two cubes around them, which is 1 for a term
        # with itself and 0 beyond `REACH`. Unlike a sum of estimated covariances it is never negative.
        about_zero = squares / REACH**3
        about_mean = about_zero - difference**2 * REACH**3 / voxels
        variance = np.maximum(about_mean, 0.5 * about_zero)  # a small window's mean holds part of the noise
        typical = _typical_sharpness(own_peak, own - mean_squares)
        with np.errstate(divide="ignore", invalid="ignore"):
            measured = np.where(side > 0, np.log(peak / side), np.inf)
            sharpness = np.clip(measured, FLATTEST * typical, typical)
            sigma = np.sqrt(variance) / (4 * peak * np.exp(-sharpness) * sharpness)
        deviation[..., axis] = np.where(peak > 0, sigma, np.nan)
    return deviation


def _typical_sharpness(peak: np.ndarray, side: np.ndarray) -> float:
    """Return the median logarithm of the ratio of autocorrelations at lag 0 and at lag 1, shape `count` each."""
    known = (side > 0) & (peak > side)
    ratio = float(np.median(peak[known] / side[known])) if known.any() else 0.0
    return math.log(max(ratio, _LEAST_RATIO))


def _window_sums(
    first: np.ndarray, second: np.ndarray, window: Triple, origin: Triple, step: Triple, count: Triple
) -> tuple[list[np.ndarray], Iterator[list[np.ndarray]]]:
    """Return sums over windows, shape `count`, float64.

    They are the sums of both volumes, of their product and of their squares, and for each axis of the products at a lag
    of 1 and of -1, of their difference, of the squares of the difference's sums over cubes, and of the products of
    each volume with itself at a lag of 1.
    """
    keep = tuple(slice(o, o + (c - 1) * s + 1, s) for o, c, s in zip(origin, count, step, strict=True))

    def window_sum(volume: np.ndarray) -> np.ndarray:
        return box_sum(volume, window, keep).astype(float)

    def terms(axis: int) -> list[np.ndarray]:
        ahead = [np.zeros_like(volume) for volume in (first, second)]
        inner = (slice(None),) * axis + (slice(None, -1),)
        for moved, volume in zip(ahead, (first, second), strict=True):
            moved[inner] = volume[(slice(None),) * axis + (slice(1, None),)]
        plus, minus = first * ahead[1], ahead[0] * second
        difference = plus - minus
        own = first * ahead[0] + second * ahead[1]
        return [window_sum(term) for term in (plus, minus, difference, _squared_cubes(difference), own)]

    squares = first * first + second * second
    return [window_sum(volume) for volume in (first, second, first * second, squares)], map(terms, range(3))


def _squared_cubes(terms: np.ndarray) -> np.ndarray:
    """Return the squares of the sums of terms over the cube around each voxel; terms outside the volume are 0."""
    before = REACH // 2  # box_sum starts at a voxel: the padding moves each cube's sum to its middle
    cubes = box_sum(np.pad(terms, (before, REACH - 1 - before)), (REACH,) * 3)
    centred = cubes[tuple(slice(n) for n in terms.shape)]
    return centred * centred
