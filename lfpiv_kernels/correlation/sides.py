"""The two volumes of a correlation as the kernels read them: stored by phase, with the statistics of their windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels.correlation.blocks import split_call
from lfpiv_kernels.correlation.layout import Lattice, Phased, Statistics, Storage
from lfpiv_kernels.correlation.memory import launch, new_array, to_device
from lfpiv_kernels.correlation.plan import Plan, Triple
from lfpiv_kernels.correlation.windows import plane_sums_call, statistics_call


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
    """One volume and the memory layout of its voxels and statistics."""

    values: np.ndarray
    flat: wp.array
    search: Triple
    """Largest lags at which its windows are measured; 0 if only at lag 0."""
    voxels: Storage
    statistics: Storage

    @classmethod
    def of(cls, plan: Plan, volume: np.ndarray, search: Triple) -> _Volume:
        values = np.ascontiguousarray(volume, np.float32)
        lags = tuple(2 * r + 1 for r in search)
        reach = tuple(b + n - 1 for b, n in zip(plan.block, lags, strict=True))
        return cls(values, to_device(values.ravel()), search, Storage.of(plan, reach), Storage.of(plan, lags))

    def voxel_lattice(self, plan: Plan) -> Lattice:
        """Blocks of the volume at the farthest negative lag."""
        return self.voxels.lattice(plan, tuple(o - r for o, r in zip(plan.origin, self.search, strict=True)))


def make_sides(
    plan: Plan, volumes: Sequence[np.ndarray], squares: Sequence[float], searches: Sequence[Triple]
) -> tuple[Side, Side]:
    """Store both volumes by phase and measure the statistics of their windows.

    Parameters
    ----------
    plan : Plan
    volumes : two ndarray, shape (z, y, x), float32
    squares : two float
        Sum of squares of each volume.
    searches : two tuple of int
        Largest lags at which windows of each volume are measured, order (z, y, x) [voxel].
    """
    first, second = (_Volume.of(plan, *pair) for pair in zip(volumes, searches, strict=True))
    both = (first, second)
    voxels = [new_array(volume.voxels.size) for volume in both]
    lattices = [volume.statistics.lattice(plan, plan.origin) for volume in both]
    sums = [plane_sums_call(v.flat, plan, v.search, lattice) for v, lattice in zip(both, lattices, strict=True)]
    splits = [split_call(v.flat, plan, v.voxel_lattice(plan), to) for v, to in zip(both, voxels, strict=True)]
    launch(*splits, *sums)
    statistics = [
        statistics_call(volume.values, total, call.outputs[1:], plan, volume.search, lattice)
        for volume, total, call, lattice in zip(both, squares, sums, lattices, strict=True)
    ]
    launch(*statistics)
    first_side, second_side = (_side(*of) for of in zip(both, voxels, statistics, strict=True))
    return first_side, second_side


def _side(volume: _Volume, voxels: wp.array, statistics_call) -> Side:
    """Describe a volume's voxels and statistics for the kernels."""
    storage, lags, (along_z, along_y, along_x) = volume.voxels, volume.statistics, volume.search
    surroundings, blocks, statistics = Phased(), Phased(), Statistics()
    surroundings.values, surroundings.plane = voxels, storage.plane
    surroundings.along_y, surroundings.along_x = storage.along_y, storage.along_x
    blocks.values, blocks.plane = voxels[along_z * storage.plane :], storage.plane
    blocks.along_y, blocks.along_x = storage.along_y[along_y:], storage.along_x[along_x:]
    statistics.mean, statistics.scale = statistics_call.outputs
    statistics.along_y, statistics.along_x, statistics.plane = lags.along_y, lags.along_x, lags.plane
    statistics.centre = wp.vec3i(*volume.search)
    return Side(blocks, surroundings, statistics)
