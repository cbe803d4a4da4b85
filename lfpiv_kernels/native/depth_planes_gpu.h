// Voxels on planes across a camera's line of sight on a GPU, a lane for each node or voxel; see
// ``reconstruction/depth_planes_gpu.py``.
#ifndef LFPIV_DEPTH_PLANES_GPU_H
#define LFPIV_DEPTH_PLANES_GPU_H

#include "depth_planes.h"
#include "lanes.h"

namespace lfpiv {

/// Write the light of voxels on 32 nodes; with `absolute` all shares count as positive. `layers_of` holds the first
/// layer that meets each plane, and the end of these layers.
LFPIV_INLINE void spread_nodes(const PlaneMap& map, const int* layers_of, int warp, bool absolute, const float* voxels,
                               float* nodes_out) {
    const int size = map.node_rows * map.planes * map.node_columns;
    for_lanes([&](int lane) {
        const int node = warp * LANES_OF_WARP + lane;
        if (node >= size) return;
        const int index = node / map.node_columns, column = node - index * map.node_columns;
        const int row = index / map.planes, plane = index - row * map.planes;
        float light = 0.0f;
        const int begin = layers_of[2 * plane], end = layers_of[2 * plane + 1];
        for (int layer = begin; layer < end; ++layer) {
            const int tap = plane - map.plane[layer], at = TAPS * layer + tap;
            if (tap < 0 || tap >= TAPS) continue;
            const float share = map.share[at];
            const int from = row - map.shift[2 * at], k = column - map.shift[2 * at + 1];
            const bool inside = share != 0.0f && from >= 0 && from < map.rows && k >= 0 && k < map.columns;
            const float* const voxel = voxels + (int64_t)from * map.row_stride + (int64_t)layer * map.layer_stride + k;
            light += (absolute && share < 0.0f ? -share : share) * (inside ? *voxel : 0.0f);
        }
        nodes_out[node] = light;
    });
}

/// Write on 32 voxels the sum of their nodes: the adjoint of `spread_nodes`. Voxels are counted (row, layer, column).
LFPIV_INLINE void collect_voxels(const PlaneMap& map, int warp, const float* nodes, float* voxels_out) {
    const int size = map.rows * map.layers * map.columns;
    for_lanes([&](int lane) {
        const int voxel = warp * LANES_OF_WARP + lane;
        if (voxel >= size) return;
        const int index = voxel / map.columns, column = voxel - index * map.columns;
        const int row = index / map.layers, layer = index - row * map.layers, plane = map.plane[layer];
        float light = 0.0f;
        for (int tap = 0; tap < TAPS; ++tap) {
            const int at = TAPS * layer + tap;
            const float share = map.share[at];
            const int to_row = row + map.shift[2 * at], to_column = column + map.shift[2 * at + 1];
            const int64_t node = ((int64_t)to_row * map.planes + plane + tap) * map.node_columns + to_column;
            light += share * (share != 0.0f ? nodes[node] : 0.0f);
        }
        voxels_out[(int64_t)row * map.row_stride + (int64_t)layer * map.layer_stride + column] = light;
    });
}

}  // namespace lfpiv

#endif
