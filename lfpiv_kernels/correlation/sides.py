"""One volume of a correlation as the kernels take it: split by phase, with the statistics of its windows."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import blocks as kernels
from lfpiv_kernels.correlation import windows
from lfpiv_kernels.correlation.blocks import LANES
from lfpiv_kernels.correlation.memory import Call, launch, new_array, to_device
from lfpiv_kernels.correlation.plan import Plan, largest_factor, whole_groups

SIGNAL_FLOOR = 1e-4
"""A window whose variance is below this part of the whole volume's variance holds no signal."""


@dataclass(frozen=True)
class Split:
    """Values at the lattice of blocks and at every offset from it, (plane, phase y, phase x, lane)."""

    shape: tuple[int, int, int, int]
    values: wp.array
    """Flat."""
    offsets: tuple[wp.array, wp.array]
    """Distance in memory for every offset in voxels along y and x."""

    @classmethod
    def empty(cls, plan: Plan, reach: tuple[int, int, int]) -> Split:
        """Room for the offsets 0 to ``reach - 1``."""
        phases = tuple(min(s, r) for s, r in zip(plan.stride, reach, strict=True))
        past = [(r - 1) // s for r, s in zip(reach, plan.stride, strict=True)]
        lanes = whole_groups(plan.lanes + past[1] * plan.pitch + past[2] + LANES)
        shape = ((plan.block_grid[0] - 1) * plan.stride[0] + reach[0], phases[1], phases[2], lanes)
        along_y = _offsets(reach[1], plan.stride[1], phases[2] * lanes, plan.pitch)
        return cls(shape, new_array(math.prod(shape)), (along_y, _offsets(reach[2], plan.stride[2], lanes, 1)))

    @property
    def plane(self) -> int:
        """Elements per plane."""
        return math.prod(self.shape[1:])


@functools.lru_cache
def _offsets(reach: int, stride: int, phase_pitch: int, lane_pitch: int) -> wp.array:
    """Distance in memory for the offsets 0 to ``reach - 1`` along one axis; a call needs many, seldom new ones."""
    offset = np.arange(reach, dtype=np.int32)
    return to_device(offset % stride * phase_pitch + offset // stride * lane_pitch, int)


@dataclass(frozen=True)
class Side:
    """One volume as the kernels take it: split by phase, with the statistics of its windows at every lag."""

    volume: np.ndarray
    search: tuple[int, int, int]
    """Largest lags at which windows are taken; lag 0 alone where they do not move."""
    voxels: Split
    mean: Split
    """Mean of the windows at every lag."""
    scale: Split
    """1 / sqrt(sum of squared deviations) of the same, 0 where there is no signal."""

    @classmethod
    def empty(cls, plan: Plan, volume: np.ndarray, search: tuple[int, int, int]) -> Side:
        """Room for one side."""
        lags = tuple(2 * r + 1 for r in search)
        reach = tuple(b + n - 1 for b, n in zip(plan.block, lags, strict=True))
        mean, scale = (Split.empty(plan, lags) for _ in range(2))
        return cls(np.ascontiguousarray(volume, np.float32), search, Split.empty(plan, reach), mean, scale)


def make_sides(
    plan: Plan,
    volumes: tuple[np.ndarray, np.ndarray],
    squares: Sequence[float],
    searches: tuple[tuple[int, int, int], tuple[int, int, int]],
) -> tuple[Side, Side]:
    """Prepare both volumes, given their sums of squares and the largest lags at which their windows are taken."""
    first, second = (Side.empty(plan, *pair) for pair in zip(volumes, searches, strict=True))
    sums = [_plane_sums(plan, side) for side in (first, second)]
    launch(_split(plan, first), _split(plan, second), *(call for call, _ in sums))
    of_both = zip((first, second), squares, (room for _, room in sums), strict=True)
    launch(*(_statistics(plan, *of) for of in of_both))
    return first, second


def _split(plan: Plan, side: Side) -> Call:
    """Store the volume split by phase."""
    voxels = side.voxels
    corner = tuple(o - r for o, r in zip(plan.origin, side.search, strict=True))
    phases, lanes = wp.vec2i(*voxels.shape[1:3]), voxels.shape[3]
    layout = [wp.vec3i(*plan.shape), wp.vec3i(*corner), wp.vec2i(*plan.stride[1:]), phases, plan.pitch, lanes]
    return Call(kernels._split, voxels.shape[0], [to_device(side.volume.ravel()), *layout], [voxels.values])


def _sums_shape(plan: Plan, side: Side) -> tuple[int, int, int]:
    """Planes of the volume, and the windows that fit along y and x with zeros around it."""
    depth, *along = plan.shape
    reach = zip(along, side.search[1:], plan.window[1:], strict=True)
    return depth, *(n + 2 * r - w + 1 for n, r, w in reach)


def _plane_sums(plan: Plan, side: Side) -> tuple[Call, list[wp.array]]:
    """Sum over the windows' y and x, and where these sums and those of squares go."""
    sums = [new_array(math.prod(_sums_shape(plan, side))) for _ in range(2)]
    pitch = whole_groups(plan.shape[2] + 2 * side.search[2] + LANES)
    scratch_pitch = pitch * (4 + 2 * plan.shape[1] + 2 * (plan.shape[1] + 2 * side.search[1] + 1))
    on_cpu = runtime.device().kind == "cpu"
    scratch = new_array((runtime.CHUNKS if on_cpu else plan.shape[0]) * scratch_pitch)
    factors = wp.vec2i(*map(largest_factor, plan.window[1:]))
    layout = [wp.vec3i(*plan.shape), wp.vec3i(*side.search), wp.vec3i(*plan.window), factors]
    rows = [plan.origin[1], plan.stride[1], side.mean.shape[1]]
    inputs = [to_device(side.volume.ravel()), *layout, *rows]
    return Call(windows._sum_planes, plan.shape[0], inputs, [scratch, *sums], after_slot=[scratch_pitch]), sums


def _statistics(plan: Plan, side: Side, squares: float, sums: list[wp.array]) -> Call:
    """Statistics of the windows from what `_plane_sums` summed."""
    variance = squares / side.volume.size - float(side.volume.mean()) ** 2
    floor = SIGNAL_FLOOR * math.prod(plan.window) * variance + float(np.finfo(np.float32).tiny)
    phases = [min(s, 2 * r + 1) for s, r in zip(plan.stride, side.search, strict=True)]
    lattice = [wp.vec3i(*plan.origin), wp.vec3i(*plan.stride), wp.vec3i(*phases)]
    shape = _sums_shape(plan, side)
    layout = [wp.vec3i(*shape), side.search[0], wp.vec3i(*plan.window), floor, *lattice]
    planes, _, _, lanes = side.mean.shape
    inputs = [*sums, *layout, planes, plan.pitch, lanes]
    outputs = [side.mean.values, side.scale.values]
    return Call(windows._window_statistics, shape[1], inputs, outputs)
