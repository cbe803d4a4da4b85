"""Prepare the two volumes of `lfpiv.correlate`: check, normalise and smooth them, and locate their voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import fft

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import MASKED, SPACING_TOLERANCE, VIEWS, checked_mask, is_finite
from lfpiv_kernels.correlation import light
from lfpiv_kernels.transfer import Given, Values, to_host

LARGEST_BLOCK = 128
"""Largest edge of the central block that is correlated as a whole [voxel]."""
CLEAR_SHARE = 2.0
"""Smallest clear peak beyond the searched lags, as a multiple of the highest peak within them."""
CLEAR_SIGMA = 8.0
"""Smallest clear peak beyond the searched lags, as a multiple of the standard deviation over all lags."""

_BACKGROUND_SAMPLES = 100_000  # voxels that are sampled for the background, their median


@dataclass(frozen=True, kw_only=True)
class VoxelAxes:
    """Voxel centres of a volume, in millimetres or as indices."""

    centres: tuple[np.ndarray, ...]
    """Voxel centres along z, y, x [`unit`]."""
    spacing: tuple[float, float, float]
    """Distance of voxels along z, y, x [`unit`]."""
    unit: str = "mm"
    """"mm", or "voxel" where the edge of a voxel is not known."""

    @property
    def spacing_mm(self) -> tuple[float, float, float] | None:
        """Distance of voxels along z, y, x [mm]; None where it is not known."""
        return self.spacing if self.unit == "mm" else None


def float_values(volume: xr.DataArray | np.ndarray, name: str) -> np.ndarray:
    """Return the values of a volume as float32, NaN where masked; raise ValueError if it is not three-dimensional."""
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
    return values


def normalise(values: np.ndarray, name: str, solid: np.ndarray | None) -> np.ndarray:
    """Return a copy of a volume (z, y, x) without background and scaled to a largest magnitude of 1.

    The background is the median of the voxels. Voxels flagged in `solid`, shape (z, y, x), may hold anything; the
    result is 0 there. Raise ValueError if other values are not finite.
    """
    if solid is not None:
        values = np.where(solid, np.float32(0), values)
    lowest, highest = float(values.min()), float(values.max())
    if not (math.isfinite(lowest) and math.isfinite(highest)):
        bad = values.size - int(np.isfinite(values).sum())
        raise ValueError(f"{name}: expected finite intensities, found {bad} that are not. Replace them, by 0 say.")
    inside = values.ravel() if solid is None else values[~solid]
    background = _median(inside[:: 1 + inside.size // _BACKGROUND_SAMPLES])
    normalised: np.ndarray = values - background
    normalised /= max(highest - float(background), float(background) - lowest, float(np.finfo(np.float32).tiny))
    if solid is not None:
        normalised[solid] = 0
    return normalised


def _median(values: np.ndarray) -> np.floating:
    """Return the median of finite numbers, as `numpy.median` does. A partial sort takes a quarter of the time."""
    half = values.size // 2
    parted = np.partition(values, half)
    upper: np.floating = parted[half]
    return upper if values.size % 2 else (parted[:half].max() + upper) / upper.dtype.type(2)


def missing_smoothing(smoothing_voxel: float, *volumes: xr.DataArray | np.ndarray) -> float:
    """Return the smoothing that volumes still need to reach a requested one [voxel].

    Volumes that consist of Gaussians have the attribute ``sieve_voxel``, their standard deviation. It counts as
    smoothing: sqrt(smoothing_voxel^2 - sieve_voxel^2) is missing.
    """
    sieve = min(
        float(volume.attrs.get("sieve_voxel", 0.0)) if isinstance(volume, xr.DataArray) else 0.0 for volume in volumes
    )
    return math.sqrt(max(smoothing_voxel**2 - sieve**2, 0.0)) if sieve > 0 else smoothing_voxel


def preprocess(volume: Given, smoothing_voxel: float, intensity_power: float) -> Given:
    """Smooth a volume without background by a Gaussian and raise its intensities to a power, negative ones as 0.

    The result is float32 like the volume, shape (z, y, x), and on the device if the volume is. A power of 1 leaves
    negative intensities.
    """
    if smoothing_voxel > 0:
        volume = light.smoothed(volume, smoothing_voxel)
    return volume if intensity_power == 1 else light.powered(volume, np.float32(intensity_power))


def voxel_axes(
    volume_a: xr.DataArray | np.ndarray, volume_b: xr.DataArray | np.ndarray, voxel_mm: float | None
) -> VoxelAxes:
    """Return the voxel centres of two volumes; raise ValueError if the volumes differ in shape, kind or place."""
    if np.shape(volume_a) != np.shape(volume_b):
        raise ValueError(f"volume_b: expected the shape of volume_a, {np.shape(volume_a)}, got {np.shape(volume_b)}.")
    if not isinstance(volume_a, xr.DataArray) and not isinstance(volume_b, xr.DataArray):
        if voxel_mm is None:
            indices = tuple(np.arange(n, dtype=float) for n in np.shape(volume_a))
            return VoxelAxes(centres=indices, spacing=(1.0, 1.0, 1.0), unit="voxel")
        if not (is_finite(voxel_mm) and voxel_mm > 0):
            raise ValueError(f"voxel_mm: expected the voxel edge [mm] > 0, got {voxel_mm!r}.")
        centres = tuple(voxel_mm * np.arange(n) for n in np.shape(volume_a))
        return VoxelAxes(centres=centres, spacing=(voxel_mm, voxel_mm, voxel_mm))
    if not isinstance(volume_a, xr.DataArray) or not isinstance(volume_b, xr.DataArray):
        one, other = ("volume_b", "volume_a") if isinstance(volume_b, xr.DataArray) else ("volume_a", "volume_b")
        raise ValueError(
            f"{other}: expected a DataArray, as {one} is, got an array without coordinates. Give it those of {one}, or "
            "hand over both as arrays."
        )
    if voxel_mm is not None:
        raise ValueError("voxel_mm: expected no value with DataArrays, whose coordinates state it. Leave it out.")
    z, y, x = (_common_axis(volume_a, volume_b, axis) for axis in AXES)
    return VoxelAxes(centres=(z[0], y[0], x[0]), spacing=(z[1], y[1], x[1]))


def _common_axis(volume_a: xr.DataArray, volume_b: xr.DataArray, axis: str) -> tuple[np.ndarray, float]:
    """Return the voxel centres of two volumes along one axis, and their distance [mm]."""
    for name, volume in (("volume_a", volume_a), ("volume_b", volume_b)):
        if volume.dims != AXES or axis not in volume.coords or volume.sizes[axis] < 2:
            raise ValueError(
                f"{name}: expected dims (z, y, x) with coordinates [mm] and at least 2 voxels each, got "
                f"{dict(volume.sizes)} with coordinates {list(volume.coords)}."
            )
    centres = np.asarray(volume_a[axis], float)
    distance = float((centres[-1] - centres[0]) / (len(centres) - 1))
    if not distance > 0 or np.abs(np.diff(centres) - distance).max() > SPACING_TOLERANCE * distance:
        raise ValueError(f"volume_a: expected increasing, evenly spaced coordinates {axis} [mm], got {centres}.")
    if np.abs(np.asarray(volume_b[axis], float) - centres).max() > SPACING_TOLERANCE * distance:
        raise ValueError(f"volume_b: expected the coordinates {axis} of volume_a, got others.")
    return centres, distance


def seen_by_two(volume_a: xr.DataArray | np.ndarray, volume_b: xr.DataArray | np.ndarray) -> np.ndarray | None:
    """Return the flags of the voxels that two cameras see, shape (z, y, x); None if the volumes do not count views."""
    views = [
        volume[VIEWS] for volume in (volume_a, volume_b) if isinstance(volume, xr.DataArray) and VIEWS in volume.coords
    ]
    if not views:
        return None
    for count in views:
        if count.dims != AXES:
            raise ValueError(f"{VIEWS}: expected a coordinate over (z, y, x), got {count.dims}.")
    return np.minimum(views[0].values, views[-1].values) >= 2


def solid_voxels(
    mask: xr.DataArray | np.ndarray | None,
    volume_a: xr.DataArray | np.ndarray,
    volume_b: xr.DataArray | np.ndarray,
    axes: VoxelAxes,
) -> np.ndarray | None:
    """Return the flags of the voxels without fluid, shape (z, y, x); None if there are none.

    Without `mask`, the coordinate ``masked`` of the volumes is taken.
    """
    if mask is not None:
        masks = [checked_mask(mask, axes.centres)]
    else:
        volumes = [volume for volume in (volume_a, volume_b) if isinstance(volume, xr.DataArray)]
        found = [volume[MASKED] for volume in volumes if MASKED in volume.coords]
        masks = [checked_mask(one.drop_vars(MASKED), axes.centres, MASKED) for one in found]
    solid = np.logical_or.reduce(masks) if masks else np.zeros(1, bool)
    return solid if solid.any() else None


def either(first: np.ndarray | None, second: np.ndarray | None) -> np.ndarray | None:
    """Return the union of two flags of voxels, shape (z, y, x); None flags no voxel."""
    if first is None or second is None:
        return second if first is None else first
    return first | second


def moves_beyond(first: Values, second: Values, search: tuple[int, int, int]) -> bool:
    """Return whether two volumes (z, y, x) as a whole clearly correlate at lags beyond `search` (z, y, x) [voxel].

    The central blocks of both volumes are correlated with wrap-around, on the host.
    """
    middle = tuple(slice(max(n - LARGEST_BLOCK, 0) // 2, (n + min(n, LARGEST_BLOCK)) // 2) for n in first.shape)
    blocks = [to_host(volume[middle]) for volume in (first, second)]
    shape = blocks[0].shape
    spectrum_a, spectrum_b = (fft.rfftn(block - block.mean()) for block in blocks)
    correlation = fft.irfftn(spectrum_a.conj() * spectrum_b, shape)
    lags = np.meshgrid(*(np.abs(n * fft.fftfreq(n)) for n in shape), indexing="ij", sparse=True)
    near = np.logical_and.reduce(np.broadcast_arrays(*(lag <= reach for lag, reach in zip(lags, search, strict=True))))
    if near.all():
        return False
    farthest = float(correlation[~near].max())
    return farthest > max(CLEAR_SHARE * float(correlation[near].max()), CLEAR_SIGMA * float(correlation.std()))
