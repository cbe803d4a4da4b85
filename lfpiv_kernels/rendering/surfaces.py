"""Taichi: plenoptic images of bright patches of a plane, by rays traced backward from each pixel as in ``collect``."""

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.libraries import ti
from lfpiv_kernels.rays.lattice import Lattice, lens_centre, nearest_lens
from lfpiv_kernels.rendering import array_faults, real_optics, traced_rays
from lfpiv_kernels.rendering.collect import lens_reach, pixel_samples, ray_of_pixel, widest_spread
from lfpiv_kernels.rendering.render import Optics, RenderCamera

Patch = ti.types.vector(14, ti.f32)
"""In the camera's frame: centre, unit vectors along and across (9) [mm]; their product is the plane's normal. Then half
length, half width [mm] or their standard deviations, whether the edges along and across are Gaussian (1) or sharp (0),
and the level of the plane, its normal times its centre [mm]."""


GAUSSIAN_REACH = 6.0
"""Distance in standard deviations beyond which a Gaussian edge is dark: 1.5e-8 of the light is left."""


@ti.func
def _place(
    s,
    t,
    u,
    v,
    so,
    si,
    plates: ti.template(),
    aberrations,
    lens_rays: ti.template(),
    thick: ti.template(),
    patch,
    ideal: ti.template(),
):
    """Return where the ray from (s, t) through (u, v) meets the patch's plane: distances along and across [mm].

    It has twelve parameters because they are numbers of one ray, of the camera and of the patch, which Taichi inlines.
    """
    along = ti.Vector([patch[3], patch[4], patch[5]])
    across = ti.Vector([patch[6], patch[7], patch[8]])
    normal = along.cross(across)
    hit = ti.Vector([0.0, 0.0, 0.0])
    if ti.static(ideal):
        start = ti.Vector([-s * so / si, -t * so / si, 0.0])
        slope = ti.Vector([u / so + s / si, v / so + t / si, 1.0])
        hit = start + (patch[13] - normal.dot(start)) / normal.dot(slope) * slope
    else:
        plane = ti.Vector([normal[0], normal[1], normal[2], patch[13]])
        hit = traced_rays.board_hit(s, t, u, v, so, si, plates, aberrations, lens_rays, thick, plane)
    arm = hit - ti.Vector([patch[0], patch[1], patch[2]])
    place = ti.Vector([arm.dot(along), arm.dot(across)])
    if not hit[2] < so:  # the plane meets the ray behind the lens, or never
        place = ti.Vector([1e30, 1e30])
    return place


@ti.func
def _edge(distance, half, gaussian):
    """Return the radiance at a distance from the middle, of a strip with sharp or Gaussian edges."""
    light = 0.0
    if gaussian > 0.0:
        light = ti.exp(-0.5 * (distance / half) ** 2)
    elif ti.abs(distance) < half:
        light = 1.0
    return light


