"""Deformation of volumes on a GPU; host function and CPU form: ``deform``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.control_grid import at_place
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("deform.h", contract="fast"))


@wp.func_native("return lfpiv::sample_spline(coefficients.data, shape, z, y, x);")
def _sample(coefficients: wp.array(dtype=float), shape: wp.vec3i, z: float, y: float, x: float) -> float: ...


@wp.kernel
def _deform(
    # in
    coefficients: wp.array(dtype=float),  # spline coefficients of a volume, flat; a thread per voxel
    shape: wp.vec3i,  # coefficients per axis, margin included
    field: wp.array3d(dtype=wp.vec3),  # displacement (z, y, x) [voxel] on the control grid
    spacing: wp.vec3,  # distance of control points [voxel], the first one at voxel (0, 0, 0)
    share: float,  # of the displacement: -1/2 or 1/2
    offset: float,  # of the sampled positions from the voxels
    margin: int,
    begin: int,
    # out
    volume_out: wp.array3d(dtype=float),  # volume at x + share d, x = voxel + offset, (z, y, x)
):
    layer, y, x = wp.tid()
    z = begin + layer
    fz = (float(z) + offset) / spacing[0]
    fy = (float(y) + offset) / spacing[1]
    fx = (float(x) + offset) / spacing[2]
    moved = share * at_place(field, fz, fy, fx)
    volume_out[z, y, x] = _sample(
        coefficients,
        shape,
        float(z + margin) + offset + moved[0],
        float(y + margin) + offset + moved[1],
        float(x + margin) + offset + moved[2],
    )


def deform_call(
    coefficients: wp.array,
    shape: wp.vec3i,
    field: wp.array,
    spacing: wp.vec3,
    share: float,
    offset: float,
    margin: int,
    volume: wp.array,
) -> Call:
    """Return the call that samples a volume: a thread per voxel."""
    inputs = [coefficients, shape, field, spacing, share, offset, margin]
    return Call(_deform, volume.shape[0], inputs, [volume], inner=volume.shape[1:])
