// The area-integrated weights of a voxel as 8-bit blocks of rays: how much room they need, and the blocks themselves.
#ifndef LFPIV_FOOTPRINT_H
#define LFPIV_FOOTPRINT_H

#include "lens_group.h"
#include "microimages.h"

namespace lfpiv {

/// Rows of a block at most.
constexpr int TALLEST = 64;
static_assert(TALLEST % ROW_GROUP == 0, "the tallest block needs no filling");
/// Heights of blocks of profiles, in groups of rows, none included.
constexpr int HEIGHTS = 17;
static_assert(HEIGHTS == TALLEST / ROW_GROUP + 1, "one for each height");
/// Parts of a voxel at most.
constexpr int MOST_PARTS = 64;
/// Steps of a cell's outline at most.
constexpr int MOST_STEPS = 8;

/// Blocks and bytes of values that some lenses need at most for the pixels in their boxes.
struct Room {
    V blocks, bytes, tiles;

    LFPIV_INLINE Room(const WeightInputs& in, const PixelBox& box, M lit) {
        tiles = floor((box.last_column - box.first_column + (float)BLOCK_WIDTH) / (float)BLOCK_WIDTH);
        const V rows = box.last_row - box.first_row + 1.0f, none = V{};
        const V parts = floor((rows + (float)(TALLEST - 1)) / (float)TALLEST);
        const V filled = rows + parts * (float)(BLOCK_WIDTH + ROW_GROUP - 1);
        const V values = in.profiles ? tiles * filled : tiles * rows * (float)BLOCK_WIDTH;
        blocks = lit ? tiles * parts : none, bytes = lit ? values : none;
    }
};
/// Bytes behind the last value that a vector may be stored to.
constexpr int PAST_VALUES = 2 * BLOCK_WIDTH;

/// Count the lenses that a voxel reaches, and the blocks and the bytes of values that it needs at most.
LFPIV_INLINE void measure(const WeightInputs& in, int index, int* lenses_out, int* blocks_out, int* bytes_out) {
    const Voxel voxel(in, index);
    ReachedLenses reached(voxel);
    int blocks = 0, bytes = 0;
    for (int n = 0; n < reached.count; n += WIDTH) {
        Lenses lenses;
        PixelBox box;
        reached.take(lenses);
        const M lit = reached.pixel_box(reached.count - n, lenses, box);
        if (!any(lit)) continue;
        const Room room(in, box, lit);
        for (int k = 0; k < WIDTH; ++k) {
            blocks += (int)lane(room.blocks, k);
            bytes += (int)lane(room.bytes, k);
            if (LFPIV_GPU) bytes += PAST_VALUES * (int)lane(room.tiles, k);  // each tile has room of its own there
        }
    }
    lenses_out[index] = reached.count;
    blocks_out[index] = blocks;
    bytes_out[index] = bytes + PAST_VALUES;
}

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

#if LFPIV_GPU

/// Steps of the cell's outline, and offsets of the voxel's parts, under one lens: computed wherever they are used, for
/// a thread has no memory for tables.
struct CellParts {
    const LensValues& values;
    const Voxel& voxel;
    const Outline& outline;

    LFPIV_INLINE CellParts(const LensValues& values, const Voxel& voxel, const Outline& outline, int)
        : values(values), voxel(voxel), outline(outline) {}

