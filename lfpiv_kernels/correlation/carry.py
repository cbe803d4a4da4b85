"""A volume carried along a displacement field: sampled at x + d(x) for all voxels x, by cubic B-spline interpolation.

The field is linear between its control points. Beside each value stands how far its place lies within the volume. A
field of displacements midway in time is turned into that of one frame's particles first. Twin:
``scipy.ndimage.map_coordinates``.
"""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.control_grid import at_place
from lfpiv_kernels.correlation.deform import MARGIN
from lfpiv_kernels.correlation.memory import empty_volume, on_device
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import Given, Values, as_given, to_device

wp.set_module_options(native.options("deform.h", contract="fast"))

ROUNDS = 4
"""Fixed-point steps that turn displacements midway in time into those of the particles of one frame."""


@wp.func_native("return lfpiv::sample_spline(coefficients.data, shape, z, y, x);")
def _sample(coefficients: wp.array(dtype=float), shape: wp.vec3i, z: float, y: float, x: float) -> float: ...


@wp.kernel
def _follow(
    # in
    midway: wp.array3d(dtype=wp.vec3),  # displacement midway in time (z, y, x) [voxel]; a thread per control point
    spacing: wp.vec3,  # distance of control points [voxel]
    steps: float,  # factor of the displacement
    rounds: int,
    first_layer: int,
    # out
    moved_out: wp.array3d(dtype=wp.vec3),  # displacement of what is at a control point (z, y, x) [voxel]
):
    layer, y, x = wp.tid()
    z = first_layer + layer
    moved = steps * midway[z, y, x]
    for _ in range(rounds):
        fz = wp.clamp(float(z) + 0.5 * moved[0] / spacing[0], 0.0, float(midway.shape[0] - 1))
        fy = wp.clamp(float(y) + 0.5 * moved[1] / spacing[1], 0.0, float(midway.shape[1] - 1))
        fx = wp.clamp(float(x) + 0.5 * moved[2] / spacing[2], 0.0, float(midway.shape[2] - 1))
        moved = steps * at_place(midway, fz, fy, fx)
    moved_out[z, y, x] = moved


@wp.func
def _share_inside(place: float, count: int):
    """Return 1 between the outer voxels of an axis, 0 a voxel beyond them, linear between."""
    return 1.0 - wp.clamp(wp.max(-place, place - float(count - 1)), 0.0, 1.0)


@wp.kernel
def _carry(
    # in
    coefficients: wp.array(dtype=float),  # spline coefficients of a volume, flat; a thread per wanted voxel
    shape: wp.vec3i,  # coefficients per axis, margin included
    field: wp.array3d(dtype=wp.vec3),  # displacement (z, y, x) [voxel] on the control grid
    spacing: wp.vec3,  # distance of control points [voxel], the first one at voxel (0, 0, 0)
    margin: int,
    wanted: wp.array(dtype=int),  # flat indices of voxels; none for all voxels
    first: int,
    # out
    carried_out: wp.array(dtype=float),  # volume at x + d, per wanted voxel
    inside_out: wp.array(dtype=float),  # share of x + d within the volume
):
    k = first + wp.tid()
    voxel = k
    if wanted.shape[0] > 0:
        voxel = wanted[k]
    rows = shape[1] - 2 * margin
    columns = shape[2] - 2 * margin
    row = voxel // columns
    x = voxel - row * columns
    z = row // rows
    y = row - z * rows
    moved = at_place(field, float(z) / spacing[0], float(y) / spacing[1], float(x) / spacing[2])
    pz = float(z) + moved[0]
    py = float(y) + moved[1]
    px = float(x) + moved[2]
    wide = float(margin)
    carried_out[k] = _sample(coefficients, shape, pz + wide, py + wide, px + wide)
    within = _share_inside(pz, shape[0] - 2 * margin) * _share_inside(py, rows)
    inside_out[k] = within * _share_inside(px, columns)


def followed(midway: Values, spacing: tuple[float, float, float], steps: float) -> wp.array:
    """Return the displacement of what is at the control points of a frame, from displacements midway in time.

    Solves u(x) = steps * d(x + u(x) / 2) by `ROUNDS` fixed-point steps. Beyond the control points the field is
    continued by the outermost ones.

    Parameters
    ----------
    midway : array, shape (n_z, n_y, n_x), vectors of float32
        Displacement d, order (z, y, x) [voxel], at control points, at least 2 per axis; linear between them.
    spacing : tuple of float
        Distance of the control points, order (z, y, x) [voxel].
    steps : float
        Factor of the displacement: 1 to the next frame, -1 to the one before.

    Returns
    -------
    wp.array, shape (n_z, n_y, n_x), vectors of float32
        Displacement u at the control points [voxel], on the device.
    """
    field = to_device(midway, wp.vec3)
    moved = empty_volume(field.shape, wp.vec3)
    inputs = [field, wp.vec3(*spacing), float(steps), ROUNDS]
    launch(Call(_follow, field.shape[0], inputs, [moved], inner=field.shape[1:]), parts=1)
    return moved


def carry(
    coefficients: Given,
    field: Values,
    spacing: tuple[float, float, float],
    wanted: np.ndarray | None = None,
) -> tuple[Given, Given]:
    """Sample a volume at ``x + d(x)`` for voxels x.

    Parameters
    ----------
    coefficients : array, float32
        `lfpiv_kernels.correlation.deform.spline_coefficients` of the volume.
    field : ndarray, shape (n_z, n_y, n_x, 3), float32, or array of vectors on the device
        Displacement d, order (z, y, x) [voxel], at control points, at least 2 per axis; linear between them.
    spacing : tuple of float
        Distance of the control points, order (z, y, x) [voxel]; the first lies on voxel (0, 0, 0).
    wanted : ndarray, shape (voxel,), int, optional
        Flat indices of the voxels. Default: all voxels.

    Returns
    -------
    carried : array, float32
        The volume at ``x + d(x)``, shape (z, y, x), or (voxel,) with `wanted`. It falls smoothly to 0 outside. On the
        device if the coefficients are.
    inside : array, float32
        Of the same shape: 1 where ``x + d(x)`` lies between the centres of the outer voxels, 0 where it lies a voxel
        beyond them or more, linear between.

    Raises
    ------
    ValueError
        If the control grid is too small.
    """
    if (isinstance(field, np.ndarray) and field.shape[3:] != (3,)) or min(field.shape[:3]) < 2:
        raise ValueError(f"field: expected shape (>= 2, >= 2, >= 2, 3), got {field.shape}.")
    shape = tuple(n - 2 * MARGIN for n in coefficients.shape) if wanted is None else wanted.shape
    outputs = [empty_volume(shape) for _ in range(2)]
    control = to_device(np.ascontiguousarray(field, np.float32) if isinstance(field, np.ndarray) else field, wp.vec3)
    places = None if wanted is None else to_device(wanted.astype(np.int32), int)
    flat, shape_3i = on_device(coefficients).flatten(), wp.vec3i(*coefficients.shape)
    inputs = [flat, shape_3i, control, wp.vec3(*spacing), MARGIN, places]
    launch(Call(_carry, math.prod(shape), inputs, [one.flatten() for one in outputs]))
    return as_given(outputs[0], coefficients), as_given(outputs[1], coefficients)
