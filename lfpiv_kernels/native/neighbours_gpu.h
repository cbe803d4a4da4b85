// Robust predictions of vectors from their 26 neighbours on a GPU: a warp per component of a vector, a lane per
// neighbour, so that a sorted list takes one register.
#ifndef LFPIV_NEIGHBOURS_GPU_H
#define LFPIV_NEIGHBOURS_GPU_H

#include "lanes.h"

namespace lfpiv {

/// Sort the lanes' values, least first, by Batcher's bitonic network.
LFPIV_INLINE void sort_lanes(PerLane<float>& value) {
    for (int size = 2; size <= LANES_OF_WARP; size *= 2)
        for (int away = size / 2; away > 0; away /= 2) {
            PerLane<float> other;
            for_lanes([&](int lane) { other[lane] = value.of(lane ^ away); });
            for_lanes([&](int lane) {
                const bool upper = (lane & away) != 0, ascending = (lane & size) == 0;
                value[lane] = upper == ascending ? max(value[lane], other[lane]) : min(value[lane], other[lane]);
            });
        }
}

/// Return the median of the first `count` of the lanes' sorted values.
LFPIV_INLINE float median_of_lanes(const PerLane<float>& sorted, int count) {
    return 0.5f * (sorted.of((count - 1) / 2) + sorted.of(count / 2));
}

/// Median of `count` values, the median distance of the values from it, least and greatest.
struct Spread {
    float median, scatter, lowest, highest;
};

/// Return what the lanes' `count` values spread over; the others are infinite. Overwrites the values.
LFPIV_INLINE Spread spread_of_lanes(PerLane<float>& value, int count) {
    sort_lanes(value);
    const float median = median_of_lanes(value, count), lowest = value.of(0), highest = value.of(max(count - 1, 0));
    for_lanes([&](int lane) { value[lane] = fabsf(value[lane] - median); });
    sort_lanes(value);
    return {median, median_of_lanes(value, count), lowest, highest};
}

/// Return the median difference of neighbours `stride` lanes apart along an axis, 0 without any.
LFPIV_INLINE float median_slope(PerLane<float>& value, PerLane<int>& has, int stride) {
    PerLane<float> difference;
    PerLane<int> both;
    for_lanes([&](int lane) {
        const int next = lane + stride < LANES_OF_WARP ? lane + stride : lane;
        const float ahead = value.of(next);
        const int is_there = has.of(next);
        both[lane] = lane < 27 - stride && lane / stride % 3 != 2 && has[lane] && is_there;
        difference[lane] = both[lane] ? ahead - value[lane] : INFINITY;
    });
    const int pairs = sum_lanes(both);
    sort_lanes(difference);
    return pairs > 0 ? median_of_lanes(difference, pairs) : 0.0f;
}

/// Predict one component of a vector from its neighbours, as `predict_component` of ``neighbours.h`` does.
/// Tasks are numbered (vector, component).
template <class Triple>
LFPIV_INLINE void predict_vector(const float* field, const int* keep, const int* points, const Triple& shape, int task,
                                 float* prediction, int* neighbours) {
    const int point = points[task / 3], component = task % 3, nx = shape[2], ny = shape[1];
    const int z = point / (ny * nx), y = point / nx % ny, x = point % nx;
    PerLane<float> value, level;
    PerLane<int> has;
    for_lanes([&](int lane) {
        const int pz = z + lane / 9 - 1, py = y + lane / 3 % 3 - 1, px = x + lane % 3 - 1;
        const bool inside = pz >= 0 && py >= 0 && px >= 0 && pz < shape[0] && py < ny && px < nx;
        const int at = (pz * ny + py) * nx + px;
        has[lane] = lane < 27 && lane != 13 && inside && keep[at];
        value[lane] = has[lane] ? field[3 * (int64_t)at + component] : INFINITY;
    });
    const int count = sum_lanes(has);
    const float slope_z = median_slope(value, has, 9), slope_y = median_slope(value, has, 3),
                slope_x = median_slope(value, has, 1);
    for_lanes([&](int lane) {
        level[lane] =
            value[lane] - (slope_z * (lane / 9 - 1) + slope_y * (lane / 3 % 3 - 1) + slope_x * (lane % 3 - 1));
    });
    const Spread plain = spread_of_lanes(value, count), moved = spread_of_lanes(level, count);
    for_lanes([&](int lane) {
        float own = lane == 0 ? plain.median : plain.scatter;
        own = lane == 2 ? moved.median : lane == 3 ? moved.scatter : own;
        own = lane == 4 ? plain.lowest : lane == 5 ? plain.highest : own;
        if (lane < 6) prediction[6 * (int64_t)task + lane] = count ? own : NAN;
        if (lane == 0 && component == 0) neighbours[task / 3] = count;
    });
}

}  // namespace lfpiv

#endif
