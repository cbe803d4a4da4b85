// A voxel's blocks of weights against the rays of a camera on a GPU: a warp gathers a voxel's light, a warp scatters
// the light of all voxels to a tile of a microimage; see ``reconstruction/projector_gpu.py``.
#ifndef LFPIV_PROJECTOR_GPU_H
#define LFPIV_PROJECTOR_GPU_H

#include "lanes.h"

namespace lfpiv {

/// Bytes that the memory of a GPU moves at once. A block's values begin at a multiple of them.
constexpr int SECTOR = 32;
/// Rays along each side of a tile at most: a warp holds them in shared memory, where four rows of eight columns then
/// lie in 32 different banks.
constexpr int TILE = 24;
/// Columns of a block, and rows that a warp takes at once: a lane for each ray.
constexpr int COLUMNS = 8;
constexpr int ROWS = 4;
/// Words of a sector, and steps of `ROWS` rows whose levels lie in a block's first sector, behind those of the columns.
constexpr int WORDS = 8;
constexpr int STEPS_OF_SECTOR = 6;
/// Warps of a thread block: Warp's default of 256 threads.
constexpr int WARPS_OF_BLOCK = 8;
/// Where a block lies in a tile, in one integer: row + 256, column + 8, rows, columns.
constexpr int ROW_BITS = 9;
constexpr int COLUMN_BITS = 6;
constexpr int HEIGHT_BITS = 8;

/// Place of a block relative to a tile.
struct Place {
    int row, column, height, width;

    LFPIV_INLINE static int pack(int row, int column, int height, int width) {
        return (row + (1 << (ROW_BITS - 1))) | (column + COLUMNS) << ROW_BITS | height << (ROW_BITS + COLUMN_BITS) |
               width << (ROW_BITS + COLUMN_BITS + HEIGHT_BITS);
    }
    LFPIV_INLINE static Place of(int packed) {
        return {(packed & ((1 << ROW_BITS) - 1)) - (1 << (ROW_BITS - 1)),
                ((packed >> ROW_BITS) & ((1 << COLUMN_BITS) - 1)) - COLUMNS,
                (packed >> (ROW_BITS + COLUMN_BITS)) & ((1 << HEIGHT_BITS) - 1),
                packed >> (ROW_BITS + COLUMN_BITS + HEIGHT_BITS)};
    }
};

/// The first sector of each lane's own block of profiles: the levels of eight columns, then those of the rows.
struct Sectors {
    PerLane<unsigned> word[WORDS];

