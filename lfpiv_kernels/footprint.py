"""Taichi: area-integrated weights of voxels, written as 8-bit blocks of sensor pixels.

The weight of a pixel is the fraction of a voxel's rays, uniform in the voxel and over the pupil, that reach it, Eq. 10,
integrated in closed form instead of counted. Per voxel the mapping is a second-order polynomial of the pupil point,
(s, t)(P) with P = (u, v); K = d(s, t)/dP. A pixel at X under the lens centred at c looks through the centre of
its lens at P = -(X - c (1 + r)) / r, r = f_m/s_i (Eq. 9 solved for u). Then

- the ray's offset from the lens centre is g = (I - K)^-1 ((s, t)(P) - c): moving it by g moves the pupil point too;
- the pixel's cell on the pupil has the area h^2 |det (I - K)^-1|, h the pixel's width on the pupil;
- g is smeared by the voxel's three projected edges and by the pixel's cell: boxes, of which along each lattice axis the
  widest stays a box and the others become one box of the same variance. The axes are taken as independent: the
  projection of a cube has the same variance in all directions and no covariance, whatever the camera's angles;
- the weight is amplitude x pupil coverage x probability that the smeared g lies in the lens's cell.

Blocks are 8 pixels wide, so that one vector load serves a row of one; twin: ``reference.footprint``.
"""

import numpy as np
import taichi as ti

from lfpiv_kernels import runtime
from lfpiv_kernels.lattice import Lattice, lens_centre

LANES = 8
"""Pixels in a row of a block."""
MODEL_SIZE = 30
"""Floats of a voxel's ray model: 6 polynomial coefficients (1, u, v, uu, uv, vv) of s, 6 of t [mm], the projected
voxel edges along x, y, z as (s, t) [mm], and their change with the pupil point, (s_u, s_v, t_u, t_v) along x, y, z."""
LEVELS = 255.0
SKEW = 0.02
"""Largest drift along the other axis [pitch] over the pixels under a lens for which profiles count as separable."""
NARROWEST = 1e-4
"""Smallest smear, in pitches or mm; keeps the closed form finite."""

Camera = ti.types.vector(8, ti.f32)
"""r = f_m/s_i, pixel [mm], columns / 2, rows / 2, pupil radius [mm], columns, rows, row stride of the image [pixel]."""
CellRow = ti.types.vector(4, ti.f32)


def pack_camera(*, sensor_per_pupil, pixel_mm, sensor_shape, pupil_radius_mm, stride):
    """Pack a camera's constants for the kernels of this module."""
    rows, columns = sensor_shape
    return Camera(sensor_per_pupil, pixel_mm, columns / 2, rows / 2, pupil_radius_mm, columns, rows, stride)


def cell_rectangles(layout: str) -> np.ndarray:
    """Rectangles that make up a lens's cell, rows (a_low, a_high, b_low, b_high) in the lattice's frame [pitch].

    A square cell is one rectangle; a hexagonal one is cut into strips along b, where its flat sides face +-a.
    """
    if layout == "square":
        return np.array([[-0.5, 0.5, -0.5, 0.5]], np.float32)
    side, tip, strips = 1 / (2 * np.sqrt(3)), 1 / np.sqrt(3), 4
    edges = np.linspace(side, tip, strips + 1)
    half = 0.5 * (tip - (edges[1:] + edges[:-1]) / 2) / (tip - side)
    rows = [(-0.5, 0.5, -side, side)]
    for low, high, a in zip(edges[:-1], edges[1:], half, strict=True):
        rows += [(-a, a, low, high), (-a, a, -high, -low)]
    return np.array(rows, np.float32)


def cell_frame(basis_mm: np.ndarray, layout: str) -> np.ndarray:
    """Matrix F, shape (2, 2): (a, b) = F (s, t) turns array millimetres into the frame of `cell_rectangles`."""
    basis = np.asarray(basis_mm, float)
    if layout == "square":
        return np.linalg.inv(basis).T
    pitch = np.sqrt(abs(np.linalg.det(basis)) * 2 / np.sqrt(3))
    a = basis[0] / np.linalg.norm(basis[0])
    return np.array([a, [-a[1], a[0]]]) / pitch


