// Voxels shared among neighbours on their row or column on a GPU, a lane for each element; see
// ``reconstruction/line_shares_gpu.py``.
#ifndef LFPIV_LINE_SHARES_GPU_H
#define LFPIV_LINE_SHARES_GPU_H

#include "lanes.h"
#include "line_shares.h"

namespace lfpiv {

/// Write 32 elements, counted (row, layer, column); with `absolute` all shares count as positive.
LFPIV_INLINE void share_elements(const LineMap& map, int warp, bool absolute, const float* in, float* out) {
    const int size = map.to.rows * map.layers * map.to.columns;
    for_lanes([&](int lane) {
        const int element = warp * LANES_OF_WARP + lane;
        if (element >= size) return;
        const int index = element / map.to.columns, column = element - index * map.to.columns;
        const int row = index / map.layers, layer = index - row * map.layers;
        float light = 0.0f;
        for (int tap = 0; tap < map.taps; ++tap) {
            const float share = map.share[map.taps * layer + tap];
            const int aside = map.back ? tap : -tap;
            const int from_row = row + (map.along_rows ? aside : 0), k = column + (map.along_rows ? 0 : aside);
            const bool inside = from_row >= 0 && from_row < map.from.rows && k >= 0 && k < map.from.columns;
            const int64_t at = (int64_t)from_row * map.from.row_stride + (int64_t)layer * map.from.layer_stride + k;
            light += (absolute && share < 0.0f ? -share : share) * (inside ? in[at] : 0.0f);
        }
        out[(int64_t)row * map.to.row_stride + (int64_t)layer * map.to.layer_stride + column] = light;
    });
}

}  // namespace lfpiv

#endif
