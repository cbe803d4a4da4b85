"""Check points and volumes that a user passes to a public function; return plain arrays and the voxel grid."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from typing import TypeGuard

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES, Grid

VIEWS = "views"
"""Name of a volume's coordinate with the number of cameras that see each voxel."""

MASKED = "masked"
"""Name of a volume's coordinate that is true for voxels without fluid."""

SPACING_TOLERANCE = 1e-3
"""Largest unevenness of coordinates, relative to the spacing. Coordinates stored as float32 are slightly uneven."""

POSITION_TOLERANCE_MM = 1e-4
"""Largest difference of equal coordinates [mm]."""


def checked_points(points: np.ndarray, name: str) -> np.ndarray:
    """Return points as float64 of shape (n, 3), or raise ValueError."""
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        fault = "" if np.isfinite(points).all() else " with NaN or infinity"
        raise ValueError(f"{name}: expected finite points (x, y, z) of shape (n, 3), got shape {points.shape}{fault}.")
    return points


def checked_volume(volume: xr.DataArray | np.ndarray, grid: Grid | None, name: str) -> tuple[np.ndarray, Grid]:
    """Return the values (z, y, x) and the grid of a volume, or raise ValueError if a value is not finite."""
    values = np.asarray(volume)
    if values.ndim != 3 or 0 in values.shape or values.dtype.kind not in "fiub":
        raise ValueError(f"{name}: expected a volume of numbers (z, y, x), got {values.dtype} of shape {values.shape}.")
    values = values.astype(np.float32 if values.dtype == np.float32 else np.float64, copy=False)
    bad = values.size - int(np.isfinite(values).sum())
    if bad:
        raise ValueError(f"{name}: expected finite intensities, found {bad} that are not. Replace them, by 0 say.")
    if isinstance(volume, xr.DataArray):
        if grid is not None:
            raise ValueError("grid: expected no value with a DataArray, whose coordinates define it. Leave it out.")
        return values, _grid_of(volume, name)
    if grid is None or values.shape != tuple(grid.shape):
        fault = "no grid" if grid is None else f"a grid of shape {grid.shape}"
        raise ValueError(f"{name}: an array of shape {values.shape} needs the grid of its voxels, got {fault}.")
    return values, grid


def in_order(volume: xr.DataArray | np.ndarray, name: str) -> xr.DataArray | np.ndarray:
    """Return a volume unchanged, or raise ValueError if its named dimensions have another order than (z, y, x)."""
    if isinstance(volume, xr.DataArray) and volume.dims != AXES:
        raise ValueError(
            f"{name}: expected dims (z, y, x), got ({', '.join(map(str, volume.dims))}). Use .transpose('z', 'y', 'x')."
        )
    return volume


def checked_mask(mask: xr.DataArray | np.ndarray, axes_mm: Sequence[np.ndarray], name: str = "mask") -> np.ndarray:
    """Return a mask of voxels as flags, true where there is no fluid.

    Parameters
    ----------
    mask : DataArray or ndarray, shape (z, y, x)
        True, or a number of 0.5 to 1, where there is no fluid; false, or a number from 0, elsewhere.
    axes_mm : sequence of three ndarrays
        Voxel centres along z, y, x [mm], which the coordinates of a DataArray must equal.
    name : str
        Name of the argument in messages.

    Raises
    ------
    ValueError
        If shape, coordinates or values are wrong, or no voxel is left.
    """
    values = np.asarray(in_order(mask, name))
    shape = tuple(len(axis) for axis in axes_mm)
    if values.shape != shape:
        raise ValueError(f"{name}: expected a voxel for each of the volume, {shape} (z, y, x), got {values.shape}.")
    if isinstance(mask, xr.DataArray):
        for axis, centres in zip(AXES, axes_mm, strict=True):
            if axis in mask.coords and np.abs(np.asarray(mask[axis], float) - centres).max() > POSITION_TOLERANCE_MM:
                raise ValueError(f"{name}: expected the coordinates {axis} of the volume [mm], got others.")
    solid: np.ndarray = values if values.dtype == bool else solid_shares(values, name) >= 0.5
    if solid.all():
        raise ValueError(f"{name}: expected some voxels of fluid (false), got none. Is the mask inverted?")
    return solid


def solid_shares(values: np.ndarray, name: str) -> np.ndarray:
    """Return the values of a mask as shares of solid, or raise ValueError if they are not flags or from 0 to 1."""
    if values.dtype.kind not in "fiub" or not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        found = f"{values.dtype}"
        if values.dtype.kind in "fiu":
            found = f"numbers from {np.nanmin(values):g} to {np.nanmax(values):g}"
            found += "" if np.isfinite(values).all() else ", some not finite"
        raise ValueError(f"{name}: expected true (no fluid) and false, or numbers from 0 to 1, got {found}.")
    return values.astype(float)


def _grid_of(volume: xr.DataArray, name: str) -> Grid:
    """Return the grid of a DataArray with coordinates [mm]."""
    if volume.dims != AXES or any(axis not in volume.coords for axis in AXES):
        raise ValueError(
            f"{name}: expected dims (z, y, x) with coordinates [mm], got {dict(volume.sizes)} with coordinates "
            f"{list(volume.coords)}."
        )
    axes = [np.asarray(volume[axis], float) for axis in AXES]
    steps = np.concatenate([np.diff(axis) for axis in axes])
    voxel_mm = float(np.median(steps)) if len(steps) else float(volume.attrs.get("voxel_mm", 1.0))
    if not voxel_mm > 0 or (np.abs(steps - voxel_mm) > SPACING_TOLERANCE * voxel_mm).any():
        raise ValueError(
            f"{name}: expected evenly spaced cubic voxels, got steps of {steps.min()} to {steps.max()} mm."
        )
    nz, ny, nx = volume.shape
    z, y, x = (float(axis[0]) for axis in axes)
    return Grid(shape=(nz, ny, nx), voxel_mm=voxel_mm, first_centre_mm=(z, y, x))


def voxel_place(points_mm: np.ndarray, grid: Grid) -> np.ndarray:
    """Return points (x, y, z) [mm] as fractional voxel indices (z, y, x)."""
    return (points_mm[:, ::-1] - np.asarray(grid.first_centre_mm)) / grid.voxel_mm


def lies_in(points_mm: np.ndarray, grid: Grid, margin_voxel: float = 0.0) -> np.ndarray:
    """Return which points (x, y, z) [mm] lie in a volume or up to a margin beside it, shape (point,)."""
    place = voxel_place(points_mm, grid)
    above, below = place > -0.5 - margin_voxel, place < np.array(grid.shape) - 0.5 + margin_voxel
    return np.asarray((above & below).all(1))


def is_finite(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite real number."""
    return isinstance(value, numbers.Real) and math.isfinite(value)
