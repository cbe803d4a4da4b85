"""Warp kernels that correlate blocks by transforms along z and y; `correlate` launches them where that is cheaper.

Lanes, offsets and volumes split by phase are those of `correlation_kernels`, the transforms those of
`correlation_transforms.Spectrum`. Transforms along z are made once per plane, those along y once per group of lanes;
along x products are summed lag by lag, at every pair of frequencies.

CPU only: a GPU has multiplications to spare, and nowhere to keep the spectra of a block.
"""

import warp as wp

from lfpiv_kernels.correlation.blocks import MOST_LAGS, VECTORS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

ROWS = 3
"""Frequencies that are computed at once: rows of the matrices are padded to a multiple."""
SYNTHESISE = """
    // Fourier sums at lags l and -l, 0 to `most`: terms k and half - k are added for even lags, subtracted for odd ones
    // (those with sines the other way round); read(0, k) gives the term that is even in l, read(1, k) the odd one
    auto synthesise = [&](auto read, const float* matrix, int half, int most, auto put) {
        const int pairs = most / 2 + 1, most_pairs = width == 16 ? 5 : 2;
        auto rows = [&](auto& cosines, int first) {  // lags 2 first, 2 first + 1 and so on
            constexpr int R = sizeof(cosines) / sizeof(V);
            V cosines_odd[R], sines[R], sines_odd[R];
            #pragma unroll
            for (int i = 0; i < R; ++i) cosines[i] = cosines_odd[i] = sines[i] = sines_odd[i] = V{};
            const float* weight = matrix + first;
            for (int k = 0; k <= half / 2; ++k, weight += 4 * pairs) {
                const V even = read(0, k), even_far = read(0, half - k);
                const V sum = even + even_far, difference = even - even_far;
                #pragma unroll
                for (int i = 0; i < R; ++i) {
                    cosines[i] += weight[i] * sum;
                    cosines_odd[i] += weight[pairs + i] * difference;
                }
                if (k == 0) continue;
                const V odd = read(1, k), odd_far = read(1, half - k);
                const V odd_sum = odd + odd_far, odd_difference = odd - odd_far;
                #pragma unroll
                for (int i = 0; i < R; ++i) {
                    sines[i] += weight[2 * pairs + i] * odd_difference;
                    sines_odd[i] += weight[3 * pairs + i] * odd_sum;
                }
            }
            #pragma unroll
            for (int i = 0; i < R; ++i) {
                const int lag = 2 * (first + i);
                put(-lag, cosines[i] + sines[i]);
                if (lag) put(lag, cosines[i] - sines[i]);
                if (lag == most) continue;
                put(-lag - 1, cosines_odd[i] + sines_odd[i]);
                put(lag + 1, cosines_odd[i] - sines_odd[i]);
            }
        };
        int parts = (pairs + most_pairs - 1) / most_pairs;
        for (int first = 0; parts > 0; --parts) {  // nearly equal parts
            const int some = (pairs - first + parts - 1) / parts;
            switch (some) {
                case 1: { V sum[1]; rows(sum, first); break; }
                case 2: { V sum[2]; rows(sum, first); break; }
                case 3: { V sum[3]; rows(sum, first); break; }
                case 4: { V sum[4]; rows(sum, first); break; }
                default: { V sum[5]; rows(sum, first); break; }
            }
            first += some;
        }
    };
"""

