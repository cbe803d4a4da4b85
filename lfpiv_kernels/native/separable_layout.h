// How a camera's weights lie in memory as profiles that planes of voxels share, for the loops on the CPU and on a GPU.
//
// A ray row is one row of pixels under every lens: rays[row][strip][lens][pixel column][lens row of the strip]. The
// light of a plane as a ray row sees it, column by column, is its line: line[column][lens row]. Profiles down lead from
// the voxels of a column to its line, profiles across from lines to rays.
#ifndef LFPIV_SEPARABLE_LAYOUT_H
#define LFPIV_SEPARABLE_LAYOUT_H

#include "simd.h"

namespace lfpiv {

/// Rows of lenses side by side: lanes of a line.
constexpr int STRIP = 16;
/// Parts of a strip, each of neighbouring rows of lenses with profiles across of its own. Their rows take turns as
/// lanes.
constexpr int PARTS = 2;
/// Columns of a plane side by side, whose profiles down begin at the same row of voxels.
constexpr int COLUMN_BLOCK = 16;
/// Most columns of a plane that a pixel sees.
constexpr int MOST_TAPS = 16;
/// Level of a ray's `rim` that stands for 1.
constexpr float RIM_LEVELS = 400.0f;

/// The arrays of `Separable`, see ``separable_layout.py``.
struct SeparableArrays {
    int rows, planes, columns;                    // voxels
    int row_stride, plane_stride, column_stride;  // of voxels in memory; on the CPU columns lie side by side
    int strips, lenses, pixels;                   // pixel columns of a lens
    int ray_rows, blocks;                         // blocks of columns
    const short* down_first;     // [plane][ray row][strip][block][lane]: first row of voxels; below 0 for none
    const unsigned char* down;   // [plane][ray row][strip][block][lane][tap][column]
    const int64_t* down_start;   // [plane]
    const int* down_taps;        // [plane]
    const float* down_scale;     // [plane]: weight of one level
    const int* lens;             // [plane][strip]: first lens
    const int* lens_count;       // [plane][strip]
    const int* taps;             // [plane][strip]
    const int64_t* first_start;  // [plane][strip]
    const int64_t* level_start;  // [plane][strip]
    const short* first;          // [plane][strip][lens][pixel]: first column of a plane
    const unsigned char* level;  // [plane][strip][lens][pixel][tap][part]
    const float* turn;           // [plane][strip][2]: columns by which a line moves per lens row and per pixel row
    const float* middle;         // [strip][lane]: pixel row of the microimages' centre, counted from the first one
    const signed char* rim;      // [ray]: how much a ray takes of its neighbours
    // for a GPU only:
    const short* reach;               // [plane][ray row][strip][block][2]: least and largest `down_first`
    const int64_t* seen_start;        // [plane][strip][column], and the end of all
    const int* seen_by;               // pixel of the strip, lens after lens, that sees a column
    const unsigned char* seen_level;  // [pixel that sees a column][part]
};

/// Return the arrays from Warp's struct.
template <class Arrays>
LFPIV_INLINE SeparableArrays separable_arrays(const Arrays& in) {
    return {in.rows,
            in.planes,
            in.columns,
            in.row_stride,
            in.plane_stride,
            in.column_stride,
            in.strips,
            in.lenses,
            in.pixels,
            in.ray_rows,
            in.blocks,
            (const short*)in.down_first.data,
            in.down.data,
            in.down_start.data,
            in.down_taps.data,
            in.down_scale.data,
            in.lens.data,
            in.lens_count.data,
            in.taps.data,
            in.first_start.data,
            in.level_start.data,
            (const short*)in.first.data,
            in.level.data,
            in.turn.data,
            in.middle.data,
            (const signed char*)in.rim.data,
            (const short*)in.reach.data,
            in.seen_start.data,
            in.seen_by.data,
            in.seen_level.data};
}

/// Return the floats of a line. Columns behind the last block stay dark.
LFPIV_INLINE int line_size(const SeparableArrays& in) { return (in.blocks * COLUMN_BLOCK + MOST_TAPS) * STRIP; }

}  // namespace lfpiv

#endif
