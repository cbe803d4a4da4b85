// A voxel's ray model: where its rays go, how wide they smear, which pixels under which lenses they can reach.
// Values of type T are floats or vectors V of lenses side by side.
#ifndef LFPIV_RAY_MODEL_H
#define LFPIV_RAY_MODEL_H

#include "simd.h"

namespace lfpiv {

/// Floats of a voxel's ray model, see `RayModel`.
constexpr int MODEL_SIZE = 38;
/// Floats of a camera's geometry, see `Geometry`.
constexpr int GEOMETRY_SIZE = 23;
/// Largest 8-bit value.
constexpr float LEVELS = 255.0f;
/// Smallest smear, in pitches or mm: keeps the closed form finite.
constexpr float NARROWEST = 1e-4f;
/// Width around the pupil within which a pixel still counts as touching it [pixel]: more than its share's rounding.
constexpr float RIM = 0.05f;

/// Polynomials of a voxel's rays in the pupil point (u, v).
struct RayModel {
    float s[6];               // coefficients of 1, u, v, uu, uv, vv of s [mm]
    float t[6];               // and of t
    float edge[3][2];         // projected voxel edges along x, y, z as (s, t) [mm]
    float edge_change[3][4];  // their change with the pupil point, (s_u, s_v, t_u, t_v)
    float s3[4];              // coefficients of uuu, uuv, uvv, vvv of s [mm]
    float t3[4];              // and of t
};
static_assert(sizeof(RayModel) == 4 * MODEL_SIZE, "floats only");

/// A camera's geometry. Lengths in mm unless stated.
struct Geometry {
    float ratio;                    // of distances on the sensor and on the pupil, r = f_m / s_i
    float pixel;                    // pixel pitch
    float half_columns, half_rows;  // half the sensor [pixel]
    float radius;                   // of the pupil
    float columns, rows;            // of the sensor
    float edge;                     // of a microimage's block [pixel]
    float origin[2];                // of lens (0, 0), (s, t)
    float basis[4];                 // (s, t) from a lens to the next along i, then along j
    float index[4];                 // the inverse: lattice indices (i, j) of (s, t), row by row
    float cell;                     // half extent of a lens's cell along s and t
    float frame[4];                 // matrix from (s, t) to the lens's own axes (a, b) [pitch], row by row
};
static_assert(sizeof(Geometry) == 4 * GEOMETRY_SIZE, "floats only");

/// What the kernels of weights read, the same for all voxels of a camera.
struct WeightInputs {
    const RayModel* models;
    const Geometry* geometry;
    const int* corners;      // first pixel (column, row) of each lens's block
    int first_i, first_j;    // the first lens
    int lenses_i, lenses_j;  // lenses along i and j
    int cuts[3];             // parts of a voxel along x, y, z
    bool profiles;           // one profile along the columns and one along the rows instead of a value per pixel
};

/// Return the inputs from Warp's struct.
template <class Inputs>
LFPIV_INLINE WeightInputs weight_inputs(const Inputs& in) {
    return {(const RayModel*)in.model.data,
            (const Geometry*)in.geometry.data,
            in.corners.data,
            in.lenses[0],
            in.lenses[1],
            in.lenses[2],
            in.lenses[3],
            {in.cuts[0], in.cuts[1], in.cuts[2]},
            in.profiles};
}

/// Invert a 2x2 matrix whose determinant is kept away from zero. Return the inverse's determinant.
template <class T>
LFPIV_INLINE T invert(const T* matrix, T* out) {
    T determinant = matrix[0] * matrix[3] - matrix[1] * matrix[2];
    determinant = abs(determinant) < 1e-12f ? T{} + 1e-12f : determinant;
    const T inverse = 1.0f / determinant;
    out[0] = matrix[3] * inverse;
    out[1] = -matrix[1] * inverse;
    out[2] = -matrix[2] * inverse;
    out[3] = matrix[0] * inverse;
    return inverse;
}

/// Invert a slope. Its diagonal is kept away from zero too.
template <class T>
LFPIV_INLINE void invert_slope(T* slope, T* out) {
    for (int n = 0; n < 4; n += 3) slope[n] = abs(slope[n]) < 1e-6f ? slope[n] + 1e-6f : slope[n];
    invert(slope, out);
}

/// Find the widest of five smears, and one box with the variance of the other four.
template <class T>
LFPIV_INLINE void two_widths(T a, T b, T c, T d, T e, T& wide, T& narrow) {
    a = abs(a), b = abs(b), c = abs(c), d = abs(d), e = abs(e);
    const T widest = max(max(max(a, b), max(c, d)), e);
    const T variance = a * a + b * b + c * c + d * d + e * e - widest * widest;
    const T none = {};
    const T rest = sqrt(max(variance, none));
    wide = max(max(widest, rest), none + NARROWEST);
    narrow = max(min(widest, rest), none + NARROWEST);
}

/// `WIDTH` lenses, one per lane.
struct Lenses {
    int index[2 * WIDTH];       // lattice indices (i, j)
    int corner[2 * WIDTH];      // first pixel (column, row) of the block
    V centre_s, centre_t;       // [mm]
    V image_s, image_t;         // middle of the microimage on the sensor [mm]
    V first_column, first_row;  // `corner` again
};

/// Pixels under `WIDTH` lenses that a voxel can light, ends included, and the pupil point in their middle.
struct PixelBox {
    V first_column, last_column, first_row, last_row;
    V u, v;  // inside the pupil
};

/// One voxel on a camera.
struct Voxel {
    const RayModel& model;
    const Geometry& camera;
    const WeightInputs& in;
    const float pupil_pixel;  // width of a pixel on the pupil [mm]
    const float rim;          // distance from the pupil's centre within which a pixel touches the pupil [mm]
    const int parts;          // into which the voxel is cut

