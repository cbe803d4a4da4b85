"""Statistics of a volume's windows at every lag: mean and scale ``1 / sqrt(sum of squared deviations)``.

Two steps: sums over the windows' y and x in each plane, then sums of planes along z. Inner loops are C++.
"""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation.blocks import VECTORS
from lfpiv_kernels.correlation.layout import Lattice
from lfpiv_kernels.correlation.memory import Call, new_array
from lfpiv_kernels.correlation.plan import LANES, Plan, Triple, largest_factor, whole_groups
from lfpiv_kernels.native import read_native

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

SIGNAL_FLOOR = 1e-4
"""Lowest variance of a window that holds signal, as a share of the whole volume's variance."""

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
    margin: wp.vec3i,  # zeros around the volume that windows may cover
    window: wp.vec3i,
    factors: wp.vec2i,  # of the window's edges along y and x
    lattice: Lattice,  # windows wanted, counted from the first that fits
    scratch_pitch: wp.int64,
    slot: int,  # scratch memory to use; -1: that of the plane
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
        factors,
        lattice.corner[1],
        lattice.stride[1],
        lattice.phases[1],
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
    square: wp.array(dtype=float),
    shape: wp.vec3i,  # of `sum`
    margin: int,  # zeros before and behind the volume along z that windows may cover
    window: wp.vec3i,
    floor: float,  # sum of squared deviations up to which a window holds no signal
    lattice: Lattice,  # windows wanted, counted from the first that fits
    begin: int,
    # out
    mean_out: wp.array(dtype=float),  # stored by phase
    scale_out: wp.array(dtype=float),  # the same
):
    y = begin + wp.tid()
    row = y - lattice.corner[1]
    stride, phases, lanes = lattice.stride, lattice.phases, lattice.lanes
    if row >= 0 and row % stride[1] < phases[1] and (row // stride[1] + 1) * lattice.pitch <= lanes:
        _row_statistics(
            sum,
            square,
            shape,
            window[0],
            window[0] * window[1] * window[2],
            floor,
            lattice.corner[0] - margin,
            lattice.planes,
            stride[0],
            phases[0],
            y,
            lattice.corner[2],
            stride[2],
            phases[2],
            lattice.pitch,
            wp.int64(row % stride[1] * phases[2]) * wp.int64(lanes) + wp.int64(row // stride[1] * lattice.pitch),
            lanes,
            wp.int64(phases[1] * phases[2]) * wp.int64(lanes),
            mean_out,
            scale_out,
        )


def _sums_shape(plan: Plan, search: Triple) -> Triple:
    """Planes of the volume, and the windows that fit along y and x with zeros around it."""
    depth, *along = plan.shape
    reach = zip(along, search[1:], plan.window[1:], strict=True)
    return depth, *(n + 2 * r - w + 1 for n, r, w in reach)


def plane_sums_call(volume: wp.array, plan: Plan, search: Triple, lattice: Lattice) -> Call:
    """Return the call that sums values and squares of each plane over the windows' y and x, into new arrays."""
    sums = [new_array(math.prod(_sums_shape(plan, search))) for _ in range(2)]
    pitch = whole_groups(plan.shape[2] + 2 * search[2] + LANES)
    scratch_pitch = pitch * (4 + 2 * plan.shape[1] + 2 * (plan.shape[1] + 2 * search[1] + 1))
    on_cpu = runtime.device().kind == "cpu"
    scratch = new_array((runtime.CHUNKS if on_cpu else plan.shape[0]) * scratch_pitch)
    factors = wp.vec2i(*map(largest_factor, plan.window[1:]))
    inputs = [volume, wp.vec3i(*plan.shape), wp.vec3i(*search), wp.vec3i(*plan.window), factors, lattice, scratch_pitch]
    return Call(_sum_planes, plan.shape[0], inputs, [scratch, *sums], scratch=True)


def statistics_call(
    volume: np.ndarray, squares: float, sums: list[wp.array], plan: Plan, search: Triple, lattice: Lattice
) -> Call:
    """Return the call that finds mean and scale of windows from `plane_sums_call`'s sums, into new arrays.

    `squares` is the sum of the volume's squares.
    """
    variance = squares / volume.size - float(volume.mean()) ** 2
    floor = SIGNAL_FLOOR * math.prod(plan.window) * variance + float(np.finfo(np.float32).tiny)
    shape = _sums_shape(plan, search)
    inputs = [*sums, wp.vec3i(*shape), search[0], wp.vec3i(*plan.window), floor, lattice]
    size = lattice.planes * lattice.phases[1] * lattice.phases[2] * lattice.lanes
    return Call(_window_statistics, shape[1], inputs, [new_array(size) for _ in range(2)])
