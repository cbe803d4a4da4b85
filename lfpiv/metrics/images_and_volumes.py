"""Quality factor of volumes, similarity of images, and errors of reconstructed board dots.

Equation numbers are the paper's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from skimage.metrics import structural_similarity

from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import POSITION_TOLERANCE_MM, checked_volume

SSIM_SIGMA = 1.5
"""Standard deviation of the Gaussian window of the structural similarity [pixel]."""
SSIM_WINDOW = 11
"""Edge of the Gaussian window [pixel]."""


# -- volumes and images ------------------------------------------------------------------------------------------------


def reconstruction_quality(
    volume: xr.DataArray | np.ndarray, truth: xr.DataArray | np.ndarray, *, zero_mean: bool = False
) -> float:
    """Compute the quality factor Q of a reconstruction, defined by Elsinga et al. 2006 [1]_ and used by the paper.

    Q = sum(E E0) / sqrt(sum(E^2) sum(E0^2)) over all voxels, with E the reconstruction and E0 the truth. It is 1 for
    proportional volumes and independent of the scale of either. Q depends on the size of the true particles: see
    `truth_volume`.

    Parameters
    ----------
    volume, truth : DataArray or ndarray, shape (z, y, x)
        Finite intensities on the same voxels.
    zero_mean : bool
        Subtract the mean of each volume first, which gives the correlation coefficient, -1 to 1. A uniform haze does
        not raise it. The paper does not subtract the mean. For sparse particles the two nearly agree.

    Raises
    ------
    ValueError
        If shapes or coordinates differ, or a volume is not finite or has no contrast, so that Q is undefined.

    References
    ----------
    .. [1] G. E. Elsinga et al., "Tomographic particle image velocimetry", Exp. Fluids 41 (2006) 933-947,
       doi:10.1007/s00348-006-0212-z.

    Examples
    --------
    >>> import numpy as np
    >>> from lfpiv import metrics
    >>> truth = np.zeros((3, 3, 3))
    >>> truth[1, 1, 1] = 1.0
    >>> with_ghost = 5 * truth
    >>> with_ghost[0, 0, 0] = 5.0  # as bright as the particle
    >>> metrics.reconstruction_quality(5 * truth, truth), round(metrics.reconstruction_quality(with_ghost, truth), 3)
    (1.0, 0.707)
    """
    if np.shape(volume) != np.shape(truth):
        raise ValueError(f"truth: expected the shape of the volume, {np.shape(volume)}, got {np.shape(truth)}.")
    grids, values = [], []
    for name, given in (("volume", volume), ("truth", truth)):
        labelled = isinstance(given, xr.DataArray)
        stand_in = None if labelled else Grid(shape=np.shape(given), voxel_mm=1.0, first_centre_mm=(0.0, 0.0, 0.0))
        value, grid = checked_volume(given, stand_in, name)
        values.append(value.astype(float) - (value.mean(dtype=float) if zero_mean else 0.0))
        grids += [np.append(grid.first_centre_mm, grid.voxel_mm)] if labelled else []
        if not values[-1].any():
            raise ValueError(f"{name}: expected some contrast, got {'a uniform' if zero_mean else 'an empty'} volume.")
    if len(grids) == 2 and np.abs(grids[0] - grids[1]).max() > POSITION_TOLERANCE_MM:
        raise ValueError("truth: expected the coordinates of the volume, got others. Draw the truth on the same grid.")
    return float(np.vdot(*values) / np.sqrt(np.vdot(values[0], values[0]) * np.vdot(values[1], values[1])))


def relative_l2(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute the relative L2 difference ||image - reference|| / ||reference|| of two arrays of equal shape.

    Raises
    ------
    ValueError
        If shapes differ, values are not finite, or the reference is zero everywhere.
    """
    image, reference = _checked_pair(image, reference)
    if not reference.any():
        raise ValueError("reference: expected values other than zero, got none.")
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def weight_ssim(first: np.ndarray, second: np.ndarray, *, crop: bool = True) -> float:
    """Compute the structural similarity [1]_ of two images of a voxel's weights (Fig. 10) by scikit-image.

    Settings: Gaussian window of 1.5 pixel standard deviation (11 x 11), population covariance, K1 = 0.01, K2 = 0.03,
    data range from 0 to the largest value of both images. The paper does not state its settings. The result is the mean
    over the bounding box of all lit pixels: the dark rest of the sensor is equal in any two images and would bring
    every result close to 1. It is symmetric in the two images and independent of their common scale.

    Parameters
    ----------
    first, second : ndarray, shape (rows, columns)
        Finite weights or counts >= 0.
    crop : bool
        Average over the bounding box. False averages over the whole image except a border of half a window.

    Returns
    -------
    float
        At most 1, for equal images.

    Raises
    ------
    ValueError
        If shapes differ, values are not finite or negative, both images are dark, or they are smaller than the window.

    References
    ----------
    .. [1] Z. Wang, A. C. Bovik, H. R. Sheikh, E. P. Simoncelli, "Image quality assessment: from error visibility to
       structural similarity", IEEE Trans. Image Process. 13 (2004) 600-612, doi:10.1109/TIP.2003.819861.
    """
    first, second = _checked_pair(first, second, ("first", "second"))
    if first.ndim != 2 or (first < 0).any() or (second < 0).any():
        raise ValueError(f"first, second: expected images (rows, columns) >= 0, got shape {first.shape} or negatives.")
    lit = (first > 0) | (second > 0)
    if not lit.any():
        raise ValueError("first, second: expected some light, got none. Does the camera see the voxel?")
    if crop:  # pad with zeros in case lit pixels touch the border
        half = SSIM_WINDOW // 2
        ends = [np.flatnonzero(lit.any(1 - axis))[[0, -1]] for axis in (0, 1)]
        box = tuple(slice(int(low), int(high) + 2 * half + 1) for low, high in ends)
        first, second = (np.pad(image, half)[box] for image in (first, second))
    if min(first.shape) < SSIM_WINDOW:
        raise ValueError(f"first, second: expected at least {SSIM_WINDOW} pixels a side, got {first.shape}.")
    return float(
        structural_similarity(
            first,
            second,
            gaussian_weights=True,
            sigma=SSIM_SIGMA,
            use_sample_covariance=False,
            data_range=max(first.max(), second.max()),
        )
    )