    LFPIV_INLINE Voxel(const WeightInputs& in, int voxel)
        : model(in.models[voxel]),
          camera(*in.geometry),
          in(in),
          pupil_pixel(in.geometry->pixel / in.geometry->ratio),
          rim(camera.radius + RIM * pupil_pixel),
          parts(in.profiles ? 1 : in.cuts[0] * in.cuts[1] * in.cuts[2]) {}

    /// Return s or t of the ray through the pupil point (u, v), from its `first` coefficient, those of third order `c`
    /// and the others.
    template <class T>
    LFPIV_INLINE static T along(float first, const float* a, const float* c, T u, T v) {
        return first + u * (a[1] + u * (a[3] + u * c[0] + v * c[1]) + v * a[4]) +
               v * (a[2] + v * (a[5] + u * c[2] + v * c[3]));
    }
    /// Find its derivatives by u and v.
    template <class T>
    LFPIV_INLINE static void slope_along(const float* a, const float* c, T u, T v, T* k) {
        k[0] = a[1] + 2.0f * (a[3] + 1.5f * c[0] * u + c[1] * v) * u + (a[4] + c[2] * v) * v;
        k[1] = a[2] + (a[4] + c[1] * u) * u + 2.0f * (a[5] + c[2] * u + 1.5f * c[3] * v) * v;
    }

    /// Find (s, t) of the ray through the pupil point (u, v).
    template <class T>
    LFPIV_INLINE void position(T u, T v, T& s, T& t) const {
        s = along(model.s[0], model.s, model.s3, u, v);
        t = along(model.t[0], model.t, model.t3, u, v);
    }

    /// Find K = d(s, t)/d(u, v), row by row.
    template <class T>
    LFPIV_INLINE void slope(T u, T v, T* k) const {
        slope_along(model.s, model.s3, u, v, k);
        slope_along(model.t, model.t3, u, v, k + 2);
    }

    /// Find half the second derivatives of s or t: coefficients of duu, duv, dvv about the pupil point (u, v).
    template <class T>
    LFPIV_INLINE static void bend_along(const float* a, const float* c, T u, T v, T* bend) {
        bend[0] = a[3] + 3.0f * c[0] * u + c[1] * v;
        bend[1] = a[4] + 2.0f * (c[1] * u + c[2] * v);
        bend[2] = a[5] + c[2] * u + 3.0f * c[3] * v;
    }

