"""A volume stored by phase on a GPU; host function and CPU form: ``blocks.split_call``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Lattice
from lfpiv_kernels.lanes import LANES, lanes_of_warp
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("split_gpu.h"))


@native.kernel(
    """
    lfpiv::split_lanes(
        volume.data, shape, lattice, plane, task, split_out.data
    );
    """,
    "plane",
    "task",
    "_lane",
)
def _split_voxels(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x); a warp per plane, phase along y and 32 lanes
    shape: wp.vec3i,
    lattice: Lattice,
    first_plane: int,
    # out
    split_out: wp.array(dtype=float),
): ...


def split_call(inputs: list[object], lattice: Lattice, split: wp.array) -> Call:
    """Return the call that stores a volume by phase: a warp per plane, phase along y and group of lanes."""
    tasks = lattice.phases[1] * -(-lattice.lanes // LANES)
    return Call(_split_voxels, lattice.planes, inputs, [split], inner=(tasks, *lanes_of_warp()))
