"""Warp kernel that transforms volumes along z for `spectral_kernels`; `correlate` launches it. CPU only."""

import warp as wp

from lfpiv_kernels.correlation.blocks import VECTORS
from lfpiv_kernels.native import read_native

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
    + read_native("planes_transform.inc")
    .replace(
        "CASES",
        "\n".join(
            f"                case {n}: {{ V sum[{n}]; all(sum, kind, r); break; }}" for n in range(1, MOST_ROWS + 1)
        ),
    )
    .replace("MOST_ROWS", str(MOST_ROWS))
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
