"""A voxel's ray model in C++: where its rays go, how wide they smear, which pixels under which lenses they can reach.

The functions are lambdas for the body of a ``wp.func_native``, on floats or on vectors `V` of `W` lenses side by side:
as many as the CPU's registers hold, one on a GPU, where every thread has a voxel of its own.
"""

import taichi as ti

LANES = 8
"""Largest width of a block [pixel]: one vector load."""
MODEL_SIZE = 30
"""Floats of a voxel's ray model: 6 polynomial coefficients (1, u, v, uu, uv, vv) of s, 6 of t [mm], the projected
voxel edges along x, y, z as (s, t) [mm], and their change with the pupil point, (s_u, s_v, t_u, t_v) along x, y, z."""
LEVELS = 255.0
"""Largest 8-bit value."""
NARROWEST = 1e-4
"""Smallest smear, in pitches or mm; keeps the closed form finite."""

Camera = ti.types.vector(8, ti.f32)
"""r = f_m/s_i, pixel [mm], columns / 2, rows / 2, pupil radius [mm], columns, rows, edge of a microimage [pixel]."""

GEOMETRY_SIZE = 23
"""Floats of a camera's geometry: `Camera`, ``lattice.Lattice``, half extent of a lens's cell along s and t [mm], and
the matrix ``lattice.cell_frame``, row by row."""

VECTORS = """
#if defined(__CUDA_ARCH__)
    typedef float V;
    typedef int M;
    enum { W = 1 };
    auto splat = [](float x) { return x; };
    auto any = [](M m) { return m != 0; };
    auto put = [](V& v, int k, float x) { v = x; };
    auto at = [](V v, int k) { return v; };
    auto size = [](float x) { return fabsf(x); };
    auto root = [](float x) { return sqrtf(x); };
    auto down = [](float x) { return floorf(x); };
    auto up = [](float x) { return ceilf(x); };
#else
#if defined(__AVX512F__)
    enum { W = 16 };
#else
    enum { W = 8 };
#endif
    typedef float V __attribute__((vector_size(4 * W)));
    typedef int M __attribute__((vector_size(4 * W)));
    auto splat = [](float x) { return V{} + x; };
    auto any = [](M m) { return __builtin_reduce_or(m) != 0; };
    auto put = [](V& v, int k, float x) { v[k] = x; };
    auto at = [](V v, int k) { return v[k]; };
    auto size = [](auto x) { return __builtin_elementwise_abs(x); };
    auto root = [](auto x) { return __builtin_elementwise_sqrt(x); };
    auto down = [](auto x) { return __builtin_elementwise_floor(x); };
    auto up = [](auto x) { return __builtin_elementwise_ceil(x); };
#endif
    auto least = [](auto a, auto b) { return a < b ? a : b; };
    auto most = [](auto a, auto b) { return a > b ? a : b; };
"""
"""Vectors `V` of `W` floats and masks `M`; `size` is the absolute value, `put` and `at` reach one of the floats."""

