// Sweeps over the voxels of volumes: on the CPU a thread goes through a run of neighbours, on a GPU it has one voxel.
#ifndef LFPIV_VOXELS_H
#define LFPIV_VOXELS_H

#include "simd.h"

namespace lfpiv {

/// Voxels that a thread of the CPU goes through.
constexpr int VOXELS_OF_RUN = 1024;
/// Sums of a thread of the CPU that are independent of each other.
constexpr int LANES = 8;

/// Call body(voxel) for the voxels of a run. An output may be an input, voxel for voxel.
template <class Body>
LFPIV_INLINE void for_voxels(int run, int size, Body body) {
#if LFPIV_GPU
    if (run < size) body(run);
#else
    const int begin = run * VOXELS_OF_RUN, end = size - begin < VOXELS_OF_RUN ? size : begin + VOXELS_OF_RUN;
#pragma clang loop vectorize(assume_safety) vectorize_width(WIDTH)
    for (int voxel = begin; voxel < end; ++voxel) body(voxel);
#endif
}

/// Write one * factor * other.
LFPIV_INLINE void multiply(int run, int size, const float* one, float factor, const float* other, float* out) {
    for_voxels(run, size, [=](int k) { out[k] = one[k] * factor * other[k]; });
}

/// Write numerator / max(denominator, least).
LFPIV_INLINE void divide(int run, int size, const float* numerator, const float* denominator, float least, float* out) {
    for_voxels(run, size, [=](int k) {
        const float below = denominator[k];
        out[k] = numerator[k] / (below > least ? below : least);
    });
}

/// Write 1 where the volume is not 0, else 0.
LFPIV_INLINE void indicate(int run, int size, const float* volume, float* out) {
    for_voxels(run, size, [=](int k) { out[k] = volume[k] != 0.0f ? 1.0f : 0.0f; });
}

/// Add a volume to another, where `mask` is not 0 if it is not null.
LFPIV_INLINE void add_masked(int run, int size, const float* added, const float* mask, float* out) {
    if (mask)
        for_voxels(run, size, [=](int k) { out[k] = mask[k] != 0.0f ? out[k] + added[k] : out[k]; });
    else
        for_voxels(run, size, [=](int k) { out[k] = out[k] + added[k]; });
}

/// Overwrite a volume by 0 where another one is 0.
LFPIV_INLINE void darken(int run, int size, const float* volume, float* out) {
    for_voxels(run, size, [=](int k) { out[k] = volume[k] == 0.0f ? 0.0f : out[k]; });
}

/// Return the sum of weight * value^2, float32, from `begin` to `end`, `step` apart, in float64. Add the values to
/// `added` if it is not null.
LFPIV_INLINE double sum_squares(const float* weight, const float* values, int begin, int end, int step, float* added) {
    double sum = 0.0;
    int k = begin;
#if !LFPIV_GPU
    typedef double Doubles __attribute__((vector_size(8 * LANES)));
    Doubles sums = {};
    for (; step == 1 && k + LANES <= end; k += LANES) {
        const Floats<LANES> value = load<LANES>(values + k);
        sums += __builtin_convertvector(load<LANES>(weight + k) * value * value, Doubles);
        if (added) store(added + k, load<LANES>(added + k) + value);
    }
    for (int lane = 0; lane < LANES; ++lane) sum += sums[lane];
#endif
    for (; k < end; k += step) {
        sum += (double)(weight[k] * values[k] * values[k]);
        if (added) added[k] += values[k];
    }
    return sum;
}

}  // namespace lfpiv

#endif