    LFPIV_INLINE void load(int lane, const unsigned* from) {
        const Quad first = ((const Quad*)from)[0], second = ((const Quad*)from)[1];
        word[0][lane] = first.x, word[1][lane] = first.y, word[2][lane] = first.z, word[3][lane] = first.w;
        word[4][lane] = second.x, word[5][lane] = second.y, word[6][lane] = second.z, word[7][lane] = second.w;
    }
    /// Return the level of a column of the block that another lane holds.
    LFPIV_INLINE float across(int holder, int column) const {
        const unsigned low = word[0].of(holder), high = word[1].of(holder);
        return byte(column < 4 ? low : high, column & 3);
    }
    /// Return the level of row `ROWS` STEP + row.
    template <int STEP>
    LFPIV_INLINE float down(int holder, int row) const {
        return byte(word[2 + STEP].of(holder), row);
    }
    LFPIV_INLINE static float byte(unsigned word, int k) { return (float)((word >> 8 * k) & 0xff); }
};

/// Call work(row, level) for a lane's row of each step of a block of profiles that another lane holds. `level` begins
/// at the block's values; those behind the first sector are read from memory.
template <int STEP = 0, class Work>
LFPIV_INLINE void for_steps(const Sectors& sectors, int holder, const unsigned char* level, int steps, int row,
                            Work work) {
    if constexpr (STEP < STEPS_OF_SECTOR) {
        if (STEP < steps) {
            work(ROWS * STEP + row, sectors.down<STEP>(holder, row));
            for_steps<STEP + 1>(sectors, holder, level, steps, row, work);
        }
    } else {
        for (int step = STEP; step < steps; ++step) {
            const int at = ROWS * step + row;
            work(at, (float)level[COLUMNS + at]);
        }
    }
}

/// Return the sum over a voxel's blocks of value(level, ray), a lane for each ray of four rows of a block.
/// Lanes first read the heads and first sectors of 32 blocks.
template <class Matrix, class Value>
LFPIV_INLINE float sum_blocks(const Matrix& matrix, int begin, int end, Value value) {
    PerLane<float> total;
    for_lanes([&](int lane) { total[lane] = 0.0f; });
    for (; begin < end; begin += LANES_OF_WARP) {
        const int count = min(end - begin, LANES_OF_WARP);
        PerLane<int> ray, start, size;
        Sectors sectors;
        for_lanes([&](int lane) {
            const int block = begin + min(lane, count - 1);
            ray[lane] = matrix.ray.data[block];
            const int height = matrix.height.data[block];
            if (matrix.profiles) {
                start[lane] = block * matrix.sectors, size[lane] = height;
                sectors.load(lane, matrix.word.data + (int64_t)start[lane] * WORDS);
            } else {
                start[lane] = matrix.start.data[block];
                size[lane] = height | matrix.width.data[block] << 8;
            }
        });
        for (int holder = 0; holder < count; ++holder)
            for_lanes([&](int lane) {
                const int row = lane / COLUMNS, column = lane % COLUMNS, packed = size.of(holder);
                const int rows = packed & 0xff, first = ray.of(holder) + column;
                const auto* level = (const unsigned char*)(matrix.word.data + (int64_t)start.of(holder) * WORDS);
                if (matrix.profiles) {
                    const float across = sectors.across(holder, column);
                    for_steps(sectors, holder, level, rows / ROWS, row, [&](int at, float down) {
                        total[lane] += value(across * down, first + at * matrix.pitch);
                    });
                    return;
                }
                const int columns = packed >> 8;
                for (int step = 0; step < rows; step += ROWS) {
                    const int at = step + row;
                    const bool inside = at < rows && column < columns;
                    const float here = inside ? (float)level[at * columns + column] : 0.0f;
                    total[lane] += value(here, inside ? first + at * matrix.pitch : -1);
                }
            });
    }
    return sum_lanes(total);
}

/// Find a voxel's blocks under some lenses, see ``projector.EVEN``.
template <class Matrix>
LFPIV_INLINE void blocks_under(const Matrix& matrix, int voxel, int lenses, int& begin, int& end) {
    begin = matrix.first_block.data[voxel], end = matrix.first_block.data[voxel + 1];
    if (lenses < 0) return;
    const int even = begin + matrix.even_blocks.data[voxel];
    (lenses == 0 ? end : begin) = even;
}

/// Add to a voxel the weighted sum of the light on its rays.
template <class Matrix>
LFPIV_INLINE void gather_voxel(const Matrix& matrix, int voxel, int lenses, const float* rays, const float* active,
                               float* volume) {
    if (active[voxel] == 0.0f) return;  // the whole warp
    int begin, end;
    blocks_under(matrix, voxel, lenses, begin, end);
    const float light =
        sum_blocks(matrix, begin, end, [&](float level, int ray) { return level * (ray >= 0 ? rays[ray] : 0.0f); });
    in_first_lane([&] { volume[voxel] += matrix.scale.data[voxel] * light; });
}

/// Count the rays that a voxel lights; `share` is zero for those that no pixel sees.
template <class Matrix>
LFPIV_INLINE void count_voxel(const Matrix& matrix, int voxel, const float* share, int* count_out) {
    int begin, end;
    blocks_under(matrix, voxel, -1, begin, end);
    const float count = sum_blocks(matrix, begin, end, [&](float level, int ray) {
        return level > 0.0f && ray >= 0 && share[ray] > 0.0f ? 1.0f : 0.0f;
    });
    in_first_lane([&] { count_out[voxel] = (int)count; });
}

/// A tile's rays, summed by one warp.
struct TileLight {
    float* ray;