    LFPIV_INLINE Smear<float> step_a(int q) const {
        return smear_of(2.0f * outline.extent[2 * q], values.wide_a, values.smear_a.narrow, values.smear_a.bend);
    }
    LFPIV_INLINE Smear<float> step_b(int q) const {
        return smear_of(2.0f * outline.extent[2 * q + 1], values.wide_b, values.smear_b.narrow, values.smear_b.bend);
    }
    LFPIV_INLINE float part_a(int part) const {
        const V* e = values.edge;
        return voxel.parts == 1 ? 0.0f : middle_of_part_rounded(voxel.in.cuts, part, e[0], e[1], e[2]);
    }
    LFPIV_INLINE float part_b(int part) const {
        const V* e = values.edge + 3;
        return voxel.parts == 1 ? 0.0f : middle_of_part(voxel.in.cuts, part, e[0], e[1], e[2]);
    }
};

#else

/// Steps of the cell's outline, and offsets of the voxel's parts, under one lens.
class CellParts {
    Smear<float> steps_a[MOST_STEPS], steps_b[MOST_STEPS];
    float parts_a[MOST_PARTS], parts_b[MOST_PARTS];

public:
    LFPIV_INLINE CellParts(const LensValues& values, const Voxel& voxel, const Outline& outline, int lens) {
        for (int q = 0; !outline.square && q < outline.steps; ++q) {
            const float width = 2.0f * outline.extent[2 * q], height = 2.0f * outline.extent[2 * q + 1];
            const Smear<float> a = values.one(values.smear_a, lens), b = values.one(values.smear_b, lens);
            steps_a[q] = smear_of(width, in_memory(values.wide_a, lens), a.narrow, a.bend);
            steps_b[q] = smear_of(height, in_memory(values.wide_b, lens), b.narrow, b.bend);
        }
        parts_a[0] = parts_b[0] = 0.0f;
        if (voxel.parts == 1) return;
        float e[6];
        for (int n = 0; n < 6; ++n) e[n] = in_memory(values.edge[n], lens);
        for (int part = 0; part < voxel.parts; ++part) {
            parts_a[part] = middle_of_part_rounded(voxel.in.cuts, part, e[0], e[1], e[2]);
            parts_b[part] = middle_of_part(voxel.in.cuts, part, e[3], e[4], e[5]);
        }
    }

    LFPIV_INLINE const Smear<float>& step_a(int q) const { return steps_a[q]; }
    LFPIV_INLINE const Smear<float>& step_b(int q) const { return steps_b[q]; }
    LFPIV_INLINE float part_a(int part) const { return parts_a[part]; }
    LFPIV_INLINE float part_b(int part) const { return parts_b[part]; }
};

#endif

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
    const float inside;      // distance from the pupil's centre up to which its edge cuts no pixel [pixel]
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
          inside(voxel.camera.radius / voxel.pupil_pixel - 0.5f),
          to_a(in_memory(values.to_a, lens)),
          smear_a(values.one(values.smear_a, lens)),
          smear_b(values.one(values.smear_b, lens)) {}

    /// Return the lens's part of a value.
    LFPIV_INLINE float of(const V& x) const { return in_memory(x, lens); }

    /// Return the profile along the columns in levels, from column x of the tile on.
    LFPIV_INLINE V level_across(int x) const {
        const V from = lane_numbers(1, 8) + (column0 + (float)x - of(values.column));
        const V level = smeared(of(values.a) - from * of(values.step_a), smear_a) * to_a + 0.5f;
        return min(level, splat(LEVELS));
    }
    /// Return the profile along the rows in levels, from a row of the box on.
    LFPIV_INLINE V level_down(int row) const {
        const V from = lane_numbers(1, WIDTH) + ((float)row - of(values.row));
        const V level = smeared(of(values.b) - from * of(values.step_b), smear_b) * of(values.to_b) + 0.5f;
        return min(level, splat(LEVELS));
    }

#if LFPIV_GPU

    /// Return the profile along the columns, a byte each.
    LFPIV_INLINE uint64_t profile_across() const {
        uint64_t word = 0;
        for (int x = 0; x < 8; ++x) word |= (uint64_t)(unsigned char)level_across(x) << (8 * x);
        return word & columns;
    }

    /// Write the block of rows from `first` on as two profiles. Nothing is written where all weights round to zero. The
    /// levels along the rows are computed twice: to find the lit ones, and to write them.
    LFPIV_INLINE void write_profiles(uint64_t across, int first, int height, BlockWriter& out) const {
        int top = -1, bottom = -1;
        for (int y = 0; y < height; ++y) {
            if (level_down(first + y) < 1.0f) continue;
            bottom = y;
            if (top < 0) top = y;
        }
        if (top < 0) return;
        const int left = lowest_bit(across) / 8, lit = bottom - top + 1;
        const int rows = (lit + ROW_GROUP - 1) / ROW_GROUP * ROW_GROUP;
        store_word(out.value, across >> (8 * left));
        out.value += BLOCK_WIDTH;
        for (int y = 0; y < rows; ++y) out.value[y] = y < lit ? (unsigned char)level_down(first + top + y) : 0;
        out.value += rows;
        out.finish(ray, first + top, left, rows, BLOCK_WIDTH);
    }

#else

