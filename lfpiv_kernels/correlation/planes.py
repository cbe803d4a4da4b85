"""Transform of volumes along z for the spectral correlation; `transforms` gives its folds and waves. CPU only."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.layout import Phased
from lfpiv_kernels.correlation.transforms import PlaneTransform
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("planes.h", contract="fast"))

PART = 1 << 10
"""Elements of a plane that a task transforms: its scratch memory fits a core's own cache."""


@native.kernel("""
#if !LFPIV_GPU
    const auto scratch = scratch_out.data + (int64_t)slot * scratch_pitch;
    lfpiv::transform_planes(volume, transform, first_plane, stride, part, task, scratch, plane_out.data);
#endif
""")
def _transform_planes(
    # in
    volume: Phased,
    transform: PlaneTransform,
    first_plane: int,  # of layer 0
    stride: int,  # distance of layers
    part: int,  # elements per thread, a multiple of `LANES`
    scratch_pitch: wp.int64,  # elements of scratch memory per slot
    slot: int,
    first_task: int,
    # out
    scratch_out: wp.array(dtype=float),
    plane_out: wp.array(dtype=float),  # (layer, row, element)
): ...


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