_SPECTRAL = (
    "#if !defined(__CUDA_ARCH__)"
    + VECTORS
    + SYNTHESISE
    + """
    const int by = block[1], bx = block[2], ny = lags[1], nx = lags[2];
    const int half_z = size[0] / 2, half_y = size[1] / 2, reach = bx + nx - 1;
    const int phases = reach < stride ? reach : stride, pad_y = (half_y / 2 + ROWS) / ROWS * ROWS;
    const int tap_sets = folds[2] ? 2 : 1;  // whether even and odd frequencies of a block differ in what they read
    const int64_t tap_pitch = bx * lanes, near_pitch = phases * wide, lag_pitch = nx * lanes, plane = ny * lag_pitch;
    // matrices, (even or odd frequencies, fold, cosine or sine, frequency)
    const float* tap_matrix = matrices.data;
    const float* near_matrix = tap_matrix + 4 * folds[0] * pad_y;
    const float* from_y = near_matrix + 4 * folds[1] * pad_y;
    const float* from_z = from_y + 4 * (half_y / 2 + 1) * (ny / 4 + 1);
    const int* near_quads = quads.data + 4 * folds[0];
    // scratch memory
    float* taps = scratch_out.data + (int64_t)slot * scratch_pitch;  // (fold, re or im, set, even or odd, x, lane)
    float* near = taps + 8 * folds[0] * tap_pitch;  // the same of the surroundings, phases along x
    float* tap_spectrum = near + 8 * folds[1] * near_pitch;  // (frequency of a tile, sign, factor, x, lane)
    float* near_spectrum = tap_spectrum + ROWS * 6 * tap_pitch;
    float* sums = near_spectrum + ROWS * 6 * near_pitch;  // (frequency y, sum re, im, difference re, im, lag x, lane)
    float* spectrum = sums + (half_y + 1) * 4 * lag_pitch;  // (frequency z, re or im, lag y, lag x, lane)
    int* place = (int*)(spectrum + (half_z + 1) * 2 * plane);  // of an offset along x in a row of `near`
    for (int x = 0; x < reach; ++x) place[x] = x % stride * wide + x / stride;

    // fold rows along y of one plane: `sets` times an even and an odd part
    auto fold = [&](const float* from, const int* quad, int count, int sets, const int* along_y, const int* along_x,
                    int columns, int some, int64_t column_pitch, int64_t part_pitch, float* to) {
        for (int q = 0; q < count; ++q, quad += 4, to += 2 * 2 * sets * part_pitch) for (int x = 0; x < columns; ++x) {
            float* out = to + x * column_pitch;
            const float* row[4];
            for (int i = 0; i < 4; ++i) row[i] = quad[i] < 0 ? nullptr : from + along_y[quad[i]] + along_x[x];
            for (int k = 0; k < some; k += width, out += width) {
                auto voxel = [&](int i) { return row[i] ? load(row[i] + k) : V{}; };
                const V up = voxel(0), down = voxel(1), far_up = voxel(2), far_down = voxel(3);
                const V even = up + down, odd = up - down, far_even = far_up + far_down, far_odd = far_up - far_down;
                store(out, even + far_even);
                store(out + part_pitch, odd - far_odd);
                if (sets == 1) continue;
                store(out + 2 * part_pitch, even - far_even);
                store(out + 3 * part_pitch, odd + far_odd);
            }
        }
    };
    // transform (fold, parts) of one complex or real plane to factors at ROWS frequencies and their negatives, whose
    // products are those of a complex product: (re - im, re, im) times (re, im - re, im + re)
    auto analyse = [&](auto& some, bool tap, const float* in, int terms, int sets, int64_t pitch, const float* matrix,
                       float* out) {
        constexpr int P = sizeof(some) / sizeof(V);  // 2: re and im
        for (int64_t c = 0; c < pitch; c += width) {
            V even_sum[ROWS][P], odd_sum[ROWS][P];
            #pragma unroll
            for (int i = 0; i < ROWS * P; ++i) even_sum[i / P][i % P] = odd_sum[i / P][i % P] = V{};
            const float* from = in + c;
            const float* weight = matrix;
            for (int k = 0; k < terms; ++k, from += 4 * sets * pitch, weight += 2 * pad_y) {
                #pragma unroll
                for (int p = 0; p < P; ++p) {
                    const V e = load(from + p * 2 * sets * pitch), d = load(from + (p * 2 * sets + 1) * pitch);
                    #pragma unroll
                    for (int i = 0; i < ROWS; ++i) {
                        even_sum[i][p] += weight[i] * e;
                        odd_sum[i][p] += weight[pad_y + i] * d;
                    }
                }
            }
            #pragma unroll
            for (int i = 0; i < ROWS; ++i) for (int sign = 0; sign < P; ++sign) {
                V re = even_sum[i][0], im = sign ? odd_sum[i][0] : -odd_sum[i][0];
                if (P > 1) {
                    re += sign ? -odd_sum[i][P - 1] : odd_sum[i][P - 1];
                    im += even_sum[i][P - 1];
                }
                float* to = out + (i * 2 + sign) * 3 * pitch + c;
                store(to, tap ? re - im : re);
                store(to + pitch, tap ? re : im - re);
                store(to + 2 * pitch, tap ? im : im + re);
            }
        }
    };
    auto add = [&](auto& total, const float* row, const float* beside, int lag) {
        constexpr int T = sizeof(total) / sizeof(V);
        auto multiply = [&](auto& tap, int x) {
            constexpr int C = sizeof(tap) / sizeof(V);
            #pragma unroll
            for (int c = 0; c < C; ++c) tap[c] = load(row + (x + c) * lanes);
            #pragma unroll
            for (int k = 0; k < T + C - 1; ++k) {
                const V v = load(beside + place[x + lag + k]);
                #pragma unroll
                for (int c = 0; c < C; ++c) if (k >= c && k - c < T) total[k - c] += tap[c] * v;
            }
        };
        int x = 0;
        for (; x + 4 <= bx; x += 4) { V tap[4]; multiply(tap, x); }
        for (; x < bx; ++x) { V tap[1]; multiply(tap, x); }
    };
    auto product = [&](auto& re, auto& im, int index, int lane, int lag) {  // conjugate of first times second
        constexpr int T = sizeof(re) / sizeof(V);
        const float* a = tap_spectrum + index * 3 * tap_pitch + lane;
        const float* b = near_spectrum + index * 3 * near_pitch + lane;
        #pragma unroll
        for (int t = 0; t < T; ++t) re[t] = V{};
        add(re, a, b, lag);
        #pragma unroll
        for (int t = 0; t < T; ++t) im[t] = re[t];
        add(re, a + 2 * tap_pitch, b + 2 * near_pitch, lag);
        add(im, a + tap_pitch, b + near_pitch, lag);
    };
    auto correlate = [&](auto& re, int i, int g, bool real, int k, int lag) {
        constexpr int T = sizeof(re) / sizeof(V);
        V im[T], re_back[T], im_back[T];
        product(re, im, 2 * i, k, lag);
        const bool alone = g == 0 || g == half_y;
        if (real || alone) {
            const float twice = alone ? 1.0f : 2.0f;  // the other sign's is its conjugate
            #pragma unroll
            for (int t = 0; t < T; ++t) { re_back[t] = V{}; im_back[t] = V{}; re[t] *= twice; im[t] *= twice; }
        } else product(re_back, im_back, 2 * i + 1, k, lag);
        float* to = sums + g * 4 * lag_pitch + lag * lanes + k;
        #pragma unroll
        for (int t = 0; t < T; ++t) {
            store(to + t * lanes, re[t] + re_back[t]);
            store(to + t * lanes + lag_pitch, im[t] + im_back[t]);
            store(to + t * lanes + 2 * lag_pitch, re[t] - re_back[t]);
            store(to + t * lanes + 3 * lag_pitch, im[t] - im_back[t]);
        }
    };

    for (int f = 0; f <= half_z; ++f) {
        const bool real = f == 0 || f == half_z;
        const int parts_z = real ? 1 : 2;
        for (int p = 0; p < parts_z; ++p) {  // real parts, then imaginary ones of the frequencies that have any
            const int64_t row = (int64_t)layer * size[0] + (p ? half_z + f : f);
            fold(first.data + row * first_pitch + lane, quads.data, folds[0], tap_sets, first_y.data, first_x.data, bx,
                 lanes, lanes, tap_pitch, taps + p * 2 * tap_sets * tap_pitch);
            fold(second.data + row * second_pitch + lane, near_quads, folds[1], 2, second_y.data, second_x.data, phases,
                 wide, wide, near_pitch, near + p * 4 * near_pitch);
        }
        for (int odd = 0; odd < 2; ++odd) for (int j = 0; 2 * j + odd <= half_y; j += ROWS) {
            const float* tap_in = taps + (tap_sets - 1) * 2 * odd * tap_pitch;
            const float* near_in = near + 2 * odd * near_pitch;
            const float* tap_weight = tap_matrix + odd * 2 * folds[0] * pad_y + j;
            const float* near_weight = near_matrix + odd * 2 * folds[1] * pad_y + j;
            if (real) {
                V some[1];
                analyse(some, true, tap_in, folds[0], tap_sets, tap_pitch, tap_weight, tap_spectrum);
                analyse(some, false, near_in, folds[1], 2, near_pitch, near_weight, near_spectrum);
            } else {
                V some[2];
                analyse(some, true, tap_in, folds[0], tap_sets, tap_pitch, tap_weight, tap_spectrum);
                analyse(some, false, near_in, folds[1], 2, near_pitch, near_weight, near_spectrum);
            }
            for (int i = 0; i < ROWS; ++i) for (int k = 0; k < lanes; k += width) {
                const int g = 2 * (j + i) + odd;
                if (g > half_y) break;
                int parts = (nx + MOST_LAGS - 1) / MOST_LAGS;
                for (int lag = 0; parts > 0; --parts) {  // nearly equal parts of the lags along x
                    const int some = (nx - lag + parts - 1) / parts;
                    switch (some) {
CASES
                    }
                    lag += some;
                }
            }
        }
        for (int p = 0; p < parts_z; ++p) {
            const float* from[2] = {sums + p * lag_pitch, sums + (3 - p) * lag_pitch};
            float* to = spectrum + (f * 2 + p) * plane + ny / 2 * lag_pitch;
            const int64_t sign = p ? -lag_pitch : lag_pitch;
            for (int64_t c = 0; c < lag_pitch; c += width)
                synthesise([&](int odd, int g) { return load(from[odd] + g * 4 * lag_pitch + c); }, from_y, half_y,
                    ny / 2, [&](int lag, V v) { store(to + lag * sign + c, v); });
        }
    }
    float* to = sum_out.data + (sum_row + (int64_t)(lags[0] / 2) * ny * nx) * sum_pitch + lane;
    for (int column = 0; column < ny * nx; ++column) for (int k = 0; k < lanes; k += width) {
        const float* from = spectrum + column * lanes + k;
        synthesise([&](int odd, int f) { return load(from + (2 * f + odd) * plane); }, from_z, half_z, lags[0] / 2,
            [&](int lag, V v) { stream(to + ((int64_t)lag * ny * nx + column) * sum_pitch + k, v); });
    }
#endif
""".replace(
        "CASES",
        "\n".join(
            f"                    case {n}: {{ V re[{n}]; correlate(re, i, g, real, k, lag); break; }}"
            for n in range(3, MOST_LAGS + 1)
        ),
    )
    .replace("MOST_LAGS", str(MOST_LAGS))
    .replace("ROWS", str(ROWS))
)


