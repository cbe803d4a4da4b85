"""Correlation coefficients of windows from the sums of products of their blocks, and the two highest peaks of each.

In: sums of products (`blocks`, `spectra`) and the statistics of the windows (`windows`). Out: displacement of the two
highest peaks by a three-point Gaussian fit along each axis, the highest coefficient, and the highest one that lies more
than two lags away from it. Inner loops are C++.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation.blocks import VECTORS, is_gathered
from lfpiv_kernels.correlation.layout import Statistics
from lfpiv_kernels.correlation.memory import Call, launch, new_array
from lfpiv_kernels.correlation.plan import LANES, Plan
from lfpiv_kernels.correlation.sides import Side
from lfpiv_kernels.native import read_native

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

_PEAKS = VECTORS + read_native("peaks_peaks.inc")


@wp.func_native(_PEAKS)
def _measure_windows(
    ahead: wp.array(dtype=float),
    behind: wp.array(dtype=float),
    symmetric: int,
    first_mean: wp.array(dtype=float),
    first_scale: wp.array(dtype=float),
    second_mean: wp.array(dtype=float),
    second_scale: wp.array(dtype=float),
    first_y: wp.array(dtype=int),
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    first_pitch: int,
    second_pitch: int,
    first_centre: wp.vec3i,
    stride: int,
    count: int,
    blocks: wp.vec3i,
    lags: wp.vec3i,
    layer: int,
    lane: int,
    lanes: int,
    ring: int,
    pitch: int,
    sum_pitch: int,
    scratch: wp.int64,
    score_pitch: int,
    out_lane: wp.int64,
    out_pitch: wp.int64,
    scratch_out: wp.array(dtype=float),
    peak_out: wp.array(dtype=float),
): ...


@wp.struct
class Windows:
    """Windows whose peaks a launch finds, and the memory of their sums, coefficients and peaks."""

    voxels: int  # in a window
    blocks: wp.vec3i  # blocks per window and axis that are still to be added up
    block_step: int  # layers of blocks from one layer of windows to the next
    stride: int  # distance of layers of blocks [voxel]
    lags: wp.vec3i
    begin: int  # first layer of windows
    ring: int  # layers of blocks that the sums have memory for: layer i lies at i % ring
    groups: int  # groups of lanes
    group: int  # lanes per group: a multiple of `LANES` on the CPU, 1 on CUDA
    pitch: int  # lanes per row
    lanes: int  # lanes per lag
    slot_pitch: wp.int64  # elements of scratch memory per slot
    score_pitch: int  # elements from one lag's coefficients to the next
    peak_pitch: wp.int64  # elements per value of the peaks


@wp.kernel
def _find_peaks(
    # in
    ahead: wp.array(dtype=float),  # sums of products of blocks of the first volume, (layer, lag, lane)
    behind: wp.array(dtype=float),  # the same of blocks of the second volume: lags count backwards
    symmetric: int,  # 1: average both; 0: `behind` is not read
    first: Statistics,  # of windows at every lag if symmetric, else at lag 0
    second: Statistics,  # at every lag
    windows: Windows,
    slot: int,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    peak_out: wp.array(dtype=float),  # two displacements (z, y, x), best and rival coefficient; each (layer, lane)
):
    index = begin + wp.tid()
    lane = (index % windows.groups) * windows.group
    layer = windows.begin + index // windows.groups
    lanes = wp.min(windows.group, windows.lanes - lane)
    scratch = wp.int64(slot) * windows.slot_pitch
    if slot < 0:
        scratch = wp.int64(index)
    _measure_windows(
        ahead,
        behind,
        symmetric,
        first.mean,
        first.scale,
        second.mean,
        second.scale,
        first.along_y,
        first.along_x,
        second.along_y,
        second.along_x,
        first.plane,
        second.plane,
        first.centre,
        windows.stride,
        windows.voxels,
        windows.blocks,
        windows.lags,
        layer * windows.block_step,
        lane,
        lanes,
        windows.ring,
        windows.pitch,
        windows.lanes,
        scratch,
        windows.score_pitch,
        wp.int64(layer) * wp.int64(windows.lanes) + wp.int64(lane),
        windows.peak_pitch,
        scratch_out,
        peak_out,
    )


SCORE_BYTES = 1 << 23
"""Memory for the coefficients of a CPU task [byte]."""


@dataclass(frozen=True)
class PeakFinder:
    """Search for the peaks of all windows, some layers at a time."""

    plan: Plan
    sides: tuple[Side, Side]
    symmetric: bool
    ring: int
    """Layers of blocks that the sums have memory for."""
    group: int
    """Lanes per task."""
    rows: int
    """Coefficients per lane: one per lag, and the highest of each row of lags."""
    scratch: wp.array
    peaks: wp.array

    @classmethod
    def prepare(cls, plan: Plan, sides: tuple[Side, Side], symmetric: bool, ring: int, depth: int) -> "PeakFinder":
        """Allocate memory for the coefficients of at most `depth` layers of windows at once, and for all peaks."""
        lags, group = math.prod(plan.lags), 1
        rows = lags + math.prod(plan.lags[:2])
        if runtime.device().kind == "cpu":
            group = LANES * min(-(-plan.lanes // LANES), max(1, SCORE_BYTES // (4 * LANES * lags)))
            size = runtime.CHUNKS * _slot_pitch(plan, rows, group)
        else:
            size = depth * plan.lanes * rows
        peaks = new_array(8 * plan.count[0] * plan.lanes)
        return cls(plan, sides, symmetric, ring, group, rows, new_array(size), peaks)

    def find(self, ahead: wp.array, behind: wp.array, layers: range) -> None:
        """Find the peaks of some layers of windows from the sums of products of their blocks in both directions."""
        first, second = self.sides
        windows = self._windows(layers)
        inputs = [ahead, behind, int(self.symmetric), first.statistics, second.statistics, windows]
        launch(Call(_find_peaks, len(layers) * windows.groups, inputs, [self.scratch, self.peaks], scratch=True))

    def _windows(self, layers: range) -> Windows:
        plan, windows = self.plan, Windows()
        windows.voxels, windows.lags = math.prod(plan.window), wp.vec3i(*plan.lags)
        windows.blocks = wp.vec3i(*((plan.block_count[0], 1, 1) if is_gathered(plan) else plan.block_count))
        windows.block_step, windows.stride = plan.block_step[0], plan.stride[0]
        windows.begin, windows.ring = layers.start, self.ring
        windows.groups, windows.group = -(-plan.lanes // self.group), self.group
        windows.pitch, windows.lanes = plan.pitch, plan.lanes
        windows.slot_pitch = _slot_pitch(plan, self.rows, self.group)
        windows.score_pitch = self.group if runtime.device().kind == "cpu" else len(layers) * windows.groups
        windows.peak_pitch = plan.count[0] * plan.lanes
        return windows

    def values(self) -> np.ndarray:
        """Return two displacements (z, y, x), highest coefficient and its rival of all windows, (8, z, y, x)."""
        plan = self.plan
        lanes = self.peaks.numpy().reshape(8, plan.count[0], -1)[..., : plan.block_grid[1] * plan.pitch]
        blocks = lanes.reshape(8, plan.count[0], -1, plan.pitch)
        along = (slice(0, (c - 1) * m + 1, m) for c, m in zip(plan.count[1:], plan.block_step[1:], strict=True))
        return blocks[(slice(None), slice(None), *along)]


def _slot_pitch(plan: Plan, rows: int, group: int) -> int:
    """Elements of scratch memory per slot."""
    return rows * group + group + plan.block_count[2] + LANES
