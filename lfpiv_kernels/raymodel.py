"""Taichi functions on a voxel's ray model: where its rays go, how wide they smear, which pixels they can reach."""

import taichi as ti

LANES = 8
"""Pixels in a row of a block: one vector load."""
MODEL_SIZE = 30
"""Floats of a voxel's ray model: 6 polynomial coefficients (1, u, v, uu, uv, vv) of s, 6 of t [mm], the projected
voxel edges along x, y, z as (s, t) [mm], and their change with the pupil point, (s_u, s_v, t_u, t_v) along x, y, z."""
LEVELS = 255.0
"""Largest 8-bit value."""
NARROWEST = 1e-4
"""Smallest smear, in pitches or mm; keeps the closed form finite."""

Camera = ti.types.vector(8, ti.f32)
"""r = f_m/s_i, pixel [mm], columns / 2, rows / 2, pupil radius [mm], columns, rows, edge of a microimage [pixel]."""
Lenses = ti.types.vector(2, ti.i32)
"""Lattice indices (i, j) of the first lens that has a microimage."""


@ti.func
def ramp(x, narrow):
    """Integral of the step function smoothed by a box of width `narrow`."""
    bent = ti.min(ti.max(x + 0.5 * narrow, 0.0), narrow)
    return bent * bent * (0.5 / narrow) + ti.max(x - 0.5 * narrow, 0.0)


@ti.func
def cumulative(x, wide, narrow):
    """Probability that the sum of two centred boxes lies below x."""
    return (ramp(x + 0.5 * wide, narrow) - ramp(x - 0.5 * wide, narrow)) / wide


@ti.func
def two_widths(a, b, c, d, e):
    """Return the widest of five smears, and one box with the variance of the other four."""
    widest = ti.max(ti.max(ti.abs(a), ti.abs(b)), ti.max(ti.max(ti.abs(c), ti.abs(d)), ti.abs(e)))
    rest = ti.sqrt(ti.max(a * a + b * b + c * c + d * d + e * e - widest * widest, 0.0))
    return ti.Vector([ti.max(widest, rest, NARROWEST), ti.max(ti.min(widest, rest), NARROWEST)])


@ti.func
def position(model: ti.template(), v, p):
    """(s, t) of the ray of voxel v through the pupil point p [mm]."""
    st = ti.Vector([0.0, 0.0])
    for axis in ti.static(range(2)):
        c = 6 * axis
        st[axis] = (
            model[v, c]
            + p[0] * (model[v, c + 1] + p[0] * model[v, c + 3] + p[1] * model[v, c + 4])
            + p[1] * (model[v, c + 2] + p[1] * model[v, c + 5])
        )
    return st


@ti.func
def slope(model: ti.template(), v, p):
    """K = d(s, t)/d(u, v) at the pupil point p."""
    k = ti.Matrix([[0.0, 0.0], [0.0, 0.0]])
    for axis in ti.static(range(2)):
        c = 6 * axis
        k[axis, 0] = model[v, c + 1] + 2.0 * model[v, c + 3] * p[0] + model[v, c + 4] * p[1]
        k[axis, 1] = model[v, c + 2] + model[v, c + 4] * p[0] + 2.0 * model[v, c + 5] * p[1]
    return k


@ti.func
def inverse(m):
    """Inverse of a 2x2 matrix whose determinant is kept away from zero."""
    det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    det = ti.select(ti.abs(det) < 1e-12, 1e-12, det)
    return ti.Matrix([[m[1, 1], -m[0, 1]], [-m[1, 0], m[0, 0]]]) / det


@ti.func
def edge(model: ti.template(), v, axis, p):
    """Projected voxel edge along one axis for the pupil point p, (s, t) [mm]."""
    k = 18 + 4 * axis
    return ti.Vector(
        [
            model[v, 12 + 2 * axis] + model[v, k] * p[0] + model[v, k + 1] * p[1],
            model[v, 13 + 2 * axis] + model[v, k + 2] * p[0] + model[v, k + 3] * p[1],
        ]
    )


@ti.func
def reach(model: ti.template(), v, p, cell, pupil_pixel):
    """Half extent of (s, t) around a lens centre within which a ray can still reach the lens [mm].

    Less the tail, a parabola of width b, whose weights round to zero anyway.
    """
    k = slope(model, v, p)
    x, y, z = edge(model, v, 0, p), edge(model, v, 1, p), edge(model, v, 2, p)
    half = ti.Vector([0.0, 0.0])
    for axis in ti.static(range(2)):
        width = two_widths(x[axis], y[axis], z[axis], k[axis, 0] * pupil_pixel, k[axis, 1] * pupil_pixel)
        box = cell * (ti.abs(1.0 - k[axis, axis]) + ti.abs(k[axis, 1 - axis]))
        tail = ti.sqrt(2.0 * width[0] * width[1] * ti.min(1.0, 2.0 * box / width[0]) / (2.0 * LEVELS))
        half[axis] = box + 0.5 * (width[0] + width[1]) - ti.min(tail, 0.5 * width[1])
    return half


@ti.func
def bend(model: ti.template(), v):
    """Bound of the second-order terms of (s, t) per squared distance on the pupil [1/mm]."""
    return ti.Vector(
        [
            ti.abs(model[v, 3]) + ti.abs(model[v, 4]) + ti.abs(model[v, 5]),
            ti.abs(model[v, 9]) + ti.abs(model[v, 10]) + ti.abs(model[v, 11]),
        ]
    )


