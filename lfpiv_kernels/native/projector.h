// A voxel's blocks of weights against the rays of a camera: gathering and scattering light, one row of a block at a
// time. For the CPU; a GPU has ``projector_gpu.h``.
#ifndef LFPIV_PROJECTOR_H
#define LFPIV_PROJECTOR_H

#include "simd.h"

namespace lfpiv {

/// Rays in a row of a block at most: one vector.
constexpr int BLOCK_WIDTH = 8;
/// A block of profiles has `BLOCK_WIDTH` columns and a multiple of these rows: levels of zero fill it up.
constexpr int ROW_GROUP = 4;
/// Groups of rows up to which loops over a block's rows are unrolled: a microimage of 24 pixels.
constexpr int UNROLLED = 6;

#if !LFPIV_GPU  // see ``projector_gpu.h``

/// One row of a block. Lanes beyond the block's width belong to another block.
using Row = Floats<BLOCK_WIDTH>;

/// The blocks of one voxel. Their values lie one after the other from `level` on.
struct VoxelBlocks {
    int first, last;
    const int* ray;
    const unsigned char* height;
    const unsigned char* width;
    const unsigned char* level;
    int stride;     // rays from one row of a microimage to the next
    bool profiles;  // values are a profile along the columns and one along the rows; blocks are sorted by height
};

/// Lenses whose blocks take part.
enum LensSet { ALL_LENSES = -1, EVEN_LENSES = 0, ODD_LENSES = 1 };

/// Return the blocks of a voxel from the device arrays of `Matrix`, see ``projector.py``.
template <class Matrix>
LFPIV_INLINE VoxelBlocks blocks_of(const Matrix& matrix, int voxel, int lenses) {
    int first = matrix.first_block.data[voxel], last = matrix.first_block.data[voxel + 1];
    const unsigned char* level = matrix.level.data + matrix.first_value.data[voxel];
    if (lenses == EVEN_LENSES) last = first + matrix.even_blocks.data[voxel];
    if (lenses == ODD_LENSES) {
        first += matrix.even_blocks.data[voxel];
        level += matrix.even_values.data[voxel];
    }
    return {first, last, matrix.ray.data, matrix.height.data, matrix.width.data, level, matrix.stride, matrix.profiles};
}

/// Ask for the memory from `begin` to `end`.
template <class T>
LFPIV_INLINE void prefetch_range(const T* begin, const T* end) {
    constexpr int LINE = 64;
    for (const char* from = (const char*)begin; from < (const char*)end; from += LINE) prefetch((const float*)from);
}

/// Ask for the next voxel's blocks, unless its `active` is 0. Where some blocks are skipped, the processor does not
/// foresee the next ones; with all of them it gains 3 to 13 % of the time.
template <class Matrix>
LFPIV_INLINE void prefetch_next(const Matrix& matrix, const float* active, int voxel, int lenses) {
    if (voxel + 1 >= (int)matrix.scale.shape[0] || active[voxel + 1] == 0.0f) return;
    const VoxelBlocks next = blocks_of(matrix, voxel + 1, lenses);
    const unsigned char* const level = matrix.level.data + matrix.first_value.data[voxel + 1];
    const unsigned char* const end = lenses == EVEN_LENSES ? level + matrix.even_values.data[voxel + 1]
                                                           : matrix.level.data + matrix.first_value.data[voxel + 2];
    prefetch_range(next.level, end);
    prefetch_range(next.ray + next.first, next.ray + next.last);
    prefetch_range(next.height + next.first, next.height + next.last);
    if (!next.profiles) prefetch_range(next.width + next.first, next.width + next.last);
}

/// Return the sum of a block's rays times its levels, and move `level` behind its values.
LFPIV_INLINE Row gather_pixels(const float* ray, int rows, int columns, int stride, const unsigned char*& level) {
    Row even = splat<BLOCK_WIDTH>(0.0f), odd = even;
    int k = 0;
    for (; k + 1 < rows; k += 2, ray += 2 * stride, level += 2 * columns) {
        even = even + load<BLOCK_WIDTH>(ray) * load_bytes<BLOCK_WIDTH>(level);
        odd = odd + load<BLOCK_WIDTH>(ray + stride) * load_bytes<BLOCK_WIDTH>(level + columns);
    }
    if (k < rows) {
        even = even + load<BLOCK_WIDTH>(ray) * load_bytes<BLOCK_WIDTH>(level);
        level += columns;
    }
    return first_lanes(even + odd, columns);
}

/// Two rows of a block side by side.
using RowPair = Floats<2 * BLOCK_WIDTH>;
static_assert(BLOCK_WIDTH == 8 && ROW_GROUP == 4, "lanes below");

LFPIV_INLINE RowPair side_by_side(Row first, Row second) {
    return __builtin_shufflevector(first, second, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
LFPIV_INLINE Row first_row(RowPair rows) { return __builtin_shufflevector(rows, rows, 0, 1, 2, 3, 4, 5, 6, 7); }
LFPIV_INLINE Row second_row(RowPair rows) { return __builtin_shufflevector(rows, rows, 8, 9, 10, 11, 12, 13, 14, 15); }

/// Read two rows.
LFPIV_INLINE RowPair load_rows(const float* ray, int stride) {
    return side_by_side(load<BLOCK_WIDTH>(ray), load<BLOCK_WIDTH>(ray + stride));
}

/// Return the levels of rows `2 PAIR` and `2 PAIR + 1`, each in all lanes of its row.
template <int PAIR>
LFPIV_INLINE RowPair levels_of(Row levels) {
    constexpr int a = 2 * PAIR, b = a + 1;
    return __builtin_shufflevector(levels, levels, a, a, a, a, a, a, a, a, b, b, b, b, b, b, b, b);
}

/// Return the sums along the columns of `groups` groups of rows, each row times its level. Two rows take one operation,
/// and eight levels are converted at once.
LFPIV_INLINE Row sum_rows(const float* ray, int groups, int stride, const unsigned char* down) {
    RowPair even = splat<2 * BLOCK_WIDTH>(0.0f), odd = even;
    int k = 0;
    for (; k + 1 < groups; k += 2, ray += 2 * ROW_GROUP * stride, down += 2 * ROW_GROUP) {
        const Row levels = load_bytes<BLOCK_WIDTH>(down);
        even = even + load_rows(ray, stride) * levels_of<0>(levels);
        odd = odd + load_rows(ray + 2 * stride, stride) * levels_of<1>(levels);
        even = even + load_rows(ray + 4 * stride, stride) * levels_of<2>(levels);
        odd = odd + load_rows(ray + 6 * stride, stride) * levels_of<3>(levels);
    }
    if (k < groups) {
        const Row levels = load_bytes<BLOCK_WIDTH>(down);
        even = even + load_rows(ray, stride) * levels_of<0>(levels);
        odd = odd + load_rows(ray + 2 * stride, stride) * levels_of<1>(levels);
    }
    const RowPair both = even + odd;
    return first_row(both) + second_row(both);
}

/// Walk over blocks of profiles. Those of one height follow each other, so that each height has a loop of its own,
/// whose rows the compiler unrolls.
template <int GROUPS, class Work>
LFPIV_INLINE void walk_height(const VoxelBlocks& blocks, int& block, const unsigned char*& level, Work work) {
    constexpr int ROWS = GROUPS * ROW_GROUP;
    for (; block < blocks.last && blocks.height[block] == ROWS; ++block, level += BLOCK_WIDTH + ROWS)
        work(blocks.ray[block], GROUPS, level);
}
template <class Work>
LFPIV_INLINE void walk_profiles(const VoxelBlocks& blocks, Work work) {
    static_assert(UNROLLED == 6, "a line for each height");
    const unsigned char* level = blocks.level;
    int block = blocks.first;
    walk_height<1>(blocks, block, level, work);
    walk_height<2>(blocks, block, level, work);
    walk_height<3>(blocks, block, level, work);
    walk_height<4>(blocks, block, level, work);
    walk_height<5>(blocks, block, level, work);
    walk_height<6>(blocks, block, level, work);
    for (; block < blocks.last; ++block) {
        work(blocks.ray[block], blocks.height[block] / ROW_GROUP, level);
        level += BLOCK_WIDTH + blocks.height[block];
    }
}

/// Return the weighted sum of the light on a voxel's rays, in levels.
LFPIV_INLINE float gather(const VoxelBlocks& blocks, const float* rays) {
    Row total = splat<BLOCK_WIDTH>(0.0f);
    if (blocks.profiles) {
        walk_profiles(blocks, [&](int ray, int groups, const unsigned char* level) __attribute__((always_inline)) {
            const Row sums = sum_rows(rays + ray, groups, blocks.stride, level + BLOCK_WIDTH);
            total = total + sums * load_bytes<BLOCK_WIDTH>(level);
        });
        return sum(total);
    }
    const unsigned char* level = blocks.level;
    for (int block = blocks.first; block < blocks.last; ++block)
        total = total + gather_pixels(rays + blocks.ray[block], blocks.height[block], blocks.width[block],
                                      blocks.stride, level);
    return sum(total);
}

/// Add light to two rows.
LFPIV_INLINE void add_to_rows(float* ray, int stride, RowPair light) {
    const RowPair sum = load_rows(ray, stride) + light;
    store(ray, first_row(sum)), store(ray + stride, second_row(sum));
}

/// Add light times the levels of its rows to `groups` groups of rows.
LFPIV_INLINE void add_rows(float* ray, int groups, int stride, const unsigned char* down, Row light) {
    const RowPair twice = side_by_side(light, light);
    int k = 0;
    for (; k + 1 < groups; k += 2, ray += 2 * ROW_GROUP * stride, down += 2 * ROW_GROUP) {
        const Row levels = load_bytes<BLOCK_WIDTH>(down);
        add_to_rows(ray, stride, twice * levels_of<0>(levels));
        add_to_rows(ray + 2 * stride, stride, twice * levels_of<1>(levels));
        add_to_rows(ray + 4 * stride, stride, twice * levels_of<2>(levels));
        add_to_rows(ray + 6 * stride, stride, twice * levels_of<3>(levels));
    }
    if (k < groups) {
        const Row levels = load_bytes<BLOCK_WIDTH>(down);
        add_to_rows(ray, stride, twice * levels_of<0>(levels));
        add_to_rows(ray + 2 * stride, stride, twice * levels_of<1>(levels));
    }
}

/// Add a voxel's light, in units of one level, to its rays.
LFPIV_INLINE void scatter(const VoxelBlocks& blocks, float intensity, float* rays_out) {
    if (blocks.profiles) {
        const Row light = splat<BLOCK_WIDTH>(intensity);
        walk_profiles(blocks, [&](int ray, int groups, const unsigned char* level) __attribute__((always_inline)) {
            add_rows(rays_out + ray, groups, blocks.stride, level + BLOCK_WIDTH,
                     load_bytes<BLOCK_WIDTH>(level) * light);
        });
        return;
    }
    const unsigned char* level = blocks.level;
    for (int block = blocks.first; block < blocks.last; ++block) {
        float* ray = rays_out + blocks.ray[block];
        const int rows = blocks.height[block], columns = blocks.width[block];
        const Row light = first_lanes(splat<BLOCK_WIDTH>(intensity), columns);
        int k = 0;
        for (; k + 1 < rows; k += 2, ray += 2 * blocks.stride, level += 2 * columns) {  // load two rows, store two
            const Row even = load<BLOCK_WIDTH>(ray) + load_bytes<BLOCK_WIDTH>(level) * light;
            const Row odd = load<BLOCK_WIDTH>(ray + blocks.stride) + load_bytes<BLOCK_WIDTH>(level + columns) * light;
            store(ray, even);
            store(ray + blocks.stride, odd);
        }
        if (k < rows) {
            store(ray, load<BLOCK_WIDTH>(ray) + load_bytes<BLOCK_WIDTH>(level) * light);
            level += columns;
        }
    }
}

/// Blocks of weights whose rows of rays are counted and copied, set by set. A row of pixels under a lens is in set
/// (row modulo `sets`). Rows of profiles have their products, a level as large as the largest level times one.
struct SplitBlocks {
    const int* first_block;
    const int64_t* first_value;
    const int* ray;
    const unsigned char* height;
    const unsigned char* width;
    const unsigned char* value;
    int edge;  // rays in a row of a microimage, and rows
    int sets, voxels;
    int profile_levels;  // largest level of a profile; 0 where blocks have a value for each ray

    /// Call work(set, ray, levels, columns) for each row of a voxel's blocks. Rows of profiles without light are left
    /// out.
    template <class Work>
    LFPIV_INLINE void for_rows(int voxel, Work work) const {
        const unsigned char* level = value + first_value[voxel];
        for (int block = first_block[voxel]; block < first_block[voxel + 1]; ++block) {
            const int columns = width[block], row = ray[block] / edge % edge;
            if (profile_levels > 0) {
                const unsigned char* const down = level + columns;
                for (int k = 0; k < height[block]; ++k) {
                    unsigned char product[BLOCK_WIDTH];
                    if (multiply(level, columns, down[k], product))
                        work((row + k) % sets, ray[block] + k * edge, product, columns);
                }
                level = down + height[block];
                continue;
            }
            for (int k = 0; k < height[block]; ++k, level += columns)
                work((row + k) % sets, ray[block] + k * edge, level, columns);
        }
    }

    /// Write the products of a profile across and one level down, rounded to levels; return whether one is not 0.
    LFPIV_INLINE bool multiply(const unsigned char* across, int columns, int down, unsigned char* product_out) const {
        bool lit = false;
        for (int k = 0; k < columns; ++k) {
            product_out[k] = (unsigned char)((across[k] * down + profile_levels / 2) / profile_levels);
            lit = lit || product_out[k] > 0;
        }
        return lit;
    }
};

/// Return the blocks from Warp's struct.
template <class Blocks>
LFPIV_INLINE SplitBlocks split_blocks(const Blocks& blocks) {
    return {blocks.first_block.data,
            (const int64_t*)blocks.first_value.data,
            blocks.ray.data,
            blocks.height.data,
            blocks.width.data,
            blocks.value.data,
            blocks.edge,
            blocks.sets,
            blocks.voxels,
            blocks.profile_levels};
}

/// Count a voxel's rows of each set. `count_out` must hold zeros.
LFPIV_INLINE void count_rows(const SplitBlocks& blocks, int voxel, int* count_out) {
    blocks.for_rows(
        voxel, [&](int set, int, const unsigned char*, int) { ++count_out[(int64_t)set * blocks.voxels + voxel]; });
}

/// Write the first ray and the levels of a voxel's rows. Moves `next_out` from where each set's rows begin to where
/// they end. Levels beyond a row's columns must be zero before.
LFPIV_INLINE void write_rows(const SplitBlocks& blocks, int voxel, int* next_out, int* ray_out,
                             unsigned char* level_out) {
    blocks.for_rows(voxel, [&](int set, int ray, const unsigned char* level, int columns) {
        const int row = next_out[(int64_t)set * blocks.voxels + voxel]++;
        ray_out[row] = ray;
        for (int k = 0; k < columns; ++k) level_out[(int64_t)BLOCK_WIDTH * row + k] = level[k];
    });
}

/// A voxel's rows of rays of one set.
struct VoxelRows {
    const int* ray;
    const unsigned char* level;
    int count;
};

/// Return a voxel's rows of a set from the device arrays of `Rows`, see ``block_rows.py``.
template <class Rows>
LFPIV_INLINE VoxelRows rows_of(const Rows& rows, int voxel, int set) {
    const int* const first = rows.first.data + (int64_t)set * rows.voxels + voxel;
    return {rows.ray.data + first[0], rows.level.data + (int64_t)BLOCK_WIDTH * first[0], first[1] - first[0]};
}

/// Return the weighted sum of the light on a voxel's rows of rays, in levels.
LFPIV_INLINE float gather_rows(const VoxelRows& rows, const float* rays) {
    Row even = splat<BLOCK_WIDTH>(0.0f), odd = even;
    const unsigned char* level = rows.level;
    int k = 0;
    for (; k + 1 < rows.count; k += 2, level += 2 * BLOCK_WIDTH) {
        even = even + load<BLOCK_WIDTH>(rays + rows.ray[k]) * load_bytes<BLOCK_WIDTH>(level);
        odd = odd + load<BLOCK_WIDTH>(rays + rows.ray[k + 1]) * load_bytes<BLOCK_WIDTH>(level + BLOCK_WIDTH);
    }
    if (k < rows.count) even = even + load<BLOCK_WIDTH>(rays + rows.ray[k]) * load_bytes<BLOCK_WIDTH>(level);
    return sum(even + odd);
}

/// Add a voxel's light, in units of one level, to its rows of rays.
LFPIV_INLINE void scatter_rows(const VoxelRows& rows, float intensity, float* rays_out) {
    const Row light = splat<BLOCK_WIDTH>(intensity);
    for (int k = 0; k < rows.count; ++k) {
        float* const ray = rays_out + rows.ray[k];
        store(ray, load<BLOCK_WIDTH>(ray) + load_bytes<BLOCK_WIDTH>(rows.level + BLOCK_WIDTH * k) * light);
    }
}

#endif

}  // namespace lfpiv

#endif
