"""Warp functions: displacements between the points of a control grid, by trilinear interpolation.

They are compiled into the kernels that call them, with the options of those.
"""

import warp as wp


@wp.func
def mix(share: float, one: wp.vec3, other: wp.vec3):
    """Interpolate linearly between two displacements."""
    return (1.0 - share) * one + share * other


@wp.func
def at_column(field: wp.array3d(dtype=wp.vec3), iz: int, iy: int, ix: int, tz: float, ty: float):
    """Interpolate the displacement at a control point along x between four along z and y."""
    near = mix(ty, field[iz, iy, ix], field[iz, iy + 1, ix])
    far = mix(ty, field[iz + 1, iy, ix], field[iz + 1, iy + 1, ix])
    return mix(tz, near, far)


@wp.func
def at_place(field: wp.array3d(dtype=wp.vec3), z: float, y: float, x: float):
    """Interpolate the displacement at a place in units of the control grid; continue its outer cells linearly."""
    iz = wp.min(int(z), field.shape[0] - 2)
    iy = wp.min(int(y), field.shape[1] - 2)
    ix = wp.min(int(x), field.shape[2] - 2)
    tz = z - float(iz)
    ty = y - float(iy)
    return mix(x - float(ix), at_column(field, iz, iy, ix, tz, ty), at_column(field, iz, iy, ix + 1, tz, ty))
