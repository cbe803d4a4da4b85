// A camera's weights as products of profiles that whole planes of voxels share, against the light of its rays. For the
// CPU; a GPU has ``separable_gpu.h``.
#ifndef LFPIV_SEPARABLE_H
#define LFPIV_SEPARABLE_H

#include "separable_layout.h"

namespace lfpiv {

/// Lenses of a strip whose rays are computed together.
constexpr int LENS_BLOCK = 16;
/// Most values of the profiles across of a lens.
constexpr int MOST_VALUES = 4096;

using Lane = Floats<STRIP>;
static_assert(STRIP == COLUMN_BLOCK, "blocks of a plane are turned");

/// What one plane is to one strip: the profiles across of its lenses.
struct Across {
    int lens, count, taps, pixels;
    const short* first;
    const unsigned char* level;

    LFPIV_INLINE Across(const SeparableArrays& in, int plane, int strip) {
        const int at = plane * in.strips + strip;
        lens = in.lens[at], count = in.lens_count[at], taps = in.taps[at], pixels = in.pixels;
        first = in.first + in.first_start[at], level = in.level + in.level_start[at];
    }
    LFPIV_INLINE const short* first_of(int i) const { return first + (i - lens) * pixels; }
    /// Write the values of a lens, whole vectors of them: some more than there are.
    LFPIV_INLINE const float* values_of(int i, float* out) const {
        const int size = pixels * taps * PARTS;
        const unsigned char* const from = level + (int64_t)(i - lens) * size;
        for (int k = 0; k < size; k += STRIP) store(out + k, load_bytes<STRIP>(from + k));
        return out;
    }
    /// Widen the range of columns that a lens's rays see. They follow each other from the first pixel to the last one.
    LFPIV_INLINE void widen(int i, int& low, int& high) const {
        const short* const from = first_of(i);
        const int one = from[0], other = from[pixels - 1];
        low = min(low, min(one, other)), high = max(high, max(one, other) + taps);
    }
};

/// The profiles down of a plane's columns for one ray row and strip.
struct Down {
    int taps;
    float scale;
    const short* first;
    const unsigned char* level;

    LFPIV_INLINE Down(const SeparableArrays& in, int plane, int ray_row, int strip) {
        const int64_t at = (((int64_t)plane * in.ray_rows + ray_row) * in.strips + strip) * in.blocks * STRIP;
        const int64_t here = ((int64_t)ray_row * in.strips + strip) * in.blocks * STRIP;
        taps = in.down_taps[plane], scale = in.down_scale[plane];
        first = in.down_first + at;
        level = in.down + in.down_start[plane] + here * taps * COLUMN_BLOCK;
    }
};

/// How lines are moved along their columns, a lane each: a line at column k becomes the sum of those at k - 1, k, k
/// + 1.
struct Turn {
    Lane before, here, behind;
    bool none;

