// Robust predictions of vectors from their 26 neighbours: medians by sorting networks, several vectors at once.
#ifndef LFPIV_NEIGHBOURS_H
#define LFPIV_NEIGHBOURS_H

#include "simd.h"

namespace lfpiv {

/// Vectors that a CPU task predicts at once.
constexpr int VECTORS = 16;

#if defined(__CUDA_ARCH__)
constexpr int PREDICTED = 1;
#else
constexpr int PREDICTED = VECTORS;
#endif

/// One component of the predicted vectors.
using Values = Floats<PREDICTED>;
/// One integer or flag per predicted vector.
using Flags = Ints<PREDICTED>;

/// Comparisons that sort SIZE values: Batcher's odd-even merge network, the same steps for any values.
template <int SIZE>
struct SortingNetwork {
    static constexpr int MOST = SIZE * SIZE;
    short low[MOST] = {}, high[MOST] = {};
    int steps = 0;

    constexpr SortingNetwork() {
        for (int merged = 1; merged < SIZE; merged *= 2)
            for (int distance = merged; distance > 0; distance /= 2)
                for (int start = distance % merged; start < SIZE - distance; start += 2 * distance)
                    for (int k = start; k < start + distance && k < SIZE - distance; ++k)
                        if (k / (2 * merged) == (k + distance) / (2 * merged)) {
                            low[steps] = (short)k;
                            high[steps++] = (short)(k + distance);
                        }
    }
};

template <int SIZE>
inline constexpr SortingNetwork<SIZE> NETWORK{};

/// Apply the steps BEGIN to END - 1 of the network.
template <int SIZE, int BEGIN, int END>
LFPIV_INLINE void apply_steps(Values* v) {
    if constexpr (END - BEGIN == 1) {
        constexpr int low = NETWORK<SIZE>.low[BEGIN], high = NETWORK<SIZE>.high[BEGIN];
        const Values smaller = min(v[low], v[high]);
        v[high] = v[low] < v[high] ? v[high] : v[low];
        v[low] = smaller;
    } else {
        constexpr int middle = (BEGIN + END) / 2;
        apply_steps<SIZE, BEGIN, middle>(v);
        apply_steps<SIZE, middle, END>(v);
    }
}

/// Sort SIZE values in place.
template <int SIZE>
LFPIV_INLINE void sort(Values* v) {
    apply_steps<SIZE, 0, NETWORK<SIZE>.steps>(v);
}

/// Return the median of the first `count` of SIZE sorted values.
template <int SIZE>
LFPIV_INLINE Values median(const Values* v, Flags count) {
    Values low = v[0], high = v[0];
    for (int i = 1; i <= SIZE / 2; ++i) {
        low = (count - 1) / 2 == i ? v[i] : low;
        high = count / 2 == i ? v[i] : high;
    }
    return 0.5f * (low + high);
}

/// Median of values, and the median distance of the values from it.
struct Robust {
    Values median, scatter;
};

/// Return median and scatter of `count` values; the others are infinite. Overwrites the values.
LFPIV_INLINE Robust robust(Values (&v)[26], Flags count) {
    Robust found;
    sort<26>(v);
    found.median = median<26>(v, count);
    for (Values& value : v) {
        const Values distance = value - found.median;
        value = distance < 0.0f ? -distance : distance;
    }
    sort<26>(v);
    found.scatter = median<26>(v, count);
    return found;
}

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
    const Robust plain = robust(v, count);
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
    const Robust level = robust(v, count);
    const Values results[6] = {plain.median, plain.scatter, level.median, level.scatter, lowest, highest};
    for (int j = 0; j < 6; ++j) result[j] = results[j];
}

/// Predict up to PREDICTED of `count` points from their neighbours. `field` is (z, y, x, component), `keep` (z, y, x);
/// writes (point, component, prediction), not-a-number without neighbours, and the number of neighbours.
template <class Triple>
LFPIV_INLINE void predict_points(const float* field, const int* keep, const int* points, const Triple& shape, int count,
                                 float* prediction, int* neighbours) {
    const int nz = shape[0], ny = shape[1], nx = shape[2], some = min(count, PREDICTED);
    Cube cube;
    Flags number = Flags{};
    int64_t at[PREDICTED][27];
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
