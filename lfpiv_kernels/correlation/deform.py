"""Symmetric deformation of two volumes by a displacement field: cubic B-spline interpolation in Warp.

The first volume is sampled at ``x - d/2``, the second at ``x + d/2``, so that particles displaced by d meet at x.

Interpolation moves a particle a little towards or away from the nearest voxel, by an error E sin(2 pi p) of the
sampling phase p. With x on the voxels the phases are -d/2 and d/2, the two errors add up to 2 E sin(pi d), and no
iteration removes that bias (0.017 voxel for cubic splines and particles of 0.7 voxel standard deviation). With x a
quarter of a voxel beside them the phases are 1/4 -+ d/2, both errors are E cos(pi d), and the bias is gone.
"""

import numpy as np
import warp as wp
from scipy import ndimage

from lfpiv_kernels import runtime
from lfpiv_kernels.native import read_native

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 4,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

OFFSET = 0.25
"""Distance of the sampled positions x from the voxels, along each axis [voxel]."""
MARGIN = 6
"""Voxels of zeros around a volume before the spline's prefilter: samples fall smoothly to 0 outside the volume."""


_SAMPLE = read_native("deform_sample.inc")


@wp.func_native(_SAMPLE)
def _sample(coefficients: wp.array(dtype=float), shape: wp.vec3i, z: float, y: float, x: float) -> float:
    """Value of the spline at a position given in coefficients; the nearest edge outside the array."""
    ...


@wp.func
def _between(field: wp.array3d(dtype=wp.vec3), iz: int, iy: int, ix: int, tz: float, ty: float):
    """Displacement at a control point along x, interpolated between four along z and y."""
    near = (1.0 - ty) * field[iz, iy, ix] + ty * field[iz, iy + 1, ix]
    far = (1.0 - ty) * field[iz + 1, iy, ix] + ty * field[iz + 1, iy + 1, ix]
    return (1.0 - tz) * near + tz * far


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
    batch: int,  # voxels along x per thread
    first_layer: int,
    # out
    first_out: wp.array3d(dtype=float),  # first volume at x - d/2, x = voxel + offset, (z, y, x)
    second_out: wp.array3d(dtype=float),  # second volume at x + d/2, (z, y, x)
):
    layer, y, part = wp.tid()
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
    for x in range(part * batch, wp.min((part + 1) * batch, first_out.shape[2])):
        fx = (float(x) + offset) / spacing[2]
        ix = wp.min(int(fx), field.shape[2] - 2)
        tx = fx - float(ix)
        if ix != cell:
            left = _between(field, iz, iy, ix, tz, ty)
            right = _between(field, iz, iy, ix + 1, tz, ty)
            cell = ix
        half = 0.5 * ((1.0 - tx) * left + tx * right)
        pz = float(z + margin) + offset
        py = float(y + margin) + offset
        px = float(x + margin) + offset
        first_out[z, y, x] = _sample(first, shape, pz - half[0], py - half[1], px - half[2])
        second_out[z, y, x] = _sample(second, shape, pz + half[0], py + half[1], px + half[2])


def spline_coefficients(volume: np.ndarray) -> np.ndarray:
    """Cubic B-spline coefficients of a volume that is 0 outside.

    Parameters
    ----------
    volume : ndarray, shape (z, y, x), float32

    Returns
    -------
    ndarray, shape (z + 2 MARGIN, y + 2 MARGIN, x + 2 MARGIN), float32
    """
    return ndimage.spline_filter(np.pad(volume, MARGIN), order=3, output=np.float32)


def deform_pair(
    first: np.ndarray, second: np.ndarray, field: np.ndarray, spacing: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Sample the first volume at ``x - d(x)/2`` and the second at ``x + d(x)/2``, x being `OFFSET` beside the voxels.

    Parameters
    ----------
    first, second : ndarray, float32
        `spline_coefficients` of both volumes.
    field : ndarray, shape (n_z, n_y, n_x, 3), float32
        Displacement d, order (z, y, x) [voxel], on a control grid of at least 2 points per axis; linear between them.
    spacing : tuple of float
        Distance of the control points, order (z, y, x) [voxel]; the first lies on voxel (0, 0, 0).

    Returns
    -------
    first, second : ndarray, shape (z, y, x), float32
        The deformed volumes; element i along an axis lies at ``i + OFFSET``.

    Raises
    ------
    ValueError
        If the coefficients differ in shape or the control grid is too small.
    """
    if first.shape != second.shape:
        raise ValueError(f"second: expected coefficients of shape {first.shape}, got {second.shape}.")
    if field.ndim != 4 or field.shape[3] != 3 or min(field.shape[:3]) < 2:
        raise ValueError(f"field: expected shape (>= 2, >= 2, >= 2, 3), got {field.shape}.")
    where = runtime.device()
    wp.load_module(__name__, device=where.warp)  # before threads start: compilation is not thread-safe
    on_cpu = where.kind == "cpu"
    flat = [wp.array(c.ravel(), dtype=float, device=where.warp, copy=not on_cpu) for c in (first, second)]
    shape = tuple(n - 2 * MARGIN for n in first.shape)
    nodes = wp.array(np.ascontiguousarray(field, np.float32), dtype=wp.vec3, device=where.warp)
    outputs = [wp.empty(shape, dtype=float, device=where.warp) for _ in range(2)]
    batch = shape[2] if on_cpu else 1
    inputs = [*flat, wp.vec3i(*first.shape), nodes, wp.vec3(*spacing), OFFSET, MARGIN, batch]

    def part(chunk: int, begin: int, end: int) -> None:
        dim = (end - begin, shape[1], -(-shape[2] // batch))
        wp.launch(_deform_pair, dim=dim, inputs=[*inputs, begin], outputs=outputs, device=where.warp)

    runtime.run_chunks(shape[0], part)
    return outputs[0].numpy(), outputs[1].numpy()
