// A voxel's blocks of weights against the rays of a camera: gathering and scattering light, one row of a block at a
// time.
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
enum LensSet { EVEN_LENSES = 0, ODD_LENSES = 1, ALL_LENSES = 2 };

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

/// Ask for the next voxel's blocks. Where half of each voxel's are skipped, the processor does not foresee them; with
/// all of them it gains 3 to 13 % of the time.
template <class Matrix>
LFPIV_INLINE void prefetch_next(const Matrix& matrix, int voxel, int lenses) {
    if (voxel + 1 >= (int)matrix.scale.shape[0]) return;
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

/// Return a level as a vector of equal lanes.
LFPIV_INLINE Row splat_level(unsigned char level) { return splat<BLOCK_WIDTH>((float)level); }

/// Return the sums along the columns of `groups` groups of rows, each row times its level.
LFPIV_INLINE Row sum_rows(const float* ray, int groups, int stride, const unsigned char* down) {
    Row even = splat<BLOCK_WIDTH>(0.0f), odd = even;
    for (int k = 0; k < groups; ++k, ray += ROW_GROUP * stride, down += ROW_GROUP) {
        even = even + load<BLOCK_WIDTH>(ray) * splat_level(down[0]);
        odd = odd + load<BLOCK_WIDTH>(ray + stride) * splat_level(down[1]);
        even = even + load<BLOCK_WIDTH>(ray + 2 * stride) * splat_level(down[2]);
        odd = odd + load<BLOCK_WIDTH>(ray + 3 * stride) * splat_level(down[3]);
    }
    return even + odd;
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

#if !defined(__CUDA_ARCH__)  // without atomics: each thread needs rays of its own

/// Add light times the levels of its rows to `groups` groups of rows.
LFPIV_INLINE void add_rows(float* ray, int groups, int stride, const unsigned char* down, Row light) {
    for (int k = 0; k < groups; ++k, ray += ROW_GROUP * stride, down += ROW_GROUP) {  // load all, then store all
        const Row a = load<BLOCK_WIDTH>(ray) + light * splat_level(down[0]);
        const Row b = load<BLOCK_WIDTH>(ray + stride) + light * splat_level(down[1]);
        const Row c = load<BLOCK_WIDTH>(ray + 2 * stride) + light * splat_level(down[2]);
        const Row d = load<BLOCK_WIDTH>(ray + 3 * stride) + light * splat_level(down[3]);
        store(ray, a), store(ray + stride, b), store(ray + 2 * stride, c), store(ray + 3 * stride, d);
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

#else

LFPIV_INLINE void scatter(const VoxelBlocks&, float, float*) {}  // a GPU scatters atomically, in another kernel

#endif

}  // namespace lfpiv

#endif
