"""Symmetric deformation of two volumes by a displacement field d, by cubic B-spline interpolation.

The first volume is sampled at ``x - d/2``, the second at ``x + d/2``, so particles displaced by d meet at x. The
positions x lie a quarter of a voxel beside the voxels, where the interpolation errors of the two volumes cancel.

Notes
-----
Interpolation moves a particle towards or away from the nearest voxel by an error E sin(2 pi p) of the sampling phase p.
With x on the voxels the phases are -d/2 and d/2 and the two errors add up to 2 E sin(pi d), a bias that no iteration
removes. With x a quarter of a voxel beside them the phases are 1/4 -+ d/2, and both errors are E cos(pi d).
"""

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import deform_gpu, filters_gpu
from lfpiv_kernels.correlation.control_grid import at_column, mix
from lfpiv_kernels.correlation.memory import empty_volume, on_device
from lfpiv_kernels.filters import spline
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import Given, Values, as_given, to_device, to_host

wp.set_module_options(native.options("deform.h", contract="fast", unroll=4))

OFFSET = 0.25
"""Distance of the sampled positions x from the voxels, along each axis [voxel]."""
MARGIN = 6
"""Voxels of zeros around a volume before the spline's prefilter: samples fall smoothly to 0 outside the volume."""


@wp.func_native("return lfpiv::sample_spline(coefficients.data, shape, z, y, x);")
def _sample(coefficients: wp.array(dtype=float), shape: wp.vec3i, z: float, y: float, x: float) -> float: ...


@wp.kernel
def _deform_pair(
    # in
    first: wp.array(dtype=float),  # spline coefficients of the first volume, flat
    second: wp.array(dtype=float),  # the same of the second volume
    shape: wp.vec3i,  # coefficients per axis, margin included
    field: wp.array3d(dtype=wp.vec3),  # displacement (z, y, x) [voxel] on the control grid
    spacing: wp.vec3,  # distance of control points [voxel], the first one at voxel (0, 0, 0)
    offset: float,  # of the sampled positions from the voxels
    margin: int,
    first_layer: int,
    # out
    first_out: wp.array3d(dtype=float),  # first volume at x - d/2, x = voxel + offset, (z, y, x)
    second_out: wp.array3d(dtype=float),  # second volume at x + d/2, (z, y, x)
):
    layer, y = wp.tid()
    z = first_layer + layer
    fz = (float(z) + offset) / spacing[0]
    fy = (float(y) + offset) / spacing[1]
    iz = wp.min(int(fz), field.shape[0] - 2)
    iy = wp.min(int(fy), field.shape[1] - 2)
    tz = fz - float(iz)
    ty = fy - float(iy)
    left = wp.vec3()
    right = wp.vec3()
    cell = wp.int32(-1)
    for x in range(first_out.shape[2]):
        fx = (float(x) + offset) / spacing[2]
        ix = wp.min(int(fx), field.shape[2] - 2)
        tx = fx - float(ix)
        if ix != cell:
            left = at_column(field, iz, iy, ix, tz, ty)
            right = at_column(field, iz, iy, ix + 1, tz, ty)
            cell = ix
        half = 0.5 * mix(tx, left, right)
        pz = float(z + margin) + offset
        py = float(y + margin) + offset
        px = float(x + margin) + offset
        first_out[z, y, x] = _sample(first, shape, pz - half[0], py - half[1], px - half[2])
        second_out[z, y, x] = _sample(second, shape, pz + half[0], py + half[1], px + half[2])


def spline_coefficients(volume: Given) -> Given:
    """Return the cubic B-spline coefficients of a volume that is 0 outside.

    Parameters
    ----------
    volume : array, shape (z, y, x), float32

    Returns
    -------
    array, shape (z + 2 MARGIN, y + 2 MARGIN, x + 2 MARGIN), float32
        On the device if the volume is.
    """
    if runtime.device().form == "gpu":
        return as_given(filters_gpu.spline_coefficients(on_device(volume), MARGIN), volume)
    padded = np.pad(to_host(volume), MARGIN)
    return as_given(spline.prefilter(padded.shape)(padded.ravel()).reshape(padded.shape), volume)


def deform_pair(first: Given, second: Given, field: Values, spacing: tuple[float, float, float]) -> tuple[Given, Given]:
    """Sample the first volume at ``x - d(x)/2`` and the second at ``x + d(x)/2``.

    Parameters
    ----------
    first, second : array, float32
        `spline_coefficients` of both volumes.
    field : ndarray, shape (n_z, n_y, n_x, 3), float32, or array of vectors on the device
        Displacement d, order (z, y, x) [voxel], at control points, at least 2 per axis; linear between them.
    spacing : tuple of float
        Distance of the control points, order (z, y, x) [voxel]; the first lies on voxel (0, 0, 0).

    Returns
    -------
    first, second : array, shape (z, y, x), float32
        The deformed volumes; element i along an axis lies at ``i + OFFSET``. On the device if the coefficients are.

    Raises
    ------
    ValueError
        If the coefficients differ in shape or the control grid is too small.
    """
    if first.shape != second.shape:
        raise ValueError(f"second: expected coefficients of shape {first.shape}, got {second.shape}.")
    if (isinstance(field, np.ndarray) and field.shape[3:] != (3,)) or min(field.shape[:3]) < 2:
        raise ValueError(f"field: expected shape (>= 2, >= 2, >= 2, 3), got {field.shape}.")
    if isinstance(field, np.ndarray):
        field = to_device(np.ascontiguousarray(field, np.float32), wp.vec3)
    flat = [on_device(c).flatten() for c in (first, second)]
    shape = tuple(n - 2 * MARGIN for n in first.shape)
    outputs = [empty_volume(shape) for _ in range(2)]
    size, control = wp.vec3i(*first.shape), (field, wp.vec3(*spacing))
    if runtime.device().form == "gpu":
        pairs = zip(flat, (-0.5, 0.5), outputs, strict=True)
        launch(*(deform_gpu.deform_call(c, size, *control, share, OFFSET, MARGIN, out) for c, share, out in pairs))
    else:
        inputs = [*flat, size, *control, OFFSET, MARGIN]
        launch(Call(_deform_pair, shape[0], inputs, outputs, inner=(shape[1],)))
    return as_given(outputs[0], first, second), as_given(outputs[1], first, second)
