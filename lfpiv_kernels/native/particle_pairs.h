// Products of the images of overlapping particles; see ``reconstruction/particle_normal.py``. For the CPU only.
#ifndef LFPIV_PARTICLE_PAIRS_H
#define LFPIV_PARTICLE_PAIRS_H

#include "simd.h"

namespace lfpiv {

#if !LFPIV_GPU

/// Derivatives by x, y, z, and the weight of a pixel.
using Four = Floats<4>;

/// Return whether the lenses of two particles, (first i, first j, last i, last j), are the same or neighbours.
LFPIV_INLINE bool are_near(const int* one, const int* other) {
    return one[0] <= other[2] + 1 && other[0] <= one[2] + 1 && one[1] <= other[3] + 1 && other[1] <= one[3] + 1;
}

/// Multiply the image of a particle, spread over `scratch`, with its own and those of later particles.
template <class Lists>
LFPIV_INLINE void multiply_images(const Lists& lists, int particle, int most, float* scratch, int* neighbour_out,
                                  float* block_out, float* right_out) {
    const int64_t begin = lists.first.data[particle], end = lists.first.data[particle + 1];
    const int count = (int)lists.first.shape[0] - 1;
    const unsigned span = (unsigned)lists.span;
    const int* pixel = lists.pixel.data;
    const float* values = (const float*)lists.values.data;
    int lowest = begin < end ? pixel[begin] : 0;
    for (int64_t k = begin; k < end; ++k) lowest = pixel[k] < lowest ? pixel[k] : lowest;
    Four right = Four{};
    for (int64_t k = begin; k < end; ++k) {
        const Four here = load<4>(values + 4 * k) * lists.weight.data[pixel[k]];
        float* at = scratch + 4 * (int64_t)(pixel[k] - lowest);
        store(at, load<4>(at) + here);
        right = right + here * lists.residual.data[pixel[k]];
    }
    store(right_out, right);
    int used = 0;
    for (int other = particle; other < count && used < most; ++other) {
        if (!are_near(lists.box.data + 4 * particle, lists.box.data + 4 * other)) continue;
        Four block[4] = {};
        bool shared = false;
        for (int64_t k = lists.first.data[other]; k < lists.first.data[other + 1]; ++k) {
            const unsigned at = (unsigned)(pixel[k] - lowest);
            if (at >= span) continue;
            const float* here = scratch + 4 * (int64_t)at;
            if (here[3] == 0.0f) continue;
            shared = true;
            const Four there = load<4>(values + 4 * k);
            for (int row = 0; row < 4; ++row) block[row] = block[row] + here[row] * there;
        }
        if (!shared) continue;
        neighbour_out[used] = other;
        for (int row = 0; row < 4; ++row) store(block_out + 16 * used + 4 * row, block[row]);
        ++used;
    }
    for (int64_t k = begin; k < end; ++k) store(scratch + 4 * (int64_t)(pixel[k] - lowest), Four{});
}

#else

template <class Lists>
LFPIV_INLINE void multiply_images(const Lists&, int, int, float*, int*, float*, float*) {}

#endif

}  // namespace lfpiv

#endif