@ti.func
def _ramp(x, narrow):
    """Integral of the step function smoothed by a box of width `narrow`."""
    bent = ti.min(ti.max(x + 0.5 * narrow, 0.0), narrow)
    return bent * bent * (0.5 / narrow) + ti.max(x - 0.5 * narrow, 0.0)


@ti.func
def _cumulative(x, wide, narrow):
    """Probability that the sum of two centred boxes lies below x."""
    return (_ramp(x + 0.5 * wide, narrow) - _ramp(x - 0.5 * wide, narrow)) / wide


@ti.func
def _two_widths(a, b, c, d, e):
    """Return the widest of five smears, and one box with the variance of the other four."""
    widest = ti.max(ti.max(ti.abs(a), ti.abs(b)), ti.max(ti.max(ti.abs(c), ti.abs(d)), ti.abs(e)))
    rest = ti.sqrt(ti.max(a * a + b * b + c * c + d * d + e * e - widest * widest, 0.0))
    return ti.Vector([ti.max(widest, rest, NARROWEST), ti.max(ti.min(widest, rest), NARROWEST)])


@ti.func
def _position(model: ti.template(), v, p):
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
def _slope(model: ti.template(), v, p):
    """K = d(s, t)/d(u, v) at the pupil point p."""
    k = ti.Matrix([[0.0, 0.0], [0.0, 0.0]])
    for axis in ti.static(range(2)):
        c = 6 * axis
        k[axis, 0] = model[v, c + 1] + 2.0 * model[v, c + 3] * p[0] + model[v, c + 4] * p[1]
        k[axis, 1] = model[v, c + 2] + model[v, c + 4] * p[0] + 2.0 * model[v, c + 5] * p[1]
    return k


@ti.func
def _inverse(m):
    """Inverse of a 2x2 matrix whose determinant is kept away from zero."""
    det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    det = ti.select(ti.abs(det) < 1e-12, 1e-12, det)
    return ti.Matrix([[m[1, 1], -m[0, 1]], [-m[1, 0], m[0, 0]]]) / det


@ti.func
def _edge(model: ti.template(), v, axis, p):
    """Projected voxel edge along one axis for the pupil point p, (s, t) [mm]."""
    k = 18 + 4 * axis
    return ti.Vector(
        [
            model[v, 12 + 2 * axis] + model[v, k] * p[0] + model[v, k + 1] * p[1],
            model[v, 13 + 2 * axis] + model[v, k + 2] * p[0] + model[v, k + 3] * p[1],
        ]
    )


@ti.func
def _reach(model: ti.template(), v, p, cell, pupil_pixel):
    """Half extent of (s, t) around a lens centre within which a ray can still reach the lens [mm].

    Less the tail, a parabola of width b, whose weights round to zero anyway.
    """
    k = _slope(model, v, p)
    x, y, z = _edge(model, v, 0, p), _edge(model, v, 1, p), _edge(model, v, 2, p)
    half = ti.Vector([0.0, 0.0])
    for axis in ti.static(range(2)):
        width = _two_widths(x[axis], y[axis], z[axis], k[axis, 0] * pupil_pixel, k[axis, 1] * pupil_pixel)
        box = cell * (ti.abs(1.0 - k[axis, axis]) + ti.abs(k[axis, 1 - axis]))
        tail = ti.sqrt(2.0 * width[0] * width[1] * ti.min(1.0, 2.0 * box / width[0]) / (2.0 * LEVELS))
        half[axis] = box + 0.5 * (width[0] + width[1]) - ti.min(tail, 0.5 * width[1])
    return half


@ti.func
def _bend(model: ti.template(), v):
    """Bound of the second-order terms of (s, t) per squared distance on the pupil [1/mm]."""
    return ti.Vector(
        [
            ti.abs(model[v, 3]) + ti.abs(model[v, 4]) + ti.abs(model[v, 5]),
            ti.abs(model[v, 9]) + ti.abs(model[v, 10]) + ti.abs(model[v, 11]),
        ]
    )