    /// Return the profile along the columns, a byte each.
    LFPIV_INLINE uint64_t profile_across() const {
        unsigned char level[WIDTH < 8 ? 8 : WIDTH];
        for (int x = 0; x < 8; x += ACROSS) store_bytes(level + x, level_across(x));
        return load_word(level) & columns;
    }

    /// Write the block of rows from `first` on as two profiles. Nothing is written where all weights round to zero.
    LFPIV_INLINE void write_profiles(uint64_t across, int first, int height, BlockWriter& out) const {
        unsigned char level[TALLEST + 24] = {};
        int top = -1, bottom = -1;
        for (int y = 0; y < height; y += WIDTH) store_bytes(level + y, level_down(first + y));
        for (int y = 0; y < height; y += 8) {
            const uint64_t word = load_word(level + y) & bytes_below(height - y);
            if (!word) continue;
            bottom = y + highest_bit(word) / 8;
            if (top < 0) top = y + lowest_bit(word) / 8;
        }
        if (top < 0) return;
        const int left = lowest_bit(across) / 8, lit = bottom - top + 1;
        const int rows = (lit + ROW_GROUP - 1) / ROW_GROUP * ROW_GROUP;
        store_word(out.value, across >> (8 * left));
        out.value += BLOCK_WIDTH;
        for (int y = 0; y < lit; y += 8) store_word(out.value + y, load_word(level + top + y) & bytes_below(lit - y));
        if ((lit - 1) / 8 != (rows - 1) / 8) store_word(out.value + rows / 8 * 8, 0);
        out.value += rows;
        out.finish(ray, first + top, left, rows, BLOCK_WIDTH);
    }

#endif

    /// Return the probability, times the widest smears, that rays at (a, b) lie in the lens's cell.
#if LFPIV_GPU
    LFPIV_INLINE V inside_cell(V a, V b) const {
        V inside = 0.0f;
        for (int part = 0; part < voxel.parts; ++part) {
            V lower = 0.0f;
            for (int q = 0; q < outline.steps; ++q) {  // a square has one, from the middle on
                const V higher = smeared(b - cell.part_b(part), cell.step_b(q));
                inside += smeared(a - cell.part_a(part), cell.step_a(q)) * (higher - lower);
                lower = higher;
            }
        }
        return inside;
    }
#else
    LFPIV_INLINE V inside_cell(V a, V b) const {
        const int parts = voxel.parts;
        if (outline.square && parts == 1) return smeared(a, smear_a) * smeared(b, smear_b);
        V inside = {};
        for (int part = 0; outline.square && part < parts; ++part)
            inside += smeared(a - cell.part_a(part), smear_a) * smeared(b - cell.part_b(part), smear_b);
        for (int part = 0; !outline.square && part < parts; ++part) {
            V lower = {};
            for (int q = 0; q < outline.steps; ++q) {
                const V higher = smeared(b - cell.part_b(part), cell.step_b(q));
                inside += smeared(a - cell.part_a(part), cell.step_a(q)) * (higher - lower);
                lower = higher;
            }
        }
        return inside;
    }
#endif

    /// What the levels of a column of pixels share.
    struct Column {
        V s, t, s_y, t_y, s_yy, t_yy;  // offset on the main lens, its slope and bend along the rows
        V s_x, t_x, s_xy, t_xy;        // its slope along the columns, and the change along the rows
        V n[4], n_y[4];                // matrix from that offset to rays in the lens's cell, its change along the rows
        V away;                        // from the pupil's centre along the columns
    };

