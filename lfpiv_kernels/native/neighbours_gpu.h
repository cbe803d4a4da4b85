// Robust predictions of vectors from their 26 neighbours on a GPU, a thread per component of a vector.
#ifndef LFPIV_NEIGHBOURS_GPU_H
#define LFPIV_NEIGHBOURS_GPU_H

#include "sorting.h"

namespace lfpiv {

/// One component of a vector's neighbours, read where they are needed: a thread's registers hold one sorted list.
template <class Triple>
struct Surroundings {
    const float* field;  // of the component, at the vector
    Triple shape;
    unsigned present = 0;  // a bit for each of the 27 vectors
    int count = 0;         // of neighbours

    LFPIV_INLINE Surroundings(const float* field, const int* keep, const Triple& shape, int point, int component)
        : field(field + 3 * (int64_t)point + component), shape(shape) {
        const int nx = shape[2], ny = shape[1], z = point / (ny * nx), y = point / nx % ny, x = point % nx;
#pragma unroll
        for (int i = 0; i < 27; ++i) {
            const int pz = z + i / 9 - 1, py = y + i / 3 % 3 - 1, px = x + i % 3 - 1;
            const bool inside = pz >= 0 && py >= 0 && px >= 0 && pz < shape[0] && py < ny && px < nx;
            const bool kept = i != 13 && inside && keep[point + away(i)];
            present |= (unsigned)kept << i;
            count += kept;
        }
    }

    /// Return the distance of a neighbour [vector].
    LFPIV_INLINE int away(int i) const { return ((i / 9 - 1) * shape[1] + i / 3 % 3 - 1) * shape[2] + i % 3 - 1; }
    LFPIV_INLINE bool has(int i) const { return present >> i & 1; }
    /// Return a neighbour's value, infinite where there is none.
    LFPIV_INLINE float value(int i) const { return has(i) ? field[3 * away(i)] : INFINITY; }

    /// Return the median difference of adjacent neighbours along an axis, 0 without any.
    template <int STRIDE>
    LFPIV_INLINE float median_slope() const {
        float difference[18];
        int pairs = 0;
#pragma unroll
        for (int i = 0, n = 0; i < 27 - STRIDE; ++i) {
            if (i / STRIDE % 3 == 2) continue;
            const bool both = has(i) && has(i + STRIDE);
            difference[n++] = both ? value(i + STRIDE) - value(i) : INFINITY;
            pairs += both;
        }
        sort<18>(difference);
        return pairs > 0 ? median<18>(difference, pairs) : 0.0f;
    }
};

/// Predict one component of a vector from its neighbours, as `predict_component` of ``neighbours.h`` does.
template <class Triple>
LFPIV_INLINE void predict_vector(const float* field, const int* keep, const int* points, const Triple& shape, int task,
                                 float* prediction, int* neighbours) {
    const int point = task / 3, component = task % 3;
    const Surroundings<Triple> around(field, keep, shape, points[point], component);
    const int count = around.count;
    float* out = prediction + 6 * (int64_t)task;
    float v[26], lowest = INFINITY, highest = -INFINITY;
#pragma unroll
    for (int n = 0; n < 26; ++n) {
        const int i = n < 13 ? n : n + 1;
        v[n] = around.value(i);
        lowest = min(v[n], lowest);
        highest = around.has(i) ? max(v[n], highest) : highest;
    }
    const Robust<float> plain = robust(v, count);
    const float slope_z = around.template median_slope<9>(), slope_y = around.template median_slope<3>(),
                slope_x = around.template median_slope<1>();
#pragma unroll
    for (int n = 0; n < 26; ++n) {
        const int i = n < 13 ? n : n + 1;
        v[n] = around.value(i) - (slope_z * (i / 9 - 1) + slope_y * (i / 3 % 3 - 1) + slope_x * (i % 3 - 1));
    }
    const Robust<float> level = robust(v, count);
    const float result[6] = {plain.median, plain.scatter, level.median, level.scatter, lowest, highest};
#pragma unroll
    for (int j = 0; j < 6; ++j) out[j] = count ? result[j] : NAN;
    if (component == 0) neighbours[point] = count;
}

}  // namespace lfpiv

#endif
