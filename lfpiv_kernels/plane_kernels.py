"""Warp kernel that transforms volumes along z for `spectral_kernels`; `correlate` launches it."""

import warp as wp

from .correlation_kernels import VECTORS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

_TRANSFORM = (
    VECTORS
    + """
    auto combine = [&](auto& v, int64_t e, int r) {
        constexpr int C = sizeof(v) / sizeof(V);
        V total[6][C];
        #pragma unroll
        for (int i = 0; i < 6 * C; ++i) total[i / C][i % C] = V{};
        const float* from = volume.data + plane * pitch + e;
        for (int k = 0; k < terms; ++k, from += pitch) {
            #pragma unroll
            for (int c = 0; c < C; ++c) v[c] = load(from + c * width);
            #pragma unroll
            for (int i = 0; i < 6; ++i) {
                const float weight = matrix.data[k * matrix_pitch + r + i];
                #pragma unroll
                for (int c = 0; c < C; ++c) total[i][c] += weight * v[c];
            }
        }
        #pragma unroll
        for (int i = 0; i < 6; ++i) if (r + i < rows)
            #pragma unroll
            for (int c = 0; c < C; ++c) store(plane_out.data + (out + r + i) * pitch + e + c * width, total[i][c]);
    };
    for (int r = 0; r < rows; r += 6) {
        int64_t e = begin;
        for (; e + 4 * width <= end; e += 4 * width) { V v[4]; combine(v, e, r); }
        for (; e < end; e += width) { V v[1]; combine(v, e, r); }
    }
"""
)


@wp.func_native(_TRANSFORM)
def _combine(
    volume: wp.array(dtype=float),
    matrix: wp.array(dtype=float),
    matrix_pitch: int,
    terms: int,
    rows: int,
    plane: wp.int64,
    pitch: wp.int64,
    begin: wp.int64,
    end: wp.int64,
    out: wp.int64,
    plane_out: wp.array(dtype=float),
): ...


@wp.kernel
def _transform_planes(
    # in
    volume: wp.array(dtype=float),  # split by phase
    matrix: wp.array(dtype=float),  # (term, row rounded up to sixes)
    matrix_pitch: int,
    terms: int,  # planes that are combined
    rows: int,  # combinations of them
    first_plane: int,  # of layer 0
    stride: int,  # distance of layers
    pitch: int,  # elements per plane
    part: int,  # elements per thread, a multiple of `LANES`
    begin: int,
    # out
    plane_out: wp.array(dtype=float),  # (layer, row, element)
):
    index = begin + wp.tid()
    parts = (pitch + part - 1) // part
    layer = index // parts
    start = index % parts * part
    _combine(
        volume,
        matrix,
        matrix_pitch,
        terms,
        rows,
        wp.int64(first_plane + layer * stride),
        wp.int64(pitch),
        wp.int64(start),
        wp.int64(wp.min(start + part, pitch)),
        wp.int64(layer * rows),
        plane_out,
    )
