// How a voxel's edges and a pixel's cell smear its rays in a lens's cell, and how that changes from pixel to pixel.
#ifndef LFPIV_SMEARS_H
#define LFPIV_SMEARS_H

#include "ray_model.h"

namespace lfpiv {

/// Largest value that a profile or weight can take, relative to that at the pupil's centre.
constexpr float HEADROOM = 1.04f;

/// Return the integral of a step smoothed by a box of width `narrow`, which ends at x = 0; `bend` is 1 / (2 narrow).
template <class T, class Scalar>
LFPIV_INLINE T ramp(T x, Scalar narrow, Scalar bend) {
    const T above = max(x, T{}), bent = min(above, T{} + narrow);
    return above + bent * (bent * bend - 1.0f);
}

/// Return the widest smear times the probability that a position, `away` from the middle and smeared, lies within half
/// a pitch: a trapezium, smoothed by the narrower smear.
template <class T>
LFPIV_INLINE T trapezium(T away, T wide, T narrow) {
    const T outer = 0.5f * (1.0f + wide + narrow), inner = 0.5f * (abs(1.0f - wide) + narrow);
    const T bend = 0.5f / narrow, x = abs(away);
    return ramp(outer - x, narrow, bend) - ramp(inner - x, narrow, bend) - ramp(narrow - inner - x, narrow, bend);
}

/// What `smeared` needs to know of the smears along one axis.
template <class T>
struct Smear {
    T outer, inner, narrow, bend;
};

/// Return the trapezium's constants for an interval of `width`; `bend` is 1 / (2 narrow).
template <class Width, class T>
LFPIV_INLINE Smear<T> smear_of(Width width, T wide, T narrow, T bend) {
    return {0.5f * (width + wide + narrow), 0.5f * (abs(width - wide) + narrow), narrow, bend};
}

/// Return the same as `trapezium`.
LFPIV_INLINE V smeared(V away, const Smear<float>& e) {
    const V x = abs(away);
    V y = ramp(e.outer - x, e.narrow, e.bend) - ramp(e.inner - x, e.narrow, e.bend);
    if (e.narrow > e.inner) y -= ramp(e.narrow - e.inner - x, e.narrow, e.bend);
    return y;
}

/// Find the widths of the smears by a voxel's edges, given along a, then b, and by a pixel's cell: widest along a and
/// b, then the narrower ones.
template <class T>
LFPIV_INLINE void smear_widths(const T* edge, const T* step, T* smears) {
    for (int n = 0; n < 2; ++n) {
        const T* e = edge + 3 * n;
        two_widths(e[0], e[1], e[2], step[2 * n], step[2 * n + 1], smears[n], smears[2 + n]);
    }
}

/// Return where the middle of one of the voxel's parts lies, from the projected voxel edges along x, y, z.
LFPIV_INLINE float middle_of_part(const int* cuts, int part, float x, float y, float z) {
    const int across = part % cuts[0], down = part / cuts[0] % cuts[1], deep = part / (cuts[0] * cuts[1]);
    return ((across + 0.5f) / cuts[0] - 0.5f) * x + ((down + 0.5f) / cuts[1] - 0.5f) * y +
           ((deep + 0.5f) / cuts[2] - 0.5f) * z;
}

/// Return the same with the products along x and z rounded before they are added.
LFPIV_INLINE float middle_of_part_rounded(const int* cuts, int part, float x, float y, float z) {
    const int across = part % cuts[0], down = part / cuts[0] % cuts[1], deep = part / (cuts[0] * cuts[1]);
    float along_x, along_z;
    {
#if defined(__clang__)
#pragma clang fp contract(off)
#endif
        along_x = ((across + 0.5f) / cuts[0] - 0.5f) * x;
        along_z = ((deep + 0.5f) / cuts[2] - 0.5f) * z;
    }
    return along_x + ((down + 0.5f) / cuts[1] - 0.5f) * y + along_z;
}

/// Replace the voxel's edges by those of its parts.
template <class T>
LFPIV_INLINE void cut_edges(const int* cuts, T* edge) {
    for (int n = 0; n < 6; ++n) edge[n] = edge[n] / (float)cuts[n % 3];
}

/// The rays about a pupil point in the lens's own axes (a, b) [pitch].
template <class T>
struct LocalFrame {
    T turn[4];    // matrix that turns offsets from the lens's centre into (a, b)
    T step[4];    // change of (a, b) from pixel to pixel
    T edge[6];    // the voxel's edges along x, y, z: a of all three, then b
    T smears[4];  // widths of the smears, see `smear_widths`
    T area;       // of a pixel's cell on the pupil, relative to one without the voxel's slope

