// Weights as profiles that planes of voxels share, on a GPU, a lane for each output; see
// ``reconstruction/separable_gpu.py``. The lines of all planes and strips lie in memory, those of some ray rows at a
// time.
#ifndef LFPIV_SEPARABLE_GPU_H
#define LFPIV_SEPARABLE_GPU_H

#include "lanes.h"
#include "separable_layout.h"

namespace lfpiv {

/// Some ray rows at equal distances, whose lines and rays lie in memory side by side.
struct RayRows {
    int first, step, count;

    LFPIV_INLINE int operator[](int n) const { return first + n * step; }
};

/// Return the rows from Warp's struct.
template <class Rows>
LFPIV_INLINE RayRows ray_rows(const Rows& rows) {
    return {rows.first, rows.step, rows.count};
}

/// Return where a line of the n-th ray row begins; it is that of a plane and strip: plane * strips + strip.
LFPIV_INLINE int64_t line_place(const SeparableArrays& in, int n, int line) {
    return ((int64_t)n * in.planes * in.strips + line) * line_size(in);
}

/// One lens row at one column of a line, which lies at `place`.
struct LineElement {
    int n, line, column, row;
    int64_t place;

    LFPIV_INLINE LineElement(const SeparableArrays& in, int line_of_all, int column, int row)
        : n(line_of_all / (in.planes * in.strips)),
          line(line_of_all % (in.planes * in.strips)),
          column(column),
          row(row),
          place(line_place(in, n, line) + column * STRIP + row) {}

    /// Return an element by its number; lens rows are neighbours.
    LFPIV_INLINE static LineElement by_rows(const SeparableArrays& in, int number) {
        const int columns = in.blocks * COLUMN_BLOCK, at = number / STRIP;
        return {in, at / columns, at % columns, number % STRIP};
    }
    /// Return an element by its number; the columns of a block are neighbours.
    LFPIV_INLINE static LineElement by_columns(const SeparableArrays& in, int number) {
        const int profile = number / COLUMN_BLOCK, at = profile / STRIP, block = at % in.blocks;
        return {in, at / in.blocks, block * COLUMN_BLOCK + number % COLUMN_BLOCK, profile % STRIP};
    }
};

/// A ray of some ray rows.
struct RayOfRows {
    int n, row, pixel, lens, strip;