    /// Find the projected voxel edge along one axis for the pupil point (u, v).
    template <class T>
    LFPIV_INLINE void voxel_edge(int axis, T u, T v, T& s, T& t) const {
        const float* k = model.edge_change[axis];
        s = model.edge[axis][0] + k[0] * u + k[1] * v;
        t = model.edge[axis][1] + k[2] * u + k[3] * v;
    }

    /// Find the half extent of (s, t) around a lens's centre within which a ray can still reach the lens: less the
    /// tail, a parabola as wide as the narrower smear, whose weights round to zero.
    template <class T>
    LFPIV_INLINE void reach(T u, T v, const T* k, T* half) const {
        T s = u, t = v, edge[2][3];
        for (int axis = 0; axis < 3; ++axis) {
            voxel_edge(axis, u, v, s, t);
            edge[0][axis] = s, edge[1][axis] = t;
        }
        for (int n = 0; n < 2; ++n) {
            T wide = u, narrow = v;
            const T *e = edge[n], *along = k + 2 * n;
            T box = camera.cell * (abs(1.0f - along[n]) + abs(along[1 - n]));
            if (parts == 1) {
                two_widths(e[0], e[1], e[2], along[0] * pupil_pixel, along[1] * pupil_pixel, wide, narrow);
            } else {  // the outermost parts of the voxel
                two_widths(e[0] / (float)in.cuts[0], e[1] / (float)in.cuts[1], e[2] / (float)in.cuts[2],
                           along[0] * pupil_pixel, along[1] * pupil_pixel, wide, narrow);
                for (int axis = 0; axis < 3; ++axis) box += (0.5f - 0.5f / in.cuts[axis]) * abs(e[axis]);
            }
            const T inner = min(wide, 2.0f * box);
            const T tail = sqrt(narrow * inner * (1.0f / LEVELS));
            half[n] = box + 0.5f * (wide + narrow) - min(tail, 0.5f * narrow);
        }
    }
};

/// The lenses that a voxel's rays can reach, from the nearest straight rays over the pupil and bounds of the rest.
struct ReachedLenses {
    const Voxel& voxel;
    float slope[4];      // at the pupil's centre
    float back[4];       // inverse of the straight rays' slope
    float half[2];       // half extent of (s, t) around a lens's centre within which a ray can reach the lens
    int i0, i1, j0, j1;  // lens indices, ends included; i1 < i0 or j1 < j0 where there are none
    int count;           // number of lenses
    int next_i, next_j;  // the lens that `take` gives next

    LFPIV_INLINE ReachedLenses(const Voxel& voxel) : voxel(voxel), i0(0), i1(-1), j0(0), j1(-1) {
        const RayModel& m = voxel.model;
        const float radius = voxel.camera.radius;
        voxel.slope(0.0f, 0.0f, slope);
        voxel.reach(0.0f, 0.0f, slope, half);
        for (int axis = 0; axis < 3; ++axis) {
            const float* k = m.edge_change[axis];
            half[0] += 0.5f * radius * (abs(k[0]) + abs(k[1]));
            half[1] += 0.5f * radius * (abs(k[2]) + abs(k[3]));
        }
        float straight[4], spread[2];  // how far the rays spread over the array
        for (int n = 0; n < 2; ++n) {
            const float *a = n ? m.t : m.s, *c = n ? m.t3 : m.s3, *k = straight + 2 * n;
            half[n] += radius * radius * (abs(a[3]) + abs(a[4]) + abs(a[5]));
            half[n] += straighten(c, radius, slope + 2 * n, straight + 2 * n);
            spread[n] = radius * sqrt(k[0] * k[0] + k[1] * k[1]);
        }
        invert_slope(straight, back);
        find_range(spread);
        count = i1 < i0 || j1 < j0 ? 0 : (i1 - i0 + 1) * (j1 - j0 + 1);
        next_i = i0, next_j = j0;
    }

