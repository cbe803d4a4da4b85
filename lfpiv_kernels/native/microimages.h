// The pixels of a sensor as rays of lenses: which pixel each ray belongs to and which share of it lies inside the
// pupil.
#ifndef LFPIV_MICROIMAGES_H
#define LFPIV_MICROIMAGES_H

#include "simd.h"

namespace lfpiv {

/// Versions of a microimage to either side of the plain one, for weights that fall or rise outwards at its edge.
constexpr int SIDE_LAYERS = 1;
/// All versions of a microimage.
constexpr int LAYERS = 3;
static_assert(LAYERS == 2 * SIDE_LAYERS + 1, "as many versions to either side");
/// Relative fall of the weight per pixel, outwards at the pupil's edge, between one version and the next.
constexpr double LAYER_FALL = 0.6;

/// Half of a pixel's diagonal and a little more: pixels farther from the pupil's edge lie wholly on one side [pixel].
constexpr float CLEAR_OF_EDGE = 0.75f;

LFPIV_INLINE float squared_above_zero(float x) { return x > 0.0f ? x * x : 0.0f; }

/// Return the fraction of a unit pixel at the offset (x, y) from the pupil's centre that lies inside the pupil.
/// The edge counts as straight within a pixel, moved by `curvature`. Lengths in pixels.
LFPIV_INLINE float disc_fraction(float x, float y, float radius, float curvature) {
    const float inner = max(radius - CLEAR_OF_EDGE, 0.0f), outer = radius + CLEAR_OF_EDGE;
    const float square = x * x + y * y;
    if (square < inner * inner || square > outer * outer) return square < radius * radius ? 1.0f : 0.0f;
    const float distance = (float)::sqrt((double)x * x + (double)y * y), outside = distance - radius;
    const float normal_x = max(fabsf(x) / max(distance, 1e-6f), 1e-3f);
    const float normal_y = max(fabsf(y) / max(distance, 1e-6f), 1e-3f);
    const float reach = -(outside + curvature);
    const float half_sum = (normal_x + normal_y) / 2.0f, half_gap = (normal_x - normal_y) / 2.0f;
    const float share = squared_above_zero(reach + half_sum) - squared_above_zero(reach + half_gap) -
                        squared_above_zero(reach - half_gap) + squared_above_zero(reach - half_sum);
    const float fraction = max(share / (2.0f * normal_x * normal_y), 0.0f);
    return fraction < 1.0f ? fraction : 1.0f;
}

/// The lenses and the sensor.
struct MicroimageLayout {
    const double* centre;  // centre of each microimage (column, row) [pixel]
    const int* corner;     // first pixel (column, row) of each lens's block
    int lenses;            // in a row of lenses
    int edge;              // pixels along each side of a block
    int columns, rows;     // of the sensor
    float radius;          // of a microimage [pixel]
    float curvature;       // how far the mean curvature moves the pupil's edge within a pixel [pixel]
};

/// Return the layout from Warp's struct.
template <class Layout>
LFPIV_INLINE MicroimageLayout microimage_layout(const Layout& layout) {
    return {layout.centre.data, layout.corner.data, layout.lenses, layout.edge,
            layout.columns,     layout.rows,        layout.radius, layout.curvature};
}

/// Write the sensor pixel and the share of every ray of one lens, in all layers.
LFPIV_INLINE void write_lens_rays(const MicroimageLayout& layout, int lens, int* pixel_out, float* share_out) {
    const int edge = layout.edge, columns = layout.columns, rows = layout.rows, lenses = layout.lenses;
    const int row_of_lenses = lens / lenses;
    const int first_column = layout.corner[2 * lens], first_row = layout.corner[2 * lens + 1];
    const double middle_x = layout.centre[2 * lens], middle_y = layout.centre[2 * lens + 1];
    const int64_t layer_rays = (int64_t)lenses * edge * edge;
    int64_t ray = layer_rays * LAYERS * row_of_lenses + (int64_t)(lens - row_of_lenses * lenses) * edge * edge;
    for (int row = first_row; row < first_row + edge; ++row) {
        for (int column = first_column; column < first_column + edge; ++column, ++ray) {
            const bool seen = column >= 0 && column < columns && row >= 0 && row < rows;
            const float inside = seen ? disc_fraction((float)(column + 0.5 - middle_x), (float)(row + 0.5 - middle_y),
                                                      layout.radius, layout.curvature)
                                      : 0.0f;
            for (int layer = 0; layer < LAYERS; ++layer) {
                // the middle of the part inside lies (1 - inside) / 2 inwards of the pixel's middle
                const float fall = (float)(LAYER_FALL * (layer - SIDE_LAYERS));
                share_out[ray + layer * layer_rays] = inside * (1.0f + fall * (1.0f - inside) / 2.0f);
                pixel_out[ray + layer * layer_rays] = seen ? row * columns + column : -1;
            }
        }
    }
}

}  // namespace lfpiv

#endif
