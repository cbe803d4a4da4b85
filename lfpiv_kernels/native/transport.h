// Light of voxels, each moved by a displacement of its own and spread by the cubic B-spline; the adjoint and
// derivatives.
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

/// Voxels along one axis that receive light, with weights. Voxels outside have zero weights.
struct Reach {
    int first;
    Four weight;
};

/// Set the lanes of voxels outside to zero.
LFPIV_INLINE Four within(const Four& v, int first, int count) {
    if (first >= 0 && first + 4 <= count) return v;
    float kept[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) kept[i] = first + i >= 0 && first + i < count ? v[i] : 0.0f;
    return Four{kept[0], kept[1], kept[2], kept[3]};
}

/// Return the place of a voxel, or one from which no light comes in, so that it fits an int.
LFPIV_INLINE float bounded(float place, int count) { return min(max(place, -3.0f), (float)count + 2.0f); }

/// Return the voxels around a place and their weights.
LFPIV_INLINE Reach reach_of(float place, int count) {
    const float low = floorf(bounded(place, count));
    const int first = (int)low - 1;
    return {first, within(spline_weights(bounded(place, count) - low), first, count)};
}

/// Return the derivatives of the weights.
LFPIV_INLINE Four slopes_of(float place, int count) {
    const float inside = bounded(place, count), low = floorf(inside);
    if (place != inside) return splat<4>(0.0f);
    return within(spline_slopes(inside - low), (int)low - 1, count);
}

/// Place to which one voxel's light goes.
struct Place {
    float z, y, x;
};

/// Return the place of voxel `k`, whose displacement is `share` of `moved`, shape (3, voxel).
template <class Triple>
LFPIV_INLINE Place place_of(int64_t k, const Triple& shape, const float* moved, float share) {
    const int64_t size = (int64_t)shape[0] * shape[1] * shape[2], row = k / shape[2];
    const int x = (int)(k - row * shape[2]), y = (int)(row % shape[1]), z = (int)(row / shape[1]);
    return {(float)z + share * moved[k], (float)y + share * moved[size + k], (float)x + share * moved[2 * size + k]};
}

/// Voxels that one voxel's light goes to.
struct Target {
    Reach z, y, x;
};

template <class Triple>
LFPIV_INLINE Target target_of(const Place& place, const Triple& shape) {
    return {reach_of(place.z, shape[0]), reach_of(place.y, shape[1]), reach_of(place.x, shape[2])};
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

/// Add to four neighbours along x. Other threads of a GPU may change them, too.
LFPIV_INLINE void add_neighbours(float* row, int first, int count, const Four& added) {
#if !LFPIV_GPU
    if (first >= 0 && first + 4 <= count) {
        typedef typename LanesOf<4>::FloatsAnywhere Anywhere;
        *(Anywhere*)(row + first) = load<4>(row + first) + added;
        return;
    }
#endif
#pragma unroll
    for (int e = 0; e < 4; ++e) {
        if (first + e < 0 || first + e >= count) continue;
#if defined(__CUDA_ARCH__)
        atomicAdd(row + first + e, added[e]);
#else
        row[first + e] += added[e];
#endif
    }
}

/// Add a voxel's moved light to a volume whose first plane is `first_plane`; with a direction (3, voxel), its change.
template <class Triple>
LFPIV_INLINE void push_voxel(int64_t k, const Triple& shape, const float* light, const float* moved, float share,
                             const float* direction, int first_plane, float* out) {
    const float own = light[k];
    if (own == 0.0f) return;
    const Place place = place_of(k, shape, moved, share);
    const Target to = target_of(place, shape);
    Four slope_z = splat<4>(0.0f), slope_y = slope_z, slope_x = slope_z;
    float along_z = 0, along_y = 0, along_x = 0;
    if (direction) {
        const int64_t size = (int64_t)shape[0] * shape[1] * shape[2];
        along_z = share * own * direction[k];
        along_y = share * own * direction[size + k];
        along_x = share * own * direction[2 * size + k];
        slope_z = slopes_of(place.z, shape[0]);
        slope_y = slopes_of(place.y, shape[1]);
        slope_x = slopes_of(place.x, shape[2]);
    }
    for (int i = 0; i < 4; ++i) {
        const int z = to.z.first + i;
        if (z < 0 || z >= shape[0]) continue;
        for (int j = 0; j < 4; ++j) {
            const int y = to.y.first + j;
            if (y < 0 || y >= shape[1]) continue;
            const float wz = to.z.weight[i], wy = to.y.weight[j];
            Four added = splat<4>(own * wz * wy) * to.x.weight;
            if (direction) {
                const float across = along_z * slope_z[i] * wy + along_y * wz * slope_y[j];
                added = splat<4>(across) * to.x.weight + splat<4>(along_x * wz * wy) * slope_x;
            }
            float* row = out + ((int64_t)(z - first_plane) * shape[1] + y) * shape[2];
            add_neighbours(row, to.x.first, shape[2], added);
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
    const Target to = target_of(place_of(k, shape, moved, share), shape);
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
    const Place place = place_of(k, shape, moved, share);
    const Target to = target_of(place, shape);
    const Four slope_z = slopes_of(place.z, shape[0]), slope_y = slopes_of(place.y, shape[1]);
    const Four slope_x = slopes_of(place.x, shape[2]);
    const int64_t size = (int64_t)shape[0] * shape[1] * shape[2];
    Four along_z = splat<4>(0.0f), along_y = splat<4>(0.0f), plain = splat<4>(0.0f);
    for (int i = 0; i < 4; ++i) {
        const int z = to.z.first + i;
        if (z < 0 || z >= shape[0]) continue;
        for (int j = 0; j < 4; ++j) {
            const int y = to.y.first + j;
            if (y < 0 || y >= shape[1]) continue;
            const Four row = neighbours_of(volume + ((int64_t)z * shape[1] + y) * shape[2], to.x.first, shape[2]);
            along_z = along_z + splat<4>(slope_z[i] * to.y.weight[j]) * row;
            along_y = along_y + splat<4>(to.z.weight[i] * slope_y[j]) * row;
            plain = plain + splat<4>(to.z.weight[i] * to.y.weight[j]) * row;
        }
    }
    out[k] += own * total_of(along_z * to.x.weight);
    out[size + k] += own * total_of(along_y * to.x.weight);
    out[2 * size + k] += own * total_of(plain * slope_x);
}

}  // namespace lfpiv

#endif
