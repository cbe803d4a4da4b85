"""Transform of volumes along z for the spectral correlation; `transforms` gives its folds and waves. CPU only."""

import warp as wp

from lfpiv_kernels.correlation.blocks import VECTORS
from lfpiv_kernels.correlation.layout import Phased
from lfpiv_kernels.correlation.memory import Call
from lfpiv_kernels.correlation.transforms import PlaneTransform
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

PART = 1 << 10
"""Elements of a plane that a task transforms: its scratch memory fits a core's own cache."""

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
    volume: Phased,
    transform: PlaneTransform,
    first_plane: int,  # of layer 0
    stride: int,  # distance of layers
    part: int,  # elements per thread, a multiple of `LANES`
    scratch_pitch: wp.int64,  # elements of scratch memory per slot
    slot: int,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    plane_out: wp.array(dtype=float),  # (layer, row, element)
):
    index = begin + wp.tid()
    parts = (volume.plane + part - 1) // part
    layer = index // parts
    start = index % parts * part
    counts = transform.counts
    _combine(
        volume.values,
        transform.quads,
        transform.folds,
        transform.rows,
        counts,
        transform.matrix,
        wp.int64(first_plane + layer * stride),
        wp.int64(volume.plane),
        wp.int64(start),
        wp.int64(wp.min(start + part, volume.plane)),
        wp.int64(layer * (counts[0] + counts[1] + counts[2] + counts[3])),
        slot,
        scratch_pitch,
        scratch_out,
        plane_out,
    )


def transform_call(
    volume: Phased,
    transform: PlaneTransform,
    layers: range,
    stride: int,
    scratch: wp.array,
    scratch_pitch: int,
    planes: wp.array,
) -> Call:
    """Return the call that transforms the planes of each layer, (layer, row, element)."""
    inputs = [volume, transform, layers.start * stride, stride, PART, scratch_pitch]
    size = len(layers) * -(-volume.plane // PART)
    return Call(_transform_planes, size, inputs, [scratch, planes], scratch=True)
