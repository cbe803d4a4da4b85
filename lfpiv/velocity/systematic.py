"""Systematic part of the uncertainty of vectors, from the light that volumes do not explain.

Correlation statistics show what differs between two volumes. Ghosts, particles of unlike brightness in the cameras and
light from beyond the volume move alike in both, so that part of the error does not show. The residual of the images
measures how much of a volume is wrong. The same wrong light makes the random part. So one systematic variance is a
share of the typical random variance. The share is proportional to the residual, as variances of independent sources
add up. Where particles are smaller than voxels, most of the residual is their form. It moves as they do, so less of it
counts. Cameras that see particles unlike bright ask for unlike light. Its errors are alike in successive volumes.
Ghosts move with the mean of the particles on the lines of sight that cross in them [1]_. So another systematic part is
proportional to the difference between a vector and the mean of the volume.

References
----------
.. [1] G. E. Elsinga, J. Westerweel, F. Scarano, M. Novara, "On the velocity of ghost particles and the bias errors in
   Tomographic-PIV", Exp. Fluids 50 (2011) 825-838, doi:10.1007/s00348-010-0930-0.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

RANDOM_SHARE = 5.0
"""Systematic variance over the square of the median random standard deviation, at a residual of 1."""
POINT_SHARE = 2.0
"""The same for volumes of particles that are smaller than voxels, which are made without a sieve."""
UNLIKE_SHARE = 400.0
"""The same over the square of the unlike light that cameras ask for, which volumes of a time series state."""
DAMPING = 0.05
"""Share by which ghosts pull a vector towards the mean of the volume."""


def systematic_share(*volumes: xr.DataArray | np.ndarray) -> float:
    """Return the systematic variance over the square of the median random standard deviation; the largest counts.

    It is `RANDOM_SHARE` or `POINT_SHARE` times the final residual of the images, ||I - P|| / ||I||, and `UNLIKE_SHARE`
    times the square of how much the cameras ask for unlike light. Volumes of `lfpiv.reconstruct` have the residual as
    an attribute, one value per iteration, NaN where it was not measured; the last one that was measured counts. Volumes
    of a time series have the attribute ``unlike`` as well. 0 if none states either.
    """
    shares = [0.0]
    for volume in volumes:
        if isinstance(volume, xr.DataArray) and "residual" in volume.attrs:
            share = RANDOM_SHARE if volume.attrs.get("sieve_voxel", 0.0) > 0 else POINT_SHARE
            residual = np.atleast_1d(volume.attrs["residual"]).astype(float)
            unlike = UNLIKE_SHARE * float(volume.attrs.get("unlike", 0.0)) ** 2
            shares.extend(share * residual[np.isfinite(residual)][-1:] + unlike)
    return float(max(shares))


def with_systematic(random: np.ndarray, field: np.ndarray, valid: np.ndarray, share: float) -> np.ndarray:
    """Add the systematic part to standard deviations of displacements.

    With the random standard deviation s of a component, its median over the valid vectors s', the displacement d, its
    mean over the valid vectors d' and the share q, it is ``sqrt(s^2 + q s'^2 + (0.05 (d - d'))^2)``.

    Parameters
    ----------
    random : ndarray, shape (z, y, x, 3)
        Standard deviation from the correlation statistics [voxel]; NaN where a vector was replaced.
    field : ndarray, shape (z, y, x, 3)
        Displacement [voxel].
    valid : ndarray of bool, shape (z, y, x)
        Vectors that were measured.
    share : float
        From `systematic_share`; 0 adds nothing.

    Returns
    -------
    ndarray, shape (z, y, x, 3)
        Standard deviation [voxel]; NaN where `random` is.
    """
    known = np.isfinite(random).all(-1) & valid
    if share == 0 or not known.any():
        return random
    typical, mean = np.median(random[known], axis=0), field[known].mean(axis=0)
    systematic = share * typical**2 + (DAMPING * (field - mean)) ** 2
    return np.sqrt(random**2 + systematic)


def variance_without_ghosts(stated: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the variances of stated standard deviations without the assumed share of ghosts [voxel^2].

    Parameters
    ----------
    stated : ndarray
        From `with_systematic`, of one component [voxel].
    distance : ndarray
        Displacement minus its mean over the valid vectors [voxel].
    """
    return np.maximum(np.square(stated, dtype=float) - (DAMPING * distance) ** 2, 0)
