"""Blocks of weights on a GPU: a thread per voxel, lens and tile. Method, host functions and CPU form: ``footprint``.

A tile is the part of the pixels under a lens that lies in the columns of one block. Each has room for its blocks, so
that no thread waits for another, and as many tiles are counted for each voxel as any may have.
"""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.weights.footprint_arrays import BlockArrays, Inputs, Outline

wp.set_module_options(native.options("footprint_gpu.h", contract="fast", gpu=True))

HEIGHTS: int = native.constant("footprint.h", "HEIGHTS")
"""Heights of profiles, by which a voxel's blocks are ordered."""
TILE_BYTES = 24
"""Memory of a tile while blocks are computed: six numbers [byte]."""


@wp.struct
class Tiles:
    """Room for the blocks of each tile, (voxel, lens, tile), flat."""

    first_block: wp.array(dtype=int)
    first_value: wp.array(dtype=int)
    blocks: wp.array(dtype=int)
    bytes: wp.array(dtype=int)
    lenses: int
    tiles: int


@native.kernel(
    """
    lfpiv::measure_lens(
        lfpiv::weight_inputs(inputs), lfpiv::tile_room(shape), voxel, lens, blocks_out.data, bytes_out.data
    );
    """,
    "voxel",
    "lens",
)
def _measure_tiles(
    # in
    inputs: Inputs,
    shape: Tiles,
    first_voxel: int,
    # out
    blocks_out: wp.array(dtype=int),  # blocks and values that each tile needs at most
    bytes_out: wp.array(dtype=int),
): ...


@native.kernel(
    """
    lfpiv::fill_tile<true>(
        lfpiv::weight_inputs(inputs), {outline.extent.data, outline.steps, outline.square}, voxel, tile,
        lfpiv::tile_room(room), lfpiv::block_arrays(blocks_out), counts_out.data, bytes_out.data
    );
    """,
    "voxel",
    "tile",
)
def _fill_profiles(
    # in
    inputs: Inputs,
    outline: Outline,
    room: Tiles,
    first_voxel: int,
    # out
    blocks_out: BlockArrays,
    counts_out: wp.array(dtype=int),  # blocks and values of each tile
    bytes_out: wp.array(dtype=int),
): ...


@native.kernel(
    """
    lfpiv::fill_tile<false>(
        lfpiv::weight_inputs(inputs), {outline.extent.data, outline.steps, outline.square}, voxel, tile,
        lfpiv::tile_room(room), lfpiv::block_arrays(blocks_out), counts_out.data, bytes_out.data
    );
    """,
    "voxel",
    "tile",
)
def _fill_pixels(
    # in
    inputs: Inputs,
    outline: Outline,
    room: Tiles,
    first_voxel: int,
    # out
    blocks_out: BlockArrays,
    counts_out: wp.array(dtype=int),  # blocks and values of each tile
    bytes_out: wp.array(dtype=int),
): ...


@native.kernel("""
    lfpiv::sum_tiles(
        lfpiv::weight_inputs(inputs), voxel, lfpiv::tile_room(filled), scale_out.data, counts_out.data,
        bytes_out.data
    );
""")
def _sum_tiles(
    # in
    inputs: Inputs,
    filled: Tiles,
    first_voxel: int,
    # out
    scale_out: wp.array(dtype=float),
    counts_out: wp.array(dtype=int),  # blocks and values of each voxel
    bytes_out: wp.array(dtype=int),
): ...


@native.kernel(
    """
    lfpiv::pack_place(
        lfpiv::block_arrays(blocks), lfpiv::tile_room(filled), lfpiv::block_arrays(packed_out), voxel,
        profiles ? place : place * lfpiv::HEIGHTS, lfpiv::BlockOrder(profiles, edge, lenses), even_blocks_out.data,
        even_values_out.data
    );
    """,
    "voxel",
    "place",
)
def _pack_tiles(
    # in
    blocks: BlockArrays,
    filled: Tiles,
    profiles: bool,
    edge: int,
    lenses: int,  # along i
    first_voxel: int,
    # out
    packed_out: BlockArrays,  # without gaps, those of even lenses first
    even_blocks_out: wp.array(dtype=int),  # blocks and values of each voxel under even lenses
    even_values_out: wp.array(dtype=int),
): ...


def fill(inputs: list[object], voxels: int, lenses: int, tiles: int, outputs: list[object]) -> Tiles:
    """Compute the blocks of voxels. Return where those of each tile lie.

    Inputs and outputs are those of ``footprint._fill_blocks``. A voxel reaches at most `lenses` lenses, each of at most
    `tiles` tiles.
    """
    blocks, scale, *counts = outputs
    arrays = [wp.empty(voxels * lenses * tiles, dtype=int, device=scale.device) for _ in range(6)]
    most, starts, found = arrays[:2], arrays[2:4], arrays[4:]
    room, filled = _tiles(lenses, tiles, starts, most), _tiles(lenses, tiles, starts, found)
    launch(Call(_measure_tiles, voxels, [inputs[0], room], most, inner=(lenses,)))
    for count, start in zip(most, starts, strict=True):
        wp.utils.array_scan(count, start, inclusive=False)
    kernel = _fill_profiles if inputs[0].profiles else _fill_pixels
    launch(Call(kernel, voxels, [*inputs, room], [blocks, *found], inner=(lenses * tiles,)))
    launch(Call(_sum_tiles, voxels, [inputs[0], filled], [scale, *counts]))
    return filled


def pack(blocks: BlockArrays, filled: Tiles, voxels: int, order: list[object], outputs: list[object]) -> None:
    """Copy the blocks of `fill` without gaps; order and outputs are those of ``footprint._pack_blocks``."""
    places = 2 * HEIGHTS if order[0] else 2
    launch(Call(_pack_tiles, voxels, [blocks, filled, *order], outputs, inner=(places,)))


def _tiles(lenses, tiles, starts, sizes):
    """Return where the blocks of each tile begin, and how many they are."""
    room = Tiles()
    room.lenses, room.tiles = lenses, tiles
    room.first_block, room.first_value = starts
    room.blocks, room.bytes = sizes
    return room
