"""Systematic part of the uncertainty of vectors, from the light that volumes do not explain.

Correlation statistics show what differs between two volumes. Ghosts, particles of unlike brightness in the cameras and
light from beyond the volume move alike in both, so that part of the error does not show. The residual of the images
measures how much of a volume is wrong. The same wrong light makes the random part, so the systematic one follows its
typical size, and the difference of a vector from its neighbours, which ghosts smooth out.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage
import xarray as xr

RANDOM_SHARE, SMOOTHED_SHARE = 2.45, 0.5
"""Systematic standard deviation over the residual: as a multiple of the median random one, and of the difference from
the mean of the neighbours."""

_NEIGHBOURS = np.ones((3, 3, 3))
_NEIGHBOURS[1, 1, 1] = 0


def image_residual(*volumes: xr.DataArray | np.ndarray) -> float:
    """Return the largest final residual of volumes, ||I - P|| / ||I||; 0 if one does not state it.

    Volumes of `lfpiv.reconstruct` have it as the attribute ``residual``, one value per iteration.
    """
    stated = [volume.attrs.get("residual") if isinstance(volume, xr.DataArray) else None for volume in volumes]
    return max(0.0 if values is None else float(np.atleast_1d(values)[-1]) for values in stated)


def with_systematic(random: np.ndarray, field: np.ndarray, valid: np.ndarray, residual: float) -> np.ndarray:
    """Add the systematic part to standard deviations of displacements.

    With the random standard deviation s of a component, its median over the valid vectors s', the displacement d, the
    mean of its valid neighbours d' and the residual r, it is ``sqrt(s^2 + r^2 ((2.45 s')^2 + (0.5 (d - d'))^2))``.

    Parameters
    ----------
    random : ndarray, shape (z, y, x, 3)
        Standard deviation from the correlation statistics [voxel]; NaN where a vector was replaced.
    field : ndarray, shape (z, y, x, 3)
        Displacement [voxel].
    valid : ndarray of bool, shape (z, y, x)
        Vectors that were measured.
    residual : float
        From `image_residual`; 0 adds nothing.

    Returns
    -------
    ndarray, shape (z, y, x, 3)
        Standard deviation [voxel]; NaN where `random` is.
    """
    known = np.isfinite(random).all(-1) & valid
    if residual == 0 or not known.any():
        return random
    count = scipy.ndimage.convolve(valid.astype(float), _NEIGHBOURS, mode="constant")
    inside = np.where(valid[..., None], field, 0.0)
    around = [scipy.ndimage.convolve(inside[..., k], _NEIGHBOURS, mode="constant") for k in range(3)]
    mean = np.stack(around, -1) / np.maximum(count, 1)[..., None]
    smoothed = np.where(count[..., None] > 0, field - mean, 0.0)
    typical = np.median(random[known], axis=0)
    systematic = residual**2 * ((RANDOM_SHARE * typical) ** 2 + (SMOOTHED_SHARE * smoothed) ** 2)
    whole: np.ndarray = np.sqrt(random**2 + systematic)
    return whole