    /// Return what the levels of columns x from the reference pixel share.
    LFPIV_INLINE Column column_at(V x) const {
        const V *slope = values.slope, *matrix = values.matrix;
        Column at;
        const LocalBend<V>& local = values.bend;
        at.s = of(values.s) + x * (of(slope[0]) + x * (of(local.s[0]) + x * bend.s3[0]));
        at.t = of(values.t) + x * (of(slope[2]) + x * (of(local.t[0]) + x * bend.t3[0]));
        at.s_y = of(slope[1]) + x * (of(local.s[1]) + x * bend.s3[1]);
        at.t_y = of(slope[3]) + x * (of(local.t[1]) + x * bend.t3[1]);
        at.s_yy = of(local.s[2]) + x * bend.s3[2], at.t_yy = of(local.t[2]) + x * bend.t3[2];
        at.s_x = of(slope[0]) + x * (2.0f * of(local.s[0]) + 3.0f * x * bend.s3[0]);
        at.t_x = of(slope[2]) + x * (2.0f * of(local.t[0]) + 3.0f * x * bend.t3[0]);
        at.s_xy = of(local.s[1]) + 2.0f * x * bend.s3[1], at.t_xy = of(local.t[1]) + 2.0f * x * bend.t3[1];
        at.away = x - of(values.centre_x);
        for (int n = 0; n < 4; ++n) {
            at.n[n] = of(matrix[n]) + x * (of(local.along_column[n]) + x * bend.n_xx[n]);
            at.n_y[n] = of(local.along_row[n]) + x * bend.n_xy[n];
        }
        return at;
    }
    /// Return the levels of pixels of a column, y rows from the reference pixel. A pixel that the pupil's edge cuts has
    /// the weight at the middle of its part inside.
    LFPIV_INLINE V level_in(const Column& at, V y) const {
        V ds = at.s + y * (at.s_y + y * (at.s_yy + y * bend.s3[3]));
        V dt = at.t + y * (at.t_y + y * (at.t_yy + y * bend.t3[3]));
        const V none = {}, away = y - of(values.centre_y), distance = sqrt(at.away * at.away + away * away);
        const V outside = min(max(distance - inside, none), splat(1.0f));
        if (any(outside > 0.0f)) {
            const V inwards = 0.5f * outside / max(distance, splat(1.0f));
            const V s_x = at.s_x + y * (at.s_xy + y * bend.s3[2]), t_x = at.t_x + y * (at.t_xy + y * bend.t3[2]);
            const V s_y = at.s_y + y * (2.0f * at.s_yy + 3.0f * y * bend.s3[3]);
            const V t_y = at.t_y + y * (2.0f * at.t_yy + 3.0f * y * bend.t3[3]);
            ds -= inwards * (at.away * s_x + away * s_y), dt -= inwards * (at.away * t_x + away * t_y);
        }
        const V k0 = at.n[0] + y * (at.n_y[0] + y * bend.n_yy[0]), k1 = at.n[1] + y * (at.n_y[1] + y * bend.n_yy[1]);
        const V k2 = at.n[2] + y * (at.n_y[2] + y * bend.n_yy[2]), k3 = at.n[3] + y * (at.n_y[3] + y * bend.n_yy[3]);
        const V inverse = 1.0f / (k0 * k3 - k1 * k2);
        const V a = (k3 * ds - k1 * dt) * inverse, b = (k0 * dt - k2 * ds) * inverse;
        const V level = abs(inverse) * inside_cell(a, b) * to_a + 0.5f;
        return min(max(level, none), splat(LEVELS));
    }