    LFPIV_INLINE RayOfRows(const SeparableArrays& in, int number) {
        row = number % STRIP, pixel = number / STRIP % in.pixels;
        const int at = number / (STRIP * in.pixels), at_strip = at / in.lenses;
        lens = at % in.lenses, strip = at_strip % in.strips, n = at_strip / in.strips;
    }
};

/// Return the number of a profile down: [plane][ray row][strip][block], with lens rows to follow.
LFPIV_INLINE int64_t profile_down(const SeparableArrays& in, int plane, int ray_row, int strip, int block) {
    return (((int64_t)plane * in.ray_rows + ray_row) * in.strips + strip) * in.blocks + block;
}

/// Return where the levels of the profiles down of a plane, ray row, strip and block begin.
LFPIV_INLINE const unsigned char* levels_down(const SeparableArrays& in, int plane, int ray_row, int strip, int block) {
    const int64_t profile = ((int64_t)ray_row * in.strips + strip) * in.blocks + block;
    return in.down + in.down_start[plane] + profile * STRIP * in.down_taps[plane] * COLUMN_BLOCK;
}

/// Write 32 elements of lines, before these are moved.
LFPIV_INLINE void sum_down(const SeparableArrays& in, int warp, const float* volume, const RayRows& rows,
                           float* lines_out) {
    for_lanes([&](int lane) {
        const LineElement at = LineElement::by_columns(in, warp * LANES_OF_WARP + lane);
        if (at.n >= rows.count) return;
        const int plane = at.line / in.strips, strip = at.line % in.strips, block = at.column / COLUMN_BLOCK;
        const int ray_row = rows[at.n];
        const int first = in.down_first[profile_down(in, plane, ray_row, strip, block) * STRIP + at.row];
        float light = 0.0f;
        if (first >= 0 && at.column < in.columns) {
            const int taps = in.down_taps[plane], seen = min(taps, in.rows - first);
            const unsigned char* const level =
                levels_down(in, plane, ray_row, strip, block) + at.row * taps * COLUMN_BLOCK + at.column % COLUMN_BLOCK;
            const float* const voxel = volume + (int64_t)first * in.row_stride + (int64_t)plane * in.plane_stride +
                                       (int64_t)at.column * in.column_stride;
            for (int t = 0; t < seen; ++t) light += (float)level[t * COLUMN_BLOCK] * voxel[(int64_t)t * in.row_stride];
        }
        lines_out[at.place] = light * in.down_scale[plane];
    });
}

/// Write 32 elements of lines, moved along their columns, or with `back` the adjoint of that.
LFPIV_INLINE void move_lines(const SeparableArrays& in, int warp, const float* lines, const RayRows& rows, bool back,
                             float* lines_out) {
    for_lanes([&](int lane) {
        const LineElement at = LineElement::by_rows(in, warp * LANES_OF_WARP + lane);
        if (at.n >= rows.count) return;
        const float* const turn = in.turn + 2 * at.line;
        const float lens_row = (float)(at.row / PARTS) - 0.5f * (STRIP / PARTS - 1);
        const float row = (float)rows[at.n] + 0.5f - in.middle[at.line % in.strips * STRIP + at.row];
        const float moved = turn[0] * lens_row + turn[1] * row, along = back ? -moved : moved;
        const float before = at.column > 0 ? lines[at.place - STRIP] : 0.0f, behind = lines[at.place + STRIP];
        lines_out[at.place] = 0.5f * along * (along + 1.0f) * before + (1.0f - along * along) * lines[at.place] +
                              0.5f * along * (along - 1.0f) * behind;
    });
}

/// Write the light of 32 bare rays, which have no rim yet, from the lines of all planes.
LFPIV_INLINE void sum_across(const SeparableArrays& in, int warp, const float* lines, const RayRows& rows,
                             float* bare_out) {
    for_lanes([&](int lane) {
        const int number = warp * LANES_OF_WARP + lane;
        const RayOfRows ray(in, number);
        if (ray.n >= rows.count) return;
        float light = 0.0f;
        for (int plane = 0; plane < in.planes; ++plane) {
            const int at = plane * in.strips + ray.strip, i = ray.lens - in.lens[at];
            if (i < 0 || i >= in.lens_count[at]) continue;
            const int seen = i * in.pixels + ray.pixel, taps = in.taps[at];
            const int first = in.first[in.first_start[at] + seen];
            const float* const from = lines + line_place(in, ray.n, at) + first * STRIP + ray.row;
            const unsigned char* const level =
                in.level + in.level_start[at] + (int64_t)seen * taps * PARTS + ray.row % PARTS;
            for (int t = 0; t < taps; ++t) light += (float)level[t * PARTS] * from[t * STRIP];
        }
        bare_out[number] = light;
    });
}

/// Return the place of a ray of the n-th ray row among those of all ray rows.
LFPIV_INLINE int64_t place_of_ray(const SeparableArrays& in, const RayRows& rows, int n, int number) {
    const int64_t size = (int64_t)in.strips * in.lenses * in.pixels * STRIP;
    return (rows[n] - n) * size + number;
}

/// Return a ray's rim.
LFPIV_INLINE float rim_of(const SeparableArrays& in, int64_t place) {
    return (float)in.rim[place] * (1.0f / RIM_LEVELS);
}

/// Write the light of 32 rays, in which each takes its rim times the difference of its neighbours.
LFPIV_INLINE void add_rim(const SeparableArrays& in, int warp, const float* bare, const RayRows& rows,
                          float* rays_out) {
    for_lanes([&](int lane) {
        const int number = warp * LANES_OF_WARP + lane;
        const RayOfRows ray(in, number);
        if (ray.n >= rows.count) return;
        const int64_t place = place_of_ray(in, rows, ray.n, number);
        const float before = ray.pixel > 0 ? bare[number - STRIP] : 0.0f;
        const float next = ray.pixel + 1 < in.pixels ? bare[number + STRIP] : 0.0f;
        rays_out[place] = bare[number] + rim_of(in, place) * (next - before);
    });
}

/// Write the adjoint of `add_rim` on 32 bare rays.
LFPIV_INLINE void turn_back_rim(const SeparableArrays& in, int warp, const float* rays, const RayRows& rows,
                                float* bare_out) {
    for_lanes([&](int lane) {
        const int number = warp * LANES_OF_WARP + lane;
        const RayOfRows ray(in, number);
        if (ray.n >= rows.count) return;
        const int64_t place = place_of_ray(in, rows, ray.n, number);
        float light = rays[place];
        if (ray.pixel > 0) light += rim_of(in, place - STRIP) * rays[place - STRIP];
        if (ray.pixel + 1 < in.pixels) light -= rim_of(in, place + STRIP) * rays[place + STRIP];
        bare_out[number] = light;
    });
}

/// Return a weight's level, or with `lit` whether there is one.
LFPIV_INLINE float level_of(unsigned char level, bool lit) { return lit ? (level > 0 ? 1.0f : 0.0f) : (float)level; }

/// Write 32 elements of lines: the adjoint of `sum_across`. With `lit` all weights count as 1.
LFPIV_INLINE void return_across(const SeparableArrays& in, int warp, const float* bare, const RayRows& rows, bool lit,
                                float* lines_out) {
    for_lanes([&](int lane) {
        const LineElement at = LineElement::by_rows(in, warp * LANES_OF_WARP + lane);
        if (at.n >= rows.count) return;
        float light = 0.0f;
        if (at.column < in.columns) {
            const int64_t column = (int64_t)at.line * in.columns + at.column, end = in.seen_start[column + 1];
            const int64_t strip = (int64_t)at.n * in.strips + at.line % in.strips;
            const float* const rays = bare + strip * in.lenses * in.pixels * STRIP + at.row;
            for (int64_t k = in.seen_start[column]; k < end; ++k) {
                const float level = level_of(in.seen_level[k * PARTS + at.row % PARTS], lit);
                light += level * rays[(int64_t)in.seen_by[k] * STRIP];
            }
        }
        lines_out[at.place] = light;
    });
}

/// Add to 32 voxels the light of lines: the adjoint of `sum_down`. With `lit` all weights count as 1.
LFPIV_INLINE void return_down(const SeparableArrays& in, int warp, const float* lines, const RayRows& rows, bool lit,
                              float* volume_out) {
    for_lanes([&](int lane) {
        const int number = warp * LANES_OF_WARP + lane, column = number % in.columns;
        const int at_row = number / in.columns, row = at_row % in.rows, plane = at_row / in.rows;
        if (plane >= in.planes) return;
        const int64_t voxel =
            (int64_t)row * in.row_stride + (int64_t)plane * in.plane_stride + (int64_t)column * in.column_stride;
        const int block = column / COLUMN_BLOCK, taps = in.down_taps[plane];
        float light = 0.0f;
        for (int n = 0; n < rows.count; ++n)
            for (int strip = 0; strip < in.strips; ++strip) {
                const int64_t profile = profile_down(in, plane, rows[n], strip, block);
                if (row < in.reach[2 * profile] || row >= in.reach[2 * profile + 1] + taps) continue;
                const unsigned char* const level =
                    levels_down(in, plane, rows[n], strip, block) + column % COLUMN_BLOCK;
                const float* const line = lines + line_place(in, n, plane * in.strips + strip) + column * STRIP;
                for (int k = 0; k < STRIP; ++k) {
                    const int first = in.down_first[profile * STRIP + k], tap = row - first;
                    if (first < 0 || tap < 0 || tap >= taps) continue;
                    light += level_of(level[(k * taps + tap) * COLUMN_BLOCK], lit) * line[k];
                }
            }
        volume_out[voxel] += lit ? light : light * in.down_scale[plane];
    });
}

}  // namespace lfpiv

#endif
