"""Warp kernels that correlate blocks by transforms along z and y; `correlate` launches them where that is cheaper.

Lanes, offsets and volumes split by phase are those of `correlation_kernels`, the transforms those of
`correlation_transforms.Spectrum`. Transforms along z are made once per plane, those along y once per group of lanes;
along x products are summed lag by lag, at every pair of frequencies.

CPU only: a GPU has multiplications to spare, and nowhere to keep the spectra of a block.
"""

import warp as wp

from lfpiv_kernels.correlation.blocks import MOST_LAGS, VECTORS
from lfpiv_kernels.native import read_native

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

ROWS = 3
"""Frequencies that are computed at once: rows of the matrices are padded to a multiple."""
SYNTHESISE = read_native("spectra_synthesise.inc")

_SPECTRAL = (
    "#if !defined(__CUDA_ARCH__)"
    + VECTORS
    + SYNTHESISE
    + read_native("spectra_spectral.inc")
    .replace(
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
