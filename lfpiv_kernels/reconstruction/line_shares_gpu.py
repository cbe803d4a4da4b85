"""Voxels shared among neighbours on a line on a GPU; host functions and CPU form: ``line_shares``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.lanes import LANES, lanes_of_warp
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction.line_layout import LineMap

wp.set_module_options(native.options("line_shares_gpu.h", contract="fast"))


@native.kernel(
    """
    lfpiv::share_elements(
        lfpiv::line_map(map), warp, absolute, values.data, shared_out.data
    );
    """,
    "warp",
    "_lane",
)
def _share(
    # in
    map: LineMap,
    absolute: bool,
    values: wp.array(dtype=float),
    first_warp: int,
    # out
    shared_out: wp.array(dtype=float),
): ...


def share(map: LineMap, absolute: bool, values: wp.array, shared_out: wp.array) -> None:
    """Write every element; with `absolute` all shares count as positive."""
    inputs = [map, absolute, values]
    launch(Call(_share, -(-shared_out.size // LANES), inputs, [shared_out], inner=lanes_of_warp()))
