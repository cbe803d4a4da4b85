"""Statistics of a volume's windows at every lag: mean and scale ``1 / sqrt(sum of squared deviations)``.

Two steps: sums over the windows' y and x in each plane, then sums of planes along z. Inner loops are C++.
"""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import windows_gpu
from lfpiv_kernels.correlation.layout import Extent, Lattice
from lfpiv_kernels.correlation.memory import new_array
from lfpiv_kernels.correlation.plan import LANES, Plan, Triple, largest_factor, whole_groups
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("windows.h", contract="fast"))

SIGNAL_FLOOR = 1e-4
"""Lowest variance of a window that holds signal, as a share of the whole volume's variance."""


@native.kernel("""
    lfpiv::sum_plane(
        volume.data, extent, lattice, z, scratch_out.data + (int64_t)slot * scratch_pitch, sum_out.data,
        square_out.data
    );
""")
def _sum_planes(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x)
    extent: Extent,
    lattice: Lattice,  # windows wanted, counted from the first that fits
    scratch_pitch: wp.int64,
    slot: int,  # scratch memory to use
    first_z: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums over the windows' y and x, (z, y, x) with as many y and x as windows fit
    square_out: wp.array(dtype=float),  # the same of the squares
): ...


@native.kernel("""
    lfpiv::measure_row(
        sum.data, square.data, extent, floor, lattice, y, mean_out.data, scale_out.data
    );
""")
def _window_statistics(
    # in
    sum: wp.array(dtype=float),  # of `_sum_planes`
    square: wp.array(dtype=float),
    extent: Extent,
    floor: float,  # sum of squared deviations up to which a window holds no signal
    lattice: Lattice,  # windows wanted, counted from the first that fits
    first_y: int,
    # out
    mean_out: wp.array(dtype=float),  # stored by phase
    scale_out: wp.array(dtype=float),  # the same
): ...


def _extent(plan: Plan, search: Triple) -> Extent:
    """Describe a plan's volume for windows that move by up to `search`."""
    extent = Extent()
    extent.shape, extent.margin, extent.window = (wp.vec3i(*triple) for triple in (plan.shape, search, plan.window))
    extent.factors = wp.vec2i(*map(largest_factor, plan.window[1:]))
    return extent


def plane_sums_shape(plan: Plan, search: Triple) -> Triple:
    """Return the planes of the volume, and the windows that fit along y and x with zeros around it."""
    depth, *along = plan.shape
    reach = zip(along, search[1:], plan.window[1:], strict=True)
    return depth, *(n + 2 * r - w + 1 for n, r, w in reach)


def plane_sums_calls(
    volume: wp.array, plan: Plan, search: Triple, lattice: Lattice, sums: tuple[wp.array, wp.array]
) -> list[Call]:
    """Return the calls, one after the other, that sum values and squares of each plane over the windows' y and x."""
    if runtime.device().form == "gpu":
        return windows_gpu.sums_calls(volume, _extent(plan, search), lattice, plane_sums_shape(plan, search), sums)
    pitch = whole_groups(plan.shape[2] + 2 * search[2] + LANES)
    scratch_pitch = pitch * (4 + 2 * plan.shape[1] + 2 * (plan.shape[1] + 2 * search[1] + 1))
    inputs, scratch = [volume, _extent(plan, search), lattice, scratch_pitch], new_array(runtime.CHUNKS * scratch_pitch)
    return [Call(_sum_planes, plan.shape[0], inputs, [scratch, *sums], scratch=True)]


def signal_floor(mean: float, square: float, plan: Plan) -> float:
    """Return the sum of squared deviations up to which a window holds no signal.

    `mean` is that of the volume, `square` the sum of its squares.
    """
    variance = square / math.prod(plan.shape) - mean**2
    return SIGNAL_FLOOR * math.prod(plan.window) * variance + float(np.finfo(np.float32).tiny)


def statistics_calls(
    sums: tuple[wp.array, wp.array],
    plan: Plan,
    search: Triple,
    lattice: Lattice,
    floor: float,
    statistics: tuple[wp.array, wp.array],
) -> list[Call]:
    """Return the calls, one after the other, that find mean and scale of windows from the sums of their planes."""
    inputs, fitting = [*sums, _extent(plan, search), floor, lattice], plane_sums_shape(plan, search)
    if runtime.device().form == "gpu":
        return windows_gpu.statistics_calls(inputs, lattice, fitting, statistics)
    return [Call(_window_statistics, fitting[1], inputs, statistics)]
