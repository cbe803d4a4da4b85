// The area-integrated weights of a voxel as 8-bit blocks of rays: how much room they need, and the blocks themselves.
#ifndef LFPIV_FOOTPRINT_H
#define LFPIV_FOOTPRINT_H

#include "microimages.h"
#include "projector.h"
#include "ray_model.h"

namespace lfpiv {

/// Largest value that a profile or weight can take, relative to that at the pupil's centre.
constexpr float HEADROOM = 1.04f;
/// Rows of a block at most.
constexpr int TALLEST = 64;
/// Width around the pupil within which a pixel still counts as touching it [pixel]: more than its share's rounding.
constexpr float RIM = 0.05f;
/// Parts of a voxel at most.
constexpr int MOST_PARTS = 64;
/// Steps of a cell's outline at most.
constexpr int MOST_STEPS = 8;

/// Count the blocks and the bytes of values that a voxel needs at most.
LFPIV_INLINE void measure(const WeightInputs& in, int index, int* blocks_out, int* bytes_out) {
    const Voxel voxel(in, index);
    ReachedLenses reached(voxel);
    int blocks = 0, bytes = 0;
    for (int n = 0; n < reached.count; n += WIDTH) {
        Lenses lenses;
        PixelBox box;
        reached.take(lenses);
        const M lit = reached.pixel_box(reached.count - n, lenses, box);
        if (!any(lit)) continue;
        const V tiles = floor((box.last_column - box.first_column + (float)BLOCK_WIDTH) / (float)BLOCK_WIDTH);
        const V rows = box.last_row - box.first_row + 1.0f, none = V{};
        const V parts = floor((rows + (float)(TALLEST - 1)) / (float)TALLEST);
        const V values = in.profiles ? tiles * (rows + parts * (float)BLOCK_WIDTH) : tiles * rows * (float)BLOCK_WIDTH;
        const V lit_blocks = lit ? tiles * parts : none, lit_values = lit ? values : none;
        for (int k = 0; k < WIDTH; ++k) {
            blocks += (int)lane(lit_blocks, k);
            bytes += (int)lane(lit_values, k);
        }
    }
    blocks_out[index] = blocks;
    bytes_out[index] = bytes + 2 * BLOCK_WIDTH;  // a vector may be stored past the last value
}

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

