"""Sums of products of blocks and their surroundings on a GPU; host functions and CPU form: ``blocks``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Layers, Phased
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("blocks_gpu.h", contract="fast", gpu=True))


@native.kernel("lfpiv::correlate_lane(first, second, layers, task, sum_out.data);", registers=64)
def _correlate_lanes(
    # in
    first: Phased,  # blocks of the first volume
    second: Phased,  # their surroundings in the second volume, from the farthest lag on
    layers: Layers,  # a thread per lane, lag along y, lag along z and layer
    first_task: int,
    # out
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
): ...


def correlation_call(first: Phased, second: Phased, layers: Layers, count: int, sums: wp.array) -> Call:
    """Return the call that sums the products of `count` layers: a thread per lane and row of lags along x."""
    size = count * layers.lags[0] * layers.lags[1] * layers.lanes
    return Call(_correlate_lanes, size, [first, second, layers], [sums])
