"""A voxel's ray model and a camera's geometry as the kernels of weights take them; see ``ray_model.h``."""

from lfpiv_kernels import native
from lfpiv_kernels.libraries import ti

ROW_GROUP: int = native.constant("projector.h", "ROW_GROUP")
"""Rows of a block of profiles are a multiple of it."""
BLOCK_WIDTH: int = native.constant("projector.h", "BLOCK_WIDTH")
"""Largest width of a block of weights [pixel]: one vector load."""
MODEL_SIZE: int = native.constant("ray_model.h", "MODEL_SIZE")
"""Floats of a voxel's ray model: 6 polynomial coefficients (1, u, v, uu, uv, vv) of s, 6 of t [mm], the projected
voxel edges along x, y, z as (s, t) [mm], their change with the pupil point, (s_u, s_v, t_u, t_v) along x, y, z, and 4
coefficients of third order (uuu, uuv, uvv, vvv) of s and of t."""
LEVELS: float = native.constant("ray_model.h", "LEVELS")
"""Largest 8-bit value."""

Camera = ti.types.vector(8, ti.f32)
"""r = f_m/s_i, pixel [mm], columns / 2, rows / 2, pupil radius [mm], columns, rows, edge of a microimage [pixel]."""

GEOMETRY_SIZE: int = native.constant("ray_model.h", "GEOMETRY_SIZE")
"""Floats of a camera's geometry: `Camera`, ``lattice.Lattice``, half extent of a lens's cell along s and t [mm], and
the matrix ``lattice.cell_frame``, row by row."""


def pack_optics(*, sensor_per_pupil, pixel_mm, sensor_shape, pupil_radius_mm, edge=0):
    """Return a camera's optics as the kernels of weights and of ``rays.count`` take them."""
    rows, columns = sensor_shape
    return Camera(sensor_per_pupil, pixel_mm, columns / 2, rows / 2, pupil_radius_mm, columns, rows, edge)
