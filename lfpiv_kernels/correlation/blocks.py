"""Direct correlation of blocks with their surroundings: sums of products at every lag, and sums of blocks over windows.

In: both volumes stored by phase (`layout.Phased`). Out: for every layer, lag and lane the sum over the block of
``a(r) b(r + lag)``. Inner loops are C++: a vector holds neighbouring blocks. A GPU takes the loops of `blocks_gpu`.
"""

import math
from dataclasses import dataclass

import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import blocks_gpu, split_gpu
from lfpiv_kernels.correlation.layout import Lattice, Layers, Phased, make_layers
from lfpiv_kernels.correlation.memory import new_array
from lfpiv_kernels.correlation.plan import LANES, Plan
from lfpiv_kernels.launch import Call, launch

wp.set_module_options(native.options("blocks.h", contract="fast"))


@native.kernel("lfpiv::split_plane(volume.data, shape, lattice, plane, split_out.data);")
def _split(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x)
    shape: wp.vec3i,
    lattice: Lattice,  # may reach beyond the volume, where values are 0
    first_plane: int,
    # out
    split_out: wp.array(dtype=float),  # (plane, phase y, phase x, lane)
): ...


def split_call(volume: wp.array, plan: Plan, lattice: Lattice, split: wp.array) -> Call:
    """Return the call that stores a volume by phase."""
    inputs = [volume, wp.vec3i(*plan.shape), lattice]
    if runtime.device().form == "gpu":
        return split_gpu.split_call(inputs, lattice, split)
    return Call(_split, lattice.planes, inputs, [split])


@native.kernel("""
#if !LFPIV_GPU
    lfpiv::correlate_blocks(
        first, second, layers, task, scratch_out.data + (int64_t)slot * scratch_pitch, sum_out.data
    );
#endif
""")
def _correlate_blocks(
    # in
    first: Phased,  # blocks of the first volume
    second: Phased,  # their surroundings in the second volume, from the farthest lag on
    layers: Layers,
    scratch_pitch: int,  # elements of scratch memory per slot
    slot: int,
    first_task: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
): ...


@native.kernel("lfpiv::gather_blocks(layers, blocks_y, blocks_x, pitch, task, sum_out.data);")
def _gather_blocks(
    # in
    blocks_y: int,  # blocks per window along y and x
    blocks_x: int,
    pitch: int,  # lanes per row of blocks
    layers: Layers,
    first_task: int,
    # out
    sum_out: wp.array(dtype=float),  # (layer, lag, lane): before, sums over blocks; after, over a window's y and x
): ...


def is_gathered(plan: Plan) -> bool:
    """Return whether blocks are added up over each window's y and x once, for all windows that share rows of blocks."""
    return runtime.device().form == "cpu" and min(plan.block_count[1:]) > 2


def gather(plan: Plan, layers: range, ring: int, sums: wp.array) -> None:
    """Add up the blocks of some layers over the y and x of each window, in place."""
    inputs = [*plan.block_count[1:], plan.pitch, make_layers(plan, layers, ring, plan.lanes)]
    launch(Call(_gather_blocks, len(layers) * math.prod(plan.lags), inputs, [sums]))


@dataclass(frozen=True)
class DirectProducts:
    """Sums of products of blocks, multiplied voxel by voxel."""

    plan: Plan
    ring: int
    """Layers that the sums have memory for."""
    scratch: wp.array
    scratch_pitch: int

    @classmethod
    def prepare(cls, plan: Plan, ring: int) -> "DirectProducts":
        """Allocate what a group of lanes needs: its blocks and as many planes of the surroundings."""
        edges = zip(plan.block[1:], plan.lags[1:], strict=True)
        pitch = LANES * plan.block[0] * (math.prod(plan.block[1:]) + math.prod(b + n - 1 for b, n in edges))
        on_cpu = runtime.device().form == "cpu"
        return cls(plan, ring, new_array(runtime.CHUNKS * pitch if on_cpu else 1), pitch)

    def sum(self, first: Phased, second: Phased, layers: range, sums: wp.array) -> None:
        """Sum the products of some layers of blocks and their surroundings at every lag."""
        if runtime.device().form == "gpu":
            tasks = make_layers(self.plan, layers, self.ring, 1)
            launch(blocks_gpu.correlation_call(first, second, tasks, len(layers), sums))
            return
        tasks = make_layers(self.plan, layers, self.ring, LANES)
        inputs = [first, second, tasks, self.scratch_pitch]
        launch(Call(_correlate_blocks, len(layers) * tasks.groups, inputs, [self.scratch, sums], scratch=True))
