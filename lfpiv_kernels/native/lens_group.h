// The pixels under a group of lenses, one lens per lane: what they need for their weights, and which of them are lit.
#ifndef LFPIV_LENS_GROUP_H
#define LFPIV_LENS_GROUP_H

#include "microimages.h"
#include "projector.h"
#include "smears.h"

namespace lfpiv {

/// `WIDTH` lenses and the pixels under them, one lens per lane.
struct LensGroup {
    const Voxel& voxel;
    const Lenses& lenses;
    const V first_column, first_row;  // of the box
    const V columns, rows;            // pixels of the box
    const V column, row;              // middle of the box, counted from its first pixel
    const V u0, v0;                   // pupil point of the first pixel; it is linear in column and row
    const V u, v;                     // pupil point of the middle
    const LocalFrame<V> local;        // about the middle of what the voxel lights

    LFPIV_INLINE LensGroup(const Voxel& voxel, const Lenses& lenses, const PixelBox& box)
        : voxel(voxel),
          lenses(lenses),
          first_column(box.first_column),
          first_row(box.first_row),
          columns(box.last_column - box.first_column + 1.0f),
          rows(box.last_row - box.first_row + 1.0f),
          column(0.5f * (columns - 1.0f)),
          row(0.5f * (rows - 1.0f)),
          u0(pupil_point(lenses.image_s, first_column, voxel.camera.half_columns)),
          v0(pupil_point(lenses.image_t, first_row, voxel.camera.half_rows)),
          u(u0 - column * voxel.pupil_pixel),
          v(v0 - row * voxel.pupil_pixel),
          local(local_frame(voxel, box.u, box.v)) {}

    /// Return the rays about a pupil point.
    LFPIV_INLINE static LocalFrame<V> local_frame(const Voxel& voxel, V u, V v) {
        V k[4];
        voxel.slope(u, v, k);
        return LocalFrame<V>(voxel, u, v, k);
    }

    /// Return where the middle of a pixel looks through the pupil, along one axis.
    LFPIV_INLINE V pupil_point(V image, V pixel, float half_sensor) const {
        const Geometry& g = voxel.camera;
        return (image - (pixel + (0.5f - half_sensor)) * g.pixel) / g.ratio;
    }

    /// Find how far from the lens's centre the ray through a pupil point meets the array.
    LFPIV_INLINE void offset(V u, V v, V& s, V& t) const {
        voxel.position(u, v, s, t);
        s -= lenses.centre_s, t -= lenses.centre_t;
    }
};

/// Return one lane of a vector that lies in memory.
LFPIV_INLINE float in_memory(const V& x, int k) { return ((const float*)&x)[k]; }

/// What the pixels under each lens of a group need.
struct LensValues {
    V columns;                    // of the box; 0 where there are no pixels
    V first_column, first_row;    // of the box
    V column, row;                // middle of the box, counted from its first pixel
    Smear<V> smear_a, smear_b;    // of the voxel's parts
    V wide_a, wide_b;             // their widest smears
    V to_a, to_b;                 // from `smeared` to levels
    V a, b, step_a, step_b;       // of profiles: the middle's offset in the lens's frame, and its change per pixel
    V s, t, slope[4], matrix[4];  // of pixels: the middle's offset, its change per pixel, the matrix N of `Bend`
    LocalBend<V> bend;            // and their change
    V centre_x, centre_y;         // the pupil's centre from the middle [pixel]
    V edge[6];                    // of a voxel that is cut: its edges in the lens's frame

    LFPIV_INLINE LensValues(const LensGroup& group, const Top& top, const Bend& of_voxel, M lit) {
        const Voxel& voxel = group.voxel;
        const LocalFrame<V>& local = group.local;
        columns = lit ? group.columns : V{};
        first_column = group.first_column, first_row = group.first_row;
        column = group.column, row = group.row;
        V smears[4];
        for (int n = 0; n < 4; ++n) smears[n] = local.smears[n];
        if (voxel.parts > 1) {
            V of_part[6];
            for (int n = 0; n < 6; ++n) edge[n] = of_part[n] = local.edge[n];
            cut_edges(voxel.in.cuts, of_part);
            smear_widths(of_part, local.step, smears);
        }
        wide_a = smears[0], wide_b = smears[1];
        smear_a = smear_of(1.0f, wide_a, smears[2], 0.5f / smears[2]);
        smear_b = smear_of(1.0f, wide_b, smears[3], 0.5f / smears[3]);
        group.offset(group.u, group.v, s, t);
        if (voxel.in.profiles) {
            const V* turn = local.turn;
            to_a = LEVELS * local.area / (top.a * top.area * wide_a);
            to_b = LEVELS / (top.b * wide_b);
            a = turn[0] * s + turn[1] * t, b = turn[2] * s + turn[3] * t;
            step_a = local.step[0], step_b = local.step[3];
        } else {
            to_a = LEVELS / (top.a * top.b * top.area * of_voxel.frame_area * wide_a * wide_b);
            if (voxel.parts > 1) to_a /= (float)voxel.parts;
            V k[4];
            voxel.slope(group.u, group.v, k);
            bend = LocalBend<V>(voxel, of_voxel, group.u, group.v);
            centre_x = group.u / voxel.pupil_pixel, centre_y = group.v / voxel.pupil_pixel;
            for (int n = 0; n < 4; ++n) slope[n] = -voxel.pupil_pixel * k[n];
            for (int n = 0; n < 2; ++n) {
                matrix[n] = (1.0f - k[0]) * of_voxel.unframe[n] - k[1] * of_voxel.unframe[2 + n];
                matrix[2 + n] = (1.0f - k[3]) * of_voxel.unframe[2 + n] - k[2] * of_voxel.unframe[n];
            }
        }
    }

