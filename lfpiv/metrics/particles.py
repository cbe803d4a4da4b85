"""Particles in a volume: true particles drawn on a grid, peaks of a reconstruction, and their comparison.

A reconstructed particle is a local maximum of the volume. Peaks without a true particle are ghosts. Points are (x, y,
z) [mm]. Volumes (z, y, x) are DataArrays with coordinates in mm, or ndarrays with a `Grid`. Equation numbers are the
paper's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import ndimage, sparse, special
from scipy.spatial import cKDTree

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.geometry.volume import checked_points, checked_volume, voxel_place

PEAK_SHARE = 0.1
"""Default threshold of a peak, as a part of the median brightness at the true particles."""

LOWEST_NEIGHBOUR = 1e-3
"""Lower limit of the brightness of a peak's neighbours in the Gaussian fit, as a part of the peak."""

BLOB_REACH = 5.0
"""Distance at which Gaussian blobs are cut off [standard deviations]."""

_CHUNK = 1 << 22  # values of blobs per batch
# offsets (z, y, x) of the neighbours that come before a voxel in storage order
_BEFORE = np.array([(z, y, x) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if (z, y, x) < (0, 0, 0)])


@dataclass(frozen=True, kw_only=True)
class Particles:
    """Peaks of a volume, brightest first."""

    positions_mm: np.ndarray
    """Sub-voxel positions (x, y, z) [mm], shape (particle, 3)."""
    peaks: np.ndarray
    """Brightness of the voxel at the peak [unit of the volume], shape (particle,)."""
    sigma_voxel: np.ndarray
    """Standard deviation of the fitted Gaussian along (x, y, z) [voxel], shape (particle, 3). NaN along an axis where
    the peak is in the outermost voxel or both neighbours are as bright as the peak."""

    def __len__(self) -> int:
        return len(self.peaks)


@dataclass(frozen=True, kw_only=True)
class ParticleQuality:
    """Agreement of the peaks of a volume with the true particles; see `particle_quality`."""

    true_count: int
    """True particles inside the grid, n_tr."""
    found_count: int
    """Peaks above the threshold, n_re."""
    matched_count: int
    """Pairs of a true particle and a peak, one to one."""
    accuracy: float
    """R_acc, Eq. 13."""
    ghost_ratio: float
    """R_g = n_re / n_tr, Eq. 14."""
    precision: float
    """Matched peaks over all peaks; NaN without peaks."""
    recall: float
    """Matched true particles over all true particles."""
    bias_mm: tuple[float, float, float]
    """Mean of found minus true position of the pairs along (x, y, z) [mm]; NaN without pairs."""
    rms_mm: tuple[float, float, float]
    """Root mean square of found minus true position of the pairs along (x, y, z) [mm]; NaN without pairs."""
    elongation: float
    """Median over the matched peaks of sigma_z / sqrt(sigma_x sigma_y), 1 for round particles; NaN without a fit."""
    threshold: float
    """Brightness that peaks exceed [unit of the volume]."""


def truth_volume(
    positions_mm: np.ndarray, intensities: np.ndarray | float | None, grid: Grid, sigma_voxel: float = 0.7
) -> xr.DataArray:
    """Draw true particles on a grid, as the truth of the quality factor Q.

    Each particle is a Gaussian blob, integrated over each voxel. The light of a particle therefore does not depend on
    its place between the voxels. With sigma 0 it lights one voxel. Particles outside the grid add the part of their
    light that reaches in.

    Parameters
    ----------
    positions_mm : ndarray, shape (particle, 3)
        Positions (x, y, z) [mm].
    intensities : ndarray of shape (particle,) or float, optional
        Light of each particle, >= 0. Default: 1.
    grid : Grid
        Voxels.
    sigma_voxel : float
        Standard deviation of the blobs [voxel], >= 0.

    Returns
    -------
    DataArray, shape (z, y, x), float32
        Light per voxel [unit of the intensities].

    Raises
    ------
    ValueError
        If an argument has the wrong shape, is not finite, or is negative where it must not be.
    """
    positions_mm = checked_points(positions_mm, "positions_mm")
    light = np.ones(len(positions_mm)) if intensities is None else np.asarray(intensities, float)
    if light.shape not in ((), (len(positions_mm),)) or not np.isfinite(light).all() or (light < 0).any():
        raise ValueError(
            f"intensities: expected finite numbers >= 0, one or one per position ({len(positions_mm)}), got shape "
            f"{light.shape}."
        )
    light = np.broadcast_to(light, len(positions_mm))
    if not (np.isfinite(sigma_voxel) and sigma_voxel >= 0):
        raise ValueError(f"sigma_voxel: expected a number >= 0, got {sigma_voxel!r}.")
    volume = _draw_blobs(voxel_place(positions_mm, grid), light, grid.shape, sigma_voxel)
    return xr.DataArray(
        volume.astype(np.float32),
        dims=AXES,
        coords=grid.coordinates(),
        name="intensity",
        attrs={"long_name": "light of the true particles", "sigma_voxel": sigma_voxel, "voxel_mm": grid.voxel_mm},
    )


