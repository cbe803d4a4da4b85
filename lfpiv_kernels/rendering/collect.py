"""Taichi: plenoptic images by rays traced backward: each pixel collects the light at the other ends of its rays.

The rays end in uniform light (white images) or on a calibration board. ``render`` traces rays forward instead, from
small sources.
"""

import math

import numpy as np
from scipy.stats import qmc

from lfpiv_kernels import runtime
from lfpiv_kernels.libraries import ti
from lfpiv_kernels.rays.lattice import Lattice, lens_centre, nearest_lens
from lfpiv_kernels.rendering import array_faults, real_optics, traced_rays
from lfpiv_kernels.rendering.render import Matrix, Optics, RenderCamera

SPREAD_RAYS = 4096
"""Rays used to bound the blur of a pixel on a board behind real optics."""

Board = ti.types.vector(7, ti.f32)
"""Plane z [mm], dots along x and y, spacing, dot radius [mm], light of a dot and between dots."""
Vector = ti.types.vector(3, ti.f32)


@ti.func
def _dot_distance(s, t, u, v, so, si, rotation, offset, board):
    """Return the distance of a ray's end on the board to the nearest dot's centre [mm], the ray's slant and its depth.

    It has nine parameters because they are numbers of one ray and of the camera, which Taichi inlines.
    """
    start = ti.Vector([-s * so / si, -t * so / si, 0.0])
    slope = ti.Vector([u / so + s / si, v / so + t / si, 1.0])
    normal = ti.Vector([rotation[0, 2], rotation[1, 2], rotation[2, 2]])  # the world's z axis seen by the camera
    level = rotation @ (ti.Vector([0.0, 0.0, board[0]]) - offset)
    slant = normal.dot(slope)
    depth = normal.dot(level - start) / slant
    place = rotation.transpose() @ (start + depth * slope) + offset
    return ti.Vector([_to_nearest_dot(place, board), ti.abs(slant), depth])


@ti.func
def _to_nearest_dot(place, board):
    """Return the distance of a point of the board to the nearest dot's centre [mm]."""
    x = place[0] / board[3] + 0.5 * (board[1] - 1)
    y = place[1] / board[3] + 0.5 * (board[2] - 1)
    i = ti.min(ti.max(ti.round(x), 0.0), board[1] - 1)
    j = ti.min(ti.max(ti.round(y), 0.0), board[2] - 1)
    return board[3] * ti.sqrt((x - i) ** 2 + (y - j) ** 2)


@ti.func
def _real_distance(
    s,
    t,
    u,
    v,
    so,
    si,
    rotation,
    offset,
    board,
    plates: ti.template(),
    aberrations,
    lens_rays: ti.template(),
    thick: ti.template(),
):
    """Return the same distance through windows and a real lens [mm]; parameters as in `_dot_distance`."""
    normal = ti.Vector([rotation[0, 2], rotation[1, 2], rotation[2, 2]])
    level = normal.dot(rotation @ (ti.Vector([0.0, 0.0, board[0]]) - offset))
    plane = ti.Vector([normal[0], normal[1], normal[2], level])
    hit = traced_rays.board_hit(s, t, u, v, so, si, plates, aberrations, lens_rays, thick, plane)
    return _to_nearest_dot(rotation.transpose() @ hit + offset, board)


@ti.func
def ray_of_pixel(
    samples: ti.template(),
    n,
    x,
    y,
    regular_centre,
    middle,
    lattice,
    scale,
    pixel,
    drifting: ti.template(),
    hexagonal: ti.template(),
):
    """Return where a ray of the pixel at (x, y) meets the array and the pupil: s, t, u, v [mm].

    `regular_centre` is the lens's centre before the drift of the pitch, `middle` the real one. It has eleven parameters
    because they are numbers of one ray and of the camera, which Taichi inlines.
    """
    px, py = x + samples[n, 0] * pixel, y + samples[n, 1] * pixel
    p, q = samples[n, 2], samples[n, 3]  # a cell of the lattice: same area, same centre
    s = regular_centre[0] + p * lattice[2] + q * lattice[4]
    t = regular_centre[1] + p * lattice[3] + q * lattice[5]
    if ti.static(hexagonal):  # fold the corners of the rhombus into the lens's own hexagon
        own = nearest_lens(lattice, s, t, True)
        folded = lens_centre(lattice, own[0], own[1])
        s, t = s - folded[0] + regular_centre[0], t - folded[1] + regular_centre[1]
    if ti.static(drifting):
        s, t = s + middle[0] - regular_centre[0], t + middle[1] - regular_centre[1]
    return ti.Vector([s, t, s - (px - middle[0]) / scale, t - (py - middle[1]) / scale])