@ti.func
def _lens_range(model: ti.template(), v, camera, lattice, cell, pupil_pixel):
    """Lattice indices (i0, i1, j0, j1) that the rays of voxel v can meet, ends included."""
    radius = camera[4] + pupil_pixel
    centre = _position(model, v, ti.Vector([0.0, 0.0]))
    reach = _reach(model, v, ti.Vector([0.0, 0.0]), cell, pupil_pixel)
    for axis in ti.static(range(3)):
        k = 18 + 4 * axis
        reach[0] += 0.5 * radius * (ti.abs(model[v, k]) + ti.abs(model[v, k + 1]))
        reach[1] += 0.5 * radius * (ti.abs(model[v, k + 2]) + ti.abs(model[v, k + 3]))
    bend = _bend(model, v)
    reach[0] += radius * ti.sqrt(model[v, 1] ** 2 + model[v, 2] ** 2) + radius * radius * bend[0]
    reach[1] += radius * ti.sqrt(model[v, 7] ** 2 + model[v, 8] ** 2) + radius * radius * bend[1]
    # only as far as the sensor reaches, and one microimage more
    margin = 2.0 * camera[0] * camera[4] + 2.0 * cell
    sensor = ti.Vector([camera[2] * camera[1] + margin, camera[3] * camera[1] + margin])
    low, high = ti.max(centre - reach, -sensor), ti.min(centre + reach, sensor)
    ds, dt = 0.5 * (low[0] + high[0]) - lattice[0], 0.5 * (low[1] + high[1]) - lattice[1]
    half = ti.max(0.5 * (high - low), 0.0)
    i, j = lattice[6] * ds + lattice[7] * dt, lattice[8] * ds + lattice[9] * dt
    di = ti.abs(lattice[6]) * half[0] + ti.abs(lattice[7]) * half[1]
    dj = ti.abs(lattice[8]) * half[0] + ti.abs(lattice[9]) * half[1]
    lens = ti.Vector(
        [
            ti.cast(ti.ceil(i - di), ti.i32),
            ti.cast(ti.floor(i + di), ti.i32),
            ti.cast(ti.ceil(j - dj), ti.i32),
            ti.cast(ti.floor(j + dj), ti.i32),
        ]
    )
    if low[0] > high[0] or low[1] > high[1]:
        lens = ti.Vector([0, -1, 0, -1])
    return lens


@ti.func
def _pixel_box(model: ti.template(), v, camera, centre, cell, pupil_pixel):
    """Pixels (column0, column1, row0, row1), ends included, under the lens at `centre` that voxel v can light.

    Also the pupil point in their middle. The box is empty where column0 > column1 or row0 > row1.
    """
    radius = camera[4]
    edge = radius + 0.5 * pupil_pixel
    low, high = ti.Vector([-edge, -edge]), ti.Vector([edge, edge])  # bounds of the pupil point
    bend = _bend(model, v)
    for _ in ti.static(range(2)):  # linear about the middle of what is left, with a bound for the rest
        p = 0.5 * (low + high)
        k = _slope(model, v, p)
        k[0, 0] += ti.select(ti.abs(k[0, 0]) < 1e-6, 1e-6, 0.0)
        k[1, 1] += ti.select(ti.abs(k[1, 1]) < 1e-6, 1e-6, 0.0)
        inverse = _inverse(k)
        reach = _reach(model, v, p, cell, pupil_pixel) + bend * 0.25 * (high - low).norm_sqr()
        spread = ti.abs(inverse) @ reach
        p -= inverse @ (_position(model, v, p) - centre)
        low, high = ti.max(low, p - spread), ti.min(high, p + spread)
    r, pixel = camera[0], camera[1]
    first = ((1.0 + r) * centre - r * high) / pixel - 0.5
    last = ((1.0 + r) * centre - r * low) / pixel - 0.5
    column0 = ti.max(ti.cast(ti.ceil(first[0] + camera[2]), ti.i32), 0)
    column1 = ti.min(ti.cast(ti.floor(last[0] + camera[2]), ti.i32), ti.cast(camera[5], ti.i32) - 1)
    row0 = ti.max(ti.cast(ti.ceil(first[1] + camera[3]), ti.i32), 0)
    row1 = ti.min(ti.cast(ti.floor(last[1] + camera[3]), ti.i32), ti.cast(camera[6], ti.i32) - 1)
    nearest = ti.min(ti.max(ti.Vector([0.0, 0.0]), low), high)
    if low[0] > high[0] or low[1] > high[1] or nearest.norm() > radius + pupil_pixel:
        column1 = column0 - 1
    middle = 0.5 * (low + high)
    length = middle.norm()
    if length > radius:
        middle *= radius / length
    return ti.Vector([column0, column1, row0, row1]), middle


