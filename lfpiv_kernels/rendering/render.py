"""Taichi: raw plenoptic images of small bright sources, by rays through main lens and microlens array (Eqs. 1-3 and 9).

Each ray adds its energy to the pixel that it meets. ``collect`` traces rays backward instead.

Sums are 64-bit integers of `FIXED` units per count. So an image does not depend on the order in which threads add: it
is the same in every run and for any number of threads.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import stats
from scipy.stats import qmc

from lfpiv_kernels import runtime
from lfpiv_kernels.libraries import ti
from lfpiv_kernels.rays.lattice import Lattice, lens_centre, nearest_lens, pack_lattice
from lfpiv_kernels.rendering import array_faults, real_optics, traced_rays

FIXED = 1 << 20
"""Integer units per count: 20 bits below one count, 43 bits above."""

RAYS_PER_TASK = 2048
"""Rays of a parallel task on the CPU, so few that a few sources with many rays make enough tasks for all threads."""
MOST_TASKS = 1 << 30
"""Parallel tasks of a launch on a GPU, where each ray is a task if there are no more. Taichi's indices have 31 bits."""

SOURCES = ("ball", "gaussian", "disc")
"""Shapes of a source: a ball or a disc of given radius, or a Gaussian of given standard deviation."""

Optics = ti.types.vector(8, ti.f32)
"""Object distance, image distance, pupil radius [mm], f_m/s_i, pixel [mm], rows, columns, microlens pitch [mm]."""
Matrix = ti.types.matrix(3, 3, ti.f32)


@dataclass(frozen=True, kw_only=True)
class RenderCamera:
    """A plenoptic camera as the renderer takes it; camera point = rotation @ (world point - offset)."""

    object_distance_mm: float
    """Main lens to the plane in focus, s_o [mm]."""
    image_distance_mm: float
    """Main lens to the microlens array, s_i [mm]."""
    pupil_radius_mm: float
    """Radius of the main lens's pupil [mm]."""
    sensor_per_pupil: float
    """f_m / s_i, the scale of the pupil's image behind a microlens."""
    pixel_mm: float
    """Pixel pitch [mm]."""
    sensor_shape: tuple[int, int]
    """Rows, columns."""
    rotation: np.ndarray
    """World to camera, shape (3, 3)."""
    offset_mm: np.ndarray
    """World point (x, y, z) on the camera's axis in the plane in focus [mm]."""
    origin_mm: np.ndarray
    """Centre (s, t) of lens (0, 0) [mm]."""
    basis_mm: np.ndarray
    """Lattice vectors of the microlens array, shape (2, 2) [mm]."""
    hexagonal: bool
    """Whether the lattice vectors are 60 degrees apart. A ray belongs to the nearest lens in any case."""
    lens_gain: np.ndarray
    """Transmission of each lens, shape (i, j). No light passes lenses outside the table."""
    first_lens: tuple[int, int]
    """Lattice index (i, j) of ``lens_gain[0, 0]``."""
    plates: np.ndarray = field(default_factory=lambda: np.empty((0, 7)))
    """Windows between particles and lens, the one next to the particles first: `real_optics.pack_plates`."""
    aberrations: np.ndarray = field(default_factory=lambda: np.zeros(9))
    """Third-order aberrations of the main lens: `real_optics.Aberrations`."""
    lens: np.ndarray = field(default_factory=lambda: real_optics.NO_LENS[:0])
    """Polynomial of a main lens of surfaces: `real_optics.lens_offsets`; empty without."""
    faults: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Drift of the microlenses' pitch and cat's eye of the main lens: `array_faults.Faults`."""

    @property
    def ideal(self) -> bool:
        """Whether the camera is a thin lens without windows and aberrations."""
        return len(self.plates) == 0 and len(self.lens) == 0 and not np.any(self.aberrations[4:])

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbouring lenses [mm], from the area of the lattice's cell."""
        return math.sqrt(abs(np.linalg.det(self.basis_mm)) * (2 / math.sqrt(3) if self.hexagonal else 1))

    @property
    def microimage_px(self) -> float:
        """Area of a fully lit microimage [pixel]."""
        return math.pi * (self.pupil_radius_mm * self.sensor_per_pupil / self.pixel_mm) ** 2

    def arguments(self) -> tuple:
        """Return the arguments of the kernels from `rotation` to `clipped`."""
        scale = (self.object_distance_mm, self.image_distance_mm, self.pupil_radius_mm, self.sensor_per_pupil)
        return (
            Matrix(np.asarray(self.rotation, float).tolist()),
            Optics(*scale, self.pixel_mm, *self.sensor_shape, self.pitch_mm),
            pack_lattice(self.origin_mm, self.basis_mm),
            np.ascontiguousarray(self.lens_gain, np.float32),
            *map(int, self.first_lens),
            np.ascontiguousarray(self.plates if len(self.plates) else real_optics.NO_PLATE, np.float32),
            real_optics.Aberrations(*np.asarray(self.aberrations, float)),
            np.ascontiguousarray(self.lens if len(self.lens) else real_optics.NO_LENS, np.float32),
            len(self.lens) > 0,
            array_faults.Faults(*np.asarray(self.faults, float)),
            bool(np.any(self.faults[:2])),
            bool(self.faults[2]),
        )


