"""Warp kernels of the window correlation; `correlate` launches them.

The lanes of a vector are neighbouring windows. A lattice of windows or blocks is walked by lane: lane
``ky * pitch + kx`` is the one at row ky and column kx of a layer, rows being followed by spare lanes, so that the lane
of a neighbour lies at a fixed distance. Volumes are stored split by phase, ``[plane, y % stride, x % stride, lane]``:
whatever the offset from a window's corner, the voxels at that offset of neighbouring windows are neighbours in memory.
Arrays of offsets along y and x hold the distance in memory for each offset in voxels.

The inner loops are native: on the CPU in vectors of clang, as wide as the registers; on CUDA a lane is a thread.
"""

import warp as wp

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

LANES = 16
"""Lanes a CPU task works on; lattices are padded to whole groups of them."""
MOST_LAGS = 11
"""Lags along x that are summed in registers at once."""

VECTORS = """
#if defined(__CUDA_ARCH__)
    typedef float V;
    typedef int M;
    const int width = 1, group = 1;
    auto load = [](const float* p) { return *p; };
    auto store = [](float* p, V v) { *p = v; };
    auto stream = [](float* p, V v) { *p = v; };
    auto any = [](M m) { return m != 0; };
    auto value = [](V v, int k) { return v; };
    auto at = [](M m, int k) { return m; };
    auto fetch = [](const float*) {};
#else
#if defined(__AVX512F__)
    enum { width = 16 };
#else
    enum { width = 8 };
#endif
    typedef float V __attribute__((vector_size(4 * width)));
    typedef int M __attribute__((vector_size(4 * width)));
    typedef float U __attribute__((vector_size(4 * width), aligned(4)));
    const int group = 16;
    auto load = [](const float* p) { return (V)*(const U*)p; };
    auto store = [](float* p, V v) { *(U*)p = v; };
    auto stream = [](float* p, V v) { __builtin_nontemporal_store(v, (V*)p); };  // aligned, past the caches
    auto any = [](M m) { return __builtin_reduce_or(m) != 0; };
    auto value = [](V v, int k) { return v[k]; };
    auto at = [](M m, int k) { return m[k]; };
    auto fetch = [](const float* p) { __builtin_prefetch(p); };
#endif
"""