@ti.func
def _coverage(p, radius, pupil_pixel):
    """Fraction of a pixel's cell on the pupil, centred at p, inside the pupil's edge (taken as straight)."""
    distance = p.norm()
    inside = ti.f32(0.0)
    if distance < radius - 0.72 * pupil_pixel:
        inside = 1.0
    elif distance < radius + 0.72 * pupil_pixel:
        a, b = ti.abs(p[0]) / distance, ti.abs(p[1]) / distance
        inside = _cumulative((radius - distance) / pupil_pixel, ti.max(a, b), ti.max(ti.min(a, b), NARROWEST))
    return inside


@ti.kernel
def _measure_blocks(
    # in
    model: ti.types.ndarray(dtype=ti.f32, ndim=2),
    camera: Camera,
    lattice: Lattice,
    cell: ti.f32,
    # out
    blocks_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
    rows_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    pupil_pixel = camera[1] / camera[0]
    for v in range(model.shape[0]):
        blocks, rows = 0, 0
        lens = _lens_range(model, v, camera, lattice, cell, pupil_pixel)
        for j in range(lens[2], lens[3] + 1):
            for i in range(lens[0], lens[1] + 1):
                box, _ = _pixel_box(model, v, camera, lens_centre(lattice, i, j), cell, pupil_pixel)
                if box[0] <= box[1] and box[2] <= box[3]:
                    across = (box[1] - box[0] + LANES) // LANES
                    blocks += across
                    rows += across * (box[3] - box[2] + 1)
        blocks_out[v] = blocks
        rows_out[v] = rows


@ti.func
def _in_cell(rectangles: ti.template(), a, b, wide_a, wide_b):
    """Probability that (a, b), smeared by the widths, lies in the lens's cell."""
    total = ti.f32(0.0)
    for q in range(rectangles.shape[0]):
        total += (
            _cumulative(rectangles[q, 1] - a, wide_a[0], wide_a[1])
            - _cumulative(rectangles[q, 0] - a, wide_a[0], wide_a[1])
        ) * (
            _cumulative(rectangles[q, 3] - b, wide_b[0], wide_b[1])
            - _cumulative(rectangles[q, 2] - b, wide_b[0], wide_b[1])
        )
    return total


@ti.kernel
def _fill_blocks(
    # in
    model: ti.types.ndarray(dtype=ti.f32, ndim=2),
    camera: Camera,
    lattice: Lattice,
    cell: ti.f32,
    frame: ti.types.matrix(2, 2, ti.f32),
    rectangles: ti.types.ndarray(dtype=ti.f32, ndim=2),
    first_block: ti.types.ndarray(dtype=ti.i64, ndim=1),
    first_row: ti.types.ndarray(dtype=ti.i64, ndim=1),
    bends: ti.template(),
    # out
    pixel_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
    height_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
    value_out: ti.types.ndarray(dtype=ti.u8, ndim=2),
    scale_out: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    r, pixel, radius = camera[0], camera[1], camera[4]
    pupil_pixel = pixel / r
    stride = ti.cast(camera[7], ti.i32)
    identity = ti.Matrix([[1.0, 0.0], [0.0, 1.0]])
    for v in range(model.shape[0]):
        block = ti.cast(first_block[v] - first_block[0], ti.i32)
        row = ti.cast(first_row[v] - first_row[0], ti.i32)
        last_block = ti.cast(first_block[v + 1] - first_block[0], ti.i32)
        last_row = ti.cast(first_row[v + 1] - first_row[0], ti.i32)
        lens = _lens_range(model, v, camera, lattice, cell, pupil_pixel)
        to_level = ti.f32(0.0)  # 255 / upper bound of the voxel's weights
        for j in range(lens[2], lens[3] + 1):
            for i in range(lens[0], lens[1] + 1):
                centre = lens_centre(lattice, i, j)
                box, middle = _pixel_box(model, v, camera, centre, cell, pupil_pixel)
                # rounding may differ from that of _measure_blocks, compiled apart: never write past what it counted
                tiles = (box[1] - box[0] + LANES) // LANES
                fits = block + tiles <= last_block and row + tiles * (box[3] - box[2] + 1) <= last_row
                if box[0] <= box[1] and box[2] <= box[3] and fits:
                    slope = _slope(model, v, middle)
                    jacobian = _inverse(identity - slope)
                    turn = frame @ jacobian
                    x, y, z = (
                        turn @ _edge(model, v, 0, middle),
                        turn @ _edge(model, v, 1, middle),
                        turn @ _edge(model, v, 2, middle),
                    )
                    step = turn @ slope * pupil_pixel  # change of (a, b) from pixel to pixel, but for the sign
                    wide_a = _two_widths(x[0], y[0], z[0], step[0, 0], step[0, 1])
                    wide_b = _two_widths(x[1], y[1], z[1], step[1, 0], step[1, 1])
                    amplitude = pupil_pixel * pupil_pixel / (np.pi * radius * radius)
                    area = ti.abs(jacobian.determinant())
                    if to_level == 0.0:
                        peak_a = 2.0 * _cumulative(0.5, wide_a[0], wide_a[1]) - 1.0
                        peak_b = 2.0 * _cumulative(0.5, wide_b[0], wide_b[1]) - 1.0
                        top = 1.04 * amplitude * area * peak_a * peak_b
                        to_level = LEVELS / top
                        scale_out[v] = top / LEVELS
                    # the pixel's pupil point is linear in its column and row
                    p0 = (
                        (1.0 + r) * centre
                        - (ti.Vector([box[0], box[2]]) + 0.5 - ti.Vector([camera[2], camera[3]])) * pixel
                    ) / r
                    columns, rows = box[1] - box[0] + 1, box[3] - box[2] + 1
                    separable = rectangles.shape[0] == 1 and (
                        ti.abs(step[1, 0]) * columns < SKEW and ti.abs(step[0, 1]) * rows < SKEW
                    )
                    half = 0.5 * ti.Vector([columns - 1, rows - 1])
                    ab = turn @ (_position(model, v, p0 - half * pupil_pixel) - centre)
                    for c0 in range((columns + LANES - 1) // LANES):
                        pixel_out[block] = box[2] * stride + box[0] + LANES * c0
                        height_out[block] = rows
                        block += 1
                        if ti.static(not bends) and separable:
                            profile = ti.Vector.zero(ti.f32, LANES)
                            for lane in ti.static(range(LANES)):
                                a = ab[0] - (LANES * c0 + lane - half[0]) * step[0, 0]
                                profile[lane] = (
                                    _cumulative(rectangles[0, 1] - a, wide_a[0], wide_a[1])
                                    - _cumulative(rectangles[0, 0] - a, wide_a[0], wide_a[1])
                                ) * (amplitude * area * to_level)
                                if LANES * c0 + lane >= columns:
                                    profile[lane] = 0.0
                            left = p0[0] - LANES * c0 * pupil_pixel
                            right = left - (LANES - 1) * pupil_pixel
                            far_u = ti.max(ti.abs(left), ti.abs(right))
                            for k in range(rows):
                                b = ab[1] - (k - half[1]) * step[1, 1]
                                across = ti.max(
                                    _cumulative(rectangles[0, 3] - b, wide_b[0], wide_b[1])
                                    - _cumulative(rectangles[0, 2] - b, wide_b[0], wide_b[1]),
                                    0.0,
                                )
                                at_v = p0[1] - k * pupil_pixel
                                if far_u * far_u + at_v * at_v < (radius - pupil_pixel) ** 2:
                                    for lane in ti.static(range(LANES)):
                                        value_out[row, lane] = ti.cast(
                                            ti.min(ti.max(profile[lane], 0.0) * across + 0.5, LEVELS), ti.u8
                                        )
                                else:
                                    for lane in range(LANES):
                                        column = LANES * c0 + lane
                                        p = p0 - ti.Vector([column, k]) * pupil_pixel
                                        g = jacobian @ (_position(model, v, p) - centre)
                                        inside = _coverage(p + g, radius, pupil_pixel)
                                        value_out[row, lane] = ti.cast(
                                            ti.min(ti.max(profile[lane], 0.0) * across * inside + 0.5, LEVELS), ti.u8
                                        )
                                row += 1
                        else:
                            for k in range(rows):
                                for lane in range(LANES):
                                    column = LANES * c0 + lane
                                    level = ti.f32(0.0)
                                    if column < columns:
                                        p = p0 - ti.Vector([column, k]) * pupil_pixel
                                        if ti.static(bends):
                                            jacobian = _inverse(identity - _slope(model, v, p))
                                            area = ti.abs(jacobian.determinant())
                                        g = jacobian @ (_position(model, v, p) - centre)
                                        inside = _coverage(p + g, radius, pupil_pixel)
                                        if inside > 0.0:
                                            at = frame @ g
                                            level = (
                                                inside
                                                * area
                                                * ti.max(_in_cell(rectangles, at[0], at[1], wide_a, wide_b), 0.0)
                                            )
                                    value_out[row, lane] = ti.cast(
                                        ti.min(level * amplitude * to_level + 0.5, LEVELS), ti.u8
                                    )
                                row += 1


def measure_blocks(model, camera, lattice, cell_mm):
    """Count the blocks and the rows of each voxel.

    Parameters
    ----------
    model : ndarray, shape (voxel, MODEL_SIZE), float32
        Ray models, see `MODEL_SIZE`.
    camera, lattice
        From `pack_camera` and `pack_lattice`.
    cell_mm : float
        Half extent of a lens's cell along s and t [mm].

    Returns
    -------
    blocks, rows : ndarray, shape (voxel,), int32
    """
    runtime.device()
    blocks, rows = np.empty(len(model), np.int32), np.empty(len(model), np.int32)
    _measure_blocks(model, camera, lattice, cell_mm, blocks, rows)
    ti.sync()
    return blocks, rows


def fill_blocks(
    model, camera, lattice, cell_mm, *, frame, rectangles, bends, first_block, first_row, pixel, height, value, scale
):
    """Compute the weights of consecutive voxels into blocks.

    Parameters
    ----------
    model, camera, lattice, cell_mm
        As for `measure_blocks`.
    frame, rectangles
        The lens's cell, from `cell_frame` and `cell_rectangles`.
    bends : bool
        Whether the slopes change over the pupil; False takes them as constant under a lens.
    first_block, first_row : ndarray, shape (voxel + 1,), int64
        Where each voxel's blocks and rows begin; the first entries are those of `pixel` and `value`.
    pixel, height : ndarray, shape (block,), int32
        Zeros; filled with the index of each block's first pixel in the padded image, and its number of rows. A block
        that was counted but is not needed stays without rows.
    value : ndarray, shape (row, LANES), uint8
        Filled with the weights in units of the voxel's `scale`.
    scale : ndarray, shape (voxel,), float32
        Filled with the weight of one level.
    """
    runtime.device()
    _fill_blocks(
        model, camera, lattice, cell_mm, ti.Matrix(np.asarray(frame, np.float32).tolist()), rectangles,
        first_block, first_row, bool(bends), pixel, height, value, scale,
    )  # fmt: skip
    ti.sync()
