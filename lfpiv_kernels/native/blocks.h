// Direct correlation of blocks with their surroundings on the CPU; see ``correlation/layout.py`` for the structures.
#ifndef LFPIV_BLOCKS_H
#define LFPIV_BLOCKS_H

#include "products.h"

namespace lfpiv {

/// Copy every `stride`th voxel of a row to the lanes `first` to `last - 1` of `count`, and 0 to the others.
LFPIV_INLINE void split_row(const float* voxel, int stride, int first, int last, int count, float* lane) {
    for (int k = 0; k < first; ++k) lane[k] = 0.0f;
    for (int k = first; k < last; ++k) lane[k] = voxel[k * stride];
    for (int k = last; k < count; ++k) lane[k] = 0.0f;
}

/// Store one plane of a volume by phase, 0 outside the volume. Lanes are written in order: what is read at a distance
/// stays in the caches.
template <class Triple, class Lattice>
LFPIV_INLINE void split_plane(const float* volume, const Triple& shape, const Lattice& lattice, int plane,
                              float* split) {
    const int ny = shape[1], nx = shape[2], stride_y = lattice.stride[1], stride_x = lattice.stride[2];
    const int rows = (lattice.lanes + lattice.pitch - 1) / lattice.pitch, z = lattice.corner[0] + plane;
    float* to = split + (int64_t)plane * lattice.phases[1] * lattice.phases[2] * lattice.lanes;
    for (int phase_y = 0; phase_y < lattice.phases[1]; ++phase_y)
        for (int phase_x = 0; phase_x < lattice.phases[2]; ++phase_x, to += lattice.lanes) {
            // voxel of lane 0, first lane inside the volume, first lane behind it
            const int x = lattice.corner[2] + phase_x;
            const int low = x < 0 ? (stride_x - 1 - x) / stride_x : 0;
            const int high = x < nx ? (nx - x + stride_x - 1) / stride_x : 0;
            for (int row = 0; row < rows; ++row) {
                const int y = lattice.corner[1] + row * stride_y + phase_y;
                const int count = min(lattice.lanes - row * lattice.pitch, lattice.pitch);
                const bool inside = z >= 0 && z < shape[0] && y >= 0 && y < ny;
                const int last = inside ? min(high, count) : 0;
                const float* voxel = volume + (inside ? ((int64_t)z * ny + y) * nx : 0) + x;
                split_row(voxel, stride_x, min(low, last), last, count, to + row * lattice.pitch);
            }
        }
}

#if !LFPIV_GPU

/// Voxels of LANES blocks, (z, y, x, lane), and of as many planes of their surroundings, (z % depth, y, x, lane).
struct BlockVoxels {
    float *block, *around;
    int depth, rows, columns;         // of a block
    int rows_around, columns_around;  // of a plane of the surroundings
    int half = 0;                     // first lane of the vector at work

    const float* block_row(int z, int y) const { return block + (z * rows + y) * columns * LANES + half; }
    const float* around_row(int z, int y) const {
        return around + (z % depth * rows_around + y) * columns_around * LANES + half;
    }
    V block_at(const float* row, int x) const { return load(row + x * LANES); }
    V around_at(const float* row, int x) const { return load(row + x * LANES); }
};

/// Copy one plane of LANES neighbouring blocks or surroundings, `rows` by `columns` voxels.
template <class Volume>
LFPIV_INLINE void copy_plane(const Volume& volume, int plane, int lane, int rows, int columns, float* to) {
    const float* from = volume.values.data + (int64_t)plane * volume.plane + lane;
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < columns; ++x, to += LANES)
            for (int k = 0; k < LANES; k += WIDTH)
                store(to + k, load(from + volume.along_y.data[y] + volume.along_x.data[x] + k));
}

