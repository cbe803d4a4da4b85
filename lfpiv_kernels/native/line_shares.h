// Voxels shared among neighbours on their row or column, each layer alike, and back.
#ifndef LFPIV_LINE_SHARES_H
#define LFPIV_LINE_SHARES_H

#include "depth_planes.h"

namespace lfpiv {

/// Rows and columns of every layer, and how far apart rows and layers lie in memory.
struct Layers {
    int rows, columns, row_stride, layer_stride;
};

/// How the elements of each layer get the light of their neighbours, see ``line_shares.py``.
struct LineMap {
    const float* share;  // of each layer and tap
    int taps, layers;
    bool along_rows;  // neighbours differ in their row, else in their column
    bool back;        // from element + tap, the adjoint; else from element - tap
    Layers from, to;
};

/// Return the map from Warp's struct.
template <class Map>
LFPIV_INLINE LineMap line_map(const Map& map) {
    return {map.share.data,
            map.taps,
            map.layers,
            map.along_rows,
            map.back,
            {map.from_rows, map.from_columns, map.from_row_stride, map.from_layer_stride},
            {map.to_rows, map.to_columns, map.to_row_stride, map.to_layer_stride}};
}

/// Write one row of a layer; with `absolute` all shares count as positive.
LFPIV_INLINE void share_row(const LineMap& map, int index, bool absolute, const float* in, float* out) {
    const int row = index / map.layers, layer = index - row * map.layers;
    float* const to = out + (int64_t)row * map.to.row_stride + (int64_t)layer * map.to.layer_stride;
    const int columns = map.to.columns < map.from.columns ? map.to.columns : map.from.columns;
    for (int k = 0; k < map.to.columns; ++k) to[k] = 0.0f;
    for (int tap = 0; tap < map.taps; ++tap) {
        const float share = map.share[map.taps * layer + tap];
        const int from_row = map.along_rows ? (map.back ? row + tap : row - tap) : row;
        if (share == 0.0f || from_row < 0 || from_row >= map.from.rows) continue;
        const float* const from = in + (int64_t)from_row * map.from.row_stride + (int64_t)layer * map.from.layer_stride;
        const int aside = map.along_rows ? 0 : tap;
        add_row(to + (map.back ? 0 : aside), from + (map.back ? aside : 0), absolute && share < 0.0f ? -share : share,
                columns);
    }
}

}  // namespace lfpiv

#endif