# -- dots of a board ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class DotError:
    """Errors of reconstructed board dots; see `dot_error`."""

    lateral_mm: np.ndarray
    """sigma_l of each plane, Eq. 18 [mm], shape (plane,); NaN where no two neighbours were found."""
    depth_mm: np.ndarray
    """sigma_d between each plane and the next, Eq. 19 [mm], shape (plane - 1,); NaN where no dot was found in both."""
    lateral_mean_mm: float
    """Mean over all spacings of all planes [mm]."""
    depth_mean_mm: float
    """Mean over all depth intervals [mm]."""
    found: int
    """Number of dots with a position."""


def dot_error(positions_mm: np.ndarray, spacing_mm: float, planes_mm: Sequence[float]) -> DotError:
    """Compute lateral and depth errors of reconstructed board dots, Eqs. 18 and 19.

    sigma_l is the mean of ``|l_r - l_t|``, with l_r the distance in x and y between neighbours along a row or column
    and l_t the true spacing. sigma_d is the mean of ``|d_r - d_t|``, with d_r the distance along z of a dot on adjacent
    planes and d_t the true interval. Each pair of dots is used once. A common shift of all dots has no effect. The
    board is assumed to be parallel to x-y and to move along z, in the order of the planes.

    Parameters
    ----------
    positions_mm : ndarray, shape (plane, row, column, 3)
        Reconstructed dots (x, y, z) [mm], at least 2 x 2 per plane. Dots that were not found are NaN in all three.
    spacing_mm : float
        True distance of adjacent dots [mm].
    planes_mm : sequence of float
        True z of each plane [mm].

    Raises
    ------
    ValueError
        If shapes do not match, a position is infinite or partly NaN, or no two neighbours were found.

    Examples
    --------
    A board of 3 x 2 dots in two planes, 2 % too large and the planes 0.1 mm too far apart:

    >>> import numpy as np
    >>> from lfpiv import metrics
    >>> z, y, x = np.meshgrid([-1.05, 1.05], [0.0, 1.02], [-1.02, 0.0, 1.02], indexing="ij")
    >>> error = metrics.dot_error(np.stack([x, y, z], axis=-1), spacing_mm=1.0, planes_mm=[-1, 1])
    >>> error.lateral_mm.round(3).tolist(), error.depth_mm.round(3).tolist()
    ([0.02, 0.02], [0.1])
    """
    positions, planes = np.asarray(positions_mm, float), np.asarray(planes_mm, float)
    if positions.ndim != 4 or positions.shape[3] != 3 or min(positions.shape[1:3]) < 2:
        raise ValueError(f"positions_mm: expected shape (plane, row, column, 3), >= 2 x 2 dots, got {positions.shape}.")
    if planes.shape != positions.shape[:1] or not np.isfinite(planes).all():
        raise ValueError(f"planes_mm: expected one finite z per plane ({len(positions)}), got shape {planes.shape}.")
    if not (np.isfinite(spacing_mm) and spacing_mm > 0):
        raise ValueError(f"spacing_mm: expected a distance > 0 [mm], got {spacing_mm!r}.")
    missing = np.isnan(positions)
    if np.isinf(positions).any() or (missing.any(-1) != missing.all(-1)).any():
        raise ValueError("positions_mm: expected finite positions, or NaN in all three for a dot that was not found.")
    lateral = np.concatenate(
        [
            np.linalg.norm(np.diff(positions[..., :2], axis=axis), axis=-1).reshape(len(positions), -1)
            for axis in (1, 2)
        ],
        axis=1,
    )
    lateral = np.abs(lateral - spacing_mm)
    depth = np.abs(np.diff(positions[..., 2], axis=0) - np.diff(planes)[:, None, None])
    if np.isnan(lateral).all():
        raise ValueError("positions_mm: expected neighbouring dots on some plane, got none that were found.")
    return DotError(
        lateral_mm=_row_means(lateral),
        depth_mm=_row_means(depth.reshape(len(depth), positions.shape[1] * positions.shape[2])),
        lateral_mean_mm=float(np.nanmean(lateral)),
        depth_mean_mm=float(_row_means(depth.reshape(1, -1))[0]),
        found=int((~missing.any(-1)).sum()),
    )


def _row_means(values: np.ndarray) -> np.ndarray:
    """Return the mean of each row without NaN; NaN for a row of NaN."""
    count = np.isfinite(values).sum(1)
    means = np.full(len(values), np.nan)
    np.divide(np.nansum(values, axis=1), count, out=means, where=count > 0)
    return means


def _checked_pair(
    first: ArrayLike, second: ArrayLike, names: tuple[str, str] = ("image", "reference")
) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.asarray(first, float), np.asarray(second, float)
    if first.shape != second.shape or first.size == 0:
        raise ValueError(f"{names[1]}: expected the shape of {names[0]}, {first.shape}, got {second.shape}.")
    for name, values in zip(names, (first, second), strict=True):
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: expected finite values, found NaN or infinity.")
    return first, second