def ray_table(count: int, shape: str, seed: int) -> np.ndarray:
    """Return well-spread rays of a source: scrambled Sobol points mapped to the pupil's disc and to the source's shape.

    Parameters
    ----------
    count : int
        Rays, rounded up to a power of two, because so many Sobol points are balanced.
    shape : {"ball", "gaussian", "disc"}
        Shape of the source.
    seed : int
        Seed of the scrambling.

    Returns
    -------
    ndarray, shape (ray, 5), float32
        Position on the unit pupil (u, v) and in the unit source (x, y, z). A disc lies in its own x-y plane.
    """
    if shape not in SOURCES:
        raise ValueError(f"shape: expected one of {', '.join(SOURCES)}, got {shape!r}.")
    bits = max(0, math.ceil(math.log2(count)))
    points = qmc.Sobol(5, scramble=True, seed=np.random.default_rng(seed)).random_base2(bits)
    table = np.empty((len(points), 5))
    radius, angle = np.sqrt(points[:, 0]), 2 * np.pi * points[:, 1]
    table[:, 0], table[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    angle = 2 * np.pi * points[:, 3]
    if shape == "disc":
        height, across = np.zeros(len(points)), np.sqrt(points[:, 2])
    else:
        direction = 2 * points[:, 4] - 1
        if shape == "ball":
            length = np.cbrt(points[:, 2])
        else:  # radius of a 3-D standard normal: chi distribution with three degrees of freedom
            length = stats.chi.ppf(np.clip(points[:, 2], 1e-9, 1 - 1e-9), 3)
        height, across = length * direction, length * np.sqrt(1 - direction**2)
    table[:, 2], table[:, 3], table[:, 4] = across * np.cos(angle), across * np.sin(angle), height
    # neighbours on the pupil light neighbouring pixels: the pixels of sorted rays stay in the processor's cache
    order = np.lexsort((table[:, 0], np.floor(table[:, 1] * 8)))
    return table[order].astype(np.float32)


@ti.kernel
def _trace_sources(
    # in
    centre: ti.types.ndarray(dtype=ti.f32, ndim=2),  # camera frame [mm], (source, 3)
    spin: ti.types.ndarray(dtype=ti.f32, ndim=2),  # cosine, sine of the turns of pupil points and source
    extent: ti.types.ndarray(dtype=ti.f32, ndim=1),  # size of the unit source [mm], (source,)
    energy: ti.types.ndarray(dtype=ti.f32, ndim=1),  # of one ray [count], (source,)
    rays: ti.types.ndarray(dtype=ti.f32, ndim=2),  # `ray_table`
    rotation: Matrix,
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
    per_task: ti.i32,
    glass: ti.template(),  # whether there are windows
    aberrated: ti.template(),  # whether there are aberrations
    hexagonal: ti.template(),
    # out
    image_out: ti.types.ndarray(dtype=ti.i64, ndim=2),  # [1/FIXED count], added to
):
    """Trace the rays of all sources.

    Taichi takes arrays and templates only as arguments of their own, hence their number.
    """
    so, si, radius, scale, pixel = optics[0], optics[1], optics[2], optics[3], optics[4]
    rows, columns = ti.cast(optics[5], ti.i32), ti.cast(optics[6], ti.i32)
    tasks = (rays.shape[0] + per_task - 1) // per_task
    for source, task in ti.ndrange(centre.shape[0], tasks):
        middle = ti.Vector([centre[source, 0], centre[source, 1], centre[source, 2]])
        turn_c, turn_s = spin[source, 0], spin[source, 1]
        roll_c, roll_s = spin[source, 2], spin[source, 3]
        size = extent[source]
        shift = ti.Vector([0.0, 0.0, 0.0])
        off = ti.Vector([0.0, 0.0])
        for ray in range(task * per_task, ti.min(rays.shape[0], (task + 1) * per_task)):
            a, b = rays[ray, 0], rays[ray, 1]
            u, v = radius * (turn_c * a - turn_s * b), radius * (turn_s * a + turn_c * b)
            a, b = rays[ray, 2], rays[ray, 3]
            place = middle + rotation @ (
                size * ti.Vector([roll_c * a - roll_s * b, roll_s * a + roll_c * b, rays[ray, 4]])
            )
            if ti.static(glass and not thick):
                shift = traced_rays.apparent_shift(place, shift, u, v, so, plates)
                place += shift
            m = si / (so - place[2])
            k = m * place[2] / so  # 1 - si/f + si/d without its cancellation
            s, t = k * u - m * place[0], k * v - m * place[1]
            passes = True
            if ti.static(thick):
                found = traced_rays.array_place(place, off, u, v, so, si, plates, aberrations, lens_rays)
                off, passes = ti.Vector([found[0], found[1]]), found[2] > 0.0
                s, t = s + off[0], t + off[1]
            if ti.static(aberrated):
                passes = (s * s + t * t) * aberrations[3] ** 2 < real_optics.FIELD_STOP**2
                error = traced_rays.aberration(s, t, u, v, aberrations)
                s, t = s + error[0], t + error[1]
            if ti.static(clipped):
                passes = passes and array_faults.passes(s, t, u, v, radius, faults)
            lens = ti.Vector([0.0, 0.0])
            centre_st = ti.Vector([0.0, 0.0])
            if ti.static(drifting):
                place_st = array_faults.undrifted(s, t, faults)
                lens = nearest_lens(lattice, place_st[0], place_st[1], hexagonal)
                centre_st = array_faults.drifted(lens_centre(lattice, lens[0], lens[1]), faults)
            else:
                lens = nearest_lens(lattice, s, t, hexagonal)
                centre_st = lens_centre(lattice, lens[0], lens[1])
            i, j = ti.cast(lens[0], ti.i32) - first_i, ti.cast(lens[1], ti.i32) - first_j
            column = ti.cast(ti.floor((centre_st[0] + scale * (s - u)) / pixel + 0.5 * columns), ti.i32)
            row = ti.cast(ti.floor((centre_st[1] + scale * (t - v)) / pixel + 0.5 * rows), ti.i32)
            on_sensor = row >= 0 and row < rows and column >= 0 and column < columns
            if passes and on_sensor and i >= 0 and i < lens_gain.shape[0] and j >= 0 and j < lens_gain.shape[1]:
                ti.atomic_add(
                    image_out[row, column], ti.cast(ti.round(energy[source] * lens_gain[i, j] * FIXED), ti.i64)
                )


def render_sources(
    camera: RenderCamera,
    points_mm: np.ndarray,
    counts: np.ndarray,
    extent_mm: np.ndarray | float,
    rays: np.ndarray,
    *,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return the image of small bright sources.

    Parameters
    ----------
    points_mm : ndarray, shape (source, 3)
        Centres (x, y, z) in the world [mm].
    counts : ndarray, shape (source,)
        Light of each source through the pupil, summed over its pixels [count].
    extent_mm : float or ndarray, shape (source,)
        Radius (ball, disc) or standard deviation (Gaussian) [mm]. A disc lies in the world's x-y plane.
    rays : ndarray, shape (ray, 5)
        Rays of every source, from `ray_table`. Each source turns them by random angles.
    rng : Generator
        Generator of the angles.

    Returns
    -------
    ndarray, shape (rows, columns), float64
        Counts per pixel, without noise.
    """
    form = runtime.device_of_taichi().form
    points_mm = np.asarray(points_mm, float).reshape(-1, 3)
    count = len(points_mm)
    if not np.isfinite(points_mm).all():
        raise ValueError("points_mm: expected finite coordinates, got NaN or infinity.")
    centre = (points_mm - camera.offset_mm) @ np.asarray(camera.rotation, float).T
    if count and centre[:, 2].max() >= camera.object_distance_mm / 2:
        raise ValueError(
            f"points_mm: expected sources within {camera.object_distance_mm / 2:g} mm of the focal plane, "
            f"got one {centre[:, 2].max():g} mm in front of it."
        )
    angle = rng.uniform(0, 2 * np.pi, (count, 2))
    spin = np.stack([np.cos(angle[:, 0]), np.sin(angle[:, 0]), np.cos(angle[:, 1]), np.sin(angle[:, 1])], 1)
    image = np.zeros(camera.sensor_shape, np.int64)
    if count:
        _trace_sources(
            np.ascontiguousarray(centre, np.float32),
            np.ascontiguousarray(spin, np.float32),
            np.ascontiguousarray(np.broadcast_to(extent_mm, count), np.float32),
            np.ascontiguousarray(np.broadcast_to(counts, count) / len(rays), np.float32),
            np.ascontiguousarray(rays, np.float32),
            *camera.arguments(),
            RAYS_PER_TASK if form == "cpu" else -(-count * len(rays) // MOST_TASKS),
            len(camera.plates) > 0,
            bool(np.any(camera.aberrations[4:])),
            bool(camera.hexagonal),
            image,
        )
        ti.sync()
    return image / FIXED
