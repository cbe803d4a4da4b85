"""Warp kernels that correlate blocks by transforms along z and y; `correlate` launches them where that is cheaper.

Lanes, offsets and volumes split by phase are those of `correlation_kernels`, the transforms those of
`correlation_plan.Spectrum`. Transforms along z are made once per plane, those along y once per group of lanes; along x
products are summed lag by lag, at every pair of frequencies. A transform of real values takes the sums and differences
of what lies symmetrically about 0 and two matrices, of cosines and of sines, half as large.

CPU only: a GPU has multiplications to spare, and nowhere to keep the spectra of a block.
"""

import warp as wp

from .correlation_kernels import MOST_LAGS, VECTORS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

ROWS = 3
"""Frequencies or lags that are computed at once: rows of the matrices are padded to a multiple."""

_SPECTRAL = (
    "#if !defined(__CUDA_ARCH__)"
    + VECTORS
    + """
    const int by = block[1], bx = block[2], ny = lags[1], nx = lags[2];
    const int half_z = size[0] / 2, half_y = size[1] / 2, reach = bx + nx - 1;
    const int phases = reach < stride ? reach : stride, pad_y = (half_y + ROWS) / ROWS * ROWS;
    const int pad_lag_y = (ny / 2 + ROWS) / ROWS * ROWS, pad_lag_z = (lags[0] / 2 + ROWS) / ROWS * ROWS;
    const int64_t tap_pitch = bx * lanes, near_pitch = phases * wide, lag_pitch = nx * lanes, plane = ny * lag_pitch;
    // matrices, (term, cosine or sine, row)
    const float* tap_matrix = matrices.data;
    const float* near_matrix = tap_matrix + by * 2 * pad_y;
    const float* from_y = near_matrix + (half_y + 1) * 2 * pad_y;
    const float* from_z = from_y + (half_y + 1) * 2 * pad_lag_y;
    // scratch memory
    float* taps = scratch_out.data + (int64_t)slot * scratch_pitch;  // (y, re or im, x, lane)
    float* near = taps + by * 2 * tap_pitch;  // (distance y, sum or difference of re or im, phase x, lane)
    float* tap_spectrum = near + (half_y + 1) * 4 * near_pitch;  // (frequency of a tile, sign, factor, x, lane)
    float* near_spectrum = tap_spectrum + ROWS * 6 * tap_pitch;
    float* sums = near_spectrum + ROWS * 6 * near_pitch;  // (frequency y, sum re, im, difference re, im, lag x, lane)
    float* spectrum = sums + (half_y + 1) * 4 * lag_pitch;  // (frequency z, re or im, lag y, lag x, lane)
    int* place = (int*)(spectrum + (half_z + 1) * 2 * plane);  // of an offset along x in a row of `near`
    for (int x = 0; x < reach; ++x) place[x] = x % stride * wide + x / stride;

    // transform (term, parts) of one complex or real plane to factors at frequencies g to g + ROWS - 1 and their
    // negatives, whose products are those of a complex product: (re - im, re, im) times (re, im - re, im + re)
    auto analyse = [&](auto& some, bool tap, const float* in, int terms, int64_t pitch, int count, const float* matrix,
                       int g, float* out) {
        constexpr int P = sizeof(some) / sizeof(V);  // 2: re and im
        const int odd = tap ? 0 : 1, parts = tap ? 2 : 4, second = tap ? 1 : 2;
        for (int c = 0; c < count; ++c) {
            V even_sum[ROWS][P], odd_sum[ROWS][P];
            #pragma unroll
            for (int i = 0; i < ROWS * P; ++i) even_sum[i / P][i % P] = odd_sum[i / P][i % P] = V{};
            const float* from = in + c * width;
            const float* weight = matrix + g;
            for (int k = 0; k < terms; ++k, from += parts * pitch, weight += 2 * pad_y) {
                #pragma unroll
                for (int p = 0; p < P; ++p) {
                    const V e = load(from + p * second * pitch), d = load(from + (p * second + odd) * pitch);
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
                float* to = out + (i * 2 + sign) * 3 * pitch + c * width;
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
    auto correlate = [&](auto& re, int i, int g, bool real, int lane, int lag) {
        constexpr int T = sizeof(re) / sizeof(V);
        V im[T], re_back[T], im_back[T];
        product(re, im, 2 * i, lane, lag);
        const bool alone = g == 0 || g == half_y;
        if (real || alone) {
            const float twice = alone ? 1.0f : 2.0f;  // the other sign's is its conjugate
            #pragma unroll
            for (int t = 0; t < T; ++t) { re_back[t] = V{}; im_back[t] = V{}; re[t] *= twice; im[t] *= twice; }
        } else product(re_back, im_back, 2 * i + 1, lane, lag);
        float* to = sums + g * 4 * lag_pitch + lag * lanes + lane;
        #pragma unroll
        for (int t = 0; t < T; ++t) {
            store(to + t * lanes, re[t] + re_back[t]);
            store(to + t * lanes + lag_pitch, im[t] + im_back[t]);
            store(to + t * lanes + 2 * lag_pitch, re[t] - re_back[t]);
            store(to + t * lanes + 3 * lag_pitch, im[t] - im_back[t]);
        }
    };
    // sums over frequencies at lags l and -l: even +- odd
    auto synthesise = [&](const float* even, const float* odd, int64_t pitch, int terms, const float* matrix, int pad,
                          int rows, int64_t count, auto put) {
        auto columns = [&](auto& v, int64_t c) {
            constexpr int C = sizeof(v) / sizeof(V);
            for (int l = 0; l < rows; l += ROWS) {
                V even_sum[ROWS][C], odd_sum[ROWS][C];
                #pragma unroll
                for (int i = 0; i < ROWS * C; ++i) even_sum[i / C][i % C] = odd_sum[i / C][i % C] = V{};
                const float* weight = matrix + l;
                for (int k = 0; k < terms; ++k, weight += 2 * pad) {
                    const float* from = even + k * pitch + c * width;
                    #pragma unroll
                    for (int j = 0; j < C; ++j) v[j] = load(from + j * width);
                    #pragma unroll
                    for (int i = 0; i < ROWS; ++i)
                        #pragma unroll
                        for (int j = 0; j < C; ++j) even_sum[i][j] += weight[i] * v[j];
                    if (k == 0 || k == terms - 1) continue;
                    from = odd + k * pitch + c * width;
                    #pragma unroll
                    for (int j = 0; j < C; ++j) v[j] = load(from + j * width);
                    #pragma unroll
                    for (int i = 0; i < ROWS; ++i)
                        #pragma unroll
                        for (int j = 0; j < C; ++j) odd_sum[i][j] += weight[pad + i] * v[j];
                }
                #pragma unroll
                for (int i = 0; i < ROWS; ++i) if (l + i < rows)
                    #pragma unroll
                    for (int j = 0; j < C; ++j) {
                        put(-(l + i), c + j, even_sum[i][j] + odd_sum[i][j]);
                        put(l + i, c + j, even_sum[i][j] - odd_sum[i][j]);
                    }
            }
        };
        int64_t c = 0;
        for (; c + 3 <= count; c += 3) { V v[3]; columns(v, c); }
        for (; c < count; ++c) { V v[1]; columns(v, c); }
    };

    for (int f = 0; f <= half_z; ++f) {
        const bool real = f == 0 || f == half_z;
        for (int p = 0; p < (real ? 1 : 2); ++p) {
            const int row = p ? half_z + f : f;  // real parts, then imaginary ones of the frequencies that have any
            const float* a = first.data + (int64_t)(layer * size[0] + row) * first_pitch + lane;
            for (int y = 0; y < by; ++y) for (int x = 0; x < bx; ++x) {
                float* to = taps + (y * 2 + p) * tap_pitch + x * lanes;
                for (int k = 0; k < lanes; k += width) store(to + k, load(a + first_y.data[y] + first_x.data[x] + k));
            }
            const float* b = second.data + (int64_t)(layer * size[0] + row) * second_pitch + lane;
            for (int y = 0; y <= half_y; ++y) {
                const int ahead = ny / 2 + y, behind = ahead - 2 * y + (y > ny / 2 ? size[1] : 0);
                const bool alone = y == 0 || y == half_y;
                for (int x = 0; x < phases; ++x) {
                    float* to = near + (y * 4 + p * 2) * near_pitch + x * wide;
                    const float* up = b + second_y.data[ahead] + second_x.data[x];
                    const float* down = b + second_y.data[behind] + second_x.data[x];
                    for (int k = 0; k < wide; k += width) {
                        const V u = load(up + k), d = alone ? V{} : load(down + k);
                        store(to + k, u + d);
                        store(to + near_pitch + k, u - d);
                    }
                }
            }
        }
        for (int g = 0; g <= half_y; g += ROWS) {
            if (real) {
                V some[1];
                analyse(some, true, taps, by, tap_pitch, tap_pitch / width, tap_matrix, g, tap_spectrum);
                analyse(some, false, near, half_y + 1, near_pitch, near_pitch / width, near_matrix, g, near_spectrum);
            } else {
                V some[2];
                analyse(some, true, taps, by, tap_pitch, tap_pitch / width, tap_matrix, g, tap_spectrum);
                analyse(some, false, near, half_y + 1, near_pitch, near_pitch / width, near_matrix, g, near_spectrum);
            }
            for (int i = 0; i < ROWS && g + i <= half_y; ++i) for (int k = 0; k < lanes; k += width) {
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
        for (int p = 0; p < (real ? 1 : 2); ++p) {
            float* to = spectrum + (f * 2 + p) * plane + ny / 2 * lag_pitch;
            const float* even = sums + p * lag_pitch;
            const float* odd = sums + (3 - p) * lag_pitch;
            const int64_t sign = p ? -lag_pitch : lag_pitch;
            synthesise(even, odd, 4 * lag_pitch, half_y + 1, from_y, pad_lag_y, ny / 2 + 1, lag_pitch / width,
                [&](int lag, int64_t c, V v) { store(to + lag * sign + c * width, v); });
        }
    }
    float* to = sum_out.data + (sum_row + (int64_t)(lags[0] / 2) * ny * nx) * sum_pitch + lane;
    const int columns = lanes / width;
    synthesise(spectrum, spectrum + plane, 2 * plane, half_z + 1, from_z, pad_lag_z, lags[0] / 2 + 1, plane / width,
        [&](int lag, int64_t c, V v) {
            stream(to + ((int64_t)lag * ny * nx + c / columns) * sum_pitch + c % columns * width, v);
        });
#endif
""".replace(
        "CASES",
        "\n".join(
            f"                    case {n}: {{ V re[{n}]; correlate(re, i, g + i, real, k, lag); break; }}"
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
    matrices: wp.array(dtype=float),  # of `correlation_plan.Spectrum`
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