@wp.func_native(_SPECTRAL)
def _sum_spectral(
    first: wp.array(dtype=float),
    second: wp.array(dtype=float),
    first_y: wp.array(dtype=int),
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    first_pitch: int,
    second_pitch: int,
    quads: wp.array(dtype=int),
    folds: wp.vec3i,
    matrices: wp.array(dtype=float),
    size: wp.vec2i,
    stride: int,
    block: wp.vec3i,
    lags: wp.vec3i,
    layer: int,
    lane: int,
    lanes: int,
    wide: int,
    sum_row: wp.int64,
    sum_pitch: int,
    slot: int,
    scratch_pitch: wp.int64,
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),
): ...


@wp.kernel
def _correlate_spectra(
    # in
    first: wp.array(dtype=float),  # of `_transform_planes`: spectra of layers of blocks, (layer, row, element)
    second: wp.array(dtype=float),  # the same of their surroundings
    first_y: wp.array(dtype=int),  # offsets along y and x, see the head of `correlation_kernels`
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    pitches: wp.vec2i,  # elements per plane of `first` and of `second`
    quads: wp.array(dtype=int),  # rows to fold, of blocks and of their surroundings, `correlation_transforms.fold`
    folds: wp.vec3i,  # how many of either; whether those of blocks fold about a quarter too
    matrices: wp.array(dtype=float),  # of `correlation_transforms.Spectrum`
    size: wp.vec2i,  # transforms' lengths along z and y
    stride: int,  # distance of blocks along x [voxel]
    block: wp.vec3i,  # edges of a block [voxel]
    lags: wp.vec3i,  # lags per axis
    begin_layer: int,
    ring: int,  # layers that `sum_out` holds: layer i lies at i % ring
    groups: int,  # groups of lanes
    group: int,  # lanes of a group
    past: int,  # lanes behind a group's last whose voxels it reaches
    sum_pitch: int,  # lanes per lag
    scratch_pitch: wp.int64,  # elements of scratch memory per slot
    slot: int,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
):
    index = begin + wp.tid()
    lane = index % groups * group
    lanes = wp.min(group, sum_pitch - lane)
    layer = index // groups
    row = (begin_layer + layer) % ring
    _sum_spectral(
        first,
        second,
        first_y,
        first_x,
        second_y,
        second_x,
        pitches[0],
        pitches[1],
        quads,
        folds,
        matrices,
        size,
        stride,
        block,
        lags,
        layer,
        lane,
        lanes,
        (lanes + past + 15) // 16 * 16,
        wp.int64(row) * wp.int64(lags[0] * lags[1] * lags[2]),
        sum_pitch,
        slot,
        scratch_pitch,
        scratch_out,
        sum_out,
    )