    LFPIV_INLINE void add(int row, int column, float light) const {
        if (light != 0.0f && row >= 0 && row < TILE && column >= 0 && column < TILE) ray[row * TILE + column] += light;
    }
};

/// Write the light of all voxels on one tile's rays; dark if the tile's lens is none of `lenses`. The warp goes through
/// the list of the tile's blocks, 32 at a time, in the order of the voxels.
template <class Matrix>
LFPIV_INLINE void scatter_tile(const Matrix& matrix, int tile, int lenses, const float* volume, float* rays_out) {
#if defined(__CUDA_ARCH__)
    __shared__ float light_of_warps[WARPS_OF_BLOCK][TILE * TILE];
    const TileLight light{light_of_warps[threadIdx.x / LANES_OF_WARP % WARPS_OF_BLOCK]};
#else
    float light_of_warp[TILE * TILE];
    const TileLight light{light_of_warp};
#endif
    const int head = matrix.tile_size.data[tile], rows = head & 0xff, columns = (head >> 8) & 0xff, set = head >> 16;
    const bool lit = lenses < 0 || lenses == set;
    float* const out = rays_out + matrix.tile_ray.data[tile];
    for_lanes([&](int lane) {
        for (int k = lane; k < TILE * TILE; k += LANES_OF_WARP) light.ray[k] = 0.0f;
    });
    sync_lanes();
    const int64_t end = lit ? matrix.tile_entry.data[tile + 1] : 0;
    for (int64_t begin = lit ? matrix.tile_entry.data[tile] : 0; begin < end; begin += LANES_OF_WARP) {
        const int count = (int)min(end - begin, (int64_t)LANES_OF_WARP);
        PerLane<float> intensity;
        PerLane<int> place, start;
        Sectors sectors;
        for_lanes([&](int lane) {
            const int64_t entry = begin + min(lane, count - 1);
            const int voxel = matrix.entry_voxel.data[entry];
            place[lane] = matrix.entry_place.data[entry];
            start[lane] = matrix.entry_start.data[entry];
            intensity[lane] = volume[voxel] * matrix.scale.data[voxel];
            if (matrix.profiles) sectors.load(lane, matrix.word.data + (int64_t)start[lane] * WORDS);
        });
        for (int holder = 0; holder < count; ++holder) {
            for_lanes([&](int lane) {
                const float factor = intensity.of(holder);
                const Place block = Place::of(place.of(holder));
                const auto* level = (const unsigned char*)(matrix.word.data + (int64_t)start.of(holder) * WORDS);
                const int row = lane / COLUMNS, column = lane % COLUMNS;
                if (factor == 0.0f) return;  // the whole warp
                if (matrix.profiles) {
                    const float across = factor * sectors.across(holder, column);
                    for_steps(sectors, holder, level, block.height / ROWS, row, [&](int at, float down) {
                        light.add(block.row + at, block.column + column, across * down);
                    });
                    return;
                }
                for (int step = 0; step < block.height; step += ROWS) {
                    const int at = step + row;
                    const bool inside = at < block.height && column < block.width;
                    const float here = inside ? (float)level[at * block.width + column] : 0.0f;
                    light.add(block.row + at, block.column + column, factor * here);
                }
            });
            sync_lanes();  // the next block's lanes add to the same rays
        }
    }
    for_lanes([&](int lane) {
        for (int row = 0; row < rows; ++row) {
            float* const to = out + (int64_t)row * matrix.pitch + lane;
            if (lane < columns) *to = light.ray[row * TILE + lane];
        }
    });
    sync_lanes();  // before the warp's next tile
}

/// Copy a voxel's values to where each block begins a sector; `to` holds zeros. A thread for each voxel.
template <class Matrix, class Compact>
LFPIV_INLINE void align_values(const Matrix& matrix, const Compact& first_value, const unsigned char* level, int voxel,
                               unsigned* word_out) {
    const unsigned char* from = level + first_value.data[voxel];
    for (int block = matrix.first_block.data[voxel]; block < matrix.first_block.data[voxel + 1]; ++block) {
        const int height = matrix.height.data[block], width = matrix.width.data[block];
        const int start = matrix.profiles ? block * matrix.sectors : matrix.start.data[block];
        const int count = matrix.profiles ? width + height : width * height;
        auto* const to = (unsigned char*)(word_out + (int64_t)start * WORDS);
        for (int k = 0; k < count; ++k) to[k] = from[k];
        from += count;
    }
}

/// Where tiles lie: microimages of edge x edge rays, each cut into tiles of at most `side` x `side`.
struct Tiling {
    int edge, side;

