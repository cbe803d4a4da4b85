// The profiles of `separable.h` from the ray models of voxels: of one plane at a time, integrated as in
// ``footprint.h``.
#ifndef LFPIV_SEPARABLE_WEIGHTS_H
#define LFPIV_SEPARABLE_WEIGHTS_H

#include "microimages.h"
#include "separable_layout.h"
#include "smears.h"

namespace lfpiv {

/// Where rays lie on the sensor, see ``weights/separable.py``.
struct RayLayout {
    const WeightInputs in;
    const int* first_column;  // [strip][lens]: first pixel column
    const int* first_row;     // [lens row]: first pixel row
    int strips, lenses, pixels, ray_rows;

    /// Return the place of a lens (s, t) [mm]; indices may be fractions.
    LFPIV_INLINE void lens_at(float i, float j, float& s, float& t) const {
        const Geometry& g = *in.geometry;
        s = g.origin[0] + i * g.basis[0] + j * g.basis[2];
        t = g.origin[1] + i * g.basis[1] + j * g.basis[3];
    }
    /// Return the row of lenses of a lane.
    LFPIV_INLINE static int lens_row(int strip, int lane) {
        return strip * STRIP + lane % PARTS * (STRIP / PARTS) + lane / PARTS;
    }
    /// Return the lane of a row of lenses.
    LFPIV_INLINE static int lane_of(int lens_row) {
        const int row = lens_row % STRIP;
        return row % (STRIP / PARTS) * PARTS + row / (STRIP / PARTS);
    }
    /// Return the middle of a microimage along one axis of the sensor [pixel].
    LFPIV_INLINE float middle(float place, float half_sensor) const {
        return (1.0f + in.geometry->ratio) * place / in.geometry->pixel + half_sensor;
    }
};

/// Return the layout from Warp's structs.
template <class Inputs, class Layout>
LFPIV_INLINE RayLayout ray_layout(const Inputs& inputs, const Layout& rays) {
    return {weight_inputs(inputs), rays.first_column.data, rays.first_row.data, rays.strips, rays.lenses,
            rays.pixels,           rays.ray_rows};
}

/// Return the middle, counted from the pupil's centre, of a row of pixels' part inside the pupil; `y` is the middle of
/// the row. All in pixels.
LFPIV_INLINE float middle_of_row(float y, float radius) {
    const float low = min(max(y - 0.5f, -radius), radius), high = min(max(y + 0.5f, -radius), radius);
    if (!(high - low > 1e-4f)) return min(max(y, -radius), radius);
    if (abs(y) + 1.5f < radius) return y - y / (12.0f * (radius * radius - y * y));  // the chord's slope is all
    const float below = radius * radius - low * low, above = radius * radius - high * high;
    const float root_low = ::sqrtf(max(below, 0.0f)), root_high = ::sqrtf(max(above, 0.0f));
    const float area = 0.5f * (high * root_high - low * root_low) +
                       0.5f * radius * radius * (::asinf(high / radius) - ::asinf(low / radius));
    const float moment = (below * root_low - above * root_high) / 3.0f;
    return area > 1e-6f * radius ? min(max(moment / area, low), high) : 0.5f * (low + high);
}

/// The profile down of a voxel: how much of its light goes to each row of pixels under the lenses of a row.
struct ProfileDown {
    const RayLayout& rays;
    const Voxel voxel;
    ReachedLenses reached;
    float amplitude;

    LFPIV_INLINE ProfileDown(const RayLayout& rays, int index) : rays(rays), voxel(rays.in, index), reached(voxel) {
        const float radius = voxel.camera.radius;
        amplitude = voxel.pupil_pixel * voxel.pupil_pixel / (3.14159265f * radius * radius);
    }
    /// Return whether a camera sees the voxel.
    LFPIV_INLINE bool seen() const { return reached.count > 0; }
    LFPIV_INLINE int first_lens_row() const { return reached.j0 - rays.in.first_j; }
    LFPIV_INLINE int last_lens_row() const { return reached.j1 - rays.in.first_j; }

    /// Return the largest value of any profile of the voxel.
    LFPIV_INLINE float top() const {
        float k[4];
        voxel.slope(0.0f, 0.0f, k);
        const LocalFrame<float> local(voxel, 0.0f, 0.0f, k);
        return HEADROOM * amplitude * trapezium(0.0f, local.smears[1], local.smears[3]) / local.smears[1];
    }