@ti.kernel
def _collect_pixels(
    # in
    samples: ti.types.ndarray(
        dtype=ti.f32, ndim=2
    ),  # position in the pixel (2) and in the lens's cell (2), -1/2 to 1/2
    rotation: Matrix,  # world to camera
    optics: Optics,
    lattice: Lattice,
    lens_gain: ti.types.ndarray(dtype=ti.f32, ndim=2),
    first_i: ti.i32,
    first_j: ti.i32,
    plates: ti.types.ndarray(dtype=ti.f32, ndim=2),  # `real_optics.pack_plates`
    aberrations: real_optics.Aberrations,
    lens_rays: ti.types.ndarray(dtype=ti.f32, ndim=2),  # `real_optics.lens_offsets`
    thick: ti.template(),  # whether the main lens is one of surfaces
    faults: array_faults.Faults,
    drifting: ti.template(),  # whether the pitch of the lenses drifts
    clipped: ti.template(),  # whether a second aperture clips the pupil
    offset: Vector,
    reach: ti.i32,  # lenses to each side whose light can reach a pixel
    board: Board,
    widest: ti.f32,  # see `widest_spread`; used where not ideal [mm]
    has_board: ti.template(),  # whether the rays end on a board or in uniform light
    ideal: ti.template(),  # whether windows and aberrations are left out
    hexagonal: ti.template(),
    # out
    image_out: ti.types.ndarray(dtype=ti.f32, ndim=2),  # light relative to a fully lit pixel
):
    """Collect the light of every pixel.

    Taichi takes arrays and templates only as arguments of their own, hence their number.
    """
    so, si, radius, scale, pixel = optics[0], optics[1], optics[2], optics[3], optics[4]
    rows, columns, pitch = optics[5], optics[6], optics[7]
    count = samples.shape[0]
    half_pixel = 0.7072 * pixel
    half_lens = 0.7072 * pitch
    inner = radius * scale - half_pixel - half_lens * scale  # all rays of a pixel pass the pupil, or none
    outer = radius * scale + half_pixel + half_lens * scale
    for row, column in image_out:
        x = (column + 0.5 - 0.5 * columns) * pixel
        y = (row + 0.5 - 0.5 * rows) * pixel
        home = nearest_lens(lattice, x / (1 + scale), y / (1 + scale), hexagonal)
        if ti.static(drifting):
            regular = array_faults.undrifted(x / (1 + scale), y / (1 + scale), faults)
            home = nearest_lens(lattice, regular[0], regular[1], hexagonal)
        total = 0.0
        for a, b in ti.ndrange((-reach, reach + 1), (-reach, reach + 1)):
            i, j = ti.cast(home[0], ti.i32) + a - first_i, ti.cast(home[1], ti.i32) + b - first_j
            regular_centre = lens_centre(lattice, home[0] + a, home[1] + b)
            middle = regular_centre
            if ti.static(drifting):
                middle = array_faults.drifted(middle, faults)
            distance = ti.sqrt((x - middle[0] * (1 + scale)) ** 2 + (y - middle[1] * (1 + scale)) ** 2)
            on_array = i >= 0 and i < lens_gain.shape[0] and j >= 0 and j < lens_gain.shape[1]
            if on_array and distance < outer:
                light, even = 1.0, True  # the light where the pixel's rays end, and whether it is the same for all
                if ti.static(has_board):
                    u, v = middle[0] - (x - middle[0]) / scale, middle[1] - (y - middle[1]) / scale
                    if ti.static(ideal):
                        hit = _dot_distance(middle[0], middle[1], u, v, so, si, rotation, offset, board)
                        spread = half_lens * (so - hit[2]) / si + half_pixel / scale * ti.abs(hit[2]) / so
                        even = ti.abs(hit[0] - board[4]) > 1.2 * spread / hit[1]  # 20 % for the slant's change
                        light = board[5] if hit[0] < board[4] else board[6]
                    else:
                        far = _real_distance(
                            *(middle[0], middle[1], u, v, so, si, rotation, offset, board),
                            *(plates, aberrations, lens_rays, thick),
                        )
                        even = ti.abs(far - board[4]) > widest
                        light = board[5] if far < board[4] else board[6]
                seen = light
                if distance > inner or not even or ti.static(clipped):
                    seen = 0.0
                    for n in range(count):
                        s, t, u, v = ray_of_pixel(
                            samples, n, x, y, regular_centre, middle, lattice, scale, pixel, drifting, hexagonal
                        )
                        open_ = u * u + v * v < radius * radius
                        if ti.static(clipped):
                            open_ = open_ and array_faults.passes(s, t, u, v, radius, faults)
                        if open_:
                            if ti.static(has_board):
                                if not even:
                                    far = 0.0
                                    if ti.static(ideal):
                                        far = _dot_distance(s, t, u, v, so, si, rotation, offset, board)[0]
                                    else:
                                        far = _real_distance(
                                            *(s, t, u, v, so, si, rotation, offset, board),
                                            *(plates, aberrations, lens_rays, thick),
                                        )
                                    light = board[5] if far < board[4] else board[6]
                            seen += light / count
                total += seen * lens_gain[i, j]
        image_out[row, column] = total


