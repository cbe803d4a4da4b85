"""Warp kernels for the statistics of windows at every lag; `correlation_sides` launches them.

Lanes, offsets and volumes split by phase are those of `correlation_kernels`.
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

_PLANE = VECTORS + read_native("windows_plane.inc")


@wp.func_native(_PLANE)
def _sum_plane(
    volume: wp.array(dtype=float),
    shape: wp.vec3i,
    margin: wp.vec3i,
    window: wp.vec3i,
    part: wp.vec2i,
    corner: int,
    stride: int,
    phases: int,
    z: int,
    slot: int,
    scratch_pitch: wp.int64,
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),
    square_out: wp.array(dtype=float),
): ...


@wp.kernel
def _sum_planes(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x)
    shape: wp.vec3i,
    margin: wp.vec3i,  # zeros around the volume along y and x that windows may cover
    window: wp.vec3i,
    part: wp.vec2i,  # factors of the window's edges along y and x
    corner: int,  # rows that windows start from: this one, each `stride` behind it, and as many after each as `phases`
    stride: int,
    phases: int,
    slot: int,  # scratch memory to use; -1: that of the plane
    scratch_pitch: wp.int64,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums over the windows' y and x, (z, y, x) with as many y and x as windows fit
    square_out: wp.array(dtype=float),  # the same of the squares
):
    z = begin + wp.tid()
    memory = slot
    if slot < 0:
        memory = z
    _sum_plane(
        volume,
        shape,
        margin,
        window,
        part,
        corner,
        stride,
        phases,
        z,
        memory,
        scratch_pitch,
        scratch_out,
        sum_out,
        square_out,
    )


_STATISTICS = read_native("windows_statistics.inc")


@wp.func_native(_STATISTICS)
def _row_statistics(
    sum: wp.array(dtype=float),
    squares: wp.array(dtype=float),
    shape: wp.vec3i,
    depth: int,
    count: int,
    floor: float,
    z: int,
    planes: int,
    stride_z: int,
    phases_z: int,
    y: int,
    corner: int,
    stride: int,
    phases: int,
    pitch: int,
    out: wp.int64,
    out_pitch: int,
    plane_pitch: wp.int64,
    mean_out: wp.array(dtype=float),
    scale_out: wp.array(dtype=float),
): ...


@wp.kernel
def _window_statistics(
    # in
    sum: wp.array(dtype=float),  # of `_sum_planes`
    squares: wp.array(dtype=float),
    shape: wp.vec3i,  # of `sum`
    margin: int,  # zeros before and behind the volume along z that windows may cover
    window: wp.vec3i,
    floor: float,  # window sum of squared deviations that is no signal
    corner: wp.vec3i,  # the lattice: window of plane 0, phase (0, 0), lane 0, counted from the first one that fits
    stride: wp.vec3i,
    phases: wp.vec3i,
    planes: int,
    pitch: int,
    lanes: int,
    begin: int,
    # out
    mean_out: wp.array(dtype=float),  # window means, split by phase
    scale_out: wp.array(dtype=float),  # 1 / sqrt(window sum of squared deviations), 0 where there is no signal
):
    y = begin + wp.tid()
    row = y - corner[1]
    if row >= 0 and row % stride[1] < phases[1] and (row // stride[1] + 1) * pitch <= lanes:
        _row_statistics(
            sum,
            squares,
            shape,
            window[0],
            window[0] * window[1] * window[2],
            floor,
            corner[0] - margin,
            planes,
            stride[0],
            phases[0],
            y,
            corner[2],
            stride[2],
            phases[2],
            pitch,
            wp.int64(row % stride[1] * phases[2]) * wp.int64(lanes) + wp.int64(row // stride[1] * pitch),
            lanes,
            wp.int64(phases[1] * phases[2]) * wp.int64(lanes),
            mean_out,
            scale_out,
        )
