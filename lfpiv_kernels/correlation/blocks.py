"""Direct correlation of blocks with their surroundings: sums of products at every lag, and sums of blocks over windows.

In: both volumes stored by phase (`layout.Phased`). Out: for every layer, lag and lane the sum over the block of
``a(r) b(r + lag)``. Inner loops are C++: on the CPU a vector holds neighbouring blocks, on CUDA each lane is a thread.
"""

import math
from dataclasses import dataclass

import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation.layout import Lattice, Layers, Phased, make_layers
from lfpiv_kernels.correlation.memory import Call, launch, new_array
from lfpiv_kernels.correlation.plan import LANES, Plan
from lfpiv_kernels.native import read_native

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

MOST_LAGS = 11
"""Lags along x that are summed in registers at once."""

VECTORS = read_native("blocks_vectors.inc")

_BLOCK = VECTORS + read_native("blocks_block.inc").replace(
    "CASES",
    "\n".join(
        f"                    case {n}: {{ V total[{n}]; sum(total, lag_z, lag_y, lag, row); break; }}"
        for n in range(3, MOST_LAGS + 1)
    ),
).replace("MOST_LAGS", str(MOST_LAGS))


@wp.func_native(_BLOCK)
def _sum_products(
    first: wp.array(dtype=float),
    second: wp.array(dtype=float),
    first_y: wp.array(dtype=int),
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    first_pitch: int,
    second_pitch: int,
    first_plane: int,
    second_plane: int,
    block: wp.vec3i,
    lags: wp.vec3i,
    lag_begin: int,
    lag_end: int,
    lane: int,
    sum_row: int,
    sum_pitch: int,
    slot: int,
    scratch_pitch: int,
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),
): ...


@wp.kernel
def _correlate_blocks(
    # in
    first: Phased,  # blocks of the first volume
    second: Phased,  # their surroundings in the second volume, from the farthest lag on
    layers: Layers,
    parts: int,  # parts of the lags along z, each of which is a task
    scratch_pitch: int,  # elements of scratch memory per slot
    slot: int,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
):
    index = begin + wp.tid()
    lane = (index % layers.groups) * layers.group
    part = (index // layers.groups) % parts
    layer = layers.begin + index // layers.groups // parts
    plane = layer * layers.stride[0]
    lags = layers.lags
    _sum_products(
        first.values,
        second.values,
        first.along_y,
        first.along_x,
        second.along_y,
        second.along_x,
        first.plane,
        second.plane,
        plane,
        plane,
        layers.block,
        lags,
        part * lags[0] // parts,
        (part + 1) * lags[0] // parts,
        lane,
        (layer % layers.ring) * lags[0] * lags[1] * lags[2],
        layers.lanes,
        slot,
        scratch_pitch,
        scratch_out,
        sum_out,
    )


_SPLIT = read_native("blocks_split.inc")


@wp.func_native(_SPLIT)
def _split_plane(
    volume: wp.array(dtype=float),
    shape: wp.vec3i,
    corner: wp.vec3i,
    stride: wp.vec2i,
    phases: wp.vec2i,
    pitch: int,
    lanes: int,
    plane: int,
    split_out: wp.array(dtype=float),
): ...


@wp.kernel
def _split(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x)
    shape: wp.vec3i,
    lattice: Lattice,  # may reach beyond the volume, where values are 0
    begin: int,
    # out
    split_out: wp.array(dtype=float),  # (plane, phase y, phase x, lane)
):
    stride = wp.vec2i(lattice.stride[1], lattice.stride[2])
    phases = wp.vec2i(lattice.phases[1], lattice.phases[2])
    pitch = lattice.pitch
    _split_plane(volume, shape, lattice.corner, stride, phases, pitch, lattice.lanes, begin + wp.tid(), split_out)


def split_call(volume: wp.array, plan: Plan, lattice: Lattice, split: wp.array) -> Call:
    """Return the call that stores a volume by phase."""
    return Call(_split, lattice.planes, [volume, wp.vec3i(*plan.shape), lattice], [split])


_GATHER = VECTORS + read_native("blocks_gather.inc")


@wp.func_native(_GATHER)
def _gather_row(
    blocks_y: int, blocks_x: int, pitch: int, lanes: int, begin: wp.int64, row_out: wp.array(dtype=float)
): ...


@wp.kernel
def _gather_blocks(
    # in
    blocks_y: int,  # blocks per window along y and x
    blocks_x: int,
    pitch: int,  # lanes per row of blocks
    layers: Layers,
    begin: int,
    # out
    sum_out: wp.array(dtype=float),  # (layer, lag, lane): before, sums over blocks; after, over a window's y and x
):
    index = begin + wp.tid()
    lags = layers.lags[0] * layers.lags[1] * layers.lags[2]
    row = (layers.begin + index // lags) % layers.ring * lags + index % lags
    _gather_row(blocks_y, blocks_x, pitch, layers.lanes, wp.int64(row) * wp.int64(layers.lanes), sum_out)


def is_gathered(plan: Plan) -> bool:
    """Return whether blocks are added up over each window's y and x once, for all windows that share rows of blocks."""
    return runtime.device().kind == "cpu" and min(plan.block_count[1:]) > 2


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
        on_cpu = runtime.device().kind == "cpu"
        return cls(plan, ring, new_array(runtime.CHUNKS * pitch if on_cpu else 1), pitch)

    def sum(self, first: Phased, second: Phased, layers: range, sums: wp.array) -> None:
        """Sum the products of some layers of blocks and their surroundings at every lag."""
        group, parts = (LANES, 1) if runtime.device().kind == "cpu" else (1, self.plan.lags[0])
        described = make_layers(self.plan, layers, self.ring, group)
        inputs = [first, second, described, parts, self.scratch_pitch]
        size = len(layers) * described.groups * parts
        launch(Call(_correlate_blocks, size, inputs, [self.scratch, sums], scratch=True))