    /// Add to a slope the straight rays nearest to the third order `c` over the pupil. Return a bound of the rest.
    ///
    /// In polar coordinates, uuu is r^3 (3 cos + cos 3) / 4, uvv is r^3 (cos - cos 3) / 4, and so with sines. Over the
    /// unit disc r^3 departs from 3/4 r by 1/4 at most.
    LFPIV_INLINE static float straighten(const float* c, float radius, const float* slope, float* out) {
        const float square = radius * radius;
        const float once_u = 0.25f * (3.0f * c[0] + c[2]), once_v = 0.25f * (3.0f * c[3] + c[1]);
        const float thrice_u = 0.25f * (c[0] - c[2]), thrice_v = 0.25f * (c[1] - c[3]);
        out[0] = slope[0] + 0.75f * square * once_u, out[1] = slope[1] + 0.75f * square * once_v;
        return square * radius *
               (0.25f * sqrt(once_u * once_u + once_v * once_v) + sqrt(thrice_u * thrice_u + thrice_v * thrice_v));
    }

    /// Find the range of lens indices, only as far as the sensor reaches and one microimage more.
    LFPIV_INLINE void find_range(const float* spread) {
        const Geometry& g = voxel.camera;
        const float middle_s = voxel.model.s[0], middle_t = voxel.model.t[0];
        const float margin = 2.0f * g.ratio * g.radius + 2.0f * g.cell;
        const float limit_s = g.half_columns * g.pixel + margin, limit_t = g.half_rows * g.pixel + margin;
        const float low_s = max(middle_s - half[0] - spread[0], -limit_s);
        const float high_s = min(middle_s + half[0] + spread[0], limit_s);
        const float low_t = max(middle_t - half[1] - spread[1], -limit_t);
        const float high_t = min(middle_t + half[1] + spread[1], limit_t);
        if (!(low_s <= high_s && low_t <= high_t)) return;
        const float s = 0.5f * (low_s + high_s) - g.origin[0], t = 0.5f * (low_t + high_t) - g.origin[1];
        const float half_s = 0.5f * (high_s - low_s), half_t = 0.5f * (high_t - low_t);
        const float i = g.index[0] * s + g.index[1] * t, j = g.index[2] * s + g.index[3] * t;
        const float di = abs(g.index[0]) * half_s + abs(g.index[1]) * half_t;
        const float dj = abs(g.index[2]) * half_s + abs(g.index[3]) * half_t;
        i0 = (int)max(ceil(i - di), (float)voxel.in.first_i);
        i1 = (int)min(floor(i + di), (float)(voxel.in.first_i + voxel.in.lenses_i - 1));
        j0 = (int)max(ceil(j - dj), (float)voxel.in.first_j);
        j1 = (int)min(floor(j + dj), (float)(voxel.in.first_j + voxel.in.lenses_j - 1));
    }

    /// Find the next `WIDTH` lenses of the range, which begins again behind its last lens.
    LFPIV_INLINE void take(Lenses& lenses) {
        const WeightInputs& in = voxel.in;
        V i, j;
        for (int k = 0; k < WIDTH; ++k) {
            const int* corner = in.corners + 2 * ((int64_t)(next_j - in.first_j) * in.lenses_i + next_i - in.first_i);
            lenses.index[2 * k] = next_i, lenses.index[2 * k + 1] = next_j;
            lenses.corner[2 * k] = corner[0], lenses.corner[2 * k + 1] = corner[1];
            set_lane(i, k, (float)next_i);
            set_lane(j, k, (float)next_j);
            set_lane(lenses.first_column, k, (float)corner[0]);
            set_lane(lenses.first_row, k, (float)corner[1]);
            if (++next_i > i1) {
                next_i = i0;
                if (++next_j > j1) next_j = j0;
            }
        }
        const Geometry& g = voxel.camera;
        lenses.centre_s = g.origin[0] + i * g.basis[0] + j * g.basis[2];
        lenses.centre_t = g.origin[1] + i * g.basis[1] + j * g.basis[3];
        lenses.image_s = (1.0f + g.ratio) * lenses.centre_s, lenses.image_t = (1.0f + g.ratio) * lenses.centre_t;
    }

