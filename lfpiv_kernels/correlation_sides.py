"""One volume of a correlation as the kernels take it: split by phase, with the statistics of its windows."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from . import correlation_kernels as kernels
from . import runtime, window_kernels
from .correlation_kernels import LANES
from .correlation_memory import launch, new_array, to_device
from .correlation_plan import Plan, largest_factor, whole_groups

SIGNAL_FLOOR = 1e-4
"""A window whose variance is below this part of the whole volume's variance holds no signal."""


class Side:
    """One volume as the kernels take it: split by phase, with the statistics of its windows at every lag."""

    def __init__(self, plan: Plan, volume: np.ndarray, squares: float, search: tuple[int, int, int]):
        self.volume, self.search = np.ascontiguousarray(volume, np.float32), search
        self.lags = tuple(2 * r + 1 for r in search)
        reach = [b + n - 1 for b, n in zip(plan.block, self.lags, strict=True)]
        corner = tuple(o - r for o, r in zip(plan.origin, search, strict=True))
        self.voxels = Split.empty(plan, reach)
        phases, lanes = wp.vec2i(*self.voxels.shape[1:3]), self.voxels.shape[3]
        layout = [wp.vec3i(*plan.shape), wp.vec3i(*corner), wp.vec2i(*plan.stride[1:]), phases, plan.pitch, lanes]
        inputs = [to_device(self.volume.ravel()), *layout]
        launch(kernels._split, self.voxels.shape[0], (), inputs, [self.voxels.flat])
        self.mean, self.scale = _statistics(plan, self.volume, squares, search)


@dataclass(frozen=True)
class Split:
    """Values at the lattice of blocks and at every offset from it, (plane, phase y, phase x, lane)."""

    shape: tuple[int, int, int, int]
    array: wp.array
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
        return cls(shape, new_array(shape), (along_y, _offsets(reach[2], plan.stride[2], lanes, 1)))

    @property
    def flat(self) -> wp.array:
        """The array as the kernels index it."""
        return self.array.flatten()

    @property
    def plane(self) -> int:
        """Elements per plane."""
        return math.prod(self.shape[1:])


@functools.lru_cache
def _offsets(reach: int, stride: int, phase_pitch: int, lane_pitch: int) -> wp.array:
    """Distance in memory for the offsets 0 to ``reach - 1`` along one axis; a call needs many, seldom new ones."""
    offset = np.arange(reach, dtype=np.int32)
    return to_device(offset % stride * phase_pitch + offset // stride * lane_pitch, int)


def _statistics(plan: Plan, volume: np.ndarray, squares: float, search: tuple[int, int, int]) -> tuple[Split, Split]:
    """Mean of the windows at every lag, and 1 / sqrt(sum of squared deviations), 0 where there is no signal."""
    window, shape, where = wp.vec3i(*plan.window), wp.vec3i(*plan.shape), runtime.device()
    on_cpu = where.kind == "cpu"
    sums = tuple(n + 2 * r - w + 1 for n, r, w in zip(plan.shape, search, plan.window, strict=True))
    rows = plan.shape[0], *sums[1:]
    total, square = (new_array(rows) for _ in range(2))
    lags = tuple(2 * r + 1 for r in search)
    phases = tuple(min(s, n) for s, n in zip(plan.stride, lags, strict=True))
    pitch = whole_groups(plan.shape[2] + 2 * search[2] + LANES)
    scratch_pitch = pitch * (4 + 2 * plan.shape[1] + 2 * (plan.shape[1] + 2 * search[1] + 1))
    scratch = new_array(((runtime.CHUNKS if on_cpu else plan.shape[0]) * scratch_pitch,))
    inputs = [
        to_device(volume.ravel()),
        shape,
        wp.vec3i(*search),
        window,
        wp.vec2i(*map(largest_factor, plan.window[1:])),
    ]
    inputs += [plan.origin[1], plan.stride[1], phases[1]]
    outputs = [array.flatten() for array in (scratch, total, square)]
    launch(window_kernels._sum_planes, plan.shape[0], (), inputs, outputs, slots=True, after_slot=[scratch_pitch])
    variance = squares / volume.size - float(volume.mean()) ** 2
    floor = SIGNAL_FLOOR * math.prod(plan.window) * variance + float(np.finfo(np.float32).tiny)
    mean, scale = (Split.empty(plan, lags) for _ in range(2))
    lattice = [wp.vec3i(*plan.origin), wp.vec3i(*plan.stride), wp.vec3i(*phases)]
    layout = [wp.vec3i(*rows), search[0], window, floor, *lattice]
    inputs = [*outputs[1:], *layout, mean.shape[0], plan.pitch, mean.shape[3]]
    launch(window_kernels._window_statistics, sums[1], (), inputs, [mean.flat, scale.flat])
    return mean, scale
