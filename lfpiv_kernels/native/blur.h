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

/// Write the weighted sums of `taps` inputs that lie `stride` apart for `count` neighbours.
LFPIV_INLINE void blend(const float* from, int64_t stride, const float* weight, int taps, int count, float* out) {
    int p = 0;
    for (; p + 4 * WIDTH <= count; p += 4 * WIDTH) {
        V sum[4] = {};
        for (int t = 0; t < taps; ++t) {
            const V share = V{} + weight[t];
            const float* row = from + t * stride + p;
            for (int k = 0; k < 4; ++k) sum[k] = sum[k] + share * load<WIDTH>(row + k * WIDTH);
        }
        for (int k = 0; k < 4; ++k) store(out + p + k * WIDTH, sum[k]);
    }
    for (; p < count; ++p) {
        float sum = 0.0f;
        for (int t = 0; t < taps; ++t) sum += weight[t] * from[t * stride + p];
        out[p] = sum;
    }
}

/// Write one plane of the blurred volume; `work` is memory of a plane.
LFPIV_INLINE void blur_plane(const AxisBlur& outer, const AxisBlur& middle, const AxisBlur& inner, int plane,
                             const float* volume, float* work, float* out) {
    const int length = inner.size, area = middle.size * length;
    const float* const from = volume + (int64_t)outer.first[plane] * area;
    blend(from, area, outer.weight + plane * outer.taps, outer.taps, area, out);
    for (int row = 0; row < middle.size; ++row)
        blend(out + middle.first[row] * length, length, middle.weight + row * middle.taps, middle.taps, length,
              work + row * length);
    const int same = inner.end - inner.begin;
    for (int row = 0; row < middle.size; ++row) {
        const float* source = work + row * length;
        float* target = out + row * length;
        for (int k = 0; k < length; ++k) {
            if (k == inner.begin && same > 0) {
                blend(source + inner.first[k], 1, inner.weight + k * inner.taps, inner.taps, same, target + k);
                k = inner.end - 1;
                continue;
            }
            blend(source + inner.first[k], 1, inner.weight + k * inner.taps, inner.taps, 1, target + k);
        }
    }
}

}  // namespace lfpiv

#endif
