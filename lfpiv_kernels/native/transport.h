// Light of voxels, each moved by a displacement of its own and spread by the cubic B-spline; the adjoint and derivatives.
#ifndef LFPIV_TRANSPORT_H
#define LFPIV_TRANSPORT_H

#include "deform.h"

namespace lfpiv {

/// The derivatives of `spline_weights` by the fraction.
LFPIV_INLINE Four spline_slopes(float fraction) {
    const Four t = splat<4>(fraction);
    const Four c1 = {-0.5f, 0, 0.5f, 0}, c2 = {1, -2, 1, 0}, c3 = {-0.5f, 1.5f, -1.5f, 0.5f};
    return c1 + t * (c2 + t * c3);
}

/// Voxels along one axis that receive light, with weights and their derivatives. Voxels outside have zero weights.
struct Reach {
    int first;
    Four weight, slope;
};

/// Return the voxels around a place. A place far outside has zero weights only.
LFPIV_INLINE Reach reach_of(float place, int count) {
    const float inside = min(max(place, -3.0f), (float)count + 2.0f);
    const int low = (int)floorf(inside);
    const float fraction = place == inside ? inside - (float)low : 0.0f;
    const Four weight = spline_weights(fraction), slope = spline_slopes(fraction);
    Reach reach = {low - 1, splat<4>(0.0f), splat<4>(0.0f)};
    float w[4], g[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) {
        const bool within = place == inside && low - 1 + i >= 0 && low - 1 + i < count;
        w[i] = within ? weight[i] : 0.0f;
        g[i] = within ? slope[i] : 0.0f;
    }
    reach.weight = Four{w[0], w[1], w[2], w[3]};
    reach.slope = Four{g[0], g[1], g[2], g[3]};
    return reach;
}

/// Voxels that one voxel's light goes to.
struct Target {
    Reach z, y, x;
};

/// Return the target of voxel `k`, whose displacement is `share` of `moved`, shape (3, voxel).
template <class Triple>
LFPIV_INLINE Target target_of(int64_t k, const Triple& shape, const float* moved, float share) {
    const int64_t size = (int64_t)shape[0] * shape[1] * shape[2], row = k / shape[2];
    const int x = (int)(k - row * shape[2]), y = (int)(row % shape[1]), z = (int)(row / shape[1]);
    return {reach_of((float)z + share * moved[k], shape[0]), reach_of((float)y + share * moved[size + k], shape[1]),
            reach_of((float)x + share * moved[2 * size + k], shape[2])};
}

/// Return the sum of four values.
LFPIV_INLINE float total_of(const Four& v) { return (v[0] + v[1]) + (v[2] + v[3]); }

/// Return four neighbours along x, zero outside.
LFPIV_INLINE Four neighbours_of(const float* row, int first, int count) {
    if (first >= 0 && first + 4 <= count) return load<4>(row + first);
    float v[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) v[i] = first + i >= 0 && first + i < count ? row[first + i] : 0.0f;
    return Four{v[0], v[1], v[2], v[3]};
}

/// Add a number to one that other threads of a GPU may change.
LFPIV_INLINE void add_shared(float* to, float value) {
#if defined(__CUDA_ARCH__)
    atomicAdd(to, value);
#else
    *to += value;
#endif
}

/// Add a voxel's moved light to a volume whose first plane is `first_plane`; with a direction (3, voxel), its change.
template <class Triple>
LFPIV_INLINE void push_voxel(int64_t k, const Triple& shape, const float* light, const float* moved, float share,
                             const float* direction, int first_plane, float* out) {
    const float own = light[k];
    if (own == 0.0f) return;
    const Target to = target_of(k, shape, moved, share);
    const int64_t size = (int64_t)shape[0] * shape[1] * shape[2];
    float along[3] = {0, 0, 0};
    if (direction)
        for (int axis = 0; axis < 3; ++axis) along[axis] = share * own * direction[axis * size + k];
    for (int i = 0; i < 4; ++i) {
        const int z = to.z.first + i;
        if (z < 0 || z >= shape[0]) continue;
        for (int j = 0; j < 4; ++j) {
            const int y = to.y.first + j;
            if (y < 0 || y >= shape[1]) continue;
            const float wz = to.z.weight[i], wy = to.y.weight[j];
            float* row = out + ((int64_t)(z - first_plane) * shape[1] + y) * shape[2];
            Four added;
            if (direction) {
                const float across = along[0] * to.z.slope[i] * wy + along[1] * wz * to.y.slope[j];
                added = splat<4>(across) * to.x.weight + splat<4>(along[2] * wz * wy) * to.x.slope;
            } else {
                added = splat<4>(own * wz * wy) * to.x.weight;
            }
#pragma unroll
            for (int e = 0; e < 4; ++e) {
                const int x = to.x.first + e;
                if (x >= 0 && x < shape[2]) add_shared(row + x, added[e]);
            }
        }
    }
}

/// Push the light of a slab of planes into a part of its own, so that the sum does not depend on threads.
template <class Triple>
LFPIV_INLINE void push_slab(int slab, const Triple& shape, int planes, const float* light, const float* moved,
                            float share, const float* direction, const int* first, const int64_t* start, float* part) {
    const int64_t area = (int64_t)shape[1] * shape[2];
    float* own = part + start[slab];
    for (int64_t k = start[slab]; k < start[slab + 1]; ++k) part[k] = 0.0f;
    const int64_t end = min((int64_t)(slab + 1) * planes, (int64_t)shape[0]) * area;
    for (int64_t k = (int64_t)slab * planes * area; k < end; ++k)
        push_voxel(k, shape, light, moved, share, direction, first[slab], own);
}

/// Sum the parts of all slabs in one plane.
template <class Triple>
LFPIV_INLINE void sum_slabs(int plane, const Triple& shape, int slabs, const int* first, const int64_t* start,
                            const float* part, float* out) {
    const int64_t area = (int64_t)shape[1] * shape[2];
    for (int64_t k = 0; k < area; ++k) out[plane * area + k] = 0.0f;
    for (int slab = 0; slab < slabs; ++slab) {
        const int64_t from = (int64_t)(plane - first[slab]) * area;
        if (from < 0 || from >= start[slab + 1] - start[slab]) continue;
        for (int64_t k = 0; k < area; ++k) out[plane * area + k] += part[start[slab] + from + k];
    }
}

/// Write the weighted sum of a volume over a voxel's target; 0 where the voxel is dark.
template <class Triple>
LFPIV_INLINE void pull_voxel(int64_t k, const Triple& shape, const float* light, const float* moved, float share,
                             const float* volume, float* out) {
    out[k] = 0.0f;
    if (light[k] == 0.0f) return;
    const Target to = target_of(k, shape, moved, share);
    Four total = splat<4>(0.0f);
    for (int i = 0; i < 4; ++i) {
        const int z = to.z.first + i;
        if (z < 0 || z >= shape[0]) continue;
        for (int j = 0; j < 4; ++j) {
            const int y = to.y.first + j;
            if (y < 0 || y >= shape[1]) continue;
            const float* row = volume + ((int64_t)z * shape[1] + y) * shape[2];
            total = total + splat<4>(to.z.weight[i] * to.y.weight[j]) * neighbours_of(row, to.x.first, shape[2]);
        }
    }
    out[k] = total_of(total * to.x.weight);
}

/// Add the derivatives of light times pulled volume by the displacement (3, voxel).
template <class Triple>
LFPIV_INLINE void pull_slope_voxel(int64_t k, const Triple& shape, const float* light, const float* moved, float share,
                                   const float* volume, float* out) {
    const float own = share * light[k];
    if (own == 0.0f) return;
    const Target to = target_of(k, shape, moved, share);
    const int64_t size = (int64_t)shape[0] * shape[1] * shape[2];
    Four along_z = splat<4>(0.0f), along_y = splat<4>(0.0f), plain = splat<4>(0.0f);
    for (int i = 0; i < 4; ++i) {
        const int z = to.z.first + i;
        if (z < 0 || z >= shape[0]) continue;
        for (int j = 0; j < 4; ++j) {
            const int y = to.y.first + j;
            if (y < 0 || y >= shape[1]) continue;
            const Four row = neighbours_of(volume + ((int64_t)z * shape[1] + y) * shape[2], to.x.first, shape[2]);
            along_z = along_z + splat<4>(to.z.slope[i] * to.y.weight[j]) * row;
            along_y = along_y + splat<4>(to.z.weight[i] * to.y.slope[j]) * row;
            plain = plain + splat<4>(to.z.weight[i] * to.y.weight[j]) * row;
        }
    }
    out[k] += own * total_of(along_z * to.x.weight);
    out[size + k] += own * total_of(along_y * to.x.weight);
    out[2 * size + k] += own * total_of(plain * to.x.slope);
}

}  // namespace lfpiv

#endif