@ti.func
def affine(model: ti.template(), v, cell, pupil_pixel, radius):
    """Rays of voxel v to first order about the pupil's centre, and bounds of the rest.

    Returns the chief ray (s, t) [mm], the inverse slope [1], the half extent of (s, t) around a lens centre within
    which a ray can reach the lens, and how far the rays spread over the array.
    """
    middle = ti.Vector([0.0, 0.0])
    k = slope(model, v, middle)
    half = reach(model, v, middle, cell, pupil_pixel)
    for axis in ti.static(range(3)):
        c = 18 + 4 * axis
        half[0] += 0.5 * radius * (ti.abs(model[v, c]) + ti.abs(model[v, c + 1]))
        half[1] += 0.5 * radius * (ti.abs(model[v, c + 2]) + ti.abs(model[v, c + 3]))
    half += radius * radius * bend(model, v)
    spread = radius * ti.Vector(
        [ti.sqrt(k[0, 0] * k[0, 0] + k[0, 1] * k[0, 1]), ti.sqrt(k[1, 0] * k[1, 0] + k[1, 1] * k[1, 1])]
    )
    for axis in ti.static(range(2)):
        k[axis, axis] += ti.select(ti.abs(k[axis, axis]) < 1e-6, 1e-6, 0.0)
    return ti.Vector([model[v, 0], model[v, 6]]), inverse(k), half, spread


@ti.func
def lens_range(chief, extent, camera, lattice, cell, first, lenses_i, lenses_j):
    """Lattice indices (i0, i1, j0, j1), ends included, of the lenses within `extent` of `chief` [mm]."""
    # only as far as the sensor reaches, and one microimage more
    margin = 2.0 * camera[0] * camera[4] + 2.0 * cell
    sensor = ti.Vector([camera[2] * camera[1] + margin, camera[3] * camera[1] + margin])
    low, high = ti.max(chief - extent, -sensor), ti.min(chief + extent, sensor)
    ds, dt = 0.5 * (low[0] + high[0]) - lattice[0], 0.5 * (low[1] + high[1]) - lattice[1]
    half = ti.max(0.5 * (high - low), 0.0)
    i, j = lattice[6] * ds + lattice[7] * dt, lattice[8] * ds + lattice[9] * dt
    di = ti.abs(lattice[6]) * half[0] + ti.abs(lattice[7]) * half[1]
    dj = ti.abs(lattice[8]) * half[0] + ti.abs(lattice[9]) * half[1]
    lens = ti.Vector(
        [
            ti.max(ti.cast(ti.ceil(i - di), ti.i32), first[0]),
            ti.min(ti.cast(ti.floor(i + di), ti.i32), first[0] + lenses_i - 1),
            ti.max(ti.cast(ti.ceil(j - dj), ti.i32), first[1]),
            ti.min(ti.cast(ti.floor(j + dj), ti.i32), first[1] + lenses_j - 1),
        ]
    )
    if low[0] > high[0] or low[1] > high[1]:
        lens = ti.Vector([0, -1, 0, -1])
    return lens


@ti.func
def pixel_box(
    model: ti.template(), v, chief, back, half, camera, centre, corner, cell, pupil_pixel, bends: ti.template()
):
    """Pixels (column0, column1, row0, row1), ends included, under the lens at `centre` that voxel v can light.

    `chief`, `back` and `half` are the chief ray, the inverse slope and the reach from `affine`, `corner` the first
    pixel of the lens's block. Also the pupil point in the middle of the box, inside the pupil. The box is empty where
    column0 > column1 or row0 > row1.
    """
    radius = camera[4]
    edge_mm = radius + 0.5 * pupil_pixel
    at = back @ (centre - chief)
    spread = ti.abs(back) @ half
    low, high = ti.max(at - spread, -edge_mm), ti.min(at + spread, edge_mm)
    if ti.static(bends):  # once more about the middle of what is left
        p = 0.5 * (low + high)
        k = slope(model, v, p)
        for axis in ti.static(range(2)):
            k[axis, axis] += ti.select(ti.abs(k[axis, axis]) < 1e-6, 1e-6, 0.0)
        local = inverse(k)
        near = reach(model, v, p, cell, pupil_pixel) + bend(model, v) * 0.25 * (high - low).norm_sqr()
        spread = ti.abs(local) @ near
        p -= local @ (position(model, v, p) - centre)
        low, high = ti.max(low, p - spread), ti.min(high, p + spread)
    r, pixel = camera[0], camera[1]
    first = ((1.0 + r) * centre - r * high) / pixel - 0.5
    last = ((1.0 + r) * centre - r * low) / pixel - 0.5
    block = ti.cast(camera[7], ti.i32)
    column0 = ti.max(ti.cast(ti.ceil(first[0] + camera[2]), ti.i32), 0, corner[0])
    column1 = ti.min(
        ti.cast(ti.floor(last[0] + camera[2]), ti.i32), ti.cast(camera[5], ti.i32) - 1, corner[0] + block - 1
    )
    row0 = ti.max(ti.cast(ti.ceil(first[1] + camera[3]), ti.i32), 0, corner[1])
    row1 = ti.min(ti.cast(ti.floor(last[1] + camera[3]), ti.i32), ti.cast(camera[6], ti.i32) - 1, corner[1] + block - 1)
    nearest = ti.min(ti.max(ti.Vector([0.0, 0.0]), low), high)
    if low[0] > high[0] or low[1] > high[1] or nearest.norm() > radius + pupil_pixel:
        column1 = column0 - 1
    middle = 0.5 * (low + high)
    length = middle.norm()
    if length > radius:
        middle *= radius / length
    return ti.Vector([column0, column1, row0, row1]), middle