RAYS = (
    """
    const float* g = geometry.data;
    const float r = g[0], pixel = g[1], half_columns = g[2], half_rows = g[3], radius = g[4];
    const float* lattice = g + 8;
    const float cell = g[18];
    const float* frame = g + 19;
    const float pupil_pixel = pixel / r;
    const float* m = model.data + (int64_t)MODEL_SIZE * voxel;
    const int parts = profiles ? 1 : cuts[0] * cuts[1] * cuts[2];

    // (s, t) of the ray through the pupil point (u, v)
    auto position = [&](auto u, auto v, auto& s, auto& t) {
        s = m[0] + u * (m[1] + u * m[3] + v * m[4]) + v * (m[2] + v * m[5]);
        t = m[6] + u * (m[7] + u * m[9] + v * m[10]) + v * (m[8] + v * m[11]);
    };
    // K = d(s, t)/d(u, v), row by row
    auto slope = [&](auto u, auto v, auto* k) {
        k[0] = m[1] + 2.0f * m[3] * u + m[4] * v;
        k[1] = m[2] + m[4] * u + 2.0f * m[5] * v;
        k[2] = m[7] + 2.0f * m[9] * u + m[10] * v;
        k[3] = m[8] + m[10] * u + 2.0f * m[11] * v;
    };
    // inverse of a 2x2 matrix whose determinant is kept away from zero; returns the inverse's determinant
    auto invert = [&](const auto* k, auto* out) {
        auto det = k[0] * k[3] - k[1] * k[2];
        det = size(det) < 1e-12f ? decltype(det){} + 1e-12f : det;
        const auto inverse = 1.0f / det;
        out[0] = k[3] * inverse;
        out[1] = -k[1] * inverse;
        out[2] = -k[2] * inverse;
        out[3] = k[0] * inverse;
        return inverse;
    };
    // the same of a slope, whose diagonal is kept away from zero
    auto invert_slope = [&](auto* k, auto* out) {
        for (int n = 0; n < 4; n += 3) k[n] = size(k[n]) < 1e-6f ? k[n] + 1e-6f : k[n];
        invert(k, out);
    };
    // projected voxel edge along one axis for the pupil point (u, v)
    auto voxel_edge = [&](int axis, auto u, auto v, auto& s, auto& t) {
        const float* k = m + 18 + 4 * axis;
        s = m[12 + 2 * axis] + k[0] * u + k[1] * v;
        t = m[13 + 2 * axis] + k[2] * u + k[3] * v;
    };
    // the widest of five smears, and one box with the variance of the other four
    auto two_widths = [&](auto a, auto b, auto c, auto d, auto e, auto& wide, auto& narrow) {
        a = size(a), b = size(b), c = size(c), d = size(d), e = size(e);
        const auto widest = most(most(most(a, b), most(c, d)), e);
        const auto variance = a * a + b * b + c * c + d * d + e * e - widest * widest;
        const decltype(a) none = {};
        const auto rest = root(most(variance, none));
        wide = most(most(widest, rest), none + NARROWEST);
        narrow = most(least(widest, rest), none + NARROWEST);
    };
    // half extent of (s, t) around a lens centre within which a ray can still reach the lens,
    // less the tail, a parabola of width b, whose weights round to zero anyway
    auto reach = [&](auto u, auto v, const auto* k, auto* half) {
        auto s = u, t = v;
        decltype(s) edge[2][3];
        for (int axis = 0; axis < 3; ++axis) {
            voxel_edge(axis, u, v, s, t);
            edge[0][axis] = s, edge[1][axis] = t;
        }
        for (int n = 0; n < 2; ++n) {
            auto wide = u, narrow = v;
            const auto *e = edge[n], *along = k + 2 * n;
            auto box = cell * (size(1.0f - along[n]) + size(along[1 - n]));
            if (parts == 1) {
                two_widths(e[0], e[1], e[2], along[0] * pupil_pixel, along[1] * pupil_pixel, wide, narrow);
            } else {  // the outermost parts of the voxel
                two_widths(e[0] / (float)cuts[0], e[1] / (float)cuts[1], e[2] / (float)cuts[2],
                    along[0] * pupil_pixel, along[1] * pupil_pixel, wide, narrow);
                for (int axis = 0; axis < 3; ++axis) box += (0.5f - 0.5f / cuts[axis]) * size(e[axis]);
            }
            const auto inner = least(wide, 2.0f * box);
            const auto tail = root(narrow * inner * (1.0f / LEVELS));
            half[n] = box + 0.5f * (wide + narrow) - least(tail, 0.5f * narrow);
        }
    };

    // rays to first order about the pupil's centre, and bounds of the rest: the inverse slope, the half extent of
    // (s, t) around a lens centre within which a ray can reach the lens, how far the rays spread over the array
    float centre_slope[4], back[4], half[2], spread[2];
    slope(0.0f, 0.0f, centre_slope);
    reach(0.0f, 0.0f, centre_slope, half);
    for (int axis = 0; axis < 3; ++axis) {
        const float* k = m + 18 + 4 * axis;
        half[0] += 0.5f * radius * (size(k[0]) + size(k[1]));
        half[1] += 0.5f * radius * (size(k[2]) + size(k[3]));
    }
    // bounds of the second-order terms per squared distance on the pupil
    const float bend[2] = {size(m[3]) + size(m[4]) + size(m[5]), size(m[9]) + size(m[10]) + size(m[11])};
    float fixed_slope[4];
    for (int n = 0; n < 4; ++n) fixed_slope[n] = centre_slope[n];
    invert_slope(fixed_slope, back);
    for (int n = 0; n < 2; ++n) {
        const float* k = centre_slope + 2 * n;
        half[n] += radius * radius * bend[n];
        spread[n] = radius * root(k[0] * k[0] + k[1] * k[1]);
    }

    // lens indices (i0, i1, j0, j1), ends included, of those the rays can reach; i1 < i0 or j1 < j0 where none are
    int i0 = 0, i1 = -1, j0 = 0, j1 = -1;
    {
        // only as far as the sensor reaches, and one microimage more
        const float margin = 2.0f * r * radius + 2.0f * cell;
        const float limit_s = half_columns * pixel + margin, limit_t = half_rows * pixel + margin;
        const float low_s = most(m[0] - half[0] - spread[0], -limit_s);
        const float high_s = least(m[0] + half[0] + spread[0], limit_s);
        const float low_t = most(m[6] - half[1] - spread[1], -limit_t);
        const float high_t = least(m[6] + half[1] + spread[1], limit_t);
        if (low_s <= high_s && low_t <= high_t) {
            const float s = 0.5f * (low_s + high_s) - lattice[0], t = 0.5f * (low_t + high_t) - lattice[1];
            const float half_s = 0.5f * (high_s - low_s), half_t = 0.5f * (high_t - low_t);
            const float i = lattice[6] * s + lattice[7] * t, j = lattice[8] * s + lattice[9] * t;
            const float di = size(lattice[6]) * half_s + size(lattice[7]) * half_t;
            const float dj = size(lattice[8]) * half_s + size(lattice[9]) * half_t;
            i0 = (int)most(up(i - di), (float)lenses[0]);
            i1 = (int)least(down(i + di), (float)(lenses[0] + lenses[2] - 1));
            j0 = (int)most(up(j - dj), (float)lenses[1]);
            j1 = (int)least(down(j + dj), (float)(lenses[1] + lenses[3] - 1));
        }
    }

    // the next W lenses of the range, which begins again behind its last: their indices, centres and first pixels
    const int reached = i1 < i0 || j1 < j0 ? 0 : (i1 - i0 + 1) * (j1 - j0 + 1);
    int next_i = i0, next_j = j0;
    auto take_lenses = [&](int* lens, int* corner, V& centre_s, V& centre_t, V& first_column, V& first_row) {
        V i, j;
        for (int k = 0; k < W; ++k) {
            const int* at_lens =
                corners.data + 2 * ((int64_t)(next_j - lenses[1]) * lenses[2] + next_i - lenses[0]);
            lens[2 * k] = next_i, lens[2 * k + 1] = next_j;
            corner[2 * k] = at_lens[0], corner[2 * k + 1] = at_lens[1];
            put(i, k, (float)next_i);
            put(j, k, (float)next_j);
            put(first_column, k, (float)at_lens[0]);
            put(first_row, k, (float)at_lens[1]);
            if (++next_i > i1) {
                next_i = i0;
                if (++next_j > j1) next_j = j0;
            }
        }
        centre_s = lattice[0] + i * lattice[2] + j * lattice[4];
        centre_t = lattice[1] + i * lattice[3] + j * lattice[5];
    };

    // Pixels (column0, column1, row0, row1), ends included, under the lenses that the voxel can light, and the pupil
    // point in their middle, inside the pupil. Returns for which lenses, of the first `some`, there are any.
    auto pixel_box = [&](int some, V centre_s, V centre_t, V first_column, V first_row, V* box, V* middle) {
        const float rim = radius + 0.5f * pupil_pixel;
        const V ds = centre_s - m[0], dt = centre_t - m[6];
        const V at_u = back[0] * ds + back[1] * dt, at_v = back[2] * ds + back[3] * dt;
        const float wide_u = size(back[0]) * half[0] + size(back[1]) * half[1];
        const float wide_v = size(back[2]) * half[0] + size(back[3]) * half[1];
        V low_u = most(at_u - wide_u, splat(-rim)), high_u = least(at_u + wide_u, splat(rim));
        V low_v = most(at_v - wide_v, splat(-rim)), high_v = least(at_v + wide_v, splat(rim));
        if (!profiles) {  // once more about the middle of what is left
            V k[4], local[4], near[2], s, t;
            const V u = 0.5f * (low_u + high_u), v = 0.5f * (low_v + high_v);
            const V extent = (high_u - low_u) * (high_u - low_u) + (high_v - low_v) * (high_v - low_v);
            slope(u, v, k);
            reach(u, v, k, near);
            invert_slope(k, local);
            for (int n = 0; n < 2; ++n) near[n] += bend[n] * 0.25f * extent;
            const V about_u = size(local[0]) * near[0] + size(local[1]) * near[1];
            const V about_v = size(local[2]) * near[0] + size(local[3]) * near[1];
            position(u, v, s, t);
            const V middle_u = u - (local[0] * (s - centre_s) + local[1] * (t - centre_t));
            const V middle_v = v - (local[2] * (s - centre_s) + local[3] * (t - centre_t));
            low_u = most(low_u, middle_u - about_u), high_u = least(high_u, middle_u + about_u);
            low_v = most(low_v, middle_v - about_v), high_v = least(high_v, middle_v + about_v);
        }
        const V from_s = (1.0f + r) * centre_s, from_t = (1.0f + r) * centre_t, zero = splat(0.0f);
        const float last = g[7] - 1.0f;
        box[0] = most(most(up((from_s - r * high_u) / pixel - 0.5f + half_columns), zero), first_column);
        box[1] = least(down((from_s - r * low_u) / pixel - 0.5f + half_columns), splat(g[5] - 1.0f));
        box[1] = least(box[1], first_column + last);
        box[2] = most(most(up((from_t - r * high_v) / pixel - 0.5f + half_rows), zero), first_row);
        box[3] = least(down((from_t - r * low_v) / pixel - 0.5f + half_rows), splat(g[6] - 1.0f));
        box[3] = least(box[3], first_row + last);
        const V near_u = least(most(zero, low_u), high_u), near_v = least(most(zero, low_v), high_v);
        const float outside = radius + pupil_pixel;
        V turn = zero;
        for (int k = 0; k < W; ++k) put(turn, k, (float)k);
        M lit = (turn < (float)some) & (low_u <= high_u) & (low_v <= high_v) & (box[0] <= box[1]) & (box[2] <= box[3]);
        lit &= near_u * near_u + near_v * near_v <= outside * outside;
        const V u = 0.5f * (low_u + high_u), v = 0.5f * (low_v + high_v);
        const V away = root(u * u + v * v);
        const V shorter = away > radius ? radius / away : zero + 1.0f;
        middle[0] = u * shorter, middle[1] = v * shorter;
        return lit;
    };
""".replace("MODEL_SIZE", str(MODEL_SIZE))
    .replace("NARROWEST", f"{NARROWEST}f")
    .replace("LEVELS", f"{LEVELS}f")
)
"""The ray model of `voxel` as functions, and the lenses its rays can reach. Reads the arguments `model` (voxel,
MODEL_SIZE), `geometry` (GEOMETRY_SIZE,), `lenses` (first i, first j, lenses along i, along j), `corners` (lens along j,
along i, 2), `voxel`, `profiles` and `cuts`, the parts of the voxel along x, y, z."""