def widest_spread(camera: RenderCamera, normal: np.ndarray, level_mm: float, seed: int) -> float:
    """Return a bound of the distance on a plane between a pixel's middle ray and its others [mm].

    Parameters
    ----------
    normal : ndarray, shape (3,)
        Unit normal of the plane in the camera's frame.
    level_mm : float
        Product of the normal and a point of the plane in the camera's frame [mm].
    seed : int
        Seed of the rays that are tried.
    """
    rng = np.random.default_rng(seed)
    radius, turn = np.sqrt(rng.random(SPREAD_RAYS)), rng.uniform(0, 2 * np.pi, SPREAD_RAYS)
    pupil = camera.pupil_radius_mm * radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = np.array(camera.sensor_shape[::-1]) * camera.pixel_mm / 2
    array = rng.uniform(-half, half, (SPREAD_RAYS, 2))
    turn = rng.uniform(0, 2 * np.pi, SPREAD_RAYS)
    step = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    hits = []
    scales = (camera.object_distance_mm, camera.image_distance_mm)
    optics = (camera.plates, camera.aberrations, camera.lens)
    for lens, pixel in ((0, 0), (1, 0), (0, 1), (1, 1), (1, -1)):
        moved = 0.7072 * (lens * camera.pitch_mm + pixel * camera.pixel_mm / camera.sensor_per_pupil) * step
        start, direction = real_optics.object_lines(
            array + 0.7072 * lens * camera.pitch_mm * step, pupil + moved, *scales, *optics
        )
        hits.append(start + ((level_mm - start @ normal) / (direction @ normal))[:, None] * direction)
    return 1.3 * float(np.linalg.norm(np.array(hits[1:]) - hits[0], axis=-1).max())


def pixel_samples(count: int, seed: int) -> np.ndarray:
    """Return well-spread rays of a pixel: scrambled Sobol points.

    Parameters
    ----------
    count : int
        Rays, rounded up to a power of two.
    seed : int
        Seed of the scrambling.

    Returns
    -------
    ndarray, shape (ray, 4), float32
        Position in the pixel (2) and in the lens's cell (2), from -1/2 to 1/2.
    """
    bits = max(0, math.ceil(math.log2(count)))
    table = qmc.Sobol(4, scramble=True, seed=np.random.default_rng(seed)).random_base2(bits)
    return (table - 0.5).astype(np.float32)


def lens_reach(camera: RenderCamera) -> int:
    """Return the number of lenses to each side whose light can reach a pixel.

    A lens k steps away lies at least (k cos 30 - 0.58) pitch from a point nearest to its own lens.
    """
    ratio = camera.pupil_radius_mm * camera.sensor_per_pupil / camera.pitch_mm
    return max(1, math.ceil((ratio + 0.6) / 0.866) - 1)


def _collect(camera: RenderCamera, samples: int, seed: int, board: tuple | None) -> np.ndarray:
    """Return the image of a board, or of uniform light if there is none."""
    runtime.device_of_taichi()
    image = np.empty(camera.sensor_shape, np.float32)
    widest = 0.0
    if board is not None and not camera.ideal:
        normal = camera.rotation[:, 2]
        level = normal @ (camera.rotation @ (np.array([0, 0, board[0]]) - camera.offset_mm))
        widest = widest_spread(camera, normal, level, seed)
    _collect_pixels(
        pixel_samples(samples, seed),
        *camera.arguments(),
        Vector(*np.asarray(camera.offset_mm, float)),
        lens_reach(camera),
        Board(*(board or (0.0,) * 7)),
        widest,
        board is not None,
        camera.ideal or board is None,  # uniform light looks the same through windows and aberrations
        bool(camera.hexagonal),
        image,
    )
    ti.sync()
    return image.astype(float)


def render_white(camera: RenderCamera, *, samples: int, seed: int) -> np.ndarray:
    """Return the image of uniform light: the fraction of each pixel that the pupil's images cover.

    Parameters
    ----------
    samples : int
        Rays of a pixel on the edge of a microimage, rounded up to a power of two.
    seed : int
        Seed of the rays.

    Returns
    -------
    ndarray, shape (rows, columns), float64
        Light relative to a fully lit pixel of a lens of gain 1.
    """
    return _collect(camera, samples, seed, None)


def render_board(
    camera: RenderCamera,
    plane_mm: float,
    *,
    dots: tuple[int, int],
    spacing_mm: float,
    dot_diameter_mm: float,
    dot_light: float,
    board_light: float,
    samples: int,
    seed: int,
) -> np.ndarray:
    """Return the image of an endless, evenly radiant board with a grid of round dots in the plane z = plane_mm.

    It has nine parameters because they describe the board one by one; all but two are given by name.

    Parameters
    ----------
    plane_mm : float
        The board's z [mm].
    dots : tuple of int
        Dots along x and y, centred on the z axis.
    spacing_mm, dot_diameter_mm : float
        Distance of neighbouring dots and diameter of a dot [mm].
    dot_light, board_light : float
        Radiance of the dots and of the board between them.
    samples : int
        Rays of a pixel, rounded up to a power of two.
    seed : int
        Seed of the rays.

    Returns
    -------
    ndarray, shape (rows, columns), float64
        Light relative to a fully lit pixel of a lens of gain 1 looking at radiance 1.
    """
    board = (plane_mm, *dots, spacing_mm, dot_diameter_mm / 2, dot_light, board_light)
    return _collect(camera, samples, seed, board)
