// Transform of planes along z, folded twice, on the CPU; see ``correlation/transforms.py``.
#ifndef LFPIV_PLANES_H
#define LFPIV_PLANES_H

#include "products.h"

namespace lfpiv {

#if !LFPIV_GPU

/// Rows that are summed in registers at once, and vectors of each.
constexpr int MOST_ROWS = 6, ROW_VECTORS = 4;

/// Store four values of a transform, given in the order of `fold` in ``transforms.py``, as the sums and differences
/// that its classes need: cosines and sines of even frequencies, then those of odd ones (the second of `sets`).
template <class Voxel>
LFPIV_INLINE void store_folded(const Voxel& voxel, int sets, int64_t pitch, float* to) {
    const V up = voxel(0), down = voxel(1), far_up = voxel(2), far_down = voxel(3);
    const V even = up + down, odd = up - down, far_even = far_up + far_down, far_odd = far_up - far_down;
    store(to, even + far_even);
    store(to + pitch, odd - far_odd);
    if (sets == 1) return;
    store(to + 2 * pitch, even - far_even);
    store(to + 3 * pitch, odd + far_odd);
}

/// Part of the planes of a layer: `count` elements, folded to (fold, class, element), and where their rows go.
struct PlanePart {
    const float* folded;
    int folds, count;
    float* rows;    // row 0
    int64_t pitch;  // from one row to the next
};

/// Combine the folds to ROWS rows of a class at VECTORS vectors from `element` on; `waves` are (fold, row).
template <int ROWS, int VECTORS>
LFPIV_INLINE void combine(const PlanePart& part, int kind, int element, const float* waves, int waves_pitch,
                          const int* row) {
    V total[ROWS][VECTORS];
#pragma unroll
    for (int i = 0; i < ROWS * VECTORS; ++i) total[i / VECTORS][i % VECTORS] = V{};
    const float* from = part.folded + kind * part.count + element;
    for (int q = 0; q < part.folds; ++q, from += 4 * part.count, waves += waves_pitch) {
        V folded[VECTORS];
#pragma unroll
        for (int c = 0; c < VECTORS; ++c) folded[c] = load(from + c * WIDTH);
#pragma unroll
        for (int i = 0; i < ROWS; ++i)
#pragma unroll
            for (int c = 0; c < VECTORS; ++c) total[i][c] += waves[i] * folded[c];
    }
#pragma unroll
    for (int i = 0; i < ROWS; ++i)
#pragma unroll
        for (int c = 0; c < VECTORS; ++c) store(part.rows + row[i] * part.pitch + element + c * WIDTH, total[i][c]);
}

/// Transform part of the planes of a layer. Tasks are numbered (layer, part of a plane).
template <class Volume, class Transform>
LFPIV_INLINE void transform_planes(const Volume& volume, const Transform& transform, int first_plane, int stride,
                                   int part_size, int task, float* scratch, float* planes) {
    const int parts = (volume.plane + part_size - 1) / part_size, layer = task / parts;
    const int begin = task % parts * part_size, count = min(part_size, volume.plane - begin);
    const auto& counts = transform.counts;
    const int64_t pitch = volume.plane, rows = counts[0] + counts[1] + counts[2] + counts[3];
    const float* from = volume.values.data + (first_plane + (int64_t)layer * stride) * pitch + begin;
    for (int q = 0; q < transform.folds; ++q) {
        const int* quad = transform.quads.data + 4 * q;
        for (int e = 0; e < count; e += WIDTH) {
            auto voxel = [&](int k) { return quad[k] < 0 ? V{} : load(from + quad[k] * pitch + e); };
            store_folded(voxel, 2, count, scratch + 4 * q * count + e);
        }
    }
    const PlanePart part{scratch, transform.folds, count, planes + layer * rows * pitch + begin, pitch};
    const float* waves = transform.matrix.data;
    const int* row = transform.rows.data;
    for (int kind = 0; kind < 4; ++kind) {
        in_parts<1, MOST_ROWS>(counts[kind], [&](auto length, int first) {
            constexpr int ROWS = decltype(length)::value;
            int e = 0;
            for (; e + ROW_VECTORS * WIDTH <= count; e += ROW_VECTORS * WIDTH)
                combine<ROWS, ROW_VECTORS>(part, kind, e, waves + first, counts[kind], row + first);
            for (; e < count; e += WIDTH) combine<ROWS, 1>(part, kind, e, waves + first, counts[kind], row + first);
        });
        waves += transform.folds * counts[kind];
        row += counts[kind];
    }
}

#endif

}  // namespace lfpiv

#endif
