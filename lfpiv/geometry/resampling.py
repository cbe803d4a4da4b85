"""`volume_on`: a volume on another grid of voxels, by cubic splines."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.geometry.volume import MASKED, SPACING_TOLERANCE, checked_volume

VOXEL_ATTRIBUTES = ("sieve_voxel", "smoothing_voxel")
"""Attributes of a volume that are lengths in its voxels."""
EDGE = 1e-6
"""Tolerance of places at the faces of a grid [voxel]."""
SMOOTH_VOXEL = 0.5
"""A volume that is a sum of Gaussians at least this wide is sampled; sharper volumes are integrated. Standard deviation
[voxel]."""
MATRICES = 6
"""Number of matrices of each kind that are kept: three axes for two pairs of grids."""


def volume_on(volume: xr.DataArray, grid: Grid) -> xr.DataArray:
    """Return a volume of light on the voxels of another grid.

    The light between voxels is the cubic spline through the values [1]_. A volume whose attribute ``sieve_voxel`` is
    `SMOOTH_VOXEL` or more is smooth, and is sampled at the voxel centres. Any other one, of single bright voxels, is
    integrated over each voxel: samples would depend on where in a voxel a particle lies. Negative values, which splines
    have beside bright voxels, become 0, and the others are lowered in proportion, so that the light stays the same. A
    voxel holds the light of its own size. Voxels of the same size and place are cut out as they are.

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
        If the volume is not finite or has no even coordinates, or is one of a joint fit and the voxels have another
        size: `reconstruct_pair` takes the grid of such volumes.

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
    if _contains(given, grid):
        return _cut(volume, grid.within(given))
    matrix_of = _sampling if float(volume.attrs.get("sieve_voxel", 0.0)) >= SMOOTH_VOXEL else _integral
    sampling = [matrix_of(given, grid, axis) for axis in range(3)]
    ratio, nearest = grid.voxel_mm / given.voxel_mm, grid.nearest_in(given)
    others = {str(name): coordinate for name, coordinate in volume.coords.items() if coordinate.dims == AXES}
    if any(coordinate.attrs.get("units") == "voxel" for coordinate in others.values()):
        raise ValueError(
            "volume: expected light alone on voxels of another size, found a volume of a joint fit, with its "
            "displacement. Give the grid to `reconstruct_pair`."
        )
    dark = others[MASKED].values[nearest].astype(bool) if MASKED in others else None
    coordinates: dict[str, Any] = dict(grid.coordinates())
    for name, coordinate in others.items():
        if coordinate.dtype.kind == "f":
            resampled = _resampled(coordinate.values, sampling, ratio, dark)
        else:
            resampled = np.ascontiguousarray(coordinate.values[nearest])
        coordinates[name] = (AXES, resampled, dict(coordinate.attrs))
    lengths = {name: float(volume.attrs[name]) / ratio for name in VOXEL_ATTRIBUTES if name in volume.attrs}
    edges = {"voxel_mm": grid.voxel_mm, "reconstruction_voxel_mm": given.voxel_mm}
    attributes = {**volume.attrs, **lengths, **edges}
    return xr.DataArray(_resampled(values, sampling, ratio, dark), coordinates, AXES, volume.name, attributes)


def _contains(given: Grid, grid: Grid) -> bool:
    """Return whether each voxel of `grid` is a voxel of `given`."""
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
    """Apply the matrix of each axis, then make negative and `dark` voxels 0 and scale the others to the same sum.

    `ratio` is the new edge of a voxel over the given edge: a voxel holds the light of its own size.
    """
    for axis, matrix in enumerate(sampling):
        values = np.moveaxis(np.tensordot(matrix, np.asarray(values, np.float32), (1, axis)), 0, axis)
    light, positive = max(float(values.sum(dtype=np.float64)), 0.0), np.maximum(values, 0)
    if dark is not None:
        positive[dark] = 0
    lit = float(positive.sum(dtype=np.float64))
    scale = ratio**3 * (light / lit if lit > 0 else 1.0)
    return np.ascontiguousarray(positive * np.float32(scale))


@lru_cache(MATRICES)
def _sampling(given: Grid, grid: Grid, axis: int) -> np.ndarray:
    """Return the matrix that samples the spline of one grid at the voxels of another along an axis, float32.

    A row is zero for voxels with their centre outside the given grid.
    """
    count, place = given.shape[axis], _place(given, grid, axis)
    inside = (place > -0.5 - EDGE) & (place < count - 0.5 + EDGE)
    matrix = np.zeros((len(place), count))
    first = np.floor(place).astype(int) - 1
    for step in range(4):
        distance = np.abs(place - (first + step))
        weight = np.where(distance < 1, 2 / 3 - distance**2 + distance**3 / 2, np.maximum(2 - distance, 0) ** 3 / 6)
        matrix[np.arange(len(place)), _mirrored(first + step, count)] += np.where(inside, weight, 0.0)
    return _for_values(matrix)


@lru_cache(MATRICES)
def _integral(given: Grid, grid: Grid, axis: int) -> np.ndarray:
    """Return the matrix that averages the spline of one grid over the voxels of another along an axis, float32.

    The part of a voxel outside the given grid counts as 0.
    """
    count, place, edge = given.shape[axis], _place(given, grid, axis), grid.voxel_mm / given.voxel_mm
    low, high = (np.clip(place + side * edge / 2, -0.5, count - 0.5) for side in (-1, 1))
    matrix = np.zeros((len(place), count))
    first = np.floor(low).astype(int) - 1
    for step in range(math.ceil(edge) + 4):
        weight = (_spline_integral(high - (first + step)) - _spline_integral(low - (first + step))) / edge
        matrix[np.arange(len(place)), _mirrored(first + step, count)] += weight
    return _for_values(matrix)


def _spline_integral(end: np.ndarray) -> np.ndarray:
    """Return the integral of the cubic B-spline around 0 from minus infinity to `end`."""
    far = np.clip(np.abs(end), 0, 2)
    half = np.where(far < 1, 2 * far / 3 - far**3 / 3 + far**4 / 8, 0.5 - (2 - far) ** 4 / 24)
    return 0.5 + np.sign(end) * half


def _for_values(matrix: np.ndarray) -> np.ndarray:
    """Turn a matrix for the coefficients of a spline into a matrix for the values that the spline goes through."""
    count = matrix.shape[1]
    if count > 1:
        matrix = matrix @ ndimage.spline_filter1d(np.eye(count), order=3, axis=0, mode="mirror")
    values: np.ndarray = matrix.astype(np.float32)
    values.flags.writeable = False  # callers share it
    return values


def _place(given: Grid, grid: Grid, axis: int) -> np.ndarray:
    """Return the voxel centres of `grid` along an axis, in voxels of `given` from the centre of its first voxel."""
    return (grid.axis_mm(axis) - given.first_centre_mm[axis]) / given.voxel_mm


def _mirrored(index: np.ndarray, count: int) -> np.ndarray:
    """Mirror indices of voxels about the centres of the first and the last voxel."""
    period = max(2 * (count - 1), 1)
    folded = np.abs(index) % period
    return np.minimum(folded, period - folded) if count > 1 else np.zeros_like(index)