SMEARS = """
    // widest smear times the probability that a position, `away` from the middle and smeared, lies within half a pitch:
    // a trapezium, smoothed by the narrower smear; `smeared` is given what depends on the smears alone
    auto ramp = [&](auto x, auto narrow, auto bend) {  // integral of a step smoothed by `narrow`, which ends at x = 0
        const decltype(x) above = most(x, decltype(x){}), bent = least(above, decltype(x){} + narrow);
        return above + bent * (bent * bend - 1.0f);
    };
    auto trapezium = [&](auto away, auto wide, auto narrow) {
        const auto outer = 0.5f * (1.0f + wide + narrow), inner = 0.5f * (size(1.0f - wide) + narrow);
        const auto bend = 0.5f / narrow, x = size(away);
        return ramp(outer - x, narrow, bend) - ramp(inner - x, narrow, bend)
            - ramp(narrow - inner - x, narrow, bend);
    };
    struct smear { float outer, inner, narrow, bend; };
    auto smeared = [&](V away, const smear& e) {
        const V x = size(away);
        V y = ramp(e.outer - x, e.narrow, e.bend) - ramp(e.inner - x, e.narrow, e.bend);
        if (e.narrow > e.inner) y -= ramp(e.narrow - e.inner - x, e.narrow, e.bend);
        return y;
    };
    // widths of the smears by three edges, given along a, then b, and by a pixel's cell: widest along a, b, narrower
    auto smear_widths = [&](const auto* edge, const auto* step, auto* smears) {
        for (int n = 0; n < 2; ++n) {
            const auto* e = edge + 3 * n;
            two_widths(e[0], e[1], e[2], step[2 * n], step[2 * n + 1], smears[n], smears[2 + n]);
        }
    };
    // the parts into which the voxel is cut: where the middle of each lies, from the voxel's edges
    auto middle_of_part = [&](int part, float x, float y, float z) {
        const int across = part % cuts[0], down = part / cuts[0] % cuts[1], deep = part / (cuts[0] * cuts[1]);
        return ((across + 0.5f) / cuts[0] - 0.5f) * x + ((down + 0.5f) / cuts[1] - 0.5f) * y
            + ((deep + 0.5f) / cuts[2] - 0.5f) * z;
    };
    auto cut_edges = [&](auto* edge) {
        for (int n = 0; n < 6; ++n) edge[n] = edge[n] / (float)cuts[n % 3];
    };
"""
"""How the edges of a voxel, or of its parts, and a pixel's cell smear a position: functions that follow `RAYS`."""
