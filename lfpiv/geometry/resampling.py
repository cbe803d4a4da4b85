"""`volume_on`: a volume on another grid of voxels, by cubic splines."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.geometry.volume import MASKED, SPACING_TOLERANCE, checked_volume

VOXEL_ATTRIBUTES = ("sieve_voxel", "smoothing_voxel")
"""Attributes of a volume that are lengths in its voxels."""


def volume_on(volume: xr.DataArray, grid: Grid) -> xr.DataArray:
    """Return a volume of light on the voxels of another grid.

    Each axis is sampled at the voxel centres from the cubic spline through the values [1]_. Negative values, which
    splines have beside bright voxels, become 0, and the others are lowered in proportion, so that the light stays the
    same. A voxel holds the light of its own size: values are scaled by the ratio of the voxels' volumes. Voxels of the
    same size and place are cut out as they are.

    Parameters
    ----------
    volume : DataArray, shape (z, y, x)
        Light of voxels, finite and >= 0, with coordinates [mm], as `reconstruct` returns it.
    grid : Grid
        Voxels to return. Outside the given volume they hold no light.

    Returns
    -------
    DataArray, shape (z, y, x), float32
        The volume on the grid. Coordinates over (z, y, x) of real numbers are resampled in the same way; of others,
        such as ``views`` and ``masked``, the nearest voxel is taken. Masked voxels stay dark. Attributes that are
        lengths in voxels are in voxels of the grid; `reconstruction_voxel_mm` is the edge of the given voxels [mm].

    Raises
    ------
    ValueError
        If the volume is not finite or has no even coordinates.

    References
    ----------
    .. [1] M. Unser, A. Aldroubi, M. Eden, "B-spline signal processing: part II - efficient design and applications",
       IEEE Trans. Signal Process. 41 (1993) 834-848, doi:10.1109/78.193221.

    Examples
    --------
    >>> from lfpiv import Grid, volume_on
    >>> grid = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.6, 0.4, 0.5), voxel_mm=0.1)
    >>> fine = grid.refined(1.25)
    >>> volume = xr.DataArray(np.ones(fine.shape), fine.coordinates(), ("z", "y", "x"))
    >>> volume_on(volume, grid).shape
    (5, 4, 6)
    """
    values, given = checked_volume(volume, None, "volume")
    if _holds(given, grid):
        return _cut(volume, grid.within(given))
    sampling = [_sampling(given, grid, axis) for axis in range(3)]
    ratio, nearest = grid.voxel_mm / given.voxel_mm, grid.nearest_in(given)
    others = {str(name): about for name, about in volume.coords.items() if about.dims == AXES}
    dark = others[MASKED].values[nearest].astype(bool) if MASKED in others else None
    coordinates: dict[str, Any] = dict(grid.coordinates())
    for name, about in others.items():
        if about.dtype.kind == "f":
            resampled = _resampled(about.values, sampling, ratio, dark)
        else:
            resampled = np.ascontiguousarray(about.values[nearest])
        coordinates[name] = (AXES, resampled, dict(about.attrs))
    lengths = {name: float(volume.attrs[name]) / ratio for name in VOXEL_ATTRIBUTES if name in volume.attrs}
    edges = {"voxel_mm": grid.voxel_mm, "reconstruction_voxel_mm": given.voxel_mm}
    attributes = {**volume.attrs, **lengths, **edges}
    return xr.DataArray(_resampled(values, sampling, ratio, dark), coordinates, AXES, volume.name, attributes)


def _holds(given: Grid, grid: Grid) -> bool:
    """Return whether the voxels of a grid are voxels of the given one."""
    if not math.isclose(given.voxel_mm, grid.voxel_mm, rel_tol=SPACING_TOLERANCE):
        return False
    for axis in range(3):
        first = (grid.first_centre_mm[axis] - given.first_centre_mm[axis]) / given.voxel_mm
        if abs(first - round(first)) > 10 * SPACING_TOLERANCE:
            return False
        if not 0 <= round(first) <= given.shape[axis] - grid.shape[axis]:
            return False
    return True


def _cut(volume: xr.DataArray, within: tuple[slice, slice, slice]) -> xr.DataArray:
    """Cut a part out of a volume; HDF5 and the kernels take contiguous arrays."""
    cut = volume[within]
    for name in cut.coords:
        if cut.coords[name].ndim == 3:
            cut = cut.assign_coords({name: cut.coords[name].copy(data=np.ascontiguousarray(cut.coords[name].values))})
    return cut.copy(data=np.ascontiguousarray(cut.values))


def _resampled(values: np.ndarray, sampling: list[np.ndarray], ratio: float, dark: np.ndarray | None) -> np.ndarray:
    """Apply the matrix of each axis, without negative values and with the light unchanged."""
    for axis, matrix in enumerate(sampling):
        values = np.moveaxis(np.tensordot(matrix, np.asarray(values, np.float32), (1, axis)), 0, axis)
    light, positive = max(float(values.sum(dtype=np.float64)), 0.0), np.maximum(values, 0)
    if dark is not None:
        positive[dark] = 0
    lit = float(positive.sum(dtype=np.float64))
    scale = ratio**3 * (light / lit if lit > 0 else 1.0)
    return np.ascontiguousarray(positive * np.float32(scale))


def _sampling(given: Grid, grid: Grid, axis: int) -> np.ndarray:
    """Return the matrix from voxels of one grid to those of another along an axis, float32.

    A row is zero for voxels with their centre outside the given grid.
    """
    count = given.shape[axis]
    place = (grid.axis_mm(axis) - given.first_centre_mm[axis]) / given.voxel_mm
    inside = (place > -0.5 - 1e-6) & (place < count - 0.5 + 1e-6)
    unit = np.eye(count)
    if count > 1:
        unit = ndimage.spline_filter1d(unit, order=3, axis=0, mode="mirror")
    matrix = np.zeros((len(place), count))
    first = np.floor(place).astype(int) - 1
    for step in range(4):
        distance = np.abs(place - (first + step))
        weight = np.where(distance < 1, 2 / 3 - distance**2 + distance**3 / 2, np.maximum(2 - distance, 0) ** 3 / 6)
        matrix[np.arange(len(place)), _mirrored(first + step, count)] += np.where(inside, weight, 0.0)
    sampled: np.ndarray = (matrix @ unit).astype(np.float32)
    return sampled


def _mirrored(index: np.ndarray, count: int) -> np.ndarray:
    """Mirror indices of voxels about the centres of the first and the last one."""
    period = max(2 * (count - 1), 1)
    folded = np.abs(index) % period
    mirrored: np.ndarray = np.minimum(folded, period - folded) if count > 1 else np.zeros_like(index)
    return mirrored