    /// Narrow the part of the pupil that lights some lenses: bound it once more about its own middle.
    LFPIV_INLINE void narrow(const Lenses& lenses, V& low_u, V& high_u, V& low_v, V& high_v) const {
        V k[4], local[4], near[2], s, t;
        const V u = 0.5f * (low_u + high_u), v = 0.5f * (low_v + high_v);
        const V wide = 0.5f * (high_u - low_u), tall = 0.5f * (high_v - low_v);
        voxel.slope(u, v, k);
        voxel.reach(u, v, k, near);
        invert_slope(k, local);
        for (int n = 0; n < 2; ++n) {
            const float *a = n ? voxel.model.t : voxel.model.s, *c = n ? voxel.model.t3 : voxel.model.s3;
            V bent[3];
            Voxel::bend_along(a, c, u, v, bent);
            near[n] += wide * wide * (abs(bent[0]) + wide * abs(c[0]) + tall * abs(c[1])) +
                       tall * tall * (abs(bent[2]) + wide * abs(c[2]) + tall * abs(c[3])) + wide * tall * abs(bent[1]);
        }
        const V about_u = abs(local[0]) * near[0] + abs(local[1]) * near[1];
        const V about_v = abs(local[2]) * near[0] + abs(local[3]) * near[1];
        voxel.position(u, v, s, t);
        const V middle_u = u - (local[0] * (s - lenses.centre_s) + local[1] * (t - lenses.centre_t));
        const V middle_v = v - (local[2] * (s - lenses.centre_s) + local[3] * (t - lenses.centre_t));
        low_u = max(low_u, middle_u - about_u), high_u = min(high_u, middle_u + about_u);
        low_v = max(low_v, middle_v - about_v), high_v = min(high_v, middle_v + about_v);
    }

    /// Find the pixels that the voxel can light under the first `some` of the lenses. Return for which there are any.
    LFPIV_INLINE M pixel_box(int some, const Lenses& lenses, PixelBox& box) const {
        const Geometry& g = voxel.camera;
        const float pupil_pixel = voxel.pupil_pixel, rim = g.radius + 0.5f * pupil_pixel;
        const V ds = lenses.centre_s - voxel.model.s[0], dt = lenses.centre_t - voxel.model.t[0];
        const V at_u = back[0] * ds + back[1] * dt, at_v = back[2] * ds + back[3] * dt;
        const float wide_u = abs(back[0]) * half[0] + abs(back[1]) * half[1];
        const float wide_v = abs(back[2]) * half[0] + abs(back[3]) * half[1];
        V low_u = max(at_u - wide_u, splat(-rim)), high_u = min(at_u + wide_u, splat(rim));
        V low_v = max(at_v - wide_v, splat(-rim)), high_v = min(at_v + wide_v, splat(rim));
        if (!voxel.in.profiles) narrow(lenses, low_u, high_u, low_v, high_v);
        const V from_s = lenses.image_s, from_t = lenses.image_t;
        const V zero = splat(0.0f);
        const float last = g.edge - 1.0f;
        V column0 = max(ceil((from_s - g.ratio * high_u) / g.pixel - 0.5f + g.half_columns), zero);
        V column1 = min(floor((from_s - g.ratio * low_u) / g.pixel - 0.5f + g.half_columns), splat(g.columns - 1.0f));
        V row0 = max(ceil((from_t - g.ratio * high_v) / g.pixel - 0.5f + g.half_rows), zero);
        V row1 = min(floor((from_t - g.ratio * low_v) / g.pixel - 0.5f + g.half_rows), splat(g.rows - 1.0f));
        box.first_column = max(column0, lenses.first_column);
        box.last_column = min(column1, lenses.first_column + last);
        box.first_row = max(row0, lenses.first_row);
        box.last_row = min(row1, lenses.first_row + last);
        const V near_u = min(max(zero, low_u), high_u), near_v = min(max(zero, low_v), high_v);
        const float outside = g.radius + pupil_pixel;
        V turn = zero;
        for (int k = 0; k < WIDTH; ++k) set_lane(turn, k, (float)k);
        M lit = (turn < (float)some) & (low_u <= high_u) & (low_v <= high_v) & (box.first_column <= box.last_column) &
                (box.first_row <= box.last_row);
        lit &= near_u * near_u + near_v * near_v <= outside * outside;
        const V u = 0.5f * (low_u + high_u), v = 0.5f * (low_v + high_v);
        const V away = sqrt(u * u + v * v);
        const V shorter = away > g.radius ? g.radius / away : zero + 1.0f;
        box.u = u * shorter, box.v = v * shorter;
        return lit;
    }
};

}  // namespace lfpiv

#endif