    /// Call found(ray row, value) for all ray rows of a row of lenses.
    template <class Found>
    LFPIV_INLINE void of_lens_row(int row, Found found) const {
        const Geometry& g = voxel.camera;
        const float j = (float)(rays.in.first_j + row), px = voxel.pupil_pixel;
        // the lens column in which the chief ray lies
        const float i = (voxel.model.s[0] - g.origin[0] - j * g.basis[2]) / g.basis[0];
        float centre_s, centre_t, s, t, k[4];
        rays.lens_at(i, j, centre_s, centre_t);
        const float middle = rays.middle(centre_t, g.half_rows), radius = g.radius / px;
        const float back = abs(reached.slope[3]) < 1e-6f ? 0.0f : (centre_t - voxel.model.t[0]) / reached.slope[3];
        const float v = min(max(back, -g.radius), g.radius);
        voxel.slope(0.0f, v, k);
        const LocalFrame<float> local(voxel, 0.0f, v, k);
        const float wide = local.smears[1], narrow = local.smears[3];
        // ray rows within reach, and one more to either side: profiles are nearly straight
        const float first = (float)rays.first_row[row] + 0.5f - middle;
        const float per_row = abs(local.turn[2] * k[1] + local.turn[3] * k[3]) * px;
        const float reach = 0.5f * (1.0f + wide + narrow) / max(per_row, 1e-6f) + 1.5f;
        const float low = max(-back / px - reach, -radius - 0.5f), high = min(-back / px + reach, radius + 0.5f);
        const int begin = (int)max(::ceilf(low - first), 0.0f);
        const int end = (int)min(::floorf(high - first), (float)(rays.ray_rows - 1)) + 1;
        for (int ray_row = begin; ray_row < end; ++ray_row) {
            const float y = first + (float)ray_row;
            voxel.position(0.0f, -middle_of_row(y, radius) * px, s, t);
            const float b = local.turn[2] * (s - centre_s) + local.turn[3] * (t - centre_t);
            const float value = trapezium(b, wide, narrow) / wide;
            if (value > 0.0f) found(ray_row, amplitude * value);
        }
    }
};

/// One plane of voxels: models and profiles down of all its voxels, counted row by row.
struct PlaneOfVoxels {
    int rows, columns, blocks;

