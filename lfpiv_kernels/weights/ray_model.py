"""A voxel's ray model in C++: where its rays go, how wide they smear, which pixels under which lenses they can reach.

The functions are lambdas for the body of a ``wp.func_native``, on floats or on vectors `V` of `W` lenses side by side:
as many as the CPU's registers hold, one on a GPU, where every thread has a voxel of its own.
"""

import taichi as ti

from lfpiv_kernels.native import read_native

LANES = 8
"""Largest width of a block [pixel]: one vector load."""
MODEL_SIZE = 30
"""Floats of a voxel's ray model: 6 polynomial coefficients (1, u, v, uu, uv, vv) of s, 6 of t [mm], the projected
voxel edges along x, y, z as (s, t) [mm], and their change with the pupil point, (s_u, s_v, t_u, t_v) along x, y, z."""
LEVELS = 255.0
"""Largest 8-bit value."""
NARROWEST = 1e-4
"""Smallest smear, in pitches or mm; keeps the closed form finite."""

Camera = ti.types.vector(8, ti.f32)
"""r = f_m/s_i, pixel [mm], columns / 2, rows / 2, pupil radius [mm], columns, rows, edge of a microimage [pixel]."""

GEOMETRY_SIZE = 23
"""Floats of a camera's geometry: `Camera`, ``lattice.Lattice``, half extent of a lens's cell along s and t [mm], and
the matrix ``lattice.cell_frame``, row by row."""

VECTORS = read_native("ray_model_vectors.inc")
"""Vectors `V` of `W` floats and masks `M`; `size` is the absolute value, `put` and `at` reach one of the floats."""

RAYS = (
    read_native("ray_model_rays.inc")
    .replace("MODEL_SIZE", str(MODEL_SIZE))
    .replace("NARROWEST", f"{NARROWEST}f")
    .replace("LEVELS", f"{LEVELS}f")
)
"""The ray model of `voxel` as functions, and the lenses its rays can reach. Reads the arguments `model` (voxel,
MODEL_SIZE), `geometry` (GEOMETRY_SIZE,), `lenses` (first i, first j, lenses along i, along j), `corners` (lens along j,
along i, 2), `voxel`, `profiles` and `cuts`, the parts of the voxel along x, y, z."""

SMEARS = read_native("ray_model_smears.inc")
"""How the edges of a voxel, or of its parts, and a pixel's cell smear a position: functions that follow `RAYS`."""
