// Voxels on planes across a camera's line of sight: each layer of voxels shifted onto the planes next to it, and back.
#ifndef LFPIV_DEPTH_PLANES_H
#define LFPIV_DEPTH_PLANES_H

#include "simd.h"

namespace lfpiv {

/// Planes that a layer of voxels is shared among.
constexpr int TAPS = 4;

/// How voxels (row a, layer z, column b) become nodes (row, plane, column), see ``depth_planes.py``.
struct PlaneMap {
    const int* plane;    // first plane of each layer
    const float* share;  // of each layer on each of its planes
    const int* shift;    // rows, then columns, from a voxel to its node, per layer and plane
    int rows, layers, columns;
    int row_stride, layer_stride;  // of voxels
    int node_rows, planes, node_columns;
};

/// Return the map from Warp's struct.
template <class Map>
LFPIV_INLINE PlaneMap plane_map(const Map& map) {
    return {map.plane.data, map.share.data,   map.shift.data, map.rows,   map.layers,      map.columns,
            map.row_stride, map.layer_stride, map.node_rows,  map.planes, map.node_columns};
}

/// Add a row times a factor to another.
LFPIV_INLINE void add_row(float* __restrict__ to, const float* __restrict__ from, float factor, int count) {
    for (int k = 0; k < count; ++k) to[k] += factor * from[k];
}

/// Write the light of voxels on one row of nodes; with `absolute` all shares count as positive.
LFPIV_INLINE void spread_row(const PlaneMap& map, int index, bool absolute, const float* voxels, float* nodes_out) {
    const int row = index / map.planes, plane = index - row * map.planes;
    float* const out = nodes_out + (int64_t)index * map.node_columns;
    for (int k = 0; k < map.node_columns; ++k) out[k] = 0.0f;
    for (int layer = 0; layer < map.layers; ++layer) {
        const int tap = plane - map.plane[layer];
        if (tap < 0 || tap >= TAPS) continue;
        const float share = map.share[TAPS * layer + tap];
        const int* const shift = map.shift + 2 * (TAPS * layer + tap);
        const int from = row - shift[0];
        if (share == 0.0f || from < 0 || from >= map.rows) continue;
        add_row(out + shift[1], voxels + (int64_t)from * map.row_stride + (int64_t)layer * map.layer_stride,
                absolute && share < 0.0f ? -share : share, map.columns);
    }
}

/// Write on one row of voxels the sum of its nodes: the adjoint of `spread_row`.
LFPIV_INLINE void collect_row(const PlaneMap& map, int index, const float* nodes, float* voxels_out) {
    const int row = index / map.layers, layer = index - row * map.layers;
    float* const out = voxels_out + (int64_t)row * map.row_stride + (int64_t)layer * map.layer_stride;
    for (int k = 0; k < map.columns; ++k) out[k] = 0.0f;
    for (int tap = 0; tap < TAPS; ++tap) {
        const float share = map.share[TAPS * layer + tap];
        const int* const shift = map.shift + 2 * (TAPS * layer + tap);
        if (share == 0.0f) continue;
        const int64_t node_row = (int64_t)(row + shift[0]) * map.planes + map.plane[layer] + tap;
        add_row(out, nodes + node_row * map.node_columns + shift[1], share, map.columns);
    }
}

}  // namespace lfpiv

#endif
