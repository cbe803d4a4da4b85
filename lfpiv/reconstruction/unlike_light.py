"""Measure how much cameras ask for unlike light, as they do where they see particles unlike bright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LEAST_SUM = 0.02
"""Least sum of the weights of a voxel that a camera sees, as a share of its largest one."""


def unlike_light(exponents: Sequence[np.ndarray], sums: Sequence[np.ndarray], volume: np.ndarray) -> float:
    """Return how much cameras ask for unlike light, a number without unit; 0 for a single camera.

    A camera asks for the mean log(I / P) of a voxel's rays, I recorded and P projected. The square of the result is the
    variance of these means between the cameras, less the square of their mean, averaged with the volume as weights.
    Where it is negative, the result is 0.

    Parameters
    ----------
    exponents, sums : sequence of ndarray, shape (voxel,)
        Of each camera the back-projected logarithms, and the sum of each voxel's weights.
    volume : ndarray, shape (voxel,)
        Light of the voxels [counts].
    """
    seen = np.all([own > LEAST_SUM * own.max() for own in sums], axis=0) & (volume > 0)
    if len(sums) < 2 or not seen.any():
        return 0.0
    asked = np.stack([one[seen] / own[seen] for one, own in zip(exponents, sums, strict=True)])
    beyond = np.average(asked.var(axis=0, ddof=1) - asked.mean(axis=0) ** 2, weights=volume[seen])
    return float(np.sqrt(max(beyond, 0.0)))
