// Voxels on planes across a camera's line of sight: each layer of voxels shifted onto the planes next to it, and back.
#ifndef LFPIV_DEPTH_PLANES_H
#define LFPIV_DEPTH_PLANES_H

#include "simd.h"

namespace lfpiv {

/// Planes that a layer of voxels is shared among, and places along an axis that a voxel is shared among.
constexpr int TAPS = 4;

/// How voxels (row a, layer z, column b) become nodes (row, plane, column), see ``depth_planes.py``.
struct PlaneMap {
    const int* plane;     // first plane of each layer
    const float* depth;   // share of each layer on each of its planes
    const int* shift;     // rows, then columns, from a voxel to its first node, per layer and plane
    const float* across;  // shares along the rows, then along the columns, per layer and plane
    int rows, layers, columns;
    int row_stride, layer_stride;  // of voxels
    int node_rows, planes, node_columns;

    LFPIV_INLINE const int* shift_of(int layer, int tap) const { return shift + 2 * (TAPS * layer + tap); }
    LFPIV_INLINE const float* row_shares(int layer, int tap) const { return across + 2 * TAPS * (TAPS * layer + tap); }
    LFPIV_INLINE const float* column_shares(int layer, int tap) const { return row_shares(layer, tap) + TAPS; }
};

/// Return the map from Warp's struct.
template <class Map>
LFPIV_INLINE PlaneMap plane_map(const Map& map) {
    return {map.plane.data, map.depth.data,   map.shift.data,   map.across.data, map.rows,   map.layers,
            map.columns,    map.row_stride,   map.layer_stride, map.node_rows,   map.planes, map.node_columns};
}

/// Add a row times a factor to another.
LFPIV_INLINE void add_row(float* __restrict__ to, const float* __restrict__ from, float factor, int count) {
    for (int k = 0; k < count; ++k) to[k] += factor * from[k];
}

/// Add a row of voxels to a row of nodes, or a row of nodes to one of voxels: every column with its shares.
template <class Add>
LFPIV_INLINE void for_columns(const PlaneMap& map, int layer, int tap, float share, Add add) {
    const float* const shares = map.column_shares(layer, tap);
    const int first = map.shift_of(layer, tap)[1];
    for (int j = 0; j < TAPS; ++j)
        if (share * shares[j] != 0.0f) add(first + j, share * shares[j]);
}

/// Write the light of voxels on one row of nodes; with `absolute` the sum of the shares' absolute values.
LFPIV_INLINE void spread_row(const PlaneMap& map, int index, bool absolute, const float* voxels, float* nodes_out) {
    const int row = index / map.planes, plane = index - row * map.planes;
    float* const out = nodes_out + (int64_t)index * map.node_columns;
    for (int k = 0; k < map.node_columns; ++k) out[k] = 0.0f;
    for (int layer = 0; layer < map.layers; ++layer) {
        const int tap = plane - map.plane[layer];
        if (tap < 0 || tap >= TAPS || map.depth[TAPS * layer + tap] == 0.0f) continue;
        for (int i = 0; i < TAPS; ++i) {
            const int a = row - map.shift_of(layer, tap)[0] - i;
            if (a < 0 || a >= map.rows) continue;
            const float share = map.depth[TAPS * layer + tap] * map.row_shares(layer, tap)[i];
            const float* const from = voxels + (int64_t)a * map.row_stride + (int64_t)layer * map.layer_stride;
            for_columns(map, layer, tap, share, [&](int first, float factor) {
                add_row(out + first, from, absolute ? (factor < 0.0f ? -factor : factor) : factor, map.columns);
            });
        }
    }
}

/// Add to one row of voxels what its nodes hold: the adjoint of `spread_row`.
LFPIV_INLINE void collect_row(const PlaneMap& map, int index, const float* nodes, float* voxels_out) {
    const int row = index / map.layers, layer = index - row * map.layers;
    float* const out = voxels_out + (int64_t)row * map.row_stride + (int64_t)layer * map.layer_stride;
    for (int tap = 0; tap < TAPS; ++tap) {
        for (int i = 0; i < TAPS; ++i) {
            const float share = map.depth[TAPS * layer + tap] * map.row_shares(layer, tap)[i];
            const int node_row = row + map.shift_of(layer, tap)[0] + i;
            const float* const from =
                nodes + ((int64_t)node_row * map.planes + map.plane[layer] + tap) * map.node_columns;
            for_columns(map, layer, tap, share,
                        [&](int first, float factor) { add_row(out, from + first, factor, map.columns); });
        }
    }
}

}  // namespace lfpiv

#endif
