"""Two volumes as a caller hands them to `correlate`: checked, prepared, and the places of their voxels."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from scipy import fft

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import VIEWS, is_finite

LARGEST_BLOCK = 128
"""Largest edge of the block in the middle of two volumes that tells how far they moved as a whole [voxel]."""
CLEAR_SHARE = 2.0
"""Correlation beyond the lags searched, over the highest within them, that tells of particles which move that far."""
CLEAR_SIGMA = 8.0
"""The same over the standard deviation of all lags: of a few million, chance brings one to 5 or 6."""

_BACKGROUND_SAMPLES = 100_000  # voxels whose median is taken for the background
_SPACING_TOLERANCE = 1e-3  # coordinates written as decimal numbers of float32 are that even, relative to the spacing


def prepared(volume: xr.DataArray | np.ndarray, name: str) -> np.ndarray:
    """Background-free copy of a volume as float32, scaled to a largest magnitude of 1."""
    try:
        values = np.asarray(volume)
    except ValueError:  # rows of unequal length
        raise ValueError(
            f"{name}: expected a volume of numbers (z, y, x), got nested sequences of other form."
        ) from None
    if values.ndim != 3 or 0 in values.shape or values.dtype.kind not in "fiub":
        raise ValueError(f"{name}: expected a volume of numbers (z, y, x), got {values.dtype} of shape {values.shape}.")
    with np.errstate(over="ignore"):
        values = values.astype(np.float32, copy=isinstance(volume, np.ma.MaskedArray))
    if isinstance(volume, np.ma.MaskedArray):
        values[np.ma.getmaskarray(volume)] = np.nan
    lowest, highest = float(values.min()), float(values.max())
    if not (math.isfinite(lowest) and math.isfinite(highest)):
        bad = values.size - int(np.isfinite(values).sum())
        raise ValueError(f"{name}: expected finite intensities, found {bad} that are not. Replace them, by 0 say.")
    background = np.median(values.ravel()[:: 1 + values.size // _BACKGROUND_SAMPLES])
    values = values - background  # a copy
    values /= max(highest - float(background), float(background) - lowest, float(np.finfo(np.float32).tiny))
    checked: np.ndarray = values
    return checked


def voxel_axes(
    volume_a: xr.DataArray | np.ndarray, volume_b: xr.DataArray | np.ndarray, voxel_mm: float | None
) -> tuple[list[np.ndarray], tuple[float, float, float]]:
    """Voxel centres [mm] along z, y, x and their spacing [mm]."""
    if np.shape(volume_a) != np.shape(volume_b):
        raise ValueError(f"volume_b: expected the shape of volume_a, {np.shape(volume_a)}, got {np.shape(volume_b)}.")
    if not isinstance(volume_a, xr.DataArray) and not isinstance(volume_b, xr.DataArray):
        if not (is_finite(voxel_mm) and voxel_mm > 0):
            raise ValueError(f"voxel_mm: expected the voxel edge [mm] > 0, which arrays need, got {voxel_mm!r}.")
        return [voxel_mm * np.arange(n) for n in np.shape(volume_a)], (voxel_mm, voxel_mm, voxel_mm)
    if not isinstance(volume_a, xr.DataArray) or not isinstance(volume_b, xr.DataArray):
        one, other = ("volume_b", "volume_a") if isinstance(volume_b, xr.DataArray) else ("volume_a", "volume_b")
        raise ValueError(
            f"{other}: expected a DataArray, as {one} is, got an array without coordinates. Give it those of {one}, or "
            "hand over both as arrays, with voxel_mm."
        )
    if voxel_mm is not None:
        raise ValueError("voxel_mm: expected no value with DataArrays, whose coordinates tell it. Leave it out.")
    axes, spacing = [], []
    for axis in AXES:
        for name, volume in (("volume_a", volume_a), ("volume_b", volume_b)):
            if volume.dims != AXES or axis not in volume.coords or volume.sizes[axis] < 2:
                raise ValueError(
                    f"{name}: expected dims (z, y, x) with coordinates [mm] and at least 2 voxels each, got "
                    f"{dict(volume.sizes)} with coordinates {list(volume.coords)}."
                )
        centres = np.asarray(volume_a[axis], float)
        distance = (centres[-1] - centres[0]) / (len(centres) - 1)
        if not distance > 0 or np.abs(np.diff(centres) - distance).max() > _SPACING_TOLERANCE * distance:
            raise ValueError(f"volume_a: expected increasing, evenly spaced coordinates {axis} [mm], got {centres}.")
        if np.abs(np.asarray(volume_b[axis], float) - centres).max() > _SPACING_TOLERANCE * distance:
            raise ValueError(f"volume_b: expected the coordinates {axis} of volume_a, got others.")
        axes.append(centres)
        spacing.append(float(distance))
    z, y, x = spacing
    return axes, (z, y, x)


def seen(volume_a: xr.DataArray | np.ndarray, volume_b: xr.DataArray | np.ndarray) -> np.ndarray | None:
    """Whether two cameras see a voxel, shape (z, y, x); None where the volumes do not say so."""
    views = [
        volume[VIEWS] for volume in (volume_a, volume_b) if isinstance(volume, xr.DataArray) and VIEWS in volume.coords
    ]
    if not views:
        return None
    for count in views:
        if count.dims != AXES:
            raise ValueError(f"{VIEWS}: expected a coordinate over (z, y, x), got {count.dims}.")
    both: np.ndarray = np.minimum(views[0].values, views[-1].values) >= 2
    return both


def moves_beyond(first: np.ndarray, second: np.ndarray, search: tuple[int, int, int]) -> bool:
    """Whether two volumes (z, y, x), as wholes, clearly correlate farther apart than lags up to `search` reach."""
    middle = tuple(slice(max(n - LARGEST_BLOCK, 0) // 2, (n + min(n, LARGEST_BLOCK)) // 2) for n in first.shape)
    spectrum, other = (fft.rfftn(volume[middle] - volume[middle].mean()) for volume in (first, second))
    shape = first[middle].shape
    correlation = fft.irfftn(spectrum.conj() * other, shape)
    lags = np.meshgrid(*(np.abs(n * fft.fftfreq(n)) for n in shape), indexing="ij", sparse=True)
    near = np.logical_and.reduce(np.broadcast_arrays(*(lag <= reach for lag, reach in zip(lags, search, strict=True))))
    if near.all():
        return False
    farthest = float(correlation[~near].max())
    return farthest > max(CLEAR_SHARE * float(correlation[near].max()), CLEAR_SIGMA * float(correlation.std()))
