"""Taichi: area-integrated weights of voxels, written as 8-bit blocks of rays.

The weight of a ray is the fraction of a voxel's light, uniform in the voxel and over the pupil, that reaches its pixel
through its lens, Eq. 10, integrated in closed form instead of counted. Per voxel the mapping is a second-order
polynomial of the pupil point, (s, t)(P) with P = (u, v); K = d(s, t)/dP. A pixel at X under the lens centred at c looks
through the centre of its lens at P = -(X - c (1 + r)) / r, r = f_m/s_i (Eq. 9 solved for u). Then

- the ray's offset from the lens centre is g = (I - K)^-1 ((s, t)(P) - c): moving it by g moves the pupil point too;
- the pixel's cell on the pupil has the area h^2 |det (I - K)^-1|, h the pixel's width on the pupil;
- g is smeared by the voxel's three projected edges and by the pixel's cell: boxes, of which along each lattice axis the
  widest stays a box and the others become one box of the same variance. The axes are taken as independent: the
  projection of a cube has the same variance in all directions and no covariance, whatever the camera's angles;
- the weight is amplitude x probability that the smeared g lies in the lens's cell. How much of the pixel lies inside
  the pupil is the ray's own share, see ``microimages``.

Two forms of the same integral: "pixels" follows the slopes and the offset pixel by pixel; "profiles" takes them as
linear and without cross terms under a lens, so that a square cell's weights are the product of a profile along the
columns and one along the rows (rank 1), a sixth of the memory. Blocks are 8 pixels wide: one vector load serves a row.
Twin: ``reference.footprint``.
"""

import numpy as np
import taichi as ti

from lfpiv_kernels import runtime
from lfpiv_kernels.lattice import Lattice, lens_centre
from lfpiv_kernels.raymodel import (
    LANES,
    LEVELS,
    Camera,
    Lenses,
    affine,
    cumulative,
    edge,
    inverse,
    lens_range,
    pixel_box,
    position,
    ramp,
    slope,
    two_widths,
)

FORMS = ("profiles", "pixels")
"""Rank-1 blocks, or one value per ray."""
SIDE_LAYERS = 1
"""Versions of a microimage to either side of the plain one, for weights that fall or rise outwards at its edge."""
LAYERS = 2 * SIDE_LAYERS + 1
LAYER_FALL = 0.6
"""Relative fall of the weight per pixel, outwards at the pupil's edge, between one version and the next."""
BATCH = 2
"""Rows of a block that are computed side by side."""
HEADROOM = 1.04
"""Largest value that a profile or weight can take, over that at the pupil's centre."""


def pack_camera(*, sensor_per_pupil, pixel_mm, sensor_shape, pupil_radius_mm, edge=0):
    """Pack a camera's constants for the kernels of this module."""
    rows, columns = sensor_shape
    return Camera(sensor_per_pupil, pixel_mm, columns / 2, rows / 2, pupil_radius_mm, columns, rows, edge)


