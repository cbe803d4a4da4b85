// Direct correlation of blocks with their surroundings on a GPU, a thread per lane and row of lags; see
// ``correlation/layout.py`` for the structures.
#ifndef LFPIV_BLOCKS_GPU_H
#define LFPIV_BLOCKS_GPU_H

#include "products.h"

namespace lfpiv {

/// Voxels of one lane's block and its surroundings, read from the volumes.
template <class Volume>
struct LaneVoxels {
    const Volume &first, &second;

    LFPIV_INLINE float block_at(const float* row, int x) const { return row[first.along_x.data[x]]; }
    LFPIV_INLINE float around_at(const float* row, int x) const { return row[second.along_x.data[x]]; }
};

/// Sum the products of one lane's block with its surroundings at all lags along x and one lag along z and y.
/// Tasks are numbered (layer, lag along z, lag along y, lane): neighbouring threads have neighbouring lanes, whose
/// voxels and sums are neighbours in memory.
template <class Volume, class Layers>
LFPIV_INLINE void correlate_lane(const Volume& first, const Volume& second, const Layers& layers, int task,
                                 float* sums) {
    const int lane = task % layers.lanes, row = task / layers.lanes, rows = layers.lags[0] * layers.lags[1];
    const int lag_z = row % rows / layers.lags[1], lag_y = row % layers.lags[1], layer = layers.begin + row / rows;
    const int plane = layer * layers.stride[0], lags = layers.lags[2];
    const LaneVoxels<Volume> voxels{first, second};
    float* to = sums + ((int64_t)(layer % layers.ring) * rows + row % rows) * lags * layers.lanes + lane;
    in_parts<LEAST_LAGS, MOST_LAGS>(lags, [&](auto length, int lag) {
        constexpr int LAGS = decltype(length)::value;
        float total[LAGS] = {};
        const float* block = first.values.data + (int64_t)plane * first.plane + lane;
        const float* around = second.values.data + (int64_t)(plane + lag_z) * second.plane + lane;
        for (int z = 0; z < layers.block[0]; ++z, block += first.plane, around += second.plane)
            for (int y = 0; y < layers.block[1]; ++y)
                add_row(total, voxels, block + first.along_y.data[y], around + second.along_y.data[lag_y + y],
                        layers.block[2], lag);
#pragma unroll
        for (int t = 0; t < LAGS; ++t) to[(int64_t)(lag + t) * layers.lanes] = total[t];
    });
}

}  // namespace lfpiv

#endif
