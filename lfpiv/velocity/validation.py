"""Vector validation: the normalised median test of Westerweel & Scarano (2005) [1]_, replacement and filling.

Fields are arrays (z, y, x, 3) of displacements [voxel]; neighbours are the 26 grid points around one. A vector passes
if it agrees with their median, or with their median after each was moved along the local gradient: in a steep gradient,
and at the edges of the grid where neighbours lie on one side only, the first alone makes outliers of good vectors.
Where the flow bends from window to window, and few layers of vectors tell so, good vectors agree with neither. There
a field known from a pass before helps: a vector with a clear peak also passes if its step from that field agrees with
its neighbours' steps. Without a clear peak that proves nothing: a wrong field confirms itself.

References
----------
.. [1] J. Westerweel, F. Scarano, "Universal outlier detection for PIV data", Exp. Fluids 39 (2005) 1096-1100,
   doi:10.1007/s00348-005-0016-6.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage

from lfpiv_kernels.correlation.neighbours import Prediction, predict

THRESHOLD = 2.0
"""Largest normalised residual of a good vector, the value of [1]_."""
NOISE_VOXEL = 0.1
"""Displacement noise that is no outlier wherever the neighbours agree perfectly (epsilon of [1]_) [voxel]."""
LARGEST_PART = 0.5
"""Largest accepted difference from the neighbours, as a part of the search range. Peaks of noise lie anywhere in that
range: neighbours that scatter like them prove nothing."""
CLEAR_RATIO = 2.0
"""Peak ratio of a peak that is no chance: in noise 8 voxel windows reach 1.5 now and then, hardly ever 2."""
MIN_NEIGHBOURS = 3
"""A vector with fewer good neighbours cannot be judged and is rejected, unless the grid itself has no more."""

LEAST_SEEN = 0.75
"""Least part of a window that two cameras see. What one camera sees has hardly any depth, and pulls the displacement
along it towards the mean of all depths, by as much as it is part of the window."""

_ROUNDS = 5
_CUBE = np.ones((3, 3, 3), bool)


def validate(
    first: np.ndarray,
    second: np.ndarray,
    measured: np.ndarray,
    search: tuple[float, float, float],
    *,
    seen: np.ndarray | None = None,
    predicted: np.ndarray | None = None,
    peak_ratio: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Test the displacement of the highest peaks, try the second peak where it fails, fill what remains.

    Parameters
    ----------
    first, second : ndarray, shape (z, y, x, 3)
        Displacement of the highest and of the second peak [voxel]; NaN where there is none.
    measured : ndarray of bool, shape (z, y, x)
        Where `first` may be trusted at all.
    search : tuple of float
        Largest lag at which peaks were searched, order (z, y, x) [voxel].
    seen : ndarray of bool, shape (z, y, x), optional
        Where there is anything to measure; all else is no part of the grid. Default: everywhere.
    predicted : ndarray, shape (z, y, x, 3), optional
        Displacement known before, around which peaks were searched [voxel].
    peak_ratio : ndarray, shape (z, y, x), optional
        Highest coefficient over its rival; needed with `predicted`.

    Returns
    -------
    field : ndarray, shape (z, y, x, 3)
        Displacement at every grid point: measured, or predicted by its neighbours; NaN only if no vector is valid.
    valid : ndarray of bool, shape (z, y, x)
        True where `field` is a measured peak that passed the test.
    """
    seen = np.ones(measured.shape, bool) if seen is None else seen
    measured = measured & seen
    possible = scipy.ndimage.convolve(seen.astype(int), _CUBE.astype(int), mode="constant") - seen
    needed = np.minimum(MIN_NEIGHBOURS, possible)
    valid, judged = measured.copy(), np.zeros(measured.shape, bool)
    second_agrees = np.zeros(measured.shape, bool)
    todo = np.ones(measured.shape, bool)
    for _ in range(_ROUNDS):  # what was rejected is no neighbour any more, so other vectors may pass again
        prediction = predict(first, valid, todo)
        judged = prediction.count >= needed[todo]
        agrees = _agrees(first[todo], prediction, search)
        if predicted is not None and peak_ratio is not None:
            step = first - predicted
            agrees |= (peak_ratio[todo] >= CLEAR_RATIO) & _agrees(step[todo], predict(step, valid, todo), search)
        passed = valid.copy()
        passed[todo] = measured[todo] & judged & (agrees | (needed[todo] == 0))
        second_agrees[todo] = judged & _agrees(second[todo], prediction, search)
        changed = passed != valid
        if not changed.any():
            break
        valid = passed
        todo = scipy.ndimage.binary_dilation(changed, _CUBE)
    rescued = ~valid & second_agrees & seen
    return fill(np.where(rescued[..., None], second, first), valid | rescued), valid | rescued


def seen_windows(
    seen: np.ndarray,
    window: tuple[int, int, int],
    origin: tuple[int, int, int],
    step: tuple[int, int, int],
    count: tuple[int, int, int],
) -> np.ndarray:
    """Whether at least `LEAST_SEEN` of a window's voxels are seen.

    Parameters
    ----------
    seen : ndarray of bool, shape (z, y, x)
        Voxels that enough cameras see.
    window, origin, step, count : tuple of int
        Edges of the windows, first voxel of the first one, distance and number of them along z, y, x.

    Returns
    -------
    ndarray of bool, shape `count`
    """
    share = seen.astype(float)
    for axis, (edge, first, distance, number) in enumerate(zip(window, origin, step, count, strict=True)):
        below = np.insert(share.cumsum(axis), 0, 0, axis)
        start = first + distance * np.arange(number)
        share = (below.take(start + edge, axis) - below.take(start, axis)) / edge
    return share >= LEAST_SEEN * (1 - 1e-9)  # sums of shares are rounded


def _agrees(field: np.ndarray, prediction: Prediction, search: tuple[float, float, float]) -> np.ndarray:
    """Whether vectors (vector, 3) are within the threshold of one of the two predictions, in every component."""
    agrees = np.zeros(len(field), bool)
    pairs = ((prediction.median, prediction.scatter), (prediction.level, prediction.level_scatter))
    for median, scatter in pairs:
        with np.errstate(invalid="ignore"):
            limit = np.minimum(THRESHOLD * (scatter + NOISE_VOXEL), LARGEST_PART * np.asarray(search))
            agrees |= (np.abs(field - median) <= limit).all(-1)
    return agrees


def fill(field: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Replace vectors that are not valid by what their neighbours predict, from the rim of each hole inwards."""
    filled = np.where(valid[..., None], field, np.nan)
    known = valid.copy()
    while known.any() and not known.all():
        rim = ~known & scipy.ndimage.binary_dilation(known, _CUBE)
        prediction = predict(filled, known, rim)
        filled[rim] = np.clip(prediction.level, prediction.lowest, prediction.highest)  # no gradient may run away
        known |= rim
    return filled
