// Value of a cubic B-spline between its coefficients.
#ifndef LFPIV_DEFORM_H
#define LFPIV_DEFORM_H

#include "simd.h"

namespace lfpiv {

/// Four neighbouring coefficients or their weights.
using Four = Floats<4>;

/// The weights of four neighbouring B-splines as polynomials of the fraction behind the second one's node.
LFPIV_INLINE Four spline_weights(float fraction) {
    const Four t = splat<4>(fraction);
    const Four c0 = {1.0f / 6, 4.0f / 6, 1.0f / 6, 0}, c1 = {-0.5f, 0, 0.5f, 0}, c2 = {0.5f, -1, 0.5f, 0};
    const Four c3 = {-1.0f / 6, 0.5f, -0.5f, 1.0f / 6};
    return c0 + t * (c1 + t * (c2 + t * c3));
}

/// First of the four coefficients around a position along one axis, and their weights.
struct SplineNodes {
    int first;
    Four weight;
};

/// Return the nodes around a position among `count` coefficients; the nearest edge if the position lies outside.
LFPIV_INLINE SplineNodes spline_nodes(float position, int count) {
    const int first = max(min((int)floorf(position) - 1, count - 4), 0);
    const float fraction = min(max(position - (float)(first + 1), 0.0f), 1.0f);
    return {first, spline_weights(fraction)};
}

/// Return the value of the spline at a position [coefficient].
template <class Triple>
LFPIV_INLINE float sample_spline(const float* coefficients, const Triple& shape, float z, float y, float x) {
    const SplineNodes nz = spline_nodes(z, shape[0]), ny = spline_nodes(y, shape[1]), nx = spline_nodes(x, shape[2]);
    const int pitch = shape[2];
    const float* from = coefficients + ((int64_t)nz.first * shape[1] + ny.first) * pitch + nx.first;
    const Four& wy = ny.weight;
    Four total = splat<4>(0.0f);
#pragma unroll
    for (int i = 0; i < 4; ++i, from += (int64_t)shape[1] * pitch) {
        const Four low = splat<4>(wy[0]) * load<4>(from) + splat<4>(wy[1]) * load<4>(from + pitch);
        const Four high = splat<4>(wy[2]) * load<4>(from + 2 * pitch) + splat<4>(wy[3]) * load<4>(from + 3 * pitch);
        total = total + splat<4>(nz.weight[i]) * (low + high);
    }
    total = total * nx.weight;
    return (total[0] + total[1]) + (total[2] + total[3]);
}

}  // namespace lfpiv

#endif
