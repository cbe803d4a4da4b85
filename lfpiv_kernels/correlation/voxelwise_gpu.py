"""Small steps from voxel to voxel on a GPU, a thread per voxel; host functions and CPU forms: ``light``, ``fluid``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.launch import Call, launch

wp.set_module_options(native.quiet_options())


@wp.kernel
def _as_power(
    # in
    volume: wp.array3d(dtype=float),
    exponent: float,
    begin: int,
    # out
    power_out: wp.array3d(dtype=float),  # negative intensities as 0
):
    layer, y, x = wp.tid()
    z = begin + layer
    value = wp.max(volume[z, y, x], 0.0)
    if exponent != 1.0:
        value = wp.pow(value, exponent)
    power_out[z, y, x] = value


@wp.kernel
def _subtract(
    # in
    one: wp.array3d(dtype=float),
    other: wp.array3d(dtype=float),
    begin: int,
    # out
    difference_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    difference_out[z, y, x] = one[z, y, x] - other[z, y, x]


@wp.kernel
def _share_light(
    # in
    one: wp.array3d(dtype=float),
    other: wp.array3d(dtype=float),
    scale_one: float,
    scale_other: float,
    begin: int,
    # out
    least_out: wp.array3d(dtype=float),
    mean_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    first = one[z, y, x] * scale_one
    second = other[z, y, x] * scale_other
    least_out[z, y, x] = wp.min(first, second)
    mean_out[z, y, x] = (first + second) / 2.0


@wp.kernel
def _invert(
    # in
    flag: wp.array3d(dtype=wp.bool),
    begin: int,
    # out
    flag_out: wp.array3d(dtype=wp.bool),
):
    layer, y, x = wp.tid()
    z = begin + layer
    flag_out[z, y, x] = not flag[z, y, x]


@wp.kernel
def _as_numbers(
    # in
    flag: wp.array3d(dtype=wp.bool),
    begin: int,
    # out
    number_out: wp.array3d(dtype=float),  # 1 where flagged
):
    layer, y, x = wp.tid()
    z = begin + layer
    number_out[z, y, x] = wp.where(flag[z, y, x], 1.0, 0.0)


@wp.func
def _differ(one: wp.array3d(dtype=float), other: wp.array3d(dtype=float), z: int, y: int, x: int):
    """Return whether just one of two volumes holds solid at a voxel; false outside."""
    if z < 0 or y < 0 or x < 0 or z >= one.shape[0] or y >= one.shape[1] or x >= one.shape[2]:
        return False
    return (one[z, y, x] > 0.5) != (other[z, y, x] > 0.5)


@wp.kernel
def _find_fluid(
    # in
    one: wp.array3d(dtype=float),  # solid: above 1/2
    other: wp.array3d(dtype=float),
    begin: int,
    # out
    fluid_out: wp.array3d(dtype=wp.bool),
):
    layer, y, x = wp.tid()
    z = begin + layer
    moved = _differ(one, other, z - 1, y, x) or _differ(one, other, z + 1, y, x)
    moved = moved or _differ(one, other, z, y - 1, x) or _differ(one, other, z, y + 1, x)
    moved = moved or _differ(one, other, z, y, x - 1) or _differ(one, other, z, y, x + 1)
    fluid_out[z, y, x] = not moved and one[z, y, x] <= 0.5 and other[z, y, x] <= 0.5


@wp.kernel
def _in_fluid(
    # in
    volume: wp.array3d(dtype=float),
    fluid: wp.array3d(dtype=wp.bool),
    begin: int,
    # out
    volume_out: wp.array3d(dtype=float),  # 0 elsewhere
):
    layer, y, x = wp.tid()
    z = begin + layer
    volume_out[z, y, x] = wp.where(fluid[z, y, x], volume[z, y, x], 0.0)


@wp.kernel
def _level(
    # in
    volume: wp.array3d(dtype=float),
    mean: wp.array3d(dtype=float),  # local mean of the volume, 0 outside the fluid
    share: wp.array3d(dtype=float),  # local mean of the fluid
    fluid: wp.array3d(dtype=wp.bool),
    least: float,
    begin: int,
    # out
    level_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    level = float(0.0)
    if fluid[z, y, x]:
        level = volume[z, y, x] - mean[z, y, x] / wp.max(share[z, y, x], least)
    level_out[z, y, x] = level


def run(kernel: wp.Kernel, inputs: list[object], *outputs: wp.array) -> None:
    """Launch a kernel with a thread per voxel of its outputs."""
    depth, *plane = outputs[0].shape
    launch(Call(kernel, depth, inputs, outputs, inner=tuple(plane)))
