"""Correlation coefficients of windows from the sums of products of their blocks, and the two highest peaks of each.

In: sums of products (`blocks`, `spectra`) and the statistics of the windows (`windows`). Out: displacement of the two
highest peaks by a three-point Gaussian fit along each axis, the highest coefficient, and the highest one that lies
beyond the reach of its peak. Inner loops are C++.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import peaks_gpu
from lfpiv_kernels.correlation.blocks import is_gathered
from lfpiv_kernels.correlation.layout import Statistics, Sums, Windows
from lfpiv_kernels.correlation.memory import new_array
from lfpiv_kernels.correlation.plan import LANES, Plan
from lfpiv_kernels.correlation.sides import Side
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_host

wp.set_module_options(native.options("peaks.h", contract="fast"))

SCORE_BYTES = 1 << 23
"""Memory for the coefficients of a CPU task [byte]."""


@native.kernel("lfpiv::find_peaks(sums, first, second, windows, slot, task, scratch_out.data, peak_out.data);")
def _find_peaks(
    # in
    sums: Sums,
    first: Statistics,  # of windows at every lag if symmetric, else at lag 0
    second: Statistics,  # at every lag
    windows: Windows,
    slot: int,
    first_task: int,
    # out
    scratch_out: wp.array(dtype=float),
    peak_out: wp.array(dtype=float),  # two displacements (z, y, x), best and rival coefficient; each (layer, lane)
): ...


@dataclass(frozen=True)
class PeakFinder:
    """Search for the peaks of all windows, some layers at a time."""

    plan: Plan
    sides: tuple[Side, Side]
    symmetric: bool
    reach: int
    """Lags around the highest coefficient that belong to its peak."""
    ring: int
    """Layers of blocks that the sums have memory for."""
    group: int
    """Lanes per task."""
    rows: int
    """Coefficients per lane on the CPU: one per lag, and the highest of each row of lags."""
    scratch: wp.array
    peaks: wp.array

    @classmethod
    def prepare(
        cls, plan: Plan, sides: tuple[Side, Side], symmetric: bool, reach: int, ring: int, depth: int
    ) -> "PeakFinder":
        """Allocate memory for the coefficients of at most `depth` layers of windows at once, and for all peaks."""
        lags, group = math.prod(plan.lags), 1
        rows = lags + math.prod(plan.lags[:2])
        if runtime.device().form == "cpu":
            group = LANES * min(-(-plan.lanes // LANES), max(1, SCORE_BYTES // (4 * LANES * lags)))
            size = runtime.CHUNKS * _slot_pitch(plan, rows, group)
        else:
            size = depth * plan.lanes * peaks_gpu.score_pitch(plan.lags)
        peaks = new_array(8 * plan.count[0] * plan.lanes)
        return cls(plan, sides, symmetric, reach, ring, group, rows, new_array(size), peaks)

    def find(self, ahead: wp.array, behind: wp.array, layers: range) -> None:
        """Find the peaks of some layers of windows from the sums of products of their blocks in both directions."""
        first, second = self.sides
        sums, windows = Sums(), self._windows(layers)
        sums.ahead, sums.behind, sums.symmetric = ahead, behind, int(self.symmetric)
        inputs = [sums, first.statistics, second.statistics, windows]
        count = len(layers) * windows.groups
        if runtime.device().form == "cpu":
            launch(Call(_find_peaks, count, inputs, [self.scratch, self.peaks], scratch=True))
            return
        for call in peaks_gpu.peak_calls(inputs, count, self.scratch, self.peaks):
            launch(call)

    def _windows(self, layers: range) -> Windows:
        plan, windows = self.plan, Windows()
        windows.voxels, windows.lags = math.prod(plan.window), wp.vec3i(*plan.lags)
        windows.blocks = wp.vec3i(*((plan.block_count[0], 1, 1) if is_gathered(plan) else plan.block_count))
        windows.block_step, windows.stride = plan.block_step[0], plan.stride[0]
        windows.reach = self.reach
        windows.begin, windows.ring = layers.start, self.ring
        windows.groups, windows.group = -(-plan.lanes // self.group), self.group
        windows.pitch, windows.lanes = plan.pitch, plan.lanes
        windows.slot_pitch = _slot_pitch(plan, self.rows, self.group)
        windows.score_pitch = self.group if runtime.device().form == "cpu" else peaks_gpu.score_pitch(plan.lags)
        windows.peak_pitch = plan.count[0] * plan.lanes
        return windows

    def values(self) -> np.ndarray:
        """Return two displacements (z, y, x), highest coefficient and its rival of all windows, (8, z, y, x)."""
        plan = self.plan
        lanes = to_host(self.peaks).reshape(8, plan.count[0], -1)[..., : plan.block_grid[1] * plan.pitch]
        blocks = lanes.reshape(8, plan.count[0], -1, plan.pitch)
        along = (slice(0, (c - 1) * m + 1, m) for c, m in zip(plan.count[1:], plan.block_step[1:], strict=True))
        return blocks[(slice(None), slice(None), *along)]


def _slot_pitch(plan: Plan, rows: int, group: int) -> int:
    """Elements of scratch memory per slot."""
    return rows * group + group + plan.block_count[2] + LANES