    LFPIV_INLINE LocalFrame(const Voxel& voxel, T u, T v) {
        const float* frame = voxel.camera.frame;
        T s = u, t = v, k[4];
        voxel.slope(u, v, k);
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

    LFPIV_INLINE explicit Top(const Voxel& voxel) {
        const LocalFrame<float> local(voxel, 0.0f, 0.0f);
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

/// How the rays of a voxel bend from pixel to pixel. The matrix N = (I - K) F^-1 turns offsets in the lens's frame F
/// into (s, t).
struct Bend {
    float unframe[4];                          // F^-1
    float frame_area;                          // of F
    float along_column[4];                     // change of N from column to column
    float along_row[4];                        // and from row to row
    float s_xx, s_xy, s_yy, t_xx, t_xy, t_yy;  // second order of the offset

    LFPIV_INLINE explicit Bend(const Voxel& voxel) {
        const float pixel = voxel.pupil_pixel, square = pixel * pixel;
        const float *s = voxel.model.s, *t = voxel.model.t;
        frame_area = abs(1.0f / invert(voxel.camera.frame, unframe));
        for (int n = 0; n < 2; ++n)
            for (int c = 0; c < 2; ++c) {
                const float* q = (n ? t : s) + 3;
                along_column[2 * n + c] = pixel * (2.0f * q[0] * unframe[c] + q[1] * unframe[2 + c]);
                along_row[2 * n + c] = pixel * (q[1] * unframe[c] + 2.0f * q[2] * unframe[2 + c]);
            }
        s_xx = square * s[3], s_xy = square * s[4], s_yy = square * s[5];
        t_xx = square * t[3], t_xy = square * t[4], t_yy = square * t[5];
    }
};

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
          u0(pupil_point(lenses.centre_s, first_column, voxel.camera.half_columns)),
          v0(pupil_point(lenses.centre_t, first_row, voxel.camera.half_rows)),
          u(u0 - column * voxel.pupil_pixel),
          v(v0 - row * voxel.pupil_pixel),
          local(voxel, box.u, box.v) {}

    /// Return where the middle of a pixel looks through the pupil, along one axis.
    LFPIV_INLINE V pupil_point(V centre, V pixel, float half_sensor) const {
        const Geometry& g = voxel.camera;
        return ((1.0f + g.ratio) * centre - (pixel + (0.5f - half_sensor)) * g.pixel) / g.ratio;
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
    V edge[6];                    // of a voxel that is cut: its edges in the lens's frame

    LFPIV_INLINE LensValues(const LensGroup& group, const Top& top, const Bend& bend, M lit) {
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
            to_a = LEVELS / (top.a * top.b * top.area * bend.frame_area * wide_a * wide_b);
            if (voxel.parts > 1) to_a /= (float)voxel.parts;
            V k[4];
            voxel.slope(group.u, group.v, k);
            for (int n = 0; n < 4; ++n) slope[n] = -voxel.pupil_pixel * k[n];
            for (int n = 0; n < 2; ++n) {
                matrix[n] = (1.0f - k[0]) * bend.unframe[n] - k[1] * bend.unframe[2 + n];
                matrix[2 + n] = (1.0f - k[3]) * bend.unframe[2 + n] - k[2] * bend.unframe[n];
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
        const float pupil_pixel = voxel.pupil_pixel, rim = voxel.camera.radius + RIM * pupil_pixel;
        const V none = {}, width = min(splat((float)BLOCK_WIDTH), group.columns - column0);
        const V u = group.u0 - (column0 + 0.5f * (width - 1.0f)) * pupil_pixel;
        layer = edge_layer(group, here, u, width);
        const V near_u = max(abs(u) - 0.5f * pupil_pixel * width, none);
        const V square = rim * rim - near_u * near_u, half_height = sqrt(max(square, none));
        low = max(ceil((group.v0 - half_height) / pupil_pixel - 0.5f), none);
        high = min(floor((group.v0 + half_height) / pupil_pixel + 0.5f), group.rows - 1.0f);
        high = (here & (square >= 0.0f)) ? high : none - 1.0f;
    }

    /// Return the layer of the microimage at the pupil's edge, from how the weights fall outwards there. Where only a
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

#if defined(__CUDA_ARCH__)

/// Return 8 bytes as one word, the first one lowest.
LFPIV_INLINE uint64_t load_word(const unsigned char* from) {
    uint64_t word = 0;
    for (int k = 0; k < 8; ++k) word |= (uint64_t)from[k] << (8 * k);
    return word;
}
/// Write a word as 8 bytes.
LFPIV_INLINE void store_word(unsigned char* to, uint64_t word) {
    for (int k = 0; k < 8; ++k) to[k] = (unsigned char)(word >> (8 * k));
}
/// Return the number of the lowest bit that is set.
LFPIV_INLINE int lowest_bit(uint64_t word) { return __ffsll(word) - 1; }
/// Return the number of the highest bit that is set.
LFPIV_INLINE int highest_bit(uint64_t word) { return 63 - __clzll(word); }

#else

LFPIV_INLINE uint64_t load_word(const unsigned char* from) {
    uint64_t word;
    __builtin_memcpy(&word, from, 8);
    return word;
}
LFPIV_INLINE void store_word(unsigned char* to, uint64_t word) { __builtin_memcpy(to, &word, 8); }
LFPIV_INLINE int lowest_bit(uint64_t word) { return __builtin_ctzll(word); }
LFPIV_INLINE int highest_bit(uint64_t word) { return 63 - __builtin_clzll(word); }

#endif

/// Return a word whose first `count` bytes are set.
LFPIV_INLINE uint64_t bytes_below(int count) { return count >= 8 ? ~(uint64_t)0 : ((uint64_t)1 << (8 * count)) - 1; }

/// Where the blocks of a voxel are written.
struct BlockWriter {
    int* ray_out;
    unsigned char* height_out;
    unsigned char* width_out;
    int block, last_block;     // the next block, and the end of the room
    unsigned char* value;      // the next value
    const unsigned char* end;  // of the room for values
    int stride;                // rays from one row of a microimage to the next

    /// Finish a block whose values are written.
    LFPIV_INLINE void finish(int ray, int row, int column, int height, int width) {
        ray_out[block] = ray + row * stride + column;
        width_out[block] = (unsigned char)width;
        height_out[block] = (unsigned char)height;
        ++block;
    }
};

/// Columns and rows of pixels in a vector.
constexpr int ACROSS = WIDTH < 8 ? WIDTH : 8, DOWN = WIDTH < 8 ? 1 : WIDTH / 8;

/// Return k / divisor % modulus for lane k.
LFPIV_INLINE V lane_numbers(int divisor, int modulus) {
    V numbers;
    for (int k = 0; k < WIDTH; ++k) set_lane(numbers, k, (float)(k / divisor % modulus));
    return numbers;
}

/// Outline of a lens's cell: half extents along a and b of rectangles on top of each other; one for a square cell.
struct Outline {
    const float* extent;
    int steps;
    bool square;
};

/// Steps of the cell's outline, and offsets of the voxel's parts, under one lens.
struct CellParts {
    Smear<float> step_a[MOST_STEPS], step_b[MOST_STEPS];
    float part_a[MOST_PARTS], part_b[MOST_PARTS];

    LFPIV_INLINE CellParts(const LensValues& values, const Voxel& voxel, const Outline& outline, int lens) {
        for (int q = 0; !outline.square && q < outline.steps; ++q) {
            const float width = 2.0f * outline.extent[2 * q], height = 2.0f * outline.extent[2 * q + 1];
            const Smear<float> a = values.one(values.smear_a, lens), b = values.one(values.smear_b, lens);
            step_a[q] = smear_of(width, in_memory(values.wide_a, lens), a.narrow, a.bend);
            step_b[q] = smear_of(height, in_memory(values.wide_b, lens), b.narrow, b.bend);
        }
        part_a[0] = part_b[0] = 0.0f;
        if (voxel.parts == 1) return;
        float e[6];
        for (int n = 0; n < 6; ++n) e[n] = in_memory(values.edge[n], lens);
        for (int part = 0; part < voxel.parts; ++part) {
            part_a[part] = middle_of_part(voxel.in.cuts, part, e[0], e[1], e[2]);
            part_b[part] = middle_of_part(voxel.in.cuts, part, e[3], e[4], e[5]);
        }
    }
};

/// The pixels under one lens of a group in one tile.
struct LensTile {
    const LensValues& values;
    const Voxel& voxel;
    const Bend& bend;
    const Outline& outline;
    const CellParts& cell;
    const int lens;          // lane of the group
    const float column0;     // of the tile, in the box
    const uint64_t columns;  // a byte for each column of the tile
    const int ray;           // of the tile's first pixel in the box's first row
    const float to_a;
    const Smear<float> smear_a, smear_b;

    LFPIV_INLINE LensTile(const LensValues& values, const Voxel& voxel, const Bend& bend, const Outline& outline,
                          const CellParts& cell, int lens, int tile, int ray)
        : values(values),
          voxel(voxel),
          bend(bend),
          outline(outline),
          cell(cell),
          lens(lens),
          column0((float)(tile * BLOCK_WIDTH)),
          columns(bytes_below((int)in_memory(values.columns, lens) - tile * BLOCK_WIDTH)),
          ray(ray),
          to_a(in_memory(values.to_a, lens)),
          smear_a(values.one(values.smear_a, lens)),
          smear_b(values.one(values.smear_b, lens)) {}

    /// Return the lens's part of a value.
    LFPIV_INLINE float of(const V& x) const { return in_memory(x, lens); }

    /// Return the profile along the columns, a byte each.
    LFPIV_INLINE uint64_t profile_across() const {
        unsigned char level[WIDTH < 8 ? 8 : WIDTH];
        for (int x = 0; x < 8; x += ACROSS) {
            const V from = lane_numbers(1, 8) + (column0 + (float)x - of(values.column));
            const V y = smeared(of(values.a) - from * of(values.step_a), smear_a) * to_a + 0.5f;
            store_bytes(level + x, min(y, splat(LEVELS)));
        }
        return load_word(level) & columns;
    }

    /// Write the block of rows from `first` on as two profiles. Nothing is written where all weights round to zero.
    LFPIV_INLINE void write_profiles(uint64_t across, int first, int height, BlockWriter& out) const {
        unsigned char level[TALLEST + 16];
        const float to_b = of(values.to_b);
        int top = -1, bottom = -1;
        for (int y = 0; y < height; y += WIDTH) {
            const V from = lane_numbers(1, WIDTH) + ((float)(first + y) - of(values.row));
            const V z = smeared(of(values.b) - from * of(values.step_b), smear_b) * to_b + 0.5f;
            store_bytes(level + y, min(z, splat(LEVELS)));
        }
        for (int y = 0; y < height; y += 8) {
            const uint64_t word = load_word(level + y) & bytes_below(height - y);
            if (!word) continue;
            bottom = y + highest_bit(word) / 8;
            if (top < 0) top = y + lowest_bit(word) / 8;
        }
        if (top < 0) return;
        const int left = lowest_bit(across) / 8, wide = highest_bit(across) / 8 - left + 1;
        store_word(out.value, across >> (8 * left));
        out.value += wide;
        for (int y = top; y <= bottom; y += 8) store_word(out.value + y - top, load_word(level + y));
        out.value += bottom - top + 1;
        out.finish(ray, first + top, left, bottom - top + 1, wide);
    }

    /// Return the probability, times the widest smears, that rays at (a, b) lie in the lens's cell.
    LFPIV_INLINE V inside_cell(V a, V b) const {
        const int parts = voxel.parts;
        if (outline.square && parts == 1) return smeared(a, smear_a) * smeared(b, smear_b);
        V inside = {};
        for (int part = 0; outline.square && part < parts; ++part)
            inside += smeared(a - cell.part_a[part], smear_a) * smeared(b - cell.part_b[part], smear_b);
        for (int part = 0; !outline.square && part < parts; ++part) {
            V lower = {};
            for (int q = 0; q < outline.steps; ++q) {
                const V higher = smeared(b - cell.part_b[part], cell.step_b[q]);
                inside += smeared(a - cell.part_a[part], cell.step_a[q]) * (higher - lower);
                lower = higher;
            }
        }
        return inside;
    }

    /// Write the levels of all pixels of `height` rows, 8 to a row.
    LFPIV_INLINE void write_levels(int first, int height, unsigned char* out) const {
        const V lane_column = lane_numbers(1, 8), lane_row = lane_numbers(8, WIDTH), none = {};
        const V *slope = values.slope, *matrix = values.matrix;
        for (int c = 0; c < 8; c += ACROSS) {
            const V x = lane_column + (column0 + (float)c - of(values.column));
            const V s_x = of(values.s) + x * (of(slope[0]) + x * bend.s_xx);
            const V t_x = of(values.t) + x * (of(slope[2]) + x * bend.t_xx);
            const V s_y = of(slope[1]) + x * bend.s_xy, t_y = of(slope[3]) + x * bend.t_xy;
            const V n0 = of(matrix[0]) + x * bend.along_column[0], n1 = of(matrix[1]) + x * bend.along_column[1];
            const V n2 = of(matrix[2]) + x * bend.along_column[2], n3 = of(matrix[3]) + x * bend.along_column[3];
            for (int row = 0; row < height; row += DOWN) {
                const V y = lane_row + ((float)(first + row) - of(values.row));
                const V ds = s_x + y * (s_y + y * bend.s_yy), dt = t_x + y * (t_y + y * bend.t_yy);
                const V k0 = n0 + y * bend.along_row[0], k1 = n1 + y * bend.along_row[1];
                const V k2 = n2 + y * bend.along_row[2], k3 = n3 + y * bend.along_row[3];
                const V inverse = 1.0f / (k0 * k3 - k1 * k2);
                const V a = (k3 * ds - k1 * dt) * inverse, b = (k0 * dt - k2 * ds) * inverse;
                const V level = abs(inverse) * inside_cell(a, b) * to_a + 0.5f;
                store_bytes(out + 8 * row + c, min(max(level, none), splat(LEVELS)));
            }
        }
    }

    /// Write the block of rows from `first` on, a value per pixel. Nothing is written where all weights round to zero.
    LFPIV_INLINE void write_pixels(int first, int height, BlockWriter& out) const {
        write_levels(first, height, out.value);
        uint64_t all = 0, lit_rows = 0;
        for (int row = 0; row < height; ++row) {
            const uint64_t word = load_word(out.value + 8 * row) & columns;
            all |= word;
            lit_rows |= (uint64_t)(word != 0) << row;
        }
        if (!all) return;
        const int top = lowest_bit(lit_rows), bottom = highest_bit(lit_rows);
        const int left = lowest_bit(all) / 8, wide = highest_bit(all) / 8 - left + 1;
        const unsigned char* from = out.value;
        for (int row = top; row <= bottom; ++row, out.value += wide)
            store_word(out.value, (load_word(from + 8 * row) & columns) >> (8 * left));
        out.finish(ray, first + top, left, bottom - top + 1, wide);
    }

    /// Write the blocks of rows `low` to `last`.
    LFPIV_INLINE void write(int low, int last, BlockWriter& out) const {
        const bool profiles = voxel.in.profiles;
        const uint64_t across = profiles ? profile_across() : 1;
        if (!across) return;
        for (int first = low; first <= last; first += TALLEST) {
            const int height = min(last, first + TALLEST - 1) - first + 1;
            // rounding may differ from that of `measure`: never write past what it counted
            const int needed = (profiles ? 8 + height : 8 * height) + BLOCK_WIDTH;
            if (out.block >= out.last_block || out.value + needed > out.end) break;
            if (profiles)
                write_profiles(across, first, height, out);
            else
                write_pixels(first, height, out);
        }
    }
};

/// Return the ray of the first pixel of a lens's box, in one layer of the microimages.
LFPIV_INLINE int first_ray(const WeightInputs& in, const Lenses& lenses, const LensValues& values, int lens,
                           int layer) {
    const int edge = (int)in.geometry->edge;
    const int lens_row = (lenses.index[2 * lens + 1] - in.first_j) * LAYERS + layer + SIDE_LAYERS;
    const int block = lens_row * in.lenses_i + lenses.index[2 * lens] - in.first_i;
    const int row = (int)in_memory(values.first_row, lens) - lenses.corner[2 * lens + 1];
    const int column = (int)in_memory(values.first_column, lens) - lenses.corner[2 * lens];
    return block * edge * edge + row * edge + column;
}

/// Write the blocks of the pixels under one group of lenses.
LFPIV_INLINE void fill_group(const LensGroup& group, const Top& top, const Bend& bend, const Outline& outline, M lit,
                             BlockWriter& out) {
    const Voxel& voxel = group.voxel;
    const LensValues values(group, top, bend, lit);
    for (int tile = 0;; ++tile) {
        const float column0 = (float)(tile * BLOCK_WIDTH);
        const M here = values.columns > column0;
        if (!any(here)) break;
        const Tile rows(group, here, column0);
        for (unsigned live = rows.lit(); live; live &= live - 1) {
            const int lens = lowest_bit(live), layer = (int)in_memory(rows.layer, lens);
            const int ray = first_ray(voxel.in, group.lenses, values, lens, layer) + tile * BLOCK_WIDTH;
            const CellParts cell(values, voxel, outline, lens);
            const LensTile pixels(values, voxel, bend, outline, cell, lens, tile, ray);
            pixels.write((int)in_memory(rows.low, lens), (int)in_memory(rows.high, lens), out);
        }
    }
}

/// Device arrays of blocks, and where each voxel's blocks and values begin, shape (voxel + 1,).
struct BlockArrays {
    const int* first_block;
    const int* first_value;
    int* ray;
    unsigned char* height;
    unsigned char* width;
    unsigned char* value;
};

/// Return the arrays from Warp's struct.
template <class Blocks>
LFPIV_INLINE BlockArrays block_arrays(const Blocks& blocks) {
    return {blocks.first_block.data, blocks.first_value.data, blocks.ray.data,
            blocks.height.data,      blocks.width.data,       blocks.value.data};
}

/// Compute the blocks of a voxel where there is room for them, without gaps from block to block.
LFPIV_INLINE void fill(const WeightInputs& in, const Outline& outline, int index, const BlockArrays& room,
                       float* scale_out, int* blocks_out, int* bytes_out) {
    const Voxel voxel(in, index);
    ReachedLenses reached(voxel);
    const Top top(voxel);
    const Bend bend(voxel);
    scale_out[index] = reached.count > 0 ? top.scale(voxel) : 0.0f;
    const int first_block = room.first_block[index], last_block = room.first_block[index + 1];
    unsigned char* const first_value = room.value + room.first_value[index];
    unsigned char* const end = room.value + room.first_value[index + 1];
    BlockWriter out = {room.ray,   room.height, room.width, first_block,
                       last_block, first_value, end,        (int)in.geometry->edge};
    for (int n = 0; n < reached.count; n += WIDTH) {
        Lenses lenses;
        PixelBox box;
        reached.take(lenses);
        const M lit = reached.pixel_box(reached.count - n, lenses, box);
        if (any(lit)) fill_group(LensGroup(voxel, lenses, box), top, bend, outline, lit, out);
    }
    blocks_out[index] = out.block - first_block;
    bytes_out[index] = (int)(out.value - first_value);
}

/// Copy the blocks of a voxel to where they lie without gaps.
LFPIV_INLINE void pack(const BlockArrays& from, const BlockArrays& to, int voxel) {
    const int from_block = from.first_block[voxel], to_block = to.first_block[voxel];
    const int blocks = to.first_block[voxel + 1] - to_block;
    for (int k = 0; k < blocks; ++k) {
        to.ray[to_block + k] = from.ray[from_block + k];
        to.height[to_block + k] = from.height[from_block + k];
        to.width[to_block + k] = from.width[from_block + k];
    }
    const unsigned char* value = from.value + from.first_value[voxel];
    unsigned char* out = to.value + to.first_value[voxel];
    const int values = to.first_value[voxel + 1] - to.first_value[voxel];
    for (int k = 0; k < values; ++k) out[k] = value[k];
}

}  // namespace lfpiv

#endif