@ti.kernel
def _measure_blocks(
    # in
    model: ti.types.ndarray(dtype=ti.f32, ndim=2),
    camera: Camera,
    lattice: Lattice,
    cell: ti.f32,
    first_lens: Lenses,
    corner: ti.types.ndarray(dtype=ti.i32, ndim=3),
    profiles: ti.template(),
    # out
    blocks_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
    rows_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    pupil_pixel = camera[1] / camera[0]
    for v in range(model.shape[0]):
        blocks, rows = 0, 0
        chief, back, half, spread = affine(model, v, cell, pupil_pixel, camera[4])
        lens = lens_range(chief, half + spread, camera, lattice, cell, first_lens, corner.shape[1], corner.shape[0])
        for j in range(lens[2], lens[3] + 1):
            for i in range(lens[0], lens[1] + 1):
                first = ti.Vector(
                    [corner[j - first_lens[1], i - first_lens[0], 0], corner[j - first_lens[1], i - first_lens[0], 1]]
                )
                box, _ = pixel_box(
                    model,
                    v,
                    chief,
                    back,
                    half,
                    camera,
                    lens_centre(lattice, i, j),
                    first,
                    cell,
                    pupil_pixel,
                    not profiles,
                )
                if box[0] <= box[1] and box[2] <= box[3]:
                    across = (box[1] - box[0] + LANES) // LANES
                    high = box[3] - box[2] + 1
                    if ti.static(profiles):
                        high = 1 + (high + LANES - 1) // LANES
                    blocks += across
                    rows += across * high
        blocks_out[v] = blocks
        rows_out[v] = rows


@ti.func
def _in_cell(rectangles: ti.template(), a, b, wide_a, wide_b):
    """Probability that (a, b), smeared by the widths, lies in the lens's cell."""
    total = ti.f32(0.0)
    for q in range(rectangles.shape[0]):
        total += (
            cumulative(rectangles[q, 1] - a, wide_a[0], wide_a[1])
            - cumulative(rectangles[q, 0] - a, wide_a[0], wide_a[1])
        ) * (
            cumulative(rectangles[q, 3] - b, wide_b[0], wide_b[1])
            - cumulative(rectangles[q, 2] - b, wide_b[0], wide_b[1])
        )
    return total


@ti.func
def _trapezium(x, width):
    """Widest smear times the probability that a position x [pitch], smeared by the widths, lies within half a pitch."""
    away = ti.abs(x)
    outer, inner = 0.5 * (1.0 + width[0]), 0.5 * ti.abs(1.0 - width[0])
    return ti.max(ramp(outer - away, width[1]) - ramp(inner - away, width[1]) - ramp(-inner - away, width[1]), 0.0)


@ti.func
def _profile(x, width):
    """Probability that a position x [pitch], smeared by the widths, lies within half a pitch of the lens's centre."""
    return _trapezium(x, width) / width[0]


@ti.func
def _layer(
    model: ti.template(), v, centre, p0, tile, columns, rows, radius, pupil_pixel, frame, jacobian, wide_a, wide_b
):
    """Layer of the microimage for a block at the pupil's edge, from how its weights fall outwards there.

    Where only a part of a pixel lies inside the pupil, the weight that counts is that of the part's middle.
    """
    width = ti.min(LANES, columns - LANES * tile)
    middle = p0 - ti.Vector([LANES * tile + 0.5 * (width - 1), 0.5 * (rows - 1)]) * pupil_pixel
    away = middle.norm()
    half = 0.5 * pupil_pixel * ti.Vector([width, rows])
    layer = 0
    if (ti.abs(middle) + half).norm() > radius - 0.25 * pupil_pixel and away > 0.3 * radius:
        normal = middle / away
        inner, outer = (radius - 0.25 * pupil_pixel) * normal, (radius + 0.25 * pupil_pixel) * normal
        at_in = frame @ (jacobian @ (position(model, v, inner) - centre))
        at_out = frame @ (jacobian @ (position(model, v, outer) - centre))
        w_in = _trapezium(at_in[0], wide_a) * _trapezium(at_in[1], wide_b)
        w_out = _trapezium(at_out[0], wide_a) * _trapezium(at_out[1], wide_b)
        fall = 4.0 * (w_in - w_out) / ti.max(w_in + w_out, 1e-9)
        layer = ti.min(ti.max(ti.cast(ti.round(fall / LAYER_FALL), ti.i32), -SIDE_LAYERS), SIDE_LAYERS)
    return layer + SIDE_LAYERS


@ti.func
def _write_profile(value: ti.template(), row, at, step, middle, first, count, width, to_level):
    """Write a row of a profile, pixels `first` and on of `count`; `at` is the position of their middle [pitch]."""
    levels = ti.Vector.zero(ti.f32, LANES)
    for lane in range(LANES):  # on local values only: the compiler makes it vectors
        levels[lane] = ti.min(_trapezium(at - (first + lane - middle) * step, width) * to_level + 0.5, LEVELS)
    for lane in ti.static(range(LANES)):
        value[row, lane] = ti.cast(ti.select(first + lane < count, levels[lane], 0.0), ti.u8)


@ti.func
def _smears(model: ti.template(), v, p, turn, pupil_pixel, k):
    """Widths of the smear along a and b, and the change of (a, b) from pixel to pixel, but for its sign [pitch]."""
    x, y, z = turn @ edge(model, v, 0, p), turn @ edge(model, v, 1, p), turn @ edge(model, v, 2, p)
    step = turn @ k * pupil_pixel
    wide_a = two_widths(x[0], y[0], z[0], step[0, 0], step[0, 1])
    wide_b = two_widths(x[1], y[1], z[1], step[1, 0], step[1, 1])
    return wide_a, wide_b, step


@ti.kernel
def _fill_blocks(
    # in
    model: ti.types.ndarray(dtype=ti.f32, ndim=2),
    camera: Camera,
    lattice: Lattice,
    cell: ti.f32,
    first_lens: Lenses,
    corner: ti.types.ndarray(dtype=ti.i32, ndim=3),
    frame: ti.types.matrix(2, 2, ti.f32),
    rectangles: ti.types.ndarray(dtype=ti.f32, ndim=2),
    first_block: ti.types.ndarray(dtype=ti.i64, ndim=1),
    first_row: ti.types.ndarray(dtype=ti.i64, ndim=1),
    square: ti.template(),
    profiles: ti.template(),
    # out
    ray_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
    height_out: ti.types.ndarray(dtype=ti.u16, ndim=1),
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
        chief, back, half, spread = affine(model, v, cell, pupil_pixel, radius)
        lens = lens_range(chief, half + spread, camera, lattice, cell, first_lens, corner.shape[1], corner.shape[0])
        # what one level stands for: the largest value, from the widths and the area at the pupil's centre
        centre_slope = slope(model, v, ti.Vector([0.0, 0.0]))
        jacobian = inverse(identity - centre_slope)
        wide_a, wide_b, step = _smears(model, v, ti.Vector([0.0, 0.0]), frame @ jacobian, pupil_pixel, centre_slope)
        top_a, top_b = HEADROOM * _profile(0.0, wide_a), HEADROOM * _profile(0.0, wide_b)
        top_area = HEADROOM * ti.abs(jacobian.determinant())
        amplitude = pupil_pixel * pupil_pixel / (np.pi * radius * radius)
        if ti.static(profiles):
            scale_out[v] = amplitude * top_area * top_a * top_b / (LEVELS * LEVELS)
        else:
            scale_out[v] = amplitude * top_area * top_a * top_b / LEVELS
        for j in range(lens[2], lens[3] + 1):
            for i in range(lens[0], lens[1] + 1):
                centre = lens_centre(lattice, i, j)
                first = ti.Vector(
                    [corner[j - first_lens[1], i - first_lens[0], 0], corner[j - first_lens[1], i - first_lens[0], 1]]
                )
                box, middle = pixel_box(
                    model, v, chief, back, half, camera, centre, first, cell, pupil_pixel, not profiles
                )
                columns, rows = box[1] - box[0] + 1, box[3] - box[2] + 1
                tiles = (columns + LANES - 1) // LANES
                high = rows
                if ti.static(profiles):
                    high = 1 + (rows + LANES - 1) // LANES
                # rounding may differ from that of _measure_blocks, compiled apart: never write past what it counted
                fits = block + tiles <= last_block and row + tiles * high <= last_row
                if columns > 0 and rows > 0 and fits:
                    k = slope(model, v, middle)
                    jacobian = inverse(identity - k)
                    turn = frame @ jacobian
                    wide_a, wide_b, step = _smears(model, v, middle, turn, pupil_pixel, k)
                    area = ti.abs(jacobian.determinant())
                    # the pixel's pupil point is linear in its column and row
                    p0 = (
                        (1.0 + r) * centre
                        - (ti.Vector([box[0], box[2]]) + 0.5 - ti.Vector([camera[2], camera[3]])) * pixel
                    ) / r
                    lens_row = (j - first_lens[1]) * LAYERS
                    along = (box[2] - first[1]) * stride + box[0] - first[0]
                    middle_px = 0.5 * ti.Vector([columns - 1, rows - 1])
                    # what either form needs: the compiler drops the other's
                    ab = turn @ (position(model, v, p0 - middle_px * pupil_pixel) - centre)
                    to_a, to_b = LEVELS * area / (top_a * top_area * wide_a[0]), LEVELS / (top_b * wide_b[0])
                    p = p0 - middle_px * pupil_pixel
                    k = slope(model, v, p)
                    # slopes are linear in the pixel offset (x, y), the offset from the lens centre is quadratic
                    q = (
                        pupil_pixel
                        * pupil_pixel
                        * ti.Matrix(
                            [
                                [model[v, 3], model[v, 4], model[v, 5]],
                                [model[v, 9], model[v, 10], model[v, 11]],
                            ]
                        )
                    )  # xx, xy, yy
                    d0, dx, dy = position(model, v, p) - centre, -pupil_pixel * k[:, 0], -pupil_pixel * k[:, 1]
                    kx = ti.Matrix([[2.0 * q[0, 0], q[0, 1]], [2.0 * q[1, 0], q[1, 1]]]) / -pupil_pixel
                    ky = ti.Matrix([[q[0, 1], 2.0 * q[0, 2]], [q[1, 1], 2.0 * q[1, 2]]]) / -pupil_pixel
                    to_level = LEVELS / (top_a * top_b * top_area)
                    if ti.static(square):
                        to_level *= (1.0 / wide_a[0]) * (1.0 / wide_b[0])
                    for tile in range(tiles):
                        layer = _layer(
                            model,
                            v,
                            centre,
                            p0,
                            tile,
                            columns,
                            rows,
                            radius,
                            pupil_pixel,
                            frame,
                            jacobian,
                            wide_a,
                            wide_b,
                        )
                        lens_block = (lens_row + layer) * corner.shape[1] + i - first_lens[0]
                        ray_out[block] = lens_block * stride * stride + along + LANES * tile
                        height_out[block] = ti.cast(rows, ti.u16)
                        block += 1
                        if ti.static(profiles):
                            _write_profile(
                                value_out, row, ab[0], step[0, 0], middle_px[0], LANES * tile, columns, wide_a, to_a
                            )
                            row += 1
                            for part in range((rows + LANES - 1) // LANES):
                                _write_profile(
                                    value_out, row, ab[1], step[1, 1], middle_px[1], LANES * part, rows, wide_b, to_b
                                )
                                row += 1
                        else:
                            for part in range((rows + BATCH - 1) // BATCH):
                                levels = ti.Vector.zero(ti.f32, BATCH * LANES)
                                for n in range(BATCH * LANES):  # on local values only: the compiler makes it vectors
                                    x = LANES * tile + n % LANES - middle_px[0]
                                    y = BATCH * part + n // LANES - middle_px[1]
                                    d = d0 + x * (dx + x * q[:, 0] + y * q[:, 1]) + y * (dy + y * q[:, 2])
                                    kk = k + x * kx + y * ky
                                    area = 1.0 / ((1.0 - kk[0, 0]) * (1.0 - kk[1, 1]) - kk[0, 1] * kk[1, 0])
                                    level = ti.f32(0.0)
                                    # frame @ inverse(identity - kk) @ d
                                    gs = ((1.0 - kk[1, 1]) * d[0] + kk[0, 1] * d[1]) * area
                                    gt = (kk[1, 0] * d[0] + (1.0 - kk[0, 0]) * d[1]) * area
                                    a = frame[0, 0] * gs + frame[0, 1] * gt
                                    b = frame[1, 0] * gs + frame[1, 1] * gt
                                    if ti.static(square):
                                        level = ti.abs(area) * _trapezium(a, wide_a) * _trapezium(b, wide_b)
                                    else:
                                        level = ti.abs(area) * ti.max(_in_cell(rectangles, a, b, wide_a, wide_b), 0.0)
                                    level = ti.select(LANES * tile + n % LANES < columns, level * to_level, 0.0)
                                    levels[n] = ti.min(level + 0.5, LEVELS)
                                for n in ti.static(range(BATCH)):
                                    if BATCH * part + n < rows:
                                        for lane in ti.static(range(LANES)):
                                            value_out[row, lane] = ti.cast(levels[LANES * n + lane], ti.u8)
                                        row += 1


def measure_blocks(model, camera, lattice, cell_mm, microimages, *, form):
    """Count the blocks and the rows of each voxel.

    Parameters
    ----------
    model : ndarray, shape (voxel, MODEL_SIZE), float32
        Ray models, see ``raymodel.MODEL_SIZE``.
    camera, lattice
        From `pack_camera` and `pack_lattice`.
    cell_mm : float
        Half extent of a lens's cell along s and t [mm].
    microimages : Microimages
        How the rays lie in memory.
    form : {"profiles", "pixels"}
        See `FORMS`.

    Returns
    -------
    blocks, rows : ndarray, shape (voxel,), int32
    """
    runtime.device()
    blocks, rows = np.empty(len(model), np.int32), np.empty(len(model), np.int32)
    _measure_blocks(
        model, camera, lattice, cell_mm, Lenses(*microimages.first_lens), microimages.corner,
        form == "profiles", blocks, rows,
    )  # fmt: skip
    ti.sync()
    return blocks, rows


def fill_blocks(
    model, camera, lattice, cell_mm, microimages, *,
    frame, rectangles, form, first_block, first_row, ray, height, value, scale,
):  # fmt: skip
    """Compute the weights of consecutive voxels into blocks.

    Parameters
    ----------
    model, camera, lattice, cell_mm, microimages, form
        As for `measure_blocks`.
    frame, rectangles
        The lens's cell, from `lattice.cell_frame` and `lattice.cell_rectangles`; profiles need a single rectangle.
    first_block, first_row : ndarray, shape (voxel + 1,), int64
        Where each voxel's blocks and rows begin; the first entries are those of `ray` and `value`.
    ray : ndarray, shape (block,), int32
        Filled with the index of each block's first ray.
    height : ndarray, shape (block,), uint16
        Zeros; filled with the number of each block's rows of pixels. A block that was counted but is not needed stays
        without rows.
    value : ndarray, shape (row, LANES), uint8
        Filled with the weights in levels, as ``project.Blocks`` orders them.
    scale : ndarray, shape (voxel,), float32
        Filled with the weight of one level.

    Raises
    ------
    ValueError
        If profiles are asked for a cell of several rectangles.
    """
    if form == "profiles" and len(rectangles) != 1:
        raise ValueError("form: profiles need a square microlens layout; use 'pixels' for a hexagonal one.")
    runtime.device()
    _fill_blocks(
        model, camera, lattice, cell_mm, Lenses(*microimages.first_lens), microimages.corner,
        ti.Matrix(np.asarray(frame, np.float32).tolist()), rectangles, first_block, first_row, len(rectangles) == 1,
        form == "profiles", ray, height, value, scale,
    )  # fmt: skip
    ti.sync()