@ti.kernel
def _collect_patch(
    # in
    samples: ti.types.ndarray(dtype=ti.f32, ndim=2),  # as in `collect`
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
    reach: ti.i32,  # lenses to each side whose light can reach a pixel
    patch: Patch,
    widest: ti.f32,  # see `collect.widest_spread` [mm]
    ideal: ti.template(),  # whether windows and aberrations are left out
    hexagonal: ti.template(),
    # out
    image_out: ti.types.ndarray(dtype=ti.f32, ndim=2),  # light relative to a fully lit pixel
):
    """Collect the light of a patch in every pixel.

    Taichi takes arrays and templates only as arguments of their own, hence their number.
    """
    so, si, radius, scale, pixel = optics[0], optics[1], optics[2], optics[3], optics[4]
    rows, columns, pitch = optics[5], optics[6], optics[7]
    count = samples.shape[0]
    outer = radius * scale + 0.7072 * (pixel + pitch * scale)
    dark = ti.Vector([0.0, 0.0])  # distances from the middle of the patch beyond which a pixel sees none of it
    for axis in ti.static(range(2)):
        dark[axis] = patch[9 + axis] * (GAUSSIAN_REACH if patch[11 + axis] > 0.0 else 1.0) + widest
    for row, column in image_out:
        x = (column + 0.5 - 0.5 * columns) * pixel
        y = (row + 0.5 - 0.5 * rows) * pixel
        regular = ti.Vector([x / (1 + scale), y / (1 + scale)])
        if ti.static(drifting):
            regular = array_faults.undrifted(regular[0], regular[1], faults)
        home = nearest_lens(lattice, regular[0], regular[1], hexagonal)
        total = 0.0
        for a, b in ti.ndrange((-reach, reach + 1), (-reach, reach + 1)):
            i, j = ti.cast(home[0], ti.i32) + a - first_i, ti.cast(home[1], ti.i32) + b - first_j
            regular_centre = lens_centre(lattice, home[0] + a, home[1] + b)
            middle = regular_centre
            if ti.static(drifting):
                middle = array_faults.drifted(regular_centre, faults)
            distance = ti.sqrt((x - middle[0] * (1 + scale)) ** 2 + (y - middle[1] * (1 + scale)) ** 2)
            on_array = i >= 0 and i < lens_gain.shape[0] and j >= 0 and j < lens_gain.shape[1]
            if on_array and distance < outer:
                seen = 0.0
                u0, v0 = middle[0] - (x - middle[0]) / scale, middle[1] - (y - middle[1]) / scale
                far = ti.abs(
                    _place(*(middle[0], middle[1], u0, v0, so, si, plates, aberrations, lens_rays, thick, patch, ideal))
                )
                rays = 0
                if far[0] < dark[0] and far[1] < dark[1]:
                    rays = count
                for n in range(rays):
                    s, t, u, v = ray_of_pixel(
                        samples, n, x, y, regular_centre, middle, lattice, scale, pixel, drifting, hexagonal
                    )
                    open_ = u * u + v * v < radius * radius
                    if ti.static(clipped):
                        open_ = open_ and array_faults.passes(s, t, u, v, radius, faults)
                    if open_:
                        place = _place(s, t, u, v, so, si, plates, aberrations, lens_rays, thick, patch, ideal)
                        light = _edge(place[0], patch[9], patch[11]) * _edge(place[1], patch[10], patch[12])
                        seen += light / count
                total += seen * lens_gain[i, j]
        image_out[row, column] = total


def render_patch(
    camera: RenderCamera,
    centre_mm: np.ndarray,
    axes: np.ndarray,
    half_mm: tuple[float, float],
    gaussian: tuple[bool, bool],
    *,
    samples: int,
    seed: int,
) -> np.ndarray:
    """Return the image of a bright patch of a plane that radiates evenly in all directions (Lambert).

    Parameters
    ----------
    centre_mm : ndarray, shape (3,)
        Centre of the patch (x, y, z) in the world [mm].
    axes : ndarray, shape (2, 3)
        Unit vectors along and across the patch, at right angles to each other.
    half_mm : (float, float)
        Half length and half width [mm]; with a Gaussian profile its standard deviation.
    gaussian : (bool, bool)
        Whether the radiance falls off as a Gaussian along and across, or ends sharply.
    samples : int
        Rays of a pixel, rounded up to a power of two.
    seed : int
        Seed of the rays.

    Returns
    -------
    ndarray, shape (rows, columns), float64
        Light relative to a fully lit pixel of a lens of gain 1 looking at radiance 1, the patch's largest.
    """
    runtime.device_of_taichi()
    rotation = np.asarray(camera.rotation, float)
    centre = rotation @ (np.asarray(centre_mm, float) - camera.offset_mm)
    along, across = np.asarray(axes, float) @ rotation.T
    level = float(np.cross(along, across) @ centre)
    image = np.empty(camera.sensor_shape, np.float32)
    _collect_patch(
        pixel_samples(samples, seed),
        *camera.arguments()[1:],
        lens_reach(camera),
        Patch(*centre, *along, *across, *map(float, half_mm), *map(float, gaussian), level),
        widest_spread(camera, np.cross(along, across), level, seed),
        camera.ideal,
        bool(camera.hexagonal),
        image,
    )
    ti.sync()
    return image.astype(float)
