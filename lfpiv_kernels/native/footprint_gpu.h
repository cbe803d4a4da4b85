// The weights of a voxel as blocks of rays on a GPU: a thread per voxel, lens and tile. See
// ``weights/footprint_gpu.py``.
#ifndef LFPIV_FOOTPRINT_GPU_H
#define LFPIV_FOOTPRINT_GPU_H

#include "footprint.h"

namespace lfpiv {

static_assert(WIDTH == 1, "a thread per lens");

/// The lens in one place of the range that a voxel reaches, and the pixels under it that the voxel can light.
struct ReachedLens {
    Lenses lens;
    PixelBox box;
    int lit;  // whether there is such a lens, and such pixels

    LFPIV_INLINE ReachedLens(ReachedLenses& reached, int place) : lit(0) {
        if (place >= reached.count) return;
        const int across = reached.i1 - reached.i0 + 1, down = place / across;
        reached.next_i = reached.i0 + place - down * across;
        reached.next_j = reached.j0 + down;
        reached.take(lens);
        lit = reached.pixel_box(1, lens, box);
    }
};

/// Device arrays of the room for blocks: for each tile of each lens of a voxel, where it begins and how much it is.
struct TileRoom {
    const int* first_block;
    const int* first_value;
    const int* blocks;
    const int* bytes;
    int lenses, tiles;  // of a voxel, of a lens

    /// Return the first tile of a voxel.
    LFPIV_INLINE int64_t first(int voxel) const { return (int64_t)voxel * lenses * tiles; }
};

/// Return the room from Warp's struct.
template <class Room>
LFPIV_INLINE TileRoom tile_room(const Room& room) {
    return {room.first_block.data, room.first_value.data, room.blocks.data, room.bytes.data, room.lenses, room.tiles};
}

/// Count the blocks and the bytes of values that a voxel needs at most for the tiles under one of its lenses.
LFPIV_INLINE void measure_lens(const WeightInputs& in, const TileRoom& room, int index, int place, int* blocks_out,
                               int* bytes_out) {
    const Voxel voxel(in, index);
    ReachedLenses reached(voxel);
    const ReachedLens found(reached, place);
    const int64_t first = room.first(index) + (int64_t)place * room.tiles;
    for (int tile = 0; tile < room.tiles; ++tile) {
        PixelBox box = found.box;
        box.first_column += (float)(tile * BLOCK_WIDTH);
        box.last_column = min(box.last_column, box.first_column + (float)(BLOCK_WIDTH - 1));
        const Room most(in, box, found.lit & (box.first_column <= box.last_column));
        blocks_out[first + tile] = (int)most.blocks;
        bytes_out[first + tile] = most.blocks > 0.0f ? (int)most.bytes + PAST_VALUES : 0;
    }
}

/// Compute the blocks of one tile of a voxel's pixels where there is room for them. Each form is a kernel of its own:
/// one for both would hold what either needs.
template <bool PROFILES>
LFPIV_INLINE void fill_tile(WeightInputs in, const Outline& outline, int index, int tile, const TileRoom& room,
                            const BlockArrays& blocks, int* blocks_out, int* bytes_out) {
    const int64_t item = room.first(index) + tile;
    blocks_out[item] = bytes_out[item] = 0;
    if (room.blocks[item] == 0) return;
    in.profiles = PROFILES;
    const int place = tile / room.tiles, tile_of_lens = tile - place * room.tiles;
    const Voxel voxel(in, index);
    ReachedLenses reached(voxel);
    const ReachedLens found(reached, place);
    const LensGroup group(voxel, found.lens, found.box);
    const Tile rows(group, 1, (float)(tile_of_lens * BLOCK_WIDTH));  // it branches: later values need no registers yet
    if (!rows.lit()) return;
    const Top top(voxel, reached.slope);
    const Bend bend(voxel);
    const LensValues values(group, top, bend, 1);
    const int first_block = room.first_block[item];
    unsigned char* const first_value = blocks.value + room.first_value[item];
    BlockWriter out = {blocks.ray,
                       blocks.height,
                       blocks.width,
                       first_block,
                       first_block + room.blocks[item],
                       first_value,
                       first_value + room.bytes[item],
                       (int)in.geometry->edge};
    fill_tile(group, rows, values, bend, outline, tile_of_lens, out);
    blocks_out[item] = out.block - first_block;
    bytes_out[item] = (int)(out.value - first_value);
}

/// Find a voxel's scale, and add up the blocks and the bytes of values of its tiles.
LFPIV_INLINE void sum_tiles(const WeightInputs& in, int index, const TileRoom& filled, float* scale_out,
                            int* blocks_out, int* bytes_out) {
    const Voxel voxel(in, index);
    const ReachedLenses reached(voxel);
    scale_out[index] = reached.count > 0 ? Top(voxel, reached.slope).scale(voxel) : 0.0f;
    int all_blocks = 0, all_bytes = 0;
    for (int64_t item = filled.first(index); item < filled.first(index + 1); ++item) {
        all_blocks += filled.blocks[item];
        all_bytes += filled.bytes[item];
    }
    blocks_out[index] = all_blocks;
    bytes_out[index] = all_bytes;
}

/// Copy the blocks of a voxel that have one place in their order to where they lie without gaps: a thread per voxel and
/// place. It counts what comes before its own.
LFPIV_INLINE void pack_place(const BlockArrays& from, const TileRoom& room, const BlockArrays& to, int voxel,
                             int wanted, const BlockOrder& order, int* even_blocks_out, int* even_values_out) {
    int block_to = to.first_block[voxel], value_to = to.first_value[voxel];
    const int first_block = block_to, first_value = value_to;
    const int64_t first = room.first(voxel), last = room.first(voxel + 1);
    for (int64_t item = first; item < last; ++item)
        for (int k = room.first_block[item]; k < room.first_block[item] + room.blocks[item]; ++k) {
            const bool before = order.place(from.ray[k], from.height[k]) < wanted;
            block_to += before;
            value_to += before ? order.bytes(from.height[k], from.width[k]) : 0;
        }
    if (wanted == HEIGHTS) {  // the first of odd lenses
        even_blocks_out[voxel] = block_to - first_block;
        even_values_out[voxel] = value_to - first_value;
    }
    for (int64_t item = first; item < last; ++item) {
        const unsigned char* value = from.value + room.first_value[item];
        for (int k = room.first_block[item]; k < room.first_block[item] + room.blocks[item]; ++k) {
            const int height = from.height[k], width = from.width[k], bytes = order.bytes(height, width);
            if (order.place(from.ray[k], height) == wanted) {
                to.ray[block_to] = from.ray[k];
                to.height[block_to] = (unsigned char)height;
                to.width[block_to++] = (unsigned char)width;
                for (int n = 0; n < bytes; ++n) to.value[value_to + n] = value[n];
                value_to += bytes;
            }
            value += bytes;
        }
    }
}

}  // namespace lfpiv

#endif
