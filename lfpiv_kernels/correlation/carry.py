"""A volume carried along a displacement field: sampled at x + d(x) for all voxels x, by cubic B-spline interpolation.

The field is linear between its control points. Beside each value stands how far its place lies within the volume. Twin:
``scipy.ndimage.map_coordinates``.
"""

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.deform import MARGIN
from lfpiv_kernels.correlation.memory import empty_volume, on_device
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import Given, as_given, to_device

wp.set_module_options(native.options("deform.h", contract="fast"))


@wp.func_native("return lfpiv::sample_spline(coefficients.data, shape, z, y, x);")
def _sample(coefficients: wp.array(dtype=float), shape: wp.vec3i, z: float, y: float, x: float) -> float: ...


@wp.func
def _at_column(field: wp.array3d(dtype=wp.vec3), iz: int, iy: int, ix: int, tz: float, ty: float):
    """Interpolate the displacement at a control point along x between four along z and y."""
    near = (1.0 - ty) * field[iz, iy, ix] + ty * field[iz, iy + 1, ix]
    far = (1.0 - ty) * field[iz + 1, iy, ix] + ty * field[iz + 1, iy + 1, ix]
    return (1.0 - tz) * near + tz * far


@wp.func
def _share_inside(place: float, count: int):
    """Return 1 between the outer voxels of an axis, 0 a voxel beyond them, linear between."""
    return 1.0 - wp.clamp(wp.max(-place, place - float(count - 1)), 0.0, 1.0)


@wp.kernel
def _carry(
    # in
    coefficients: wp.array(dtype=float),  # spline coefficients of a volume, flat; a thread per voxel
    shape: wp.vec3i,  # coefficients per axis, margin included
    field: wp.array3d(dtype=wp.vec3),  # displacement (z, y, x) [voxel] on the control grid
    spacing: wp.vec3,  # distance of control points [voxel], the first one at voxel (0, 0, 0)
    margin: int,
    wanted: wp.array3d(dtype=float),  # 0 for voxels that are left out, (z, y, x), if there is any
    first_layer: int,
    # out
    carried_out: wp.array3d(dtype=float),  # volume at x + d, (z, y, x)
    inside_out: wp.array3d(dtype=float),  # share of x + d within the volume
):
    layer, y, x = wp.tid()
    z = first_layer + layer
    if wanted.shape[0] > 0:
        if wanted[z, y, x] == 0.0:
            carried_out[z, y, x] = 0.0
            inside_out[z, y, x] = 0.0
            return
    fz = float(z) / spacing[0]
    fy = float(y) / spacing[1]
    fx = float(x) / spacing[2]
    iz = wp.min(int(fz), field.shape[0] - 2)
    iy = wp.min(int(fy), field.shape[1] - 2)
    ix = wp.min(int(fx), field.shape[2] - 2)
    tz = fz - float(iz)
    ty = fy - float(iy)
    tx = fx - float(ix)
    moved = (1.0 - tx) * _at_column(field, iz, iy, ix, tz, ty) + tx * _at_column(field, iz, iy, ix + 1, tz, ty)
    pz = float(z) + moved[0]
    py = float(y) + moved[1]
    px = float(x) + moved[2]
    wide = float(margin)
    carried_out[z, y, x] = _sample(coefficients, shape, pz + wide, py + wide, px + wide)
    within = _share_inside(pz, shape[0] - 2 * margin) * _share_inside(py, shape[1] - 2 * margin)
    inside_out[z, y, x] = within * _share_inside(px, shape[2] - 2 * margin)


def carry(
    coefficients: Given,
    field: np.ndarray,
    spacing: tuple[float, float, float],
    wanted: np.ndarray | None = None,
) -> tuple[Given, Given]:
    """Sample a volume at ``x + d(x)`` for all voxels x.

    Parameters
    ----------
    coefficients : array, float32
        `lfpiv_kernels.correlation.deform.spline_coefficients` of the volume.
    field : ndarray, shape (n_z, n_y, n_x, 3), float32
        Displacement d, order (z, y, x) [voxel], at control points, at least 2 per axis; linear between them.
    spacing : tuple of float
        Distance of the control points, order (z, y, x) [voxel]; the first lies on voxel (0, 0, 0).
    wanted : ndarray, shape (z, y, x), float32, optional
        0 for voxels that are left out: both results are 0 there. Default: all are wanted.

    Returns
    -------
    carried : array, shape (z, y, x), float32
        The volume at ``x + d(x)``. It falls smoothly to 0 outside. On the device if the coefficients are.
    inside : array, shape (z, y, x), float32
        1 where ``x + d(x)`` lies between the centres of the outer voxels, 0 where it lies a voxel beyond them or more,
        linear between.

    Raises
    ------
    ValueError
        If the control grid is too small.
    """
    if field.shape[3:] != (3,) or min(field.shape[:3]) < 2:
        raise ValueError(f"field: expected shape (>= 2, >= 2, >= 2, 3), got {field.shape}.")
    shape = tuple(n - 2 * MARGIN for n in coefficients.shape)
    outputs = [empty_volume(shape) for _ in range(2)]
    control = to_device(np.ascontiguousarray(field, np.float32), wp.vec3)
    mask = None if wanted is None else on_device(wanted)
    flat, shape_3i = on_device(coefficients).flatten(), wp.vec3i(*coefficients.shape)
    inputs = [flat, shape_3i, control, wp.vec3(*spacing), MARGIN, mask]
    launch(Call(_carry, shape[0], inputs, outputs, inner=shape[1:]))
    return as_given(outputs[0], coefficients), as_given(outputs[1], coefficients)
