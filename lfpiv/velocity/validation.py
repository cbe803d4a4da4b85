"""Vector validation by the normalised median test of Westerweel & Scarano (2005) [1]_, with replacement.

Fields are arrays (z, y, x, 3) of displacements [voxel]. Neighbours are the 26 grid points around a vector. A vector
passes if it agrees with one of these predictions:

- the median of its neighbours;
- the median of its neighbours after each was moved to the vector's place along the local gradient, which suits steep
  gradients and the edges of the grid;
- only if its peak is clear: the field of the pass before, plus the median of the neighbours' steps from that field,
  which suits flows that bend from window to window. Without a clear peak a wrong field would confirm itself.

References
----------
.. [1] J. Westerweel, F. Scarano, "Universal outlier detection for PIV data", Exp. Fluids 39 (2005) 1096-1100,
   doi:10.1007/s00348-005-0016-6.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage

from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation.neighbours import Prediction, predict

THRESHOLD = 2.0
"""Largest normalised residual of a valid vector, the value of [1]_."""
NOISE_VOXEL = 0.1
"""Displacement noise that is always accepted, epsilon of [1]_ [voxel]."""
LARGEST_PART = 0.5
"""Largest accepted difference from a prediction, as a part of the search range."""
CLEAR_RATIO = 2.0
"""Smallest peak ratio of a clear peak."""
MIN_NEIGHBOURS = 3
"""Smallest number of valid neighbours of a valid vector, or as many as the grid has."""
LEAST_SEEN = 0.75
"""Smallest part of a window's voxels that two cameras must see."""

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
    """Test the displacement of the highest peaks, try the second peak where it fails, and fill the remaining gaps.

    Parameters
    ----------
    first, second : ndarray, shape (z, y, x, 3)
        Displacement of the highest and of the second peak [voxel]; NaN where there is none.
    measured : ndarray of bool, shape (z, y, x)
        True where `first` is a peak to test.
    search : tuple of float
        Largest lag at which peaks were searched, order (z, y, x) [voxel].
    seen : ndarray of bool, shape (z, y, x), optional
        True where two cameras see enough of the window. Other grid points are ignored. Default: everywhere.
    predicted : ndarray, shape (z, y, x, 3), optional
        Displacement around which peaks were searched [voxel].
    peak_ratio : ndarray, shape (z, y, x), optional
        Highest coefficient over its rival; required with `predicted`.

    Returns
    -------
    field : ndarray, shape (z, y, x, 3)
        Displacement at every grid point: measured, or predicted from its neighbours; NaN if no vector is valid.
    valid : ndarray of bool, shape (z, y, x)
        True where `field` is a measured peak that passed.
    """
    seen = np.ones(measured.shape, bool) if seen is None else seen
    measured = measured & seen
    possible = scipy.ndimage.convolve(seen.astype(int), _CUBE.astype(int), mode="constant") - seen
    needed = np.minimum(MIN_NEIGHBOURS, possible)
    valid, judged = measured.copy(), np.zeros(measured.shape, bool)
    second_agrees = np.zeros(measured.shape, bool)
    todo = np.ones(measured.shape, bool)
    for _ in range(_ROUNDS):  # rejected vectors are no longer neighbours, which changes the predictions
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


def seen_windows(seen: np.ndarray, windows: Windows) -> np.ndarray:
    """Return whether at least `LEAST_SEEN` of each window's voxels are seen, shape (z, y, x).

    `seen` is true where two cameras see the voxel, shape (z, y, x).
    """
    return windows.means(seen) >= LEAST_SEEN * (1 - 1e-9)  # the shares have rounding errors


def _agrees(field: np.ndarray, prediction: Prediction, search: tuple[float, float, float]) -> np.ndarray:
    """Return whether each vector (vector, 3) agrees with one of its two predictions in every component."""
    agrees = np.zeros(len(field), bool)
    pairs = ((prediction.median, prediction.scatter), (prediction.level, prediction.level_scatter))
    for median, scatter in pairs:
        with np.errstate(invalid="ignore"):
            limit = np.minimum(THRESHOLD * (scatter + NOISE_VOXEL), LARGEST_PART * np.asarray(search))
            agrees |= (np.abs(field - median) <= limit).all(-1)
    return agrees


def fill(field: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Replace vectors that are not valid by predictions from their neighbours, from the rim of each gap inwards."""
    filled = np.where(valid[..., None], field, np.nan)
    known = valid.copy()
    while known.any() and not known.all():
        rim = ~known & scipy.ndimage.binary_dilation(known, _CUBE)
        prediction = predict(filled, known, rim)
        filled[rim] = np.clip(prediction.level, prediction.lowest, prediction.highest)  # do not extrapolate gradients
        known |= rim
    return filled
