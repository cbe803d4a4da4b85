"""The two volumes of a correlation as the kernels read them: stored by phase, with the statistics of their windows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from lfpiv_kernels.correlation.blocks import split_call
from lfpiv_kernels.correlation.layout import Phased, Statistics, Storage
from lfpiv_kernels.correlation.memory import new_array
from lfpiv_kernels.correlation.plan import Plan, Triple
from lfpiv_kernels.correlation.windows import plane_sums_calls, plane_sums_shape, signal_floor, statistics_calls
from lfpiv_kernels.launch import Call, launch


@dataclass(frozen=True)
class Side:
    """One volume of a correlation."""

    blocks: Phased
    """Voxels of its blocks at lag 0."""
    surroundings: Phased
    """Voxels of the same blocks from the farthest lag on."""
    statistics: Statistics
    """Mean and scale of its windows at every lag."""


@dataclass(frozen=True)
class _Volume:
    """One volume, and the memory that its kernels write."""

    flat: wp.array
    """Values, flat."""
    search: Triple
    """Largest lags at which its windows are measured; 0 if only at lag 0."""
    voxels: Storage
    statistics: Storage
    split: wp.array
    """Voxels stored by phase."""
    sums: tuple[wp.array, wp.array]
    """Sums of values and of squares over the windows' y and x."""
    measured: tuple[wp.array, wp.array]
    """Mean and scale of the windows, stored by phase."""

    @classmethod
    def allocate(cls, plan: Plan, volume: wp.array, search: Triple) -> _Volume:
        """Allocate memory for a volume whose windows are measured at lags up to `search`."""
        lags = tuple(2 * r + 1 for r in search)
        voxels = Storage.from_plan(plan, tuple(b + n - 1 for b, n in zip(plan.block, lags, strict=True)))
        statistics = Storage.from_plan(plan, lags)
        split, sums = new_array(voxels.size), math.prod(plane_sums_shape(plan, search))
        first_sums, second_sums = new_array(sums), new_array(sums)
        mean, scale = new_array(statistics.size), new_array(statistics.size)
        return cls(volume.flatten(), search, voxels, statistics, split, (first_sums, second_sums), (mean, scale))

    def calls(self, plan: Plan, mean: float, square: float) -> list[list[Call]]:
        """Return steps of calls: store voxels by phase and sum over windows, then measure the windows."""
        corner = tuple(o - r for o, r in zip(plan.origin, self.search, strict=True))
        windows = self.statistics.lattice(plan, plan.origin)
        split = split_call(self.flat, plan, self.voxels.lattice(plan, corner), self.split)
        first, *more = plane_sums_calls(self.flat, plan, self.search, windows, self.sums)
        floor = signal_floor(mean, square, plan)
        last = statistics_calls(self.sums, plan, self.search, windows, floor, self.measured)
        return [[split, first], *([call] for call in (*more, *last))]

    def side(self) -> Side:
        """Describe voxels and statistics for the kernels."""
        storage, (along_z, along_y, along_x) = self.voxels, self.search
        surroundings, blocks, statistics = Phased(), Phased(), Statistics()
        surroundings.values, surroundings.plane = self.split, storage.plane
        surroundings.along_y, surroundings.along_x = storage.along_y, storage.along_x
        blocks.values, blocks.plane = self.split[along_z * storage.plane :], storage.plane
        blocks.along_y, blocks.along_x = storage.along_y[along_y:], storage.along_x[along_x:]
        statistics.mean, statistics.scale = self.measured
        statistics.along_y, statistics.along_x = self.statistics.along_y, self.statistics.along_x
        statistics.plane, statistics.centre = self.statistics.plane, wp.vec3i(*self.search)
        return Side(blocks, surroundings, statistics)


def make_sides(
    plan: Plan, volumes: Sequence[wp.array], moments: Sequence[tuple[float, float]], searches: Sequence[Triple]
) -> tuple[Side, Side]:
    """Store both volumes by phase and measure the statistics of their windows.

    Parameters
    ----------
    volumes : two wp.array, shape (z, y, x), float32
    moments : two tuple of float
        Mean and sum of squares of each volume.
    searches : two tuple of int
        Largest lags at which windows of each volume are measured, order (z, y, x) [voxel].
    """
    first, second = (_Volume.allocate(plan, *pair) for pair in zip(volumes, searches, strict=True))
    for step in zip(first.calls(plan, *moments[0]), second.calls(plan, *moments[1]), strict=True):
        launch(*(call for calls in step for call in calls))
    return first.side(), second.side()
