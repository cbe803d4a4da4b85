"""`PreparedPair`: two volumes checked, normalised and smoothed for correlation, and what their voxels hold."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.velocity import common_particles
from lfpiv.velocity.coverage import Voxels
from lfpiv.velocity.multi_pass import Pass, UndeformedPair
from lfpiv.velocity.seeding import unseeded_voxels
from lfpiv.velocity.settings import CorrelationSettings, triple
from lfpiv.velocity.standing_light import on_standing_light
from lfpiv.velocity.volume_pair import (
    VoxelAxes,
    either,
    float_values,
    missing_smoothing,
    normalise,
    preprocess,
    seen_by_two,
    solid_voxels,
    voxel_axes,
)
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.transfer import DeviceArray

log = logging.getLogger(__name__)

Volume = xr.DataArray | np.ndarray
"""Intensities, shape (z, y, x), finite, of any sign."""


@dataclass(frozen=True, kw_only=True)
class CheckedPair:
    """Two volumes as `lfpiv.correlate` takes them, checked and without background."""

    given: tuple[Volume, Volume]
    axes: VoxelAxes
    solid: np.ndarray | None
    """True for voxels without fluid, shape (z, y, x); None without a mask."""
    values: tuple[np.ndarray, np.ndarray]
    """Intensities without background, shape (z, y, x), float32."""

    @classmethod
    def from_volumes(
        cls, first: Volume, second: Volume, *, voxel_mm: float | None = None, mask: Volume | None = None
    ) -> CheckedPair:
        """Check two volumes; arguments and exceptions as of `lfpiv.correlate`."""
        values_a, values_b = float_values(first, "volume_a"), float_values(second, "volume_b")
        axes = voxel_axes(first, second, voxel_mm)
        solid = solid_voxels(mask, first, second, axes)
        values = normalise(values_a, "volume_a", solid), normalise(values_b, "volume_b", solid)
        return cls(given=(first, second), axes=axes, solid=solid, values=values)

    def prepared(self, settings: CorrelationSettings) -> PreparedPair:
        """Smooth the volumes, and find what their voxels hold."""
        seen = seen_by_two(*self.given)
        unseeded = unseeded_voxels(self.values, either(self.solid, None if seen is None else ~seen))
        missing, power = missing_smoothing(settings.smoothing_voxel, *self.given), settings.intensity_power
        first, second = (preprocess(on_device(volume), missing, power) for volume in self.values)
        voxels = Voxels(seen=seen, solid=self.solid, unseeded=unseeded)
        return PreparedPair(first=first, second=second, voxels=voxels, settings=settings)


@dataclass(frozen=True, kw_only=True)
class PreparedPair:
    """Two volumes ready for correlation."""

    first: DeviceArray
    """Shape (z, y, x), on the device."""
    second: DeviceArray
    voxels: Voxels
    settings: CorrelationSettings

    def in_common(self) -> bool:
        """Return whether both volumes clearly show the same particles."""
        pair = UndeformedPair((self.first, self.second), self.voxels.solid_on_device)
        window = self.settings.windows[-1]
        return common_particles.in_common(pair, window, self.settings.first_search(triple(self.first.shape)))

    def without_standing_light(self, last: Pass) -> Pass:
        """Return the last pass without the vectors of windows in which light brighter than particles stays in place."""
        power = 1 / self.settings.intensity_power
        lights = preprocess(self.first, 0, power), preprocess(self.second, 0, power)
        standing = on_standing_light(*lights, last.given.windows, last.field, last.valid)
        if not standing.any():
            return last
        log.warning(
            "correlation: light brighter than particles stays in place in %d windows: their vectors are not valid",
            standing.sum(),
        )
        return last.without(standing)