def _draw_blobs(place: np.ndarray, light: np.ndarray, shape: tuple[int, int, int], sigma: float) -> np.ndarray:
    """Add up Gaussian blobs at fractional voxel indices (particle, 3), integrated over each voxel."""
    reach = int(np.ceil(BLOB_REACH * sigma + 0.5))
    offset = np.arange(-reach, reach + 1)
    near = ((place > -0.5 - reach) & (place < np.array(shape) - 0.5 + reach)).all(1)
    place, light = place[near], light[near]
    volume = np.zeros(shape)
    step = max(1, _CHUNK // len(offset) ** 3)
    for first in range(0, len(place), step):
        part = place[first : first + step]
        shares, indices = [], []
        for axis in range(3):
            index = np.floor(part[:, axis, None] + 0.5).astype(int) + offset
            edges = np.concatenate([index - 0.5, index[:, -1:] + 0.5], axis=1) - part[:, axis, None]
            below = special.ndtr(edges / sigma) if sigma > 0 else (edges > 0).astype(float)
            inside = (index >= 0) & (index < shape[axis])
            shares.append(np.diff(below, axis=1) * inside)
            indices.append(np.where(inside, index, 0))
        blobs = np.einsum("n,nz,ny,nx->nzyx", light[first : first + step], *shares)
        z, y, x = indices
        np.add.at(volume, (z[:, :, None, None], y[:, None, :, None], x[:, None, None, :]), blobs)
    return volume


def find_particles(volume: xr.DataArray | np.ndarray, threshold: float, *, grid: Grid | None = None) -> Particles:
    """Find the particles of a volume: local maxima among the 26 neighbours, with sub-voxel positions and widths.

    A three-point Gaussian fit along each axis gives position and width. Among equal neighbours the first in storage
    order is the peak. Particles are assumed to be about as small as a voxel. Particles that merge into one maximum are
    found as one.

    Parameters
    ----------
    volume : DataArray or ndarray, shape (z, y, x)
        Finite intensities.
    threshold : float
        Brightness that a peak must exceed [unit of the volume], >= 0.
    grid : Grid, optional
        Voxels of an ndarray.

    Raises
    ------
    ValueError
        If the volume has the wrong shape or is not finite, or the threshold is negative.
    """
    values, grid = checked_volume(volume, grid, "volume")
    if not (np.isfinite(threshold) and threshold >= 0):
        raise ValueError(f"threshold: expected a number >= 0 in the unit of the volume, got {threshold!r}.")
    index, padded = _peaks(values, threshold)
    peak = values[tuple(index.T)].astype(float)
    offset, sigma = np.zeros((len(peak), 3)), np.full((len(peak), 3), np.nan)
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        lower, upper = (padded[tuple((index + 1 + sign * step).T)].astype(float) for sign in (-1, 1))
        inside = np.isfinite(lower) & np.isfinite(upper)
        lower, upper = (np.log(np.maximum(side / peak, LOWEST_NEIGHBOUR)) for side in (lower, upper))
        fitted = inside & (lower + upper < 0)
        curvature = np.where(fitted, -(lower + upper), 1.0)
        offset[fitted, axis] = ((upper - lower) / (2 * curvature))[fitted]
        sigma[fitted, axis] = (1 / np.sqrt(curvature))[fitted]
    positions = np.asarray(grid.first_centre_mm) + (index + offset) * grid.voxel_mm
    return Particles(positions_mm=positions[:, ::-1].copy(), peaks=peak, sigma_voxel=sigma[:, ::-1].copy())


def _peaks(values: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the voxel indices (peak, 3) of local maxima, brightest first, and the volume padded by one voxel."""
    highest = ndimage.maximum_filter(values, size=3, mode="nearest")
    index = np.argwhere((values == highest) & (values > threshold))
    padded = np.pad(values, 1, constant_values=-np.inf)
    before = padded[tuple(np.moveaxis(index[:, None] + 1 + _BEFORE, -1, 0))]
    index = index[~(before == values[tuple(index.T)][:, None]).any(1)]
    return index[np.argsort(-values[tuple(index.T)].astype(float), kind="stable")], padded


def match_particles(found_mm: np.ndarray, true_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Match found and true particles one to one: as many pairs as possible, then the least total distance.

    Parameters
    ----------
    found_mm, true_mm : ndarray, shape (particle, 3)
        Positions (x, y, z) [mm].
    radius_mm : float
        Largest distance of a pair, Euclidean [mm], > 0.

    Returns
    -------
    ndarray, shape (pair, 2), int
        Indices (found, true), in the order of the true particles.

    Raises
    ------
    ValueError
        If positions are not finite or have the wrong shape, or the radius is not positive.
    """
    found_mm, true_mm = checked_points(found_mm, "found_mm"), checked_points(true_mm, "true_mm")
    if not (np.isfinite(radius_mm) and radius_mm > 0):
        raise ValueError(f"radius_mm: expected a length > 0 [mm], got {radius_mm!r}.")
    near = cKDTree(true_mm).sparse_distance_matrix(cKDTree(found_mm), radius_mm, output_type="coo_matrix")
    if near.nnz == 0:
        return np.empty((0, 2), int)
    rows, inverse = np.unique(near.row, return_inverse=True)
    count = len(rows)
    # one more column per true particle leaves it unmatched, at a cost above the sum of all distances; no cost is zero
    unmatched = (count + 1) * 2.0
    cost = np.concatenate([1 + near.data / radius_mm, np.full(count, 1 + unmatched)])
    row = np.concatenate([inverse, np.arange(count)])
    column = np.concatenate([near.col, len(found_mm) + np.arange(count)])
    graph = sparse.csr_array((cost, (row, column)), shape=(count, len(found_mm) + count))
    row, column = sparse.csgraph.min_weight_full_bipartite_matching(graph)
    paired = column < len(found_mm)
    return np.stack([column[paired], rows[row[paired]]], axis=1)


def reconstruction_accuracy(found_mm: np.ndarray, true_mm: np.ndarray, voxel_mm: float) -> float:
    """Compute R_acc = #VD / (#VD + #ID), Eq. 13: the part of the true particles with exactly one peak nearby.

    A detection is valid (VD) if a single peak lies within a chessboard distance of 1 voxel of the true particle, and
    invalid (ID) if there is none or several. Distances are between sub-voxel positions. The peak of a true neighbour
    within that distance makes a detection invalid too: with n particles per voxel, a perfect reconstruction reaches
    about exp(-8 n).

    Parameters
    ----------
    found_mm, true_mm : ndarray, shape (particle, 3)
        Positions (x, y, z) [mm]; at least one true one.
    voxel_mm : float
        Voxel edge [mm].

    Returns
    -------
    float
        0 to 1.
    """
    found_mm, true_mm = checked_points(found_mm, "found_mm"), checked_points(true_mm, "true_mm")
    if len(true_mm) == 0:
        raise ValueError("true_mm: expected at least one true particle, got none.")
    if not (np.isfinite(voxel_mm) and voxel_mm > 0):
        raise ValueError(f"voxel_mm: expected a length > 0 [mm], got {voxel_mm!r}.")
    if len(found_mm) == 0:
        return 0.0
    around = cKDTree(found_mm).query_ball_point(true_mm, voxel_mm * (1 + 1e-9), p=np.inf, return_length=True)
    return float(np.mean(around == 1))


def particle_quality(
    volume: xr.DataArray | np.ndarray,
    true_mm: np.ndarray,
    *,
    grid: Grid | None = None,
    threshold: float | None = None,
    radius_voxel: float = 1.0,
) -> ParticleQuality:
    """Compare the peaks of a reconstructed volume with the true particles: R_acc, R_g, precision, recall and more.

    R_acc and R_g are Eqs. 13 and 14. R_g counts every peak above the threshold, as the paper does: ghosts raise it and
    merged particles lower it. Precision (1 minus the part of ghosts) and recall separate the two. All depend on the
    threshold, which the paper does not state.

    Parameters
    ----------
    volume : DataArray or ndarray, shape (z, y, x)
        Reconstruction, finite.
    true_mm : ndarray, shape (particle, 3)
        True positions (x, y, z) [mm]. Those outside the grid are ignored.
    grid : Grid, optional
        Voxels of an ndarray.
    threshold : float, optional
        Brightness that a peak must exceed. Default: `PEAK_SHARE` of the median brightness at the true particles, the
        brightest of the 27 voxels around each.
    radius_voxel : float
        Largest distance of a matched pair [voxel], > 0.

    Raises
    ------
    ValueError
        If the volume has the wrong shape or is not finite, or no true particle lies in the grid.
    """
    values, grid = checked_volume(volume, grid, "volume")
    true_mm = checked_points(true_mm, "true_mm")
    place = voxel_place(true_mm, grid)
    inside = ((place >= -0.5) & (place < np.array(grid.shape) - 0.5)).all(1)
    true_mm, place = true_mm[inside], np.floor(place[inside] + 0.5).astype(int)
    if len(true_mm) == 0:
        raise ValueError(
            "true_mm: expected at least one position inside the grid, got none. Points are (x, y, z) [mm]."
        )
    if threshold is None:
        threshold = PEAK_SHARE * float(np.median(ndimage.maximum_filter(values, 3, mode="nearest")[tuple(place.T)]))
        threshold = max(threshold, 0.0)
    found = find_particles(values, threshold, grid=grid)
    pairs = match_particles(found.positions_mm, true_mm, radius_voxel * grid.voxel_mm)
    miss = found.positions_mm[pairs[:, 0]] - true_mm[pairs[:, 1]]
    unknown = (np.nan,) * 3
    return ParticleQuality(
        true_count=len(true_mm),
        found_count=len(found),
        matched_count=len(pairs),
        accuracy=reconstruction_accuracy(found.positions_mm, true_mm, grid.voxel_mm),
        ghost_ratio=len(found) / len(true_mm),
        precision=len(pairs) / len(found) if len(found) else float("nan"),
        recall=len(pairs) / len(true_mm),
        bias_mm=tuple(miss.mean(0).tolist()) if len(pairs) else unknown,
        rms_mm=tuple(np.sqrt((miss**2).mean(0)).tolist()) if len(pairs) else unknown,
        elongation=elongation(found.sigma_voxel[pairs[:, 0]]),
        threshold=threshold,
    )


def elongation(sigma_voxel: np.ndarray) -> float:
    """Compute the median of sigma_z / sqrt(sigma_x sigma_y): the length of particles along depth over their width.

    `sigma_voxel` holds widths along (x, y, z), shape (particle, 3), as in `Particles`. Rows with NaN are ignored. The
    result is NaN if no row remains.
    """
    sigma_voxel = np.asarray(sigma_voxel, float)
    if sigma_voxel.ndim != 2 or sigma_voxel.shape[1] != 3:
        raise ValueError(f"sigma_voxel: expected shape (particle, 3), order (x, y, z), got {sigma_voxel.shape}.")
    x, y, z = sigma_voxel[np.isfinite(sigma_voxel).all(1)].T
    return float(np.median(z / np.sqrt(x * y))) if len(x) else float("nan")
