"""Twins of the simulator's kernels: true rays in float64, ray by ray, added up by definition."""

import numpy as np
from support.simulated_cameras import land, lens_gain

from lfpiv.simulation.scene import true_mapping
from lfpiv_kernels.rendering import real_optics


def turned(vectors, angle):
    return vectors @ [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]


def sources(scene_camera, renderer, centres, counts, extent, rays, rng):
    """Return what `render_sources` does."""
    image, mapping = 0, true_mapping(scene_camera)
    angles = rng.uniform(0, 2 * np.pi, (len(centres), 2))
    for centre, count, (turn, roll) in zip(centres, counts, angles, strict=True):
        pupil = scene_camera.optics.pupil_radius_mm * turned(rays[:, :2], turn)
        unit = rays[:, 2:].astype(float)
        unit[:, :2] = turned(unit[:, :2], roll)
        weight = np.full(len(rays), count / len(rays))
        image = image + land(scene_camera, renderer, mapping(centre + extent * unit, pupil), pupil, weight)
    return image


def pixel_rays(scene_camera, table):
    """Yield lens (i, j), (s, t) and (u, v) of the rays of all pixels through each of 3 x 3 lenses, by Eq. 9.

    Arrays have shape (row, column, ray, 2).
    """
    optics, lattice, drift = scene_camera.optics, scene_camera.lattice, scene_camera.faults[:2]
    scale = optics.microlens_focal_length_mm / optics.image_distance_mm
    rows, columns = optics.sensor_shape
    row, column = np.indices((rows, columns))
    middle = (np.stack([column, row], axis=-1) + 0.5 - np.array([columns, rows]) / 2) * optics.pixel_mm
    cell = table[:, 2:] @ lattice.basis_mm
    cell -= lattice.centres_mm(lattice.nearest(cell + lattice.origin_mm)) - lattice.origin_mm  # into a lens's own cell
    near = middle / (1 + scale)
    home = lattice.nearest(2 * near / (1 + np.sqrt(1 + 4 * drift * near)))
    for step in np.ndindex(3, 3):
        index = home + np.array(step) - [1, 1]
        regular = lattice.centres_mm(index)
        lens = (regular + drift * regular**2)[:, :, None]
        s_t = lens + cell
        yield index, s_t, s_t - (middle[:, :, None] + table[:, :2] * optics.pixel_mm - lens) / scale


def open_rays(scene_camera, s_t, pupil):
    """Return which rays pass both apertures."""
    radius, eye = scene_camera.optics.pupil_radius_mm, scene_camera.faults[2]
    return ((pupil**2).sum(-1) < radius**2) & (((pupil - eye * s_t) ** 2).sum(-1) < radius**2)


def plane_light(scene_camera, renderer, table, plane, light):
    """Return the light that each pixel's rays find on a plane, traced back to it.

    The plane is a point of it and its normal in the world [mm]. `light` maps places in the world (n, 3) to light (n,).
    """
    optics, image, (point, normal) = scene_camera.optics, 0, plane
    scales = (optics.object_distance_mm, optics.image_distance_mm)
    for index, s_t, pupil in pixel_rays(scene_camera, table):
        passing, found = open_rays(scene_camera, s_t, pupil), np.zeros(s_t.shape[:-1])
        start, direction = real_optics.object_lines(
            s_t[passing], pupil[passing], *scales, renderer.plates, renderer.aberrations
        )
        start, direction = start @ renderer.rotation + renderer.offset_mm, direction @ renderer.rotation
        along = ((point - start) @ normal) / (direction @ normal)
        found[passing] = light(start + along[:, None] * direction)
        gain = lens_gain(renderer, index.reshape(-1, 2)).reshape(index.shape[:-1])
        image = image + gain * found.mean(axis=-1)
    return image


def board(scene_camera, renderer, plane_mm, dots, spacing_mm, dot_diameter_mm, table):
    """Return what `render_board` does of bright dots."""

    def light(places):
        off = [
            np.abs(at[:, None] - (np.arange(n) - (n - 1) / 2) * spacing_mm).min(1)
            for at, n in zip(places.T[:2], dots, strict=True)
        ]
        return np.hypot(*off) < dot_diameter_mm / 2

    return plane_light(scene_camera, renderer, table, (np.array([0, 0, plane_mm]), np.array([0, 0, 1.0])), light)
