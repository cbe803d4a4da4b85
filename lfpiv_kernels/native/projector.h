// A voxel's blocks of weights against the rays of a camera: gathering and scattering light, one row of a block at a
// time.
#ifndef LFPIV_PROJECTOR_H
#define LFPIV_PROJECTOR_H

#include "simd.h"

namespace lfpiv {

/// Rays in a row of a block at most: one vector.
constexpr int BLOCK_WIDTH = 8;

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
    bool profiles;  // values are a profile along the columns and one along the rows
};

/// Return the blocks of a voxel from the device arrays of `Matrix`, see ``projector.py``.
template <class Matrix>
LFPIV_INLINE VoxelBlocks blocks_of(const Matrix& matrix, int voxel) {
    return {matrix.first_block.data[voxel],
            matrix.first_block.data[voxel + 1],
            matrix.ray.data,
            matrix.height.data,
            matrix.width.data,
            matrix.level.data + matrix.first_value.data[voxel],
            matrix.stride,
            matrix.profiles};
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

/// Return the weighted sum of the light on a voxel's rays, in levels.
LFPIV_INLINE float gather(const VoxelBlocks& blocks, const float* rays) {
    const unsigned char* level = blocks.level;
    Row total = splat<BLOCK_WIDTH>(0.0f);
    for (int block = blocks.first; block < blocks.last; ++block) {
        const float* ray = rays + blocks.ray[block];
        const int rows = blocks.height[block], columns = blocks.width[block];
        if (blocks.profiles) {
            const Row across = first_lanes(load_bytes<BLOCK_WIDTH>(level), columns);
            level += columns;
            Row down = splat<BLOCK_WIDTH>(0.0f);
            for (int k = 0; k < rows; ++k, ray += blocks.stride)
                down = down + load<BLOCK_WIDTH>(ray) * splat<BLOCK_WIDTH>((float)level[k]);
            level += rows;
            total = total + down * across;
        } else {
            total = total + gather_pixels(ray, rows, columns, blocks.stride, level);
        }
    }
    return sum(total);
}

#if !defined(__CUDA_ARCH__)  // without atomics: each thread needs rays of its own

/// Replace the rows of a block's rays. A row's new light is update(old light, its levels); levels of neighbouring rows
/// are `step` apart. Return the levels behind the last row.
template <class Update>
LFPIV_INLINE const unsigned char* update_rows(float* ray, int rows, int stride, const unsigned char* level, int step,
                                              Update update) {
    int k = 0;
    for (; k + 1 < rows; k += 2, ray += 2 * stride, level += 2 * step) {  // load two rows, then store two
        const Row even = update(load<BLOCK_WIDTH>(ray), level);
        const Row odd = update(load<BLOCK_WIDTH>(ray + stride), level + step);
        store(ray, even);
        store(ray + stride, odd);
    }
    if (k < rows) {
        store(ray, update(load<BLOCK_WIDTH>(ray), level));
        level += step;
    }
    return level;
}

/// Add a voxel's light, in units of one level, to its rays.
LFPIV_INLINE void scatter(const VoxelBlocks& blocks, float intensity, float* rays_out) {
    const unsigned char* level = blocks.level;
    for (int block = blocks.first; block < blocks.last; ++block) {
        float* ray = rays_out + blocks.ray[block];
        const int rows = blocks.height[block], columns = blocks.width[block];
        const Row light = first_lanes(splat<BLOCK_WIDTH>(intensity), columns);
        if (blocks.profiles) {
            const Row across = load_bytes<BLOCK_WIDTH>(level) * light;
            level = update_rows(ray, rows, blocks.stride, level + columns, 1,
                                [&](Row row, const unsigned char* down) { return row + across * (float)*down; });
        } else {
            level = update_rows(ray, rows, blocks.stride, level, columns, [&](Row row, const unsigned char* values) {
                return row + load_bytes<BLOCK_WIDTH>(values) * light;
            });
        }
    }
}

#else

LFPIV_INLINE void scatter(const VoxelBlocks&, float, float*) {}  // a GPU scatters atomically, in another kernel

#endif

}  // namespace lfpiv

#endif