    /// `k` is the slope at the pupil point (u, v).
    LFPIV_INLINE LocalFrame(const Voxel& voxel, T u, T v, const T* k) {
        const float* frame = voxel.camera.frame;
        T s = u, t = v;
        T less[4] = {1.0f - k[0], -k[1], -k[2], 1.0f - k[3]}, jacobian[4];
        area = abs(invert(less, jacobian));
        for (int n = 0; n < 2; ++n)
            for (int c = 0; c < 2; ++c)
                turn[2 * n + c] = frame[2 * n] * jacobian[c] + frame[2 * n + 1] * jacobian[2 + c];
        for (int n = 0; n < 2; ++n)
            for (int c = 0; c < 2; ++c)
                step[2 * n + c] = (turn[2 * n] * k[c] + turn[2 * n + 1] * k[2 + c]) * voxel.pupil_pixel;
        for (int axis = 0; axis < 3; ++axis) {
            voxel.voxel_edge(axis, u, v, s, t);
            for (int n = 0; n < 2; ++n) edge[3 * n + axis] = turn[2 * n] * s + turn[2 * n + 1] * t;
        }
        smear_widths(edge, step, smears);
    }
};

/// What one level stands for: the largest value of a voxel, from the smears and the area at the pupil's centre.
struct Top {
    float area, a, b;

    LFPIV_INLINE Top(const Voxel& voxel, const float* centre_slope) {
        const LocalFrame<float> local(voxel, 0.0f, 0.0f, centre_slope);
        const float* smears = local.smears;
        area = HEADROOM * local.area;
        a = HEADROOM * trapezium(0.0f, smears[0], smears[2]) / smears[0];
        b = HEADROOM * trapezium(0.0f, smears[1], smears[3]) / smears[1];
        if (voxel.parts == 1) return;
        const float* e = local.edge;
        const int* cuts = voxel.in.cuts;
        float sum = 0.0f, of_part[6], widths[4];
        for (int n = 0; n < 6; ++n) of_part[n] = e[n];
        cut_edges(cuts, of_part);
        smear_widths(of_part, local.step, widths);
        for (int part = 0; part < voxel.parts; ++part)
            sum += trapezium(middle_of_part(cuts, part, e[0], e[1], e[2]), widths[0], widths[2]) *
                   trapezium(middle_of_part(cuts, part, e[3], e[4], e[5]), widths[1], widths[3]);
        a = HEADROOM * HEADROOM * sum / (voxel.parts * widths[0] * widths[1]), b = 1.0f;
    }

    /// Return the weight of one level.
    LFPIV_INLINE float scale(const Voxel& voxel) const {
        const float radius = voxel.camera.radius;
        const float amplitude = voxel.pupil_pixel * voxel.pupil_pixel / (3.14159265f * radius * radius);
        return amplitude * area * a * b / (voxel.in.profiles ? LEVELS * LEVELS : LEVELS);
    }
};

/// How the rays of a voxel bend from pixel to pixel, in third order. The matrix N = (I - K) F^-1 turns offsets in the
/// lens's frame F into (s, t).
struct Bend {
    float unframe[4];                 // F^-1
    float frame_area;                 // of F
    float s3[4], t3[4];               // third order of the offset: xxx, xxy, xyy, yyy
    float n_xx[4], n_xy[4], n_yy[4];  // second order of N

    LFPIV_INLINE explicit Bend(const Voxel& voxel) {
        const float pixel = voxel.pupil_pixel, square = pixel * pixel;
        frame_area = abs(1.0f / invert(voxel.camera.frame, unframe));
        for (int n = 0; n < 4; ++n) {
            s3[n] = -square * pixel * voxel.model.s3[n];
            t3[n] = -square * pixel * voxel.model.t3[n];
        }
        for (int n = 0; n < 4; ++n) {
            const float* c = n < 2 ? voxel.model.s3 : voxel.model.t3;
            const float a = -square * unframe[n % 2], b = -square * unframe[2 + n % 2];
            n_xx[n] = 3.0f * c[0] * a + c[1] * b;
            n_xy[n] = 2.0f * (c[1] * a + c[2] * b);
            n_yy[n] = c[2] * a + 3.0f * c[3] * b;
        }
    }
};

/// The same about the middle of what a lens sees: second order of the offset, and first order of N.
template <class T>
struct LocalBend {
    T s[3], t[3];       // xx, xy, yy of the offset
    T along_column[4];  // change of N from column to column
    T along_row[4];     // and from row to row

    LFPIV_INLINE LocalBend() = default;
    LFPIV_INLINE LocalBend(const Voxel& voxel, const Bend& bend, T u, T v) {
        const float pixel = voxel.pupil_pixel, square = pixel * pixel;
        Voxel::bend_along(voxel.model.s, voxel.model.s3, u, v, s);
        Voxel::bend_along(voxel.model.t, voxel.model.t3, u, v, t);
        for (int c = 0; c < 2; ++c) {
            const float a = bend.unframe[c], b = bend.unframe[2 + c];
            along_column[c] = pixel * (s[1] * b + 2.0f * s[0] * a);
            along_row[c] = pixel * (s[1] * a + 2.0f * s[2] * b);
            along_column[2 + c] = pixel * (2.0f * t[0] * a + t[1] * b);
            along_row[2 + c] = pixel * (t[1] * a + 2.0f * t[2] * b);
        }
        for (int n = 0; n < 3; ++n) s[n] = square * s[n], t[n] = square * t[n];
    }
};

}  // namespace lfpiv

#endif