    LFPIV_INLINE int per_edge() const { return (edge + side - 1) / side; }
    /// Return the tile of a ray, counted along the rows of tiles.
    LFPIV_INLINE int64_t tile(int row, int column) const {
        return ((int64_t)(row / edge) * per_edge() + row % edge / side) * per_edge() + column / side;
    }
};

/// Call visit(voxel, block, start, tile, place) for every tile that a block lights, in the order of the blocks. All
/// arrays are the host's, and the blocks' values those of ``projector.Blocks``.
template <class Matrix, class Visit>
LFPIV_INLINE void for_entries(const Matrix& matrix, const unsigned char* level, const Tiling& tiling, Visit visit) {
    const int voxels = (int)matrix.first_block.shape[0] - 1;
    for (int voxel = 0; voxel < voxels; ++voxel)
        for (int block = matrix.first_block.data[voxel]; block < matrix.first_block.data[voxel + 1]; ++block) {
            const int height = matrix.height.data[block], width = matrix.width.data[block];
            int rows = height, columns = width;  // that are lit
            if (matrix.profiles) {
                while (rows > 0 && !level[width + rows - 1]) --rows;
                while (columns > 0 && !level[columns - 1]) --columns;
            }
            level += matrix.profiles ? width + height : width * height;
            const int ray = matrix.ray.data[block], row = ray / tiling.edge, column = ray % tiling.edge;
            const int start = matrix.profiles ? block * matrix.sectors : matrix.start.data[block];
            for (int r = 0; r < rows;) {
                const int in_lens = (row + r) % tiling.edge, in_tile = in_lens % tiling.side;
                for (int c = 0; c < columns;) {
                    const int of_tile = (column + c) % tiling.side;
                    visit(voxel, block, start, tiling.tile(row + r, column + c),
                          Place::pack(in_tile - r, of_tile - c, height, width));
                    c += tiling.side - of_tile;
                }
                r += min(tiling.side - in_tile, tiling.edge - in_lens);
            }
        }
}

/// Count the entries of each tile and find the set of its lens: 0 for the voxel's first blocks, 1 for the others.
template <class Matrix>
LFPIV_INLINE void count_entries(const Matrix& matrix, const unsigned char* level, const Tiling& tiling,
                                int64_t* count_out, unsigned char* set_out) {
    for_entries(matrix, level, tiling, [&](int voxel, int block, int, int64_t tile, int) {
        ++count_out[tile];
        set_out[tile] = block - matrix.first_block.data[voxel] >= matrix.even_blocks.data[voxel];
    });
}

/// Write the entries of each tile. Moves `next_out[tile]` from where they begin to where they end.
template <class Matrix>
LFPIV_INLINE void write_entries(const Matrix& matrix, const unsigned char* level, const Tiling& tiling,
                                int64_t* next_out, int* voxel_out, int* start_out, int* place_out) {
    for_entries(matrix, level, tiling, [&](int voxel, int, int start, int64_t tile, int place) {
        const int64_t entry = next_out[tile]++;
        voxel_out[entry] = voxel, start_out[entry] = start, place_out[entry] = place;
    });
}

}  // namespace lfpiv

#endif