    /// Write the levels of all pixels of `height` rows, 8 to a row.
    LFPIV_INLINE void write_levels(int first, int height, unsigned char* out) const {
#if LFPIV_GPU
        for (int k = 0; k < 8 * height; ++k) {  // nothing is kept for a column: a thread lacks the registers
            const V x = (float)(k % 8) + (column0 - of(values.column));
            out[k] = (unsigned char)level_in(column_at(x), (float)(first + k / 8) - of(values.row));
        }
#else
        const V lane_column = lane_numbers(1, 8), lane_row = lane_numbers(8, WIDTH);
        for (int c = 0; c < 8; c += ACROSS) {
            const Column at = column_at(lane_column + (column0 + (float)c - of(values.column)));
            for (int row = 0; row < height; row += DOWN)
                store_bytes(out + 8 * row + c, level_in(at, lane_row + ((float)(first + row) - of(values.row))));
        }
#endif
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
            const int needed = (profiles ? 8 + height + ROW_GROUP - 1 : 8 * height) + BLOCK_WIDTH;
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

/// Write the blocks of one tile of the pixels under a group of lenses.
LFPIV_INLINE void fill_tile(const LensGroup& group, const Tile& rows, const LensValues& values, const Bend& bend,
                            const Outline& outline, int tile, BlockWriter& out) {
    const Voxel& voxel = group.voxel;
    for (unsigned live = rows.lit(); live; live &= live - 1) {
        const int lens = lowest_bit(live), layer = (int)in_memory(rows.layer, lens);
        const int ray = first_ray(voxel.in, group.lenses, values, lens, layer) + tile * BLOCK_WIDTH;
        const CellParts cell(values, voxel, outline, lens);
        const LensTile pixels(values, voxel, bend, outline, cell, lens, tile, ray);
        pixels.write((int)in_memory(rows.low, lens), (int)in_memory(rows.high, lens), out);
    }
}

/// Write the blocks of the pixels under one group of lenses.
LFPIV_INLINE void fill_group(const LensGroup& group, const Top& top, const Bend& bend, const Outline& outline, M lit,
                             BlockWriter& out) {
    const LensValues values(group, top, bend, lit);
    for (int tile = 0;; ++tile) {
        const M here = values.columns > (float)(tile * BLOCK_WIDTH);
        if (!any(here)) break;
        fill_tile(group, Tile(group, here, (float)(tile * BLOCK_WIDTH)), values, bend, outline, tile, out);
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
    const Top top(voxel, reached.slope);
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

/// Where the blocks of a voxel go: those of even lenses before those of odd ones; of these, profiles by their height.
struct BlockOrder {
    const bool profiles;
    const int lens_rays, lenses_i;

    LFPIV_INLINE BlockOrder(bool profiles, int edge, int lenses_i)
        : profiles(profiles), lens_rays(edge * edge), lenses_i(lenses_i) {}

    /// Return the place of a block's lens and height in the order.
    LFPIV_INLINE int place(int ray, int height) const {
        const int lens = ray / lens_rays, row = lens / lenses_i;
        const int odd = (lens - row * lenses_i + row / LAYERS) & 1;
        return odd * HEIGHTS + (profiles ? height / ROW_GROUP : 0);
    }

    /// Return the bytes of a block's values.
    LFPIV_INLINE int bytes(int height, int width) const { return profiles ? height + width : height * width; }
};

/// Copy the blocks of a voxel in their order to where they lie without gaps.
LFPIV_INLINE void pack(const BlockArrays& from, const BlockArrays& to, int voxel, bool profiles, int edge, int lenses_i,
                       int* even_blocks_out, int* even_values_out) {
    const BlockOrder order(profiles, edge, lenses_i);
    int block_of[2 * HEIGHTS + 1] = {}, value_of[2 * HEIGHTS + 1] = {};
    const int from_block = from.first_block[voxel], to_block = to.first_block[voxel];
    const int blocks = to.first_block[voxel + 1] - to_block;
    for (int k = from_block; k < from_block + blocks; ++k) {
        const int place = order.place(from.ray[k], from.height[k]);
        block_of[place + 1] += 1;
        value_of[place + 1] += order.bytes(from.height[k], from.width[k]);
    }
    for (int place = 0; place < 2 * HEIGHTS; ++place) {
        block_of[place + 1] += block_of[place];
        value_of[place + 1] += value_of[place];
    }
    even_blocks_out[voxel] = block_of[HEIGHTS];
    even_values_out[voxel] = value_of[HEIGHTS];
    const unsigned char* value = from.value + from.first_value[voxel];
    for (int k = from_block; k < from_block + blocks; ++k) {
        const int height = from.height[k], width = from.width[k], bytes = order.bytes(height, width);
        const int place = order.place(from.ray[k], height), block = to_block + block_of[place]++;
        to.ray[block] = from.ray[k];
        to.height[block] = (unsigned char)height;
        to.width[block] = (unsigned char)width;
        unsigned char* out = to.value + to.first_value[voxel] + value_of[place];
        for (int n = 0; n < bytes; ++n) out[n] = value[n];
        value_of[place] += bytes;
        value += bytes;
    }
}

}  // namespace lfpiv

#endif