    /// Return the smear of one lens.
    LFPIV_INLINE static Smear<float> one(const Smear<V>& smear, int k) {
        return {in_memory(smear.outer, k), in_memory(smear.inner, k), in_memory(smear.narrow, k),
                in_memory(smear.bend, k)};
    }
};

/// The pixels of a group that lie in `BLOCK_WIDTH` columns from `column0` on.
struct Tile {
    V low, high;  // first and last row of the box that touches the pupil; low > high where none does
    V layer;      // of the microimage

    LFPIV_INLINE Tile(const LensGroup& group, M here, float column0) {
        const Voxel& voxel = group.voxel;
        const float pupil_pixel = voxel.pupil_pixel, rim = voxel.rim;
        const V none = {}, width = min(splat((float)BLOCK_WIDTH), group.columns - column0);
        const V u = group.u0 - (column0 + 0.5f * (width - 1.0f)) * pupil_pixel;
        layer = voxel.in.profiles ? edge_layer(group, here, u, width) : none;
        const V near_u = max(abs(u) - 0.5f * pupil_pixel * width, none);
        const V square = rim * rim - near_u * near_u, half_height = sqrt(max(square, none));
        low = max(ceil((group.v0 - half_height) / pupil_pixel - 0.5f), none);
        high = min(floor((group.v0 + half_height) / pupil_pixel + 0.5f), group.rows - 1.0f);
        high = (here & (square >= 0.0f)) ? high : none - 1.0f;
    }

    /// Return the layer of the microimage at the pupil's edge, from how the profiles fall outwards there. Where only a
    /// part of a pixel lies inside the pupil, the weight that counts is that of the part's middle.
    LFPIV_INLINE static V edge_layer(const LensGroup& group, M here, V u, V width) {
        const LocalFrame<V>& local = group.local;
        const float radius = group.voxel.camera.radius, pupil_pixel = group.voxel.pupil_pixel;
        const float inside = radius - 0.25f * pupil_pixel, outside = radius + 0.25f * pupil_pixel;
        const V none = {}, v = group.v, away = sqrt(u * u + v * v);
        const V far_u = abs(u) + 0.5f * pupil_pixel * width, far_v = abs(v) + 0.5f * pupil_pixel * group.rows;
        const M at_rim = here & (far_u * far_u + far_v * far_v > inside * inside) & (away > 0.3f * radius);
        if (!any(at_rim)) return none;
        const V normal_u = u / away, normal_v = v / away;
        V weight[2], s, t;
        for (int n = 0; n < 2; ++n) {
            const float at_radius = n ? outside : inside;
            group.offset(at_radius * normal_u, at_radius * normal_v, s, t);
            weight[n] = trapezium(local.turn[0] * s + local.turn[1] * t, local.smears[0], local.smears[2]) *
                        trapezium(local.turn[2] * s + local.turn[3] * t, local.smears[1], local.smears[3]);
        }
        const V fall = 4.0f * (weight[0] - weight[1]) / max(weight[0] + weight[1], none + 1e-9f);
        V layer = floor(fall / (float)LAYER_FALL + 0.5f);
        layer = min(max(layer, none - (float)SIDE_LAYERS), none + (float)SIDE_LAYERS);
        return at_rim ? layer : none;
    }

    /// Return a bit for each lens with pixels that touch the pupil.
    LFPIV_INLINE unsigned lit() const {
        unsigned lit = 0;
        for (int k = 0; k < WIDTH; ++k) lit |= (unsigned)(in_memory(low, k) <= in_memory(high, k)) << k;
        return lit;
    }
};

}  // namespace lfpiv

#endif