    LFPIV_INLINE int64_t place(const RayLayout& rays, int ray_row, int lens_row, int block) const {
        return ((int64_t)ray_row * rays.strips + lens_row / STRIP) * blocks * STRIP + block * STRIP +
               RayLayout::lane_of(lens_row);
    }
};

/// Find the largest value of a block of columns.
LFPIV_INLINE float top_of_block(const RayLayout& rays, const PlaneOfVoxels& plane, int block) {
    float top = 0.0f;
    for (int row = 0; row < plane.rows; ++row)
        for (int c = block * COLUMN_BLOCK; c < min((block + 1) * COLUMN_BLOCK, plane.columns); ++c) {
            const ProfileDown profile(rays, row * plane.columns + c);
            if (profile.seen()) top = max(top, profile.top());
        }
    return top;
}

/// Find the first and the last row of voxels that each ray row sees in a block of columns; `first` must hold -1.
LFPIV_INLINE void measure_down(const RayLayout& rays, const PlaneOfVoxels& plane, int block, float per_level,
                               short* first_out, short* last_out) {
    for (int row = 0; row < plane.rows; ++row)
        for (int c = block * COLUMN_BLOCK; c < min((block + 1) * COLUMN_BLOCK, plane.columns); ++c) {
            const ProfileDown profile(rays, row * plane.columns + c);
            if (!profile.seen()) continue;
            for (int j = profile.first_lens_row(); j <= profile.last_lens_row(); ++j)
                profile.of_lens_row(j, [&](int ray_row, float value) {
                    if (value * per_level < 0.5f) return;
                    const int64_t at = plane.place(rays, ray_row, j, block);
                    if (first_out[at] < 0) first_out[at] = (short)row;
                    last_out[at] = (short)row;
                });
        }
}

/// Write the levels of a block of columns, which must hold zeros.
LFPIV_INLINE void fill_down(const RayLayout& rays, const PlaneOfVoxels& plane, int block, float per_level, int taps,
                            const short* first, unsigned char* level_out) {
    for (int row = 0; row < plane.rows; ++row)
        for (int c = 0; c < COLUMN_BLOCK && block * COLUMN_BLOCK + c < plane.columns; ++c) {
            const ProfileDown profile(rays, row * plane.columns + block * COLUMN_BLOCK + c);
            if (!profile.seen()) continue;
            for (int j = profile.first_lens_row(); j <= profile.last_lens_row(); ++j)
                profile.of_lens_row(j, [&](int ray_row, float value) {
                    const float level = value * per_level + 0.5f;
                    if (level < 1.0f) return;
                    const int64_t at = plane.place(rays, ray_row, j, block);
                    level_out[(at * taps + (row - first[at])) * COLUMN_BLOCK + c] = (unsigned char)min(level, LEVELS);
                });
        }
}

/// Find the profiles across of the columns of a plane for one strip, whose ray models lie on the middle row of lenses
/// of each part. Write the first lens and the number of lenses, the number of taps, then `first` of each lens and
/// pixel, which must hold -1, and the values, `MOST_TAPS` to a pixel and part. Values of further taps are left out.
LFPIV_INLINE void find_across(const RayLayout& rays, int strip, int columns, float least, int* lens_out,
                              short* first_out, float* value_out) {
    const Geometry& g = *rays.in.geometry;
    int low = rays.lenses, high = -1, taps = 0;
    for (int at_column = 0; at_column < columns * PARTS; ++at_column) {
        const int column = at_column / PARTS, part = at_column % PARTS;
        const float j = (float)(rays.in.first_j + strip * STRIP + part * (STRIP / PARTS)) + 0.5f * (STRIP / PARTS - 1);
        const Voxel voxel(rays.in, (strip * PARTS + part) * columns + column);
        RayModel on_sensor = voxel.model;  // the middle of a part may lie beyond it
        on_sensor.t[0] = min(max(on_sensor.t[0], -g.half_rows * g.pixel), g.half_rows * g.pixel);
        WeightInputs there = rays.in;
        there.models = &on_sensor;
        const Voxel nearest(there, 0);
        const ReachedLenses reached(nearest);
        if (reached.count == 0) continue;
        for (int i = reached.i0; i <= reached.i1; ++i) {
            const int lens = i - rays.in.first_i;
            float centre_s, centre_t, s, t, k[4];
            rays.lens_at((float)i, j, centre_s, centre_t);
            const float middle = rays.middle(centre_s, g.half_columns), radius = g.radius / voxel.pupil_pixel;
            const float back = abs(reached.slope[0]) < 1e-6f ? 0.0f : (centre_s - voxel.model.s[0]) / reached.slope[0];
            const float u = min(max(back, -g.radius), g.radius);
            voxel.slope(u, 0.0f, k);
            const LocalFrame<float> local(voxel, u, 0.0f, k);
            for (int pixel = 0; pixel < rays.pixels; ++pixel) {
                const float x = (float)(rays.first_column[strip * rays.lenses + lens] + pixel) + 0.5f - middle;
                if (abs(x) > radius + 1.0f) continue;
                voxel.position(-x * voxel.pupil_pixel, 0.0f, s, t);
                const float a = local.turn[0] * (s - centre_s) + local.turn[1] * (t - centre_t);
                const float value = local.area * trapezium(a, local.smears[0], local.smears[2]) / local.smears[0];
                if (value < least) continue;
                const int at = lens * rays.pixels + pixel;
                if (first_out[at] < 0) first_out[at] = (short)column;
                const int tap = column - first_out[at];
                taps = max(taps, tap + 1);
                if (tap >= MOST_TAPS) continue;
                value_out[((int64_t)at * MOST_TAPS + tap) * PARTS + part] = value;
                low = min(low, lens), high = max(high, lens);
            }
        }
    }
    lens_out[0] = low, lens_out[1] = max(high - low + 1, 0), lens_out[2] = taps;
}

/// Write the pixel, the share and the rim of the rays of one lens in one ray row of a strip.
LFPIV_INLINE void write_ray_row(const RayLayout& rays, int ray_row, int strip, int lens, int* pixel_out,
                                float* share_out, signed char* rim_out) {
    const Geometry& g = *rays.in.geometry;
    const float radius = g.radius * g.ratio / g.pixel, curvature = 1.0f / (24.0f * max(radius, 1.0f));
    const int columns = (int)g.columns, rows = (int)g.rows;
    for (int k = 0; k < STRIP; ++k) {
        const int lens_row = RayLayout::lens_row(strip, k);
        float s, t;
        rays.lens_at((float)(rays.in.first_i + lens), (float)(rays.in.first_j + lens_row), s, t);
        const int row = rays.first_row[lens_row] + ray_row;
        const float y = (float)row + 0.5f - rays.middle(t, g.half_rows);
        for (int p = 0; p < rays.pixels; ++p) {
            const int column = rays.first_column[strip * rays.lenses + lens] + p;
            const float x = (float)column + 0.5f - rays.middle(s, g.half_columns);
            const bool seen = column >= 0 && column < columns && row >= 0 && row < rows && lens_row < rays.in.lenses_j;
            const float inside = seen ? disc_fraction(x, y, radius, curvature) : 0.0f;
            const float away = ::sqrtf(x * x + y * y);
            const int at = p * STRIP + k;
            pixel_out[at] = seen ? row * columns + column : -1;
            share_out[at] = inside;
            const bool cut = inside > 0.0f && inside < 1.0f;
            // the middle of the part inside lies (1 - inside) / 2 inwards; half of it times a difference over two
            // pixels
            const float rim = cut ? -0.25f * (1.0f - inside) * x / max(away, 1e-3f) : 0.0f;
            rim_out[at] = (signed char)(rim * RIM_LEVELS + (rim < 0.0f ? -0.5f : 0.5f));
        }
    }
}

}  // namespace lfpiv

#endif
