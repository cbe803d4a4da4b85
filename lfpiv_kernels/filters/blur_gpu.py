"""Gaussian blur of a volume on a GPU, one axis after the other; host functions and CPU form: ``blur``."""

from collections.abc import Sequence

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.filters.blur_layout import Axis
from lfpiv_kernels.lanes import LANES, lanes_of_warp
from lfpiv_kernels.launch import Call, launch

wp.set_module_options(native.options("blur_gpu.h", contract="fast"))


@native.kernel(
    """
    lfpiv::blur_lanes(
        lfpiv::axis_blur(axis), stride, warp, volume.shape[0], volume.data, blurred_out.data
    );
    """,
    "warp",
    "_lane",
)
def _blur_axis(
    # in
    axis: Axis,
    stride: int,  # from a voxel to the next along the axis
    volume: wp.array(dtype=float),
    first_warp: int,
    # out
    blurred_out: wp.array(dtype=float),
): ...


def blur(axes: Sequence[Axis], volume: wp.array, work_out: wp.array, blurred_out: wp.array) -> None:
    """Write a volume blurred along its three axes, outermost first; `work_out` has its size."""
    warps, stride = -(-volume.size // LANES), volume.size
    for axis, source, target in zip(
        axes, (volume, blurred_out, work_out), (blurred_out, work_out, blurred_out), strict=True
    ):
        stride //= len(axis.first)
        launch(Call(_blur_axis, warps, [axis, stride, source], [target], inner=lanes_of_warp()))
