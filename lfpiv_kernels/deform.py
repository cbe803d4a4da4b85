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

from . import runtime

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


@wp.func
def _spline_weights(t: float):
    """Weights of four neighbouring cubic B-spline coefficients at fraction t behind the second one."""
    s = 1.0 - t
    return wp.vec4(s * s * s, 4.0 - 6.0 * t * t + 3.0 * t * t * t, 4.0 - 6.0 * s * s + 3.0 * s * s * s, t * t * t) / 6.0


@wp.func
def _cell(position: float, count: int):
    """First of the four coefficients around a position, kept inside the array."""
    return wp.clamp(int(wp.floor(position)) - 1, 0, count - 4)


@wp.func
def _sample(coefficients: wp.array(dtype=wp.vec4), shape: wp.vec3i, z: float, y: float, x: float):
    """Value of the spline at a position given in coefficients; the nearest edge outside the array."""
    cz = _cell(z, shape[0])
    cy = _cell(y, shape[1])
    cx = _cell(x, shape[2])
    wz = _spline_weights(wp.clamp(z - float(cz + 1), 0.0, 1.0))
    wy = _spline_weights(wp.clamp(y - float(cy + 1), 0.0, 1.0))
    wx = _spline_weights(wp.clamp(x - float(cx + 1), 0.0, 1.0))
    total = wp.vec4()
    for i in range(4):
        layer = wp.vec4()
        row = ((cz + i) * shape[1] + cy) * shape[2] + cx
        for j in range(4):
            layer += wy[j] * coefficients[row + j * shape[2]]
        total += wz[i] * layer
    return wp.dot(wx, total)


@wp.kernel
def _deform_pair(
    # in
    first: wp.array(dtype=wp.vec4),  # spline coefficients of the first volume, flat, as overlapping rows
    second: wp.array(dtype=wp.vec4),  # the same of the second volume
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
    for x in range(part * batch, wp.min((part + 1) * batch, first_out.shape[2])):
        fx = (float(x) + offset) / spacing[2]
        ix = wp.min(int(fx), field.shape[2] - 2)
        tx = fx - float(ix)
        near = (1.0 - ty) * ((1.0 - tx) * field[iz, iy, ix] + tx * field[iz, iy, ix + 1])
        near += ty * ((1.0 - tx) * field[iz, iy + 1, ix] + tx * field[iz, iy + 1, ix + 1])
        far = (1.0 - ty) * ((1.0 - tx) * field[iz + 1, iy, ix] + tx * field[iz + 1, iy, ix + 1])
        far += ty * ((1.0 - tx) * field[iz + 1, iy + 1, ix] + tx * field[iz + 1, iy + 1, ix + 1])
        half = 0.5 * ((1.0 - tz) * near + tz * far)
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
    rows = [wp.array(ptr=c.ptr, dtype=wp.vec4, shape=(c.size - 3,), strides=(4,), device=where.warp) for c in flat]
    shape = tuple(n - 2 * MARGIN for n in first.shape)
    nodes = wp.array(np.ascontiguousarray(field, np.float32), dtype=wp.vec3, device=where.warp)
    outputs = [wp.empty(shape, dtype=float, device=where.warp) for _ in range(2)]
    batch = shape[2] if on_cpu else 1
    inputs = [*rows, wp.vec3i(*first.shape), nodes, wp.vec3(*spacing), OFFSET, MARGIN, batch]

    def part(chunk: int, begin: int, end: int) -> None:
        dim = (end - begin, shape[1], -(-shape[2] // batch))
        wp.launch(_deform_pair, dim=dim, inputs=[*inputs, begin], outputs=outputs, device=where.warp)

    runtime.run_chunks(shape[0], part)
    return outputs[0].numpy(), outputs[1].numpy()