    LFPIV_INLINE Turn(const SeparableArrays& in, int plane, int ray_row, int strip) {
        const float* const turn = in.turn + 2 * (plane * in.strips + strip);
        Lane along;
        float largest = 0.0f;
        for (int k = 0; k < STRIP; ++k) {
            const float row = (float)ray_row + 0.5f - in.middle[strip * STRIP + k];
            const float moved = turn[0] * ((float)(k / PARTS) - 0.5f * (STRIP / PARTS - 1)) + turn[1] * row;
            along[k] = moved;
            largest = max(largest, moved < 0.0f ? -moved : moved);
        }
        none = largest < 1e-3f;
        before = 0.5f * along * (along + 1.0f), here = 1.0f - along * along, behind = 0.5f * along * (along - 1.0f);
    }
};

/// Swap parts of `WIDE` lanes between vectors that lie `WIDE` apart: one stage of `transpose`.
#define LFPIV_SWAP(WIDE, ...)                                 \
    for (int n = 0; n < STRIP; ++n) {                         \
        if (n & WIDE) continue;                               \
        const Lane one = square[n], other = square[n + WIDE]; \
        square[n] = __builtin_shufflevector(one, other, __VA_ARGS__);

/// Turn a square of vectors: lane k of vector n becomes lane n of vector k.
LFPIV_INLINE void transpose(Lane* square) {
    static_assert(STRIP == 16, "lanes below");
    LFPIV_SWAP(8, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
    square[n + 8] = __builtin_shufflevector(one, other, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
}
LFPIV_SWAP(4, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27)
square[n + 4] = __builtin_shufflevector(one, other, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
}
LFPIV_SWAP(2, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
square[n + 2] = __builtin_shufflevector(one, other, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
}
LFPIV_SWAP(1, 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30)
square[n + 1] = __builtin_shufflevector(one, other, 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
}
}
#undef LFPIV_SWAP

/// Read `count` voxels of a block of columns; the other lanes are 0.
LFPIV_INLINE Lane load_voxels(const float* from, int count) {
    if (count >= COLUMN_BLOCK) return load<COLUMN_BLOCK>(from);
    Lane lanes = {};
    for (int k = 0; k < count; ++k) lanes[k] = from[k];
    return lanes;
}

/// Columns of a plane, whole blocks of them.
struct ColumnBlocks {
    int begin, end;

    /// The blocks that hold columns from `low` to before `high` and the neighbours of these.
    LFPIV_INLINE ColumnBlocks(const SeparableArrays& in, int low, int high)
        : begin(max(low - 1, 0) / COLUMN_BLOCK), end(min((high + COLUMN_BLOCK) / COLUMN_BLOCK, in.blocks)) {}
    LFPIV_INLINE int first() const { return begin * COLUMN_BLOCK; }
    LFPIV_INLINE int last() const { return end * COLUMN_BLOCK; }
};

/// Write some columns of a plane's line in one ray row.
LFPIV_INLINE void sum_down(const SeparableArrays& in, const float* volume, int plane, int ray_row, int strip,
                           const ColumnBlocks& some, float* out) {
    const Down down(in, plane, ray_row, strip);
    for (int block = some.begin; block < some.end; ++block) {
        const int column = block * COLUMN_BLOCK, count = in.columns - column;
        const short* const first = down.first + block * STRIP;
        const unsigned char* level = down.level + (int64_t)block * STRIP * down.taps * COLUMN_BLOCK;
        Lane square[STRIP];
        for (int k = 0; k < STRIP; ++k, level += down.taps * COLUMN_BLOCK) {
            square[k] = Lane{};
            if (first[k] < 0) continue;
            const float* voxels =
                volume + (int64_t)first[k] * in.row_stride + (int64_t)plane * in.plane_stride + column;
            const int taps = min(down.taps, in.rows - first[k]);
            for (int t = 0; t < taps; ++t, voxels += in.row_stride)
                square[k] += load_bytes<COLUMN_BLOCK>(level + t * COLUMN_BLOCK) * load_voxels(voxels, count);
        }
        transpose(square);
        for (int k = 0; k < COLUMN_BLOCK; ++k) store(out + (column + k) * STRIP, square[k] * down.scale);
    }
}

/// Add the adjoint of `sum_down` to the voxels of a plane.
LFPIV_INLINE void sum_up(const SeparableArrays& in, const float* line, int plane, int ray_row, int strip,
                         const ColumnBlocks& some, float* volume_out) {
    const Down down(in, plane, ray_row, strip);
    for (int block = some.begin; block < some.end; ++block) {
        const int column = block * COLUMN_BLOCK, count = in.columns - column;
        const short* const first = down.first + block * STRIP;
        const unsigned char* level = down.level + (int64_t)block * STRIP * down.taps * COLUMN_BLOCK;
        Lane square[COLUMN_BLOCK];
        for (int k = 0; k < COLUMN_BLOCK; ++k) square[k] = load<STRIP>(line + (column + k) * STRIP) * down.scale;
        transpose(square);
        for (int k = 0; k < STRIP; ++k, level += down.taps * COLUMN_BLOCK) {
            if (first[k] < 0) continue;
            float* voxels = volume_out + (int64_t)first[k] * in.row_stride + (int64_t)plane * in.plane_stride + column;
            const int taps = min(down.taps, in.rows - first[k]);
            for (int t = 0; t < taps; ++t, voxels += in.row_stride) {
                const Lane light = load_bytes<COLUMN_BLOCK>(level + t * COLUMN_BLOCK) * square[k];
                if (count >= COLUMN_BLOCK)
                    store(voxels, load<COLUMN_BLOCK>(voxels) + light);
                else
                    for (int n = 0; n < count; ++n) voxels[n] += light[n];
            }
        }
    }
}

/// Move some columns of a line. Those beside them count as dark.
LFPIV_INLINE void move_along(const Turn& turn, const ColumnBlocks& some, float* line) {
    Lane before = {}, here = load<STRIP>(line + some.first() * STRIP);
    for (int k = some.first(); k < some.last(); ++k) {
        const Lane next = k + 1 < some.last() ? load<STRIP>(line + (k + 1) * STRIP) : Lane{};
        store(line + k * STRIP, turn.before * before + turn.here * here + turn.behind * next);
        before = here, here = next;
    }
}
/// The adjoint of `move_along`.
LFPIV_INLINE void move_back(const Turn& turn, const ColumnBlocks& some, float* line) {
    Lane before = {}, here = load<STRIP>(line + some.first() * STRIP);
    for (int k = some.first(); k < some.last(); ++k) {
        const Lane next = k + 1 < some.last() ? load<STRIP>(line + (k + 1) * STRIP) : Lane{};
        store(line + k * STRIP, turn.before * next + turn.here * here + turn.behind * before);
        before = here, here = next;
    }
}

/// Compute some columns of a plane's line.
LFPIV_INLINE void see_line(const SeparableArrays& in, const float* volume, int plane, int ray_row, int strip,
                           const ColumnBlocks& some, float* line) {
    const Turn turn(in, plane, ray_row, strip);
    sum_down(in, volume, plane, ray_row, strip, some, line);
    if (!turn.none) move_along(turn, some, line);
}

/// The adjoint of `see_line`: add what a line got to the voxels of a plane. Overwrites the line.
LFPIV_INLINE void return_line(const SeparableArrays& in, int plane, int ray_row, int strip, const ColumnBlocks& some,
                              float* line, float* volume_out) {
    const Turn turn(in, plane, ray_row, strip);
    if (!turn.none) move_back(turn, some, line);
    sum_up(in, line, plane, ray_row, strip, some, volume_out);
}

/// Read the value of each part, in the lanes of its rows.
LFPIV_INLINE Lane load_parts(const float* value) {
    static_assert(PARTS == 2 && STRIP == 16, "lanes below");
    const Floats<2> parts = load<2>(value);
    return __builtin_shufflevector(parts, parts, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1);
}

/// Add the light of a line to the rays of one lens, `TAPS` columns to a pixel.
template <int TAPS>
LFPIV_INLINE void add_across(const float* line, const short* first, const float* value, int pixels, float* out) {
    for (int c = 0; c < pixels; ++c, value += TAPS * PARTS, out += STRIP) {
        const float* const from = line + first[c] * STRIP;
        Lane even = load<STRIP>(out), odd = {};
        for (int t = 0; t + 1 < TAPS; t += 2) {
            even += load_parts(value + t * PARTS) * load<STRIP>(from + t * STRIP);
            odd += load_parts(value + (t + 1) * PARTS) * load<STRIP>(from + (t + 1) * STRIP);
        }
        if (TAPS % 2) even += load_parts(value + (TAPS - 1) * PARTS) * load<STRIP>(from + (TAPS - 1) * STRIP);
        store(out, even + odd);
    }
}
/// Add the light of the rays of one lens to a line: the adjoint of `add_across`. Pixels that see the same columns are
/// summed before.
template <int TAPS>
LFPIV_INLINE void gather_across(const float* rays, const short* first, const float* value, int pixels, float* line) {
    Lane sum[TAPS] = {};
    int column = first[0];
    for (int c = 0; c < pixels; ++c, value += TAPS * PARTS, rays += STRIP) {
        if (first[c] != column) {
            for (int t = 0; t < TAPS; ++t) {
                float* const at = line + (column + t) * STRIP;
                store(at, load<STRIP>(at) + sum[t]);
                sum[t] = Lane{};
            }
            column = first[c];
        }
        const Lane light = load<STRIP>(rays);
        for (int t = 0; t < TAPS; ++t) sum[t] += load_parts(value + t * PARTS) * light;
    }
    for (int t = 0; t < TAPS; ++t) {
        float* const at = line + (column + t) * STRIP;
        store(at, load<STRIP>(at) + sum[t]);
    }
}

/// A number that is known to the compiler.
template <int N>
struct Number {
    static constexpr int value = N;
};

/// Call work(Number<taps>{}) with the number of taps, from 1 to `MOST_TAPS`.
template <int N = 1, class Work>
LFPIV_INLINE void with_taps(int taps, Work work) {
    if (taps == N)
        work(Number<N>{});
    else if constexpr (N < MOST_TAPS)
        with_taps<N + 1>(taps, work);
}

/// Return a ray's rim.
LFPIV_INLINE Lane rim_of(const signed char* rim) {
    using Bytes = signed char __attribute__((vector_size(STRIP), aligned(1)));
    return __builtin_convertvector(*(const Bytes*)rim, Lane) * (1.0f / RIM_LEVELS);
}

/// Project a volume to the rays of some lenses in one ray row of a strip; `lines` is memory of a line for each plane.
LFPIV_INLINE void project_segment(const SeparableArrays& in, const float* volume, int ray_row, int strip, int begin,
                                  int end, float* lines, float* rays_out) {
    const int size = line_size(in);
    for (int plane = 0; plane < in.planes; ++plane) {
        const Across across(in, plane, strip);
        const int from = max(begin, across.lens), to = min(end, across.lens + across.count);
        if (from >= to) continue;
        int low = in.columns, high = 0;
        across.widen(from, low, high), across.widen(to - 1, low, high);
        see_line(in, volume, plane, ray_row, strip, ColumnBlocks(in, low, high), lines + (int64_t)plane * size);
    }
    const int64_t lens_rays = (int64_t)in.pixels * STRIP;
    const int64_t start = ((int64_t)ray_row * in.strips + strip) * in.lenses;
    float values[MOST_VALUES];
    for (int block = begin; block < end; block += LENS_BLOCK) {
        const int last = min(block + LENS_BLOCK, end);
        float* const out = rays_out + (start + block) * lens_rays;
        for (int64_t k = 0; k < (last - block) * lens_rays; k += STRIP) store(out + k, Lane{});
        for (int plane = 0; plane < in.planes; ++plane) {
            const Across across(in, plane, strip);
            const float* const line = lines + (int64_t)plane * size;
            const int from = max(block, across.lens), to = min(last, across.lens + across.count);
            with_taps(across.taps, [&](auto taps) {
                for (int i = from; i < to; ++i)
                    add_across<taps.value>(line, across.first_of(i), across.values_of(i, values), in.pixels,
                                           out + (i - block) * lens_rays);
            });
        }
        const signed char* rim = in.rim + (start + block) * lens_rays;
        for (int i = block; i < last; ++i, rim += lens_rays) {  // the middle of what lies inside the pupil
            float* const ray = out + (i - block) * lens_rays;
            Lane before = {}, here = load<STRIP>(ray);
            for (int c = 0; c < in.pixels; ++c) {
                const Lane next = c + 1 < in.pixels ? load<STRIP>(ray + (c + 1) * STRIP) : Lane{};
                store(ray + c * STRIP, here + rim_of(rim + c * STRIP) * (next - before));
                before = here, here = next;
            }
        }
    }
}

/// Write the adjoint of the rim on the rays of one lens.
LFPIV_INLINE void turn_back_rim(const SeparableArrays& in, int64_t lens, const float* rays, float* out) {
    const int64_t lens_rays = (int64_t)in.pixels * STRIP;
    const float* const ray = rays + lens * lens_rays;
    const signed char* const rim = in.rim + lens * lens_rays;
    for (int c = 0; c < in.pixels; ++c) {
        Lane light = load<STRIP>(ray + c * STRIP);
        if (c > 0) light += rim_of(rim + (c - 1) * STRIP) * load<STRIP>(ray + (c - 1) * STRIP);
        if (c + 1 < in.pixels) light -= rim_of(rim + (c + 1) * STRIP) * load<STRIP>(ray + (c + 1) * STRIP);
        store(out + c * STRIP, light);
    }
}

/// Add the weighted sum of the light of rays to the voxels of one plane. `turned` are the rays of some ray rows and
/// strips with the rim turned back: rays[row][strip][lens][pixel column][lens row]. `line` is memory of one line. All
/// rows of a strip follow each other, so that the voxels that it sees stay in the caches.
template <class Part>
LFPIV_INLINE void gather_plane(const SeparableArrays& in, const float* turned, const Part& part, int plane, float* line,
                               float* volume_out) {
    const int64_t lens_rays = (int64_t)in.pixels * STRIP;
    float values[MOST_VALUES];
    for (int k = 0; k < part.strips; ++k) {
        const int strip = part.first_strip + k;
        const Across across(in, plane, strip);
        if (across.count == 0) continue;
        int low = in.columns, high = 0;
        across.widen(across.lens, low, high), across.widen(across.lens + across.count - 1, low, high);
        const ColumnBlocks some(in, low, min(high, in.columns));
        for (int n = 0; n < part.rows; ++n) {
            const float* const rays = turned + ((int64_t)n * part.strips + k) * in.lenses * lens_rays;
            for (int at = 0; at < line_size(in); at += STRIP) store(line + at, Lane{});
            with_taps(across.taps, [&](auto taps) {
                for (int i = across.lens; i < across.lens + across.count; ++i)
                    gather_across<taps.value>(rays + i * lens_rays, across.first_of(i), across.values_of(i, values),
                                              in.pixels, line);
            });
            return_line(in, plane, part.first_row + n * part.step, strip, some, line, volume_out);
        }
    }
}

}  // namespace lfpiv

#endif
