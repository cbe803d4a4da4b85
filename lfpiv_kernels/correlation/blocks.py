"""Warp kernels of the window correlation; `correlate` launches them.

The lanes of a vector are neighbouring windows. A lattice of windows or blocks is walked by lane: lane
``ky * pitch + kx`` is the one at row ky and column kx of a layer, rows being followed by spare lanes, so that the lane
of a neighbour lies at a fixed distance. Volumes are stored split by phase, ``[plane, y % stride, x % stride, lane]``:
whatever the offset from a window's corner, the voxels at that offset of neighbouring windows are neighbours in memory.
Arrays of offsets along y and x hold the distance in memory for each offset in voxels.

The inner loops are native: on the CPU in vectors of clang, as wide as the registers; on CUDA a lane is a thread.
"""

import warp as wp

from lfpiv_kernels.native import read_native

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

LANES = 16
"""Lanes a CPU task works on; lattices are padded to whole groups of them."""
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
    first: wp.array(dtype=float),  # first volume, split by phase
    second: wp.array(dtype=float),  # second volume, the same
    first_y: wp.array(dtype=int),  # offsets along y and x, see the head of this module
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    pitches: wp.vec2i,  # elements per plane of `first` and of `second`
    stride: int,  # distance of layers of blocks [voxel]
    block: wp.vec3i,  # edges of a block [voxel]
    lags: wp.vec3i,  # lags per axis
    begin_layer: int,
    ring: int,  # layers that `sum_out` holds: layer i lies at i % ring
    groups: int,  # groups of lanes
    group: int,  # lanes of a group: `LANES` on the CPU, 1 on CUDA
    parts: int,  # parts the lags along z are cut into
    scratch_pitch: int,  # elements of scratch memory per slot
    slot: int,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
):
    index = begin + wp.tid()
    lane = (index % groups) * group
    part = (index // groups) % parts
    layer = begin_layer + index // groups // parts
    plane = layer * stride
    _sum_products(
        first,
        second,
        first_y,
        first_x,
        second_y,
        second_x,
        pitches[0],
        pitches[1],
        plane,
        plane,
        block,
        lags,
        part * lags[0] // parts,
        (part + 1) * lags[0] // parts,
        lane,
        (layer % ring) * lags[0] * lags[1] * lags[2],
        groups * group,
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
    corner: wp.vec3i,  # voxel of plane 0, phase (0, 0), lane 0; what lies outside the volume is 0
    stride: wp.vec2i,  # distance of the lattice's rows and columns [voxel]
    phases: wp.vec2i,  # phases stored along y and x
    pitch: int,  # lanes per row
    lanes: int,  # lanes stored
    begin: int,
    # out
    split_out: wp.array(dtype=float),  # (plane, phase y, phase x, lane)
):
    _split_plane(volume, shape, corner, stride, phases, pitch, lanes, begin + wp.tid(), split_out)


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
    lanes: int,  # lanes per lag
    lags: int,
    ring: int,  # layers that `sum_out` holds: layer i lies at i % ring
    begin_layer: int,
    begin: int,
    # out
    sum_out: wp.array(dtype=float),  # (layer, lag, lane): of blocks before, of windows' layers of blocks after
):
    index = begin + wp.tid()
    row = (begin_layer + index // lags) % ring * lags + index % lags
    _gather_row(blocks_y, blocks_x, pitch, lanes, wp.int64(row) * wp.int64(lanes), sum_out)
