"""Warp kernel that transforms volumes along z for `spectral_kernels`; `correlate` launches it. CPU only."""

import warp as wp

from lfpiv_kernels.correlation.blocks import VECTORS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

MOST_ROWS = 6
"""Rows that are summed in registers at once."""

_TRANSFORM = (
    "#if !defined(__CUDA_ARCH__)"
    + VECTORS
    + """
    const int some = (int)(end - begin);
    float* folded = scratch_out.data + (int64_t)slot * scratch_pitch;  // (fold, class, element)
    for (int q = 0; q < folds; ++q) {
        const int* quad = quads.data + 4 * q;
        float* to = folded + 4 * q * some;
        for (int e = 0; e < some; e += width) {
            auto voxel = [&](int k) {
                return quad[k] < 0 ? V{} : load(volume.data + (plane + quad[k]) * pitch + begin + e);
            };
            const V up = voxel(0), down = voxel(1), far_up = voxel(2), far_down = voxel(3);
            const V even = up + down, odd = up - down, far_even = far_up + far_down, far_odd = far_up - far_down;
            store(to + e, even + far_even);
            store(to + some + e, odd - far_odd);
            store(to + 2 * some + e, even - far_even);
            store(to + 3 * some + e, odd + far_odd);
        }
    }
    const float* weight = matrix.data;
    const int* row = rows.data;
    auto combine = [&](auto& v, auto& sum, int kind, int r, int e) {
        constexpr int C = sizeof(v) / sizeof(V), T = sizeof(sum) / sizeof(V);
        V total[T][C];
        #pragma unroll
        for (int i = 0; i < T * C; ++i) total[i / C][i % C] = V{};
        const float* from = folded + kind * some + e;
        const float* factor = weight + r;
        for (int q = 0; q < folds; ++q, from += 4 * some, factor += counts[kind]) {
            #pragma unroll
            for (int c = 0; c < C; ++c) v[c] = load(from + c * width);
            #pragma unroll
            for (int i = 0; i < T; ++i)
                #pragma unroll
                for (int c = 0; c < C; ++c) total[i][c] += factor[i] * v[c];
        }
        #pragma unroll
        for (int i = 0; i < T; ++i)
            #pragma unroll
            for (int c = 0; c < C; ++c)
                store(plane_out.data + (out + row[r + i]) * pitch + begin + e + c * width, total[i][c]);
    };
    auto all = [&](auto& sum, int kind, int r) {
        int e = 0;
        for (; e + 4 * width <= some; e += 4 * width) { V v[4]; combine(v, sum, kind, r, e); }
        for (; e < some; e += width) { V v[1]; combine(v, sum, kind, r, e); }
    };
    for (int kind = 0; kind < 4; ++kind) {
        int parts = (counts[kind] + MOST_ROWS - 1) / MOST_ROWS;
        for (int r = 0; parts > 0; --parts) {  // nearly equal parts of the rows
            const int part = (counts[kind] - r + parts - 1) / parts;
            switch (part) {
CASES
            }
            r += part;
        }
        weight += folds * counts[kind];
        row += counts[kind];
    }
#endif
""".replace(
        "CASES",
        "\n".join(
            f"                case {n}: {{ V sum[{n}]; all(sum, kind, r); break; }}" for n in range(1, MOST_ROWS + 1)
        ),
    ).replace("MOST_ROWS", str(MOST_ROWS))
)


@wp.func_native(_TRANSFORM)
def _combine(
    volume: wp.array(dtype=float),
    quads: wp.array(dtype=int),
    folds: int,
    rows: wp.array(dtype=int),
    counts: wp.vec4i,
    matrix: wp.array(dtype=float),
    plane: wp.int64,
    pitch: wp.int64,
    begin: wp.int64,
    end: wp.int64,
    out: wp.int64,
    slot: int,
    scratch_pitch: wp.int64,
    scratch_out: wp.array(dtype=float),
    plane_out: wp.array(dtype=float),
): ...


@wp.kernel
def _transform_planes(
    # in
    volume: wp.array(dtype=float),  # split by phase
    quads: wp.array(dtype=int),  # of `correlation_transforms.Planes`, as are rows, counts and matrix
    folds: int,
    rows: wp.array(dtype=int),
    counts: wp.vec4i,
    matrix: wp.array(dtype=float),
    first_plane: int,  # of layer 0
    stride: int,  # distance of layers
    pitch: int,  # elements per plane
    part: int,  # elements per thread, a multiple of `LANES`
    slot: int,
    scratch_pitch: wp.int64,  # elements of scratch memory per slot
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    plane_out: wp.array(dtype=float),  # (layer, row, element)
):
    index = begin + wp.tid()
    parts = (pitch + part - 1) // part
    layer = index // parts
    start = index % parts * part
    _combine(
        volume,
        quads,
        folds,
        rows,
        counts,
        matrix,
        wp.int64(first_plane + layer * stride),
        wp.int64(pitch),
        wp.int64(start),
        wp.int64(wp.min(start + part, pitch)),
        wp.int64(layer * (counts[0] + counts[1] + counts[2] + counts[3])),
        slot,
        scratch_pitch,
        scratch_out,
        plane_out,
    )