/// Sum the products of blocks at all lags along y and x and one lag along z, (lag y, lag x, lane).
template <class Voxels, class Triple>
LFPIV_INLINE void sum_lags(const Voxels& voxels, const Triple& block, const Triple& lags, int lag_z, int64_t pitch,
                           float* sums) {
    for (int lag_y = 0; lag_y < lags[1]; ++lag_y) {
        float* row_sums = sums + (int64_t)lag_y * lags[2] * pitch;
        in_parts<LEAST_LAGS, MOST_LAGS>(lags[2], [&](auto length, int lag) {
            constexpr int LAGS = decltype(length)::value;
            V total[LAGS];
#pragma unroll
            for (int t = 0; t < LAGS; ++t) total[t] = V{};
            for (int z = 0; z < block[0]; ++z)
                for (int y = 0; y < block[1]; ++y)
                    add_row(total, voxels, voxels.block_row(z, y), voxels.around_row(lag_z + z, lag_y + y), block[2],
                            lag);
#pragma unroll
            for (int t = 0; t < LAGS; ++t) store(row_sums + (lag + t) * pitch, total[t]);
        });
    }
}

/// Sum the products of a group of blocks with their surroundings at all lags. Tasks are numbered (layer, group of
/// lanes).
template <class Volume, class Layers>
LFPIV_INLINE void correlate_blocks(const Volume& first, const Volume& second, const Layers& layers, int task,
                                   float* scratch, float* sums) {
    const int lane = task % layers.groups * layers.group;
    const int layer = layers.begin + task / layers.groups, plane = layer * layers.stride[0];
    const int nz = layers.lags[0], ny = layers.lags[1], nx = layers.lags[2];
    const int depth = layers.block[0], rows = layers.block[1], columns = layers.block[2];
    float* to = sums + (int64_t)(layer % layers.ring) * nz * ny * nx * layers.lanes + lane;
    const int64_t plane_pitch = (int64_t)ny * nx * layers.lanes;
    const int rows_around = rows + ny - 1, columns_around = columns + nx - 1, block_size = rows * columns * LANES;
    float* around = scratch + (int64_t)depth * block_size;
    BlockVoxels voxels{scratch, around, depth, rows, columns, rows_around, columns_around};
    auto copy_around = [&](int z) {  // the last `depth` planes are held
        float* to = around + (int64_t)(z % depth) * rows_around * columns_around * LANES;
        copy_plane(second, plane + z, lane, rows_around, columns_around, to);
    };
    for (int z = 0; z < depth; ++z) copy_plane(first, plane + z, lane, rows, columns, scratch + z * block_size);
    for (int z = 0; z < depth - 1; ++z) copy_around(z);
    for (int lag = 0; lag < nz; ++lag) {
        copy_around(lag + depth - 1);
        for (voxels.half = 0; voxels.half < LANES; voxels.half += WIDTH)
            sum_lags(voxels, layers.block, layers.lags, lag, layers.lanes, to + lag * plane_pitch + voxels.half);
    }
}

#endif

/// Add to each lane the `count - 1` that follow at a distance. In place: lanes that are read have not been written yet.
LFPIV_INLINE void add_following(float* sums, int lanes, int count, int distance) {
    for (int k = 0; k < lanes; k += WIDTH) {
        V total = load(sums + k);
        for (int i = 1; i < count; ++i) total += load(sums + k + i * distance);
        store(sums + k, total);
    }
}

/// Add up the blocks of one lag over the y and x of each window. Lanes behind a row's end hold no window.
/// Tasks are numbered (layer, lag).
template <class Layers>
LFPIV_INLINE void gather_blocks(const Layers& layers, int blocks_y, int blocks_x, int pitch, int task, float* sums) {
    const int lags = layers.lags[0] * layers.lags[1] * layers.lags[2];
    const int row = (layers.begin + task / lags) % layers.ring * lags + task % lags;
    float* lanes = sums + (int64_t)row * layers.lanes;
    add_following(lanes, layers.lanes, blocks_y, pitch);
    add_following(lanes, layers.lanes, blocks_x, 1);
}

}  // namespace lfpiv

#endif