_BLOCK = (
    VECTORS
    + """
    const int bz = block[0], by = block[1], bx = block[2], ny = lags[1], nx = lags[2];
    const int ey = by + ny - 1, ex = bx + nx - 1;
#if defined(__CUDA_ARCH__)
    const float* a0 = first.data + lane;
    const float* b0 = second.data + lane;
    auto tap_row = [&](int z, int y) {
        return a0 + (int64_t)(first_plane + z) * first_pitch + first_y.data[y];
    };
    auto lag_row = [&](int z, int y) {
        return b0 + (int64_t)(second_plane + z) * second_pitch + second_y.data[y];
    };
    auto tap_at = [&](const float* row, int x) { return row[first_x.data[x]]; };
    auto lag_at = [&](const float* row, int x) { return row[second_x.data[x]]; };
#else
    float* taps = scratch_out.data + (int64_t)slot * scratch_pitch;  // the group's voxels, gathered: [z][y][x][lane]
    float* near = taps + (int64_t)bz * by * bx * group;
    auto gather_taps = [&](int plane) {
        for (int z = 0; z < bz; ++z) for (int y = 0; y < by; ++y) for (int x = 0; x < bx; ++x) {
            const float* from = first.data + (int64_t)(first_plane + plane + z) * first_pitch;
            float* to = taps + ((z * by + y) * bx + x) * group;
            for (int k = 0; k < group; k += width)
                store(to + k, load(from + first_y.data[y] + first_x.data[x] + lane + k));
        }
    };
    auto gather = [&](int plane, int slot) {  // one plane of the surroundings; the last bz are kept
        for (int y = 0; y < ey; ++y) for (int x = 0; x < ex; ++x) {
            const float* from = second.data + (int64_t)(second_plane + plane) * second_pitch + second_y.data[y];
            float* to = near + ((slot * ey + y) * ex + x) * group;
            for (int k = 0; k < group; k += width) store(to + k, load(from + second_x.data[x] + lane + k));
        }
    };
    int half = 0;
    auto tap_row = [&](int z, int y) { return taps + (z * by + y) * bx * group + half; };
    auto lag_row = [&](int z, int y) { return near + ((z % bz) * ey + y) * ex * group + half; };
    auto tap_at = [&](const float* row, int x) { return load(row + x * group); };
    auto lag_at = [&](const float* row, int x) { return load(row + x * group); };
#endif
    const int64_t out_pitch = sum_pitch;
    auto multiply = [&](auto& total, auto& tap, const float* row, const float* beside, int x, int lag) {
        constexpr int T = sizeof(total) / sizeof(V), C = sizeof(tap) / sizeof(V);
        #pragma unroll
        for (int c = 0; c < C; ++c) tap[c] = tap_at(row, x + c);
        #pragma unroll
        for (int k = 0; k < T + C - 1; ++k) {
            V v = lag_at(beside, x + lag + k);
            #pragma unroll
            for (int c = 0; c < C; ++c) if (k >= c && k - c < T) total[k - c] += tap[c] * v;
        }
    };
    auto sum = [&](auto& total, int lag_z, int lag_y, int lag, float* out) {
        constexpr int T = sizeof(total) / sizeof(V);
        #pragma unroll
        for (int t = 0; t < T; ++t) total[t] = V{};
        for (int z = 0; z < bz; ++z) for (int y = 0; y < by; ++y) {
            const float* row = tap_row(z, y);
            const float* beside = lag_row(lag_z + z, lag_y + y);
            int x = 0;
            for (; x + 4 <= bx; x += 4) { V tap[4]; multiply(total, tap, row, beside, x, lag); }
            for (; x < bx; ++x) { V tap[1]; multiply(total, tap, row, beside, x, lag); }
        }
        #pragma unroll
        for (int t = 0; t < T; ++t) store(out + (int64_t)(lag + t) * out_pitch, total[t]);
    };
    auto plane = [&](int lag_z, float* out) {  // all lags along y and x
        for (int k = 0; k < group; k += width) {
#if !defined(__CUDA_ARCH__)
            half = k;
#endif
            for (int lag_y = 0; lag_y < ny; ++lag_y) {
                float* row = out + (int64_t)lag_y * nx * out_pitch + k;
                int parts = (nx + MOST_LAGS - 1) / MOST_LAGS;
                for (int lag = 0; parts > 0; --parts) {  // nearly equal parts of the lags along x
                    int some = (nx - lag + parts - 1) / parts;
                    switch (some) {
CASES
                    }
                    lag += some;
                }
            }
        }
    };
#if !defined(__CUDA_ARCH__)
    gather_taps(0);
    for (int z = lag_begin; z < lag_begin + bz - 1; ++z) gather(z, z % bz);
#endif
    for (int lag_z = lag_begin; lag_z < lag_end; ++lag_z) {
#if !defined(__CUDA_ARCH__)
        gather(lag_z + bz - 1, (lag_z + bz - 1) % bz);
#endif
        plane(lag_z, sum_out.data + (sum_row + (int64_t)lag_z * ny * nx) * sum_pitch + lane);
    }
""".replace(
        "CASES",
        "\n".join(
            f"                    case {n}: {{ V total[{n}]; sum(total, lag_z, lag_y, lag, row); break; }}"
            for n in range(3, MOST_LAGS + 1)
        ),
    ).replace("MOST_LAGS", str(MOST_LAGS))
)


@wp.func_native(_BLOCK)
def _sum_products(
    first: wp.array(dtype=float),
    second: wp.array(dtype=float),
    first_y: wp.array(dtype=int),
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    first_pitch: int,
    second_pitch: int,
    first_plane: int,
    second_plane: int,
    block: wp.vec3i,
    lags: wp.vec3i,
    lag_begin: int,
    lag_end: int,
    lane: int,
    sum_row: int,
    sum_pitch: int,
    slot: int,
    scratch_pitch: int,
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),
): ...


