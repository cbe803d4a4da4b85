// Separable blur of a volume, one plane of the outermost axis at a time.
#ifndef LFPIV_BLUR_H
#define LFPIV_BLUR_H

#include "simd.h"

namespace lfpiv {

/// Weights along one axis: output k is the sum over t < taps of weight[k * taps + t] times input first[k] + t.
struct AxisBlur {
    const int* first;
    const float* weight;
    int size;   // outputs, and inputs
    int taps;   // inputs of an output
    int begin;  // outputs from here
    int end;    // to here have the same weights
};

/// Return the weights from Warp's struct.
template <class Axis>
LFPIV_INLINE AxisBlur axis_blur(const Axis& axis) {
    return {axis.first.data, axis.weight.data, (int)axis.first.shape[0], axis.taps, axis.begin, axis.end};
}

/// Weights along the innermost axis, with which rows are continued beyond their ends.
struct RowBlur {
    const float* weight;
    int taps;      // neighbours, odd
    bool nearest;  // whether rows are continued by their outermost voxels, not by zeros
};

/// Write the weighted sums of `taps` inputs that lie `stride` apart for `N` vectors of neighbours.
template <int N>
LFPIV_INLINE void blend_vectors(const float* from, int64_t stride, const float* weight, int taps, float* out) {
    V sum[N] = {};
    for (int t = 0; t < taps; ++t) {
        const V share = V{} + weight[t];
        const float* row = from + t * stride;
        for (int k = 0; k < N; ++k) sum[k] = sum[k] + share * load<WIDTH>(row + k * WIDTH);
    }
    for (int k = 0; k < N; ++k) store(out + k * WIDTH, sum[k]);
}

/// Write the weighted sums of `taps` inputs that lie `stride` apart for `count` neighbours. A last vector that is not
/// full is completed by neighbours that are written before.
LFPIV_INLINE void blend(const float* from, int64_t stride, const float* weight, int taps, int count, float* out) {
    int p = 0;
    for (; p + 4 * WIDTH <= count; p += 4 * WIDTH) blend_vectors<4>(from + p, stride, weight, taps, out + p);
    for (; p + WIDTH <= count; p += WIDTH) blend_vectors<1>(from + p, stride, weight, taps, out + p);
    if (p < count && count >= WIDTH) {
        p = count - WIDTH;
        blend_vectors<1>(from + p, stride, weight, taps, out + p);
        return;
    }
    for (; p < count; ++p) {
        float sum = 0.0f;
        for (int t = 0; t < taps; ++t) sum += weight[t] * from[t * stride + p];
        out[p] = sum;
    }
}

/// Write one plane of the blurred volume; `work` is memory of a plane, and of a row continued beyond its ends.
LFPIV_INLINE void blur_plane(const AxisBlur& outer, const AxisBlur& middle, const RowBlur& inner, int length, int plane,
                             const float* volume, float* work, float* out) {
    const int area = middle.size * length, reach = inner.taps / 2;
    float *const before = work + area, *const row = before + reach, *const behind = row + length;
    blend(volume + (int64_t)outer.first[plane] * area, area, outer.weight + plane * outer.taps, outer.taps, area, work);
    for (int n = 0; n < middle.size; ++n) {
        blend(work + middle.first[n] * length, length, middle.weight + n * middle.taps, middle.taps, length, row);
        for (int k = 0; k < reach; ++k) {
            before[k] = inner.nearest ? row[0] : 0.0f;
            behind[k] = inner.nearest ? row[length - 1] : 0.0f;
        }
        blend(before, 1, inner.weight, inner.taps, length, out + n * length);
    }
}

}  // namespace lfpiv

#endif
