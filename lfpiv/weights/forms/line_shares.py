"""Shares of a voxel on the lines of sight on either side of it: interpolation across the line of sight.

Voxels that lie along a row meet lines of sight that lie along the same row, a voxel apart, some part of a voxel aside.
The image of a voxel, as a function of its place on the row, is smooth only as far as particles are: sums of voxels that
make a blob are interpolated well, a single voxel is not. So the shares are the best for a blob: those of universal
kriging [1]_ with a Gaussian autocovariance, exact for images that change linearly with the place.

.. [1] N. Cressie, "Statistics for spatial data", Wiley 1993, section 3.4, doi:10.1002/9781119115151.
"""

from __future__ import annotations

import numpy as np

LINES = 6
"""Lines of sight among which a voxel is shared along an axis."""
BEFORE = LINES // 2 - 1
"""Lines of sight used below a voxel, beside the nearest line."""
VARIANCE_VOXEL = 0.8
"""Variance of the image of a blob across the line of sight that the shares are made for [voxel^2]."""


def line_shares(place: np.ndarray) -> np.ndarray:
    """Return the shares of voxels on the lines of sight at -2, -1, ..., 3.

    Parameters
    ----------
    place : ndarray, shape (layer,)
        Places of the voxels between the lines of sight at 0 and 1 [voxel].

    Returns
    -------
    ndarray, shape (layer, 6), float64
        Their sum is 1, and their mean place that of the voxel.
    """
    lines = np.arange(LINES) - BEFORE
    exact = np.stack([np.ones(LINES), lines])
    kriging = np.block([[_covariance(lines[:, None] - lines), exact.T], [exact, np.zeros((2, 2))]])
    sides = np.concatenate([_covariance(lines[:, None] - place), np.ones((1, len(place))), place[None]])
    return np.linalg.solve(kriging, sides)[:LINES].T


def _covariance(distance: np.ndarray) -> np.ndarray:
    """Return the autocovariance of the image at a distance [voxel], relative to that at none."""
    return np.exp(-np.square(distance) / (4 * VARIANCE_VOXEL))
