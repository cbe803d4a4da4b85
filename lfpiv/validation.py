"""Vector validation: the normalised median test of Westerweel & Scarano (2005) [1]_, replacement and filling.

Fields are arrays (z, y, x, 3) of displacements [voxel]; a neighbourhood is the 26 grid points around one.

References
----------
.. [1] J. Westerweel, F. Scarano, "Universal outlier detection for PIV data", Exp. Fluids 39 (2005) 1096-1100,
   doi:10.1007/s00348-005-0016-6.
"""

from __future__ import annotations

import numpy as np

THRESHOLD = 2.0
"""Largest normalised residual of a good vector, the value of [1]_."""
NOISE_VOXEL = 0.1
"""Displacement noise that is no outlier wherever the neighbours agree perfectly (epsilon of [1]_) [voxel]."""
MIN_NEIGHBOURS = 3
"""A vector with fewer good neighbours cannot be judged; it is rejected unless the grid itself has no more."""

_ROUNDS = 4
_OFFSET = np.array([-1.0, 0.0, 1.0])


def neighbourhoods(field: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Collect the neighbours of every grid point.

    Parameters
    ----------
    field : ndarray, shape (z, y, x, component)
    keep : ndarray of bool, shape (z, y, x)
        Vectors that may be used.

    Returns
    -------
    ndarray, shape (z, y, x, component, 3, 3, 3)
        NaN in the middle and where a neighbour is outside the grid or not kept.
    """
    padded = np.pad(np.where(keep[..., None], field, np.nan), [(1, 1)] * 3 + [(0, 0)], constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3, 3), axis=(0, 1, 2)).copy()
    around[..., 1, 1, 1] = np.nan
    return around


def _median(values: np.ndarray) -> np.ndarray:
    """Median over the last three axes without NaNs, NaN where nothing is left; much faster than ``nanmedian``."""
    ordered = np.sort(values.reshape(*values.shape[:-3], -1), axis=-1)  # NaNs go last
    count = np.isfinite(ordered).sum(-1, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=-1)
    high = np.take_along_axis(ordered, count // 2, axis=-1)
    return np.where(count > 0, 0.5 * (low + high), np.nan)[..., 0]


def predict(around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Predict vectors from their neighbours, and how far these scatter about the prediction.

    Parameters
    ----------
    around : ndarray, shape (..., 3, 3, 3)
        From `neighbourhoods`.

    Returns
    -------
    median, scatter : ndarray, shape (...)
        Median of the neighbours and the median of their distances from it; NaN without neighbours.
    """
    median = _median(around)
    return median, _median(np.abs(around - median[..., None, None, None]))


def remove_gradient(around: np.ndarray) -> np.ndarray:
    """Move neighbours to the middle along the local gradient, the median of the differences between them.

    At the edges of a grid, where neighbours lie on one side only, a median alone is off by a step of the gradient.
    """
    level = around
    for axis in (-3, -2, -1):
        slope = np.nan_to_num(_median(np.diff(around, axis=axis)))[..., None, None, None]
        level = level - slope * np.expand_dims(_OFFSET, [k for k in (-3, -2, -1) if k != axis])
    return level


class _Test:
    """The normalised median test against one set of neighbours, and against the same without their gradient."""

    def __init__(self, around: np.ndarray):
        self.predictions = [predict(around), predict(remove_gradient(around))]

    def passed(self, field: np.ndarray) -> np.ndarray:
        """Whether vectors agree with their neighbours in every component, in one of the two ways."""
        agrees = np.zeros(field.shape[:-1], bool)
        for median, scatter in self.predictions:
            with np.errstate(invalid="ignore"):
                agrees |= (np.abs(field - median) <= THRESHOLD * (scatter + NOISE_VOXEL)).all(-1)
        return agrees


def validate(first: np.ndarray, second: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Test the displacement of the highest peaks, try the second peak where it fails, fill what remains.

    Parameters
    ----------
    first, second : ndarray, shape (z, y, x, 3)
        Displacement of the highest and of the second peak [voxel]; NaN where there is none.
    measured : ndarray of bool, shape (z, y, x)
        Where `first` may be trusted at all.

    Returns
    -------
    field : ndarray, shape (z, y, x, 3)
        Displacement at every grid point: measured, or predicted by its neighbours; NaN only if no vector is valid.
    valid : ndarray of bool, shape (z, y, x)
        True where `field` is a measured peak that passed the test.
    """
    possible = np.isfinite(neighbourhoods(np.zeros((*measured.shape, 1)), np.ones_like(measured))).sum((-1, -2, -3))
    needed = np.minimum(MIN_NEIGHBOURS, possible[..., 0])
    valid = measured
    for _ in range(_ROUNDS):  # rejected vectors no longer count as neighbours, so others may pass again
        around = neighbourhoods(first, valid)
        judged = np.isfinite(around[..., 0, :, :, :]).sum((-1, -2, -3)) >= needed
        test = _Test(around)
        passed = measured & judged & (test.passed(first) | (needed == 0))
        if (passed == valid).all():
            break
        valid = passed
    rescued = ~valid & judged & test.passed(second)
    return fill(np.where(rescued[..., None], second, first), valid | rescued), valid | rescued


def fill(field: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Replace vectors that are not valid by what their neighbours predict, from the rim of each hole inwards."""
    filled = np.where(valid[..., None], field, np.nan)
    known = valid.copy()
    while known.any() and not known.all():
        around = neighbourhoods(filled, known)
        rim = ~known & np.isfinite(around[..., 0, :, :, :]).any((-1, -2, -3))
        around = around[rim]
        predicted, _ = predict(remove_gradient(around))
        lowest, highest = np.nanmin(around, axis=(-1, -2, -3)), np.nanmax(around, axis=(-1, -2, -3))
        filled[rim] = np.clip(predicted, lowest, highest)  # a gradient must not run away across a hole
        known |= rim
    return filled
