"""Warp kernel that finds the peaks of a correlation: `correlate` launches it.

Lanes, offsets and statistics split by phase are those of `correlation_kernels` and `window_kernels`.
"""

import warp as wp

from lfpiv_kernels.correlation.blocks import VECTORS
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


@wp.kernel
def _find_peaks(
    # in
    ahead: wp.array(dtype=float),  # sums of products of blocks of the first volume, (layer, lag, lane)
    behind: wp.array(dtype=float),  # of blocks of the second volume, whose lags count backwards
    symmetric: int,  # 1: average both; 0: `behind` is not read
    first_mean: wp.array(dtype=float),  # of `_window_statistics`, at every lag where symmetric, else at lag 0
    first_scale: wp.array(dtype=float),
    second_mean: wp.array(dtype=float),  # at every lag
    second_scale: wp.array(dtype=float),
    first_y: wp.array(dtype=int),  # offsets along y and x, see the head of this module
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    pitches: wp.vec2i,  # elements per plane of the statistics of either volume
    first_centre: wp.vec3i,  # lag index of lag 0 in the first's statistics
    stride: int,  # distance of layers of blocks [voxel]
    count: int,  # voxels in a window
    blocks: wp.vec3i,  # blocks per window and axis
    block_step: int,  # layers of blocks from one layer of windows to the next
    lags: wp.vec3i,
    begin_layer: int,  # of windows
    ring: int,  # layers of blocks that the sums hold: layer i lies at i % ring
    groups: int,  # groups of lanes
    group: int,  # lanes of a group: a multiple of `LANES` on the CPU, 1 on CUDA
    pitch: int,  # lanes per row
    sum_pitch: int,  # lanes per lag
    slot: int,
    slot_pitch: wp.int64,
    score_pitch: int,
    out_pitch: wp.int64,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    peak_out: wp.array(dtype=float),  # two displacements (z, y, x), best and rival coefficient; each (layer, lane)
):
    index = begin + wp.tid()
    lane = (index % groups) * group
    layer = begin_layer + index // groups
    lanes = wp.min(group, sum_pitch - lane)
    scratch = wp.int64(slot) * slot_pitch
    if slot < 0:
        scratch = wp.int64(index)
    _measure_windows(
        ahead,
        behind,
        symmetric,
        first_mean,
        first_scale,
        second_mean,
        second_scale,
        first_y,
        first_x,
        second_y,
        second_x,
        pitches[0],
        pitches[1],
        first_centre,
        stride,
        count,
        blocks,
        lags,
        layer * block_step,
        lane,
        lanes,
        ring,
        pitch,
        sum_pitch,
        scratch,
        score_pitch,
        wp.int64(layer) * wp.int64(sum_pitch) + wp.int64(lane),
        out_pitch,
        scratch_out,
        peak_out,
    )
