"""A volume stored by phase on a GPU; host function and CPU form: ``blocks.split_call``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Lattice
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("split_gpu.h"))


@wp.func_native("lfpiv::split_voxel(volume.data, shape, lattice, plane, place, split_out.data);")
def _split_voxel(
    volume: wp.array(dtype=float),
    shape: wp.vec3i,
    lattice: Lattice,
    plane: int,
    place: int,
    split_out: wp.array(dtype=float),
): ...


@wp.kernel
def _split_voxels(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x); a thread per element of `split_out`
    shape: wp.vec3i,
    lattice: Lattice,
    begin: int,
    # out
    split_out: wp.array(dtype=float),
):
    plane, place = wp.tid()
    _split_voxel(volume, shape, lattice, begin + plane, place, split_out)


def split_call(inputs: list[object], lattice: Lattice, split: wp.array) -> Call:
    """Return the call that stores a volume by phase: a thread per element of `split`."""
    plane = lattice.phases[1] * lattice.phases[2] * lattice.lanes
    return Call(_split_voxels, lattice.planes, inputs, [split], inner=(plane,))
