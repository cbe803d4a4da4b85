"""A volume stored by phase on a GPU; host function and CPU form: ``blocks.split_call``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Lattice

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
def split_voxels(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x); a thread per element of `split_out`
    shape: wp.vec3i,
    lattice: Lattice,
    begin: int,
    # out
    split_out: wp.array(dtype=float),
):
    """Store one voxel by phase, 0 outside the volume."""
    plane, place = wp.tid()
    _split_voxel(volume, shape, lattice, begin + plane, place, split_out)