@wp.kernel
def _correlate_blocks(
    # in
    first: wp.array(dtype=float),  # first volume, split by phase
    second: wp.array(dtype=float),  # second volume, the same
    first_y: wp.array(dtype=int),  # offsets along y and x, see the head of this module
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    pitches: wp.vec2i,  # elements per plane of `first` and of `second`
    stride: int,  # distance of layers of blocks [voxel]
    block: wp.vec3i,  # edges of a block [voxel]
    lags: wp.vec3i,  # lags per axis
    begin_layer: int,
    ring: int,  # layers that `sum_out` holds: layer i lies at i % ring
    groups: int,  # groups of lanes
    group: int,  # lanes of a group: `LANES` on the CPU, 1 on CUDA
    parts: int,  # parts the lags along z are cut into
    scratch_pitch: int,  # elements of scratch memory per slot
    slot: int,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
):
    index = begin + wp.tid()
    lane = (index % groups) * group
    part = (index // groups) % parts
    layer = begin_layer + index // groups // parts
    plane = layer * stride
    _sum_products(
        first,
        second,
        first_y,
        first_x,
        second_y,
        second_x,
        pitches[0],
        pitches[1],
        plane,
        plane,
        block,
        lags,
        part * lags[0] // parts,
        (part + 1) * lags[0] // parts,
        lane,
        (layer % ring) * lags[0] * lags[1] * lags[2],
        groups * group,
        slot,
        scratch_pitch,
        scratch_out,
        sum_out,
    )


_SPLIT = """
    const int ny = shape[1], nx = shape[2], rows = (lanes + pitch - 1) / pitch;
    const int z = corner[0] + plane;
    float* to = split_out.data + (int64_t)plane * phases[0] * phases[1] * lanes;
    for (int ry = 0; ry < phases[0]; ++ry) for (int rx = 0; rx < phases[1]; ++rx, to += lanes) {
        const int x = corner[2] + rx;  // of lane 0
        const int low = x < 0 ? (-x + stride[1] - 1) / stride[1] : 0;
        const int high = x < nx ? (nx - x + stride[1] - 1) / stride[1] : 0;
        for (int ky = 0; ky < rows; ++ky) {  // written one after the other; what is read stays in the cache
            const int y = corner[1] + ky * stride[0] + ry, rest = lanes - ky * pitch;
            const int some = rest < pitch ? rest : pitch;
            const bool inside = z >= 0 && z < shape[0] && y >= 0 && y < ny;
            const int last = !inside || high < 0 ? 0 : high < some ? high : some, first = low < last ? low : last;
            const float* row = volume.data + (inside ? ((int64_t)z * ny + y) * nx : 0) + x;
            float* lane = to + ky * pitch;
            for (int k = 0; k < first; ++k) lane[k] = 0.0f;
            for (int k = first; k < last; ++k) lane[k] = row[k * stride[1]];
            for (int k = last; k < some; ++k) lane[k] = 0.0f;
        }
    }
"""


@wp.func_native(_SPLIT)
def _split_plane(
    volume: wp.array(dtype=float),
    shape: wp.vec3i,
    corner: wp.vec3i,
    stride: wp.vec2i,
    phases: wp.vec2i,
    pitch: int,
    lanes: int,
    plane: int,
    split_out: wp.array(dtype=float),
): ...


@wp.kernel
def _split(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x)
    shape: wp.vec3i,
    corner: wp.vec3i,  # voxel of plane 0, phase (0, 0), lane 0; what lies outside the volume is 0
    stride: wp.vec2i,  # distance of the lattice's rows and columns [voxel]
    phases: wp.vec2i,  # phases stored along y and x
    pitch: int,  # lanes per row
    lanes: int,  # lanes stored
    begin: int,
    # out
    split_out: wp.array(dtype=float),  # (plane, phase y, phase x, lane)
):
    _split_plane(volume, shape, corner, stride, phases, pitch, lanes, begin + wp.tid(), split_out)


_GATHER = (
    VECTORS
    + """
    for (int y = 0; y < lanes; y += width) {  // reads run ahead of writes: lanes behind the row's end hold no window
        V total = load(row_out.data + begin + y);
        for (int k = 1; k < blocks_y; ++k) total += load(row_out.data + begin + y + k * pitch);
        store(row_out.data + begin + y, total);
    }
    for (int x = 0; x < lanes; x += width) {
        V total = load(row_out.data + begin + x);
        for (int k = 1; k < blocks_x; ++k) total += load(row_out.data + begin + x + k);
        store(row_out.data + begin + x, total);
    }
"""
)


@wp.func_native(_GATHER)
def _gather_row(
    blocks_y: int, blocks_x: int, pitch: int, lanes: int, begin: wp.int64, row_out: wp.array(dtype=float)
): ...


@wp.kernel
def _gather_blocks(
    # in
    blocks_y: int,  # blocks per window along y and x
    blocks_x: int,
    pitch: int,  # lanes per row of blocks
    lanes: int,  # lanes per lag
    lags: int,
    ring: int,  # layers that `sum_out` holds: layer i lies at i % ring
    begin_layer: int,
    begin: int,
    # out
    sum_out: wp.array(dtype=float),  # (layer, lag, lane): of blocks before, of windows' layers of blocks after
):
    index = begin + wp.tid()
    row = (begin_layer + index // lags) % ring * lags + index % lags
    _gather_row(blocks_y, blocks_x, pitch, lanes, wp.int64(row) * wp.int64(lanes), sum_out)
