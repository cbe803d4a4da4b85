// Robust predictions of vectors from their 26 neighbours on the CPU, several vectors at once.
#ifndef LFPIV_NEIGHBOURS_H
#define LFPIV_NEIGHBOURS_H

#include "sorting.h"

namespace lfpiv {

/// Vectors that a CPU task predicts at once.
constexpr int VECTORS = 16;

/// One component of the predicted vectors.
using Values = Floats<VECTORS>;
/// One integer or flag per predicted vector.
using Flags = Ints<VECTORS>;

/// One component of a vector and its 26 neighbours, the vector itself in the middle.
struct Cube {
    Values value[27];  // infinite where there is no neighbour
    Flags present[27];
};

/// Return 1 in every lane where a flag is set, else 0.
LFPIV_INLINE Flags ones(Flags flag) { return flag != 0 ? Flags{} + 1 : Flags{}; }

/// Return the median difference of adjacent neighbours along an axis, 0 without any.
LFPIV_INLINE Values median_slope(const Cube& cube, int axis) {
    const int stride = axis == 0 ? 9 : axis == 1 ? 3 : 1;
    const Values none = Values{} + INFINITY;
    Values difference[18];
    Flags pairs = Flags{};
    int n = 0;
    for (int i = 0; i < 27 - stride; ++i) {
        if (i / stride % 3 == 2) continue;
        const Flags both = (cube.present[i] != 0) & (cube.present[i + stride] != 0);
        difference[n++] = both != 0 ? cube.value[i + stride] - cube.value[i] : none;
        pairs = pairs + ones(both);
    }
    sort<18>(difference);
    return pairs > 0 ? median<18>(difference, pairs) : Values{};
}

/// Predict one component from `count` neighbours: median and scatter as they are and moved to the middle along the
/// local gradient, least and greatest; in the order of `Prediction` in ``neighbours.py``.
LFPIV_INLINE void predict_component(const Cube& cube, Flags count, Values (&result)[6]) {
    const Values none = Values{} + INFINITY;
    Values v[26], slope[3], lowest = none, highest = -none;
    for (int i = 0; i < 26; ++i) v[i] = cube.value[i < 13 ? i : i + 1];
    const Robust<Values> plain = robust(v, count);
    for (int axis = 0; axis < 3; ++axis) slope[axis] = median_slope(cube, axis);
    for (int i = 0, n = 0; i < 27; ++i) {
        if (i == 13) continue;
        const Values value = cube.value[i];
        const Values away =
            slope[0] * (float)(i / 9 - 1) + slope[1] * (float)(i / 3 % 3 - 1) + slope[2] * (float)(i % 3 - 1);
        lowest = min(value, lowest);
        highest = ((cube.present[i] != 0) & (value > highest)) != 0 ? value : highest;
        v[n++] = cube.present[i] != 0 ? value - away : none;
    }
    const Robust<Values> level = robust(v, count);
    const Values results[6] = {plain.median, plain.scatter, level.median, level.scatter, lowest, highest};
    for (int j = 0; j < 6; ++j) result[j] = results[j];
}

/// Predict up to VECTORS of `count` points from their neighbours. `field` is (z, y, x, component), `keep` (z, y, x);
/// writes (point, component, prediction), not-a-number without neighbours, and the number of neighbours.
template <class Triple>
LFPIV_INLINE void predict_points(const float* field, const int* keep, const int* points, const Triple& shape, int count,
                                 float* prediction, int* neighbours) {
    const int nz = shape[0], ny = shape[1], nx = shape[2], some = min(count, VECTORS);
    Cube cube;
    Flags number = Flags{};
    int64_t at[VECTORS][27];
    for (Flags& present : cube.present) present = Flags{};
    for (int k = 0; k < some; ++k) {
        const int z = points[k] / (ny * nx), y = points[k] / nx % ny, x = points[k] % nx;
        for (int i = 0; i < 27; ++i) {
            const int pz = z + i / 9 - 1, py = y + i / 3 % 3 - 1, px = x + i % 3 - 1;
            const bool inside = pz >= 0 && py >= 0 && px >= 0 && pz < nz && py < ny && px < nx;
            at[k][i] = inside ? ((int64_t)pz * ny + py) * nx + px : 0;
            if (i != 13 && inside && keep[at[k][i]]) set_lane(cube.present[i], k, -1);
        }
    }
    for (const Flags& present : cube.present) number = number + ones(present);
    for (int component = 0; component < 3; ++component) {
        for (int i = 0; i < 27; ++i) {
            Values value = Values{};
            for (int k = 0; k < some; ++k) set_lane(value, k, field[3 * at[k][i] + component]);
            cube.value[i] = cube.present[i] != 0 ? value : Values{} + INFINITY;
        }
        Values result[6];
        predict_component(cube, number, result);
        for (int j = 0; j < 6; ++j)
            for (int k = 0; k < some; ++k)
                prediction[((int64_t)k * 3 + component) * 6 + j] = lane(number, k) ? lane(result[j], k) : NAN;
    }
    for (int k = 0; k < some; ++k) neighbours[k] = lane(number, k);
}

}  // namespace lfpiv

#endif
