"""Images of one simulated camera: white, board, particles, light that is not from particles, and their exposure."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from lfpiv.experiment.images import FLIPS
from lfpiv.simulation.board_errors import BoardTruth, true_board
from lfpiv.simulation.light import StrayLight
from lfpiv.simulation.particles import LitParticles
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.scene_camera import SceneCamera, true_mapping
from lfpiv.simulation.sensor import Noise, Sensor, SensorPattern
from lfpiv.simulation.series import SeriesInstant
from lfpiv.simulation.surfaces import Surface
from lfpiv_kernels.rendering import collect, render, surfaces

log = logging.getLogger(__name__)

FRAMES = ("a", "b")
"""Names of the two frames of a pair."""

AREA_STEP_MM = 1e-3
"""Step of the differences that give the area of a dot's image [mm]."""


def render_camera(camera: SceneCamera, *, seed: int | list[int] = 0) -> render.RenderCamera:
    """Return the renderer's form of a camera. `seed` determines the transmission of its microlenses."""
    optics, lattice = camera.optics, camera.lattice
    half = np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / 2
    corners = (half + 3 * lattice.pitch_mm) * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    index = (corners - lattice.origin_mm) @ np.linalg.inv(lattice.basis_mm)
    first, last = np.floor(index.min(0)).astype(int), np.ceil(index.max(0)).astype(int)
    i, j = (np.arange(low, high + 1) for low, high in zip(first, last, strict=True))
    centre = lattice.centres_mm(np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1))
    gain = 1 - camera.vignetting * np.clip((centre**2).sum(-1) / (half**2).sum(), 0, 1)
    rng = np.random.default_rng(seed)
    gain = gain * np.maximum(0, 1 + camera.lens_gain_sd * rng.standard_normal(gain.shape))
    if camera.array is not None:
        gain = np.where(rng.random(gain.shape) < camera.array.dead_share, 0, gain)
    return render.RenderCamera(
        object_distance_mm=optics.object_distance_mm,
        image_distance_mm=optics.image_distance_mm,
        pupil_radius_mm=optics.pupil_radius_mm,
        sensor_per_pupil=optics.sensor_per_pupil,
        pixel_mm=optics.pixel_mm,
        sensor_shape=optics.sensor_shape,
        rotation=camera.rotation,
        offset_mm=camera.axis_point_mm,
        origin_mm=np.asarray(lattice.origin_mm, float),
        basis_mm=np.asarray(lattice.basis_mm, float),
        hexagonal=lattice.layout == "hexagonal",
        lens_gain=gain,
        first_lens=(int(first[0]), int(first[1])),
        plates=camera.plates,
        aberrations=camera.seidel,
        lens=camera.lens_rays,
        faults=camera.faults,
    )


def image_area(camera: SceneCamera, points_mm: np.ndarray) -> np.ndarray:
    """Return the area on the array per area of a plane of constant z, averaged over the rays that reach the array.

    Points have shape (n, 3) [mm], the result has shape (n,); 0 for a point without such rays.
    """
    optics, points_mm = camera.optics, np.asarray(points_mm, float)
    if not camera.window and camera.aberrations is None and camera.lens is None:
        distance = optics.object_distance_mm - camera.local_mm(points_mm)[:, 2]
        return abs(camera.rotation[2, 2]) * (optics.image_distance_mm / distance) ** 2
    ring, angle = np.meshgrid(np.sqrt((np.arange(4) + 0.5) / 4), 2 * np.pi * np.arange(8) / 8)
    pupil = optics.pupil_radius_mm * np.stack([ring * np.cos(angle), ring * np.sin(angle)], -1).reshape(-1, 2)
    mapping, step = true_mapping(camera), AREA_STEP_MM * np.eye(3)[:2]
    at, pupil = np.repeat(points_mm, len(pupil), axis=0), np.tile(pupil, (len(points_mm), 1))
    along_x, along_y = ((mapping(at + h, pupil) - mapping(at - h, pupil)) / (2 * AREA_STEP_MM) for h in step)
    area: np.ndarray = np.abs(along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0])
    reached = np.isfinite(area).reshape(len(points_mm), -1).sum(axis=1)
    return np.nan_to_num(area).reshape(len(points_mm), -1).sum(axis=1) / np.maximum(reached, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class StaticLight:
    """Light of one camera's particle images that is not from particles; images of shape (rows, columns) [count]."""

    surfaces: tuple[tuple[Surface, np.ndarray], ...]
    """Bright surfaces, each with its image at power 1."""
    stray: np.ndarray
    """Stray light through the lens, at power 1."""
    ambient: np.ndarray
    """Light that reaches the sensor directly."""

    def at_powers(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the images of both frames of a pair whose pulses have the powers `power` (2,)."""
        first, second = (
            power[frame] * self.stray
            + self.ambient
            + sum(surface.powers(power)[frame] * image for surface, image in self.surfaces)
            for frame in range(2)
        )
        return first, second

    def at_power(self, power: float, pulse: int) -> np.ndarray:
        """Return the image of one instant of a series, whose pulse has a power."""
        return self.at_powers(np.full(2, power))[pulse]


def static_light(scene: Scene, number: int, white: np.ndarray) -> StaticLight | None:
    """Return the light of one camera that is not from particles, or None where the scene has none.

    Parameters
    ----------
    number : int
        Number of the camera.
    white : ndarray, shape (rows, columns)
        Light of its white image relative to a fully lit pixel.
    """
    if scene.surface is None and scene.stray_light is None:
        return None
    camera, stray = scene.camera[number].at_particles, scene.stray_light or StrayLight()
    rng = np.random.default_rng([scene.seed, 25, number])
    lens, ambient = stray.fields(camera.optics.sensor_shape, camera.optics.pixel_mm, rng)
    renderer = render_camera(camera, seed=[scene.seed, 3, number])
    seed, samples = int(rng.integers(2**31)), scene.quality.pixel_rays
    lit = []
    for surface in scene.surface or ():
        gaussian = (surface.edges[0] == "gaussian", surface.edges[1] == "gaussian")
        image = surfaces.render_patch(
            renderer, np.asarray(surface.centre_mm), surface.axes, surface.half_mm, gaussian, samples=samples, seed=seed
        )
        lit.append((surface, surface.counts * image))
    return StaticLight(
        surfaces=tuple(lit), stray=stray.lens_counts * lens * white, ambient=stray.ambient_counts * ambient
    )


def board_truth(scene: Scene) -> BoardTruth | None:
    """Return the true dots of a board with errors, None for a board without."""
    if scene.board.errors is None:
        return None
    nominal = np.stack([scene.board.dots_mm(depth) for depth in scene.board.planes_mm])
    rng = np.random.default_rng([scene.seed, 26])
    return true_board(scene.board.errors, nominal, len(scene.camera), rng)


def white_image(scene: Scene, number: int) -> np.ndarray:
    """Return the light of one camera's white image relative to a fully lit pixel, shape (rows, columns)."""
    renderer = render_camera(scene.camera[number], seed=[scene.seed, 3, number])
    return collect.render_white(renderer, samples=scene.quality.pixel_rays, seed=_ray_seed(scene, number))


def _ray_seed(scene: Scene, number: int) -> int:
    return int(np.random.default_rng([scene.seed, 4, number]).integers(2**31))


def camera_images(
    scene: Scene,
    number: int,
    pairs: list[LitParticles],
    *,
    white: np.ndarray,
    static: StaticLight | None,
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and noise-free image [count] of dark, white, board and particle images of one camera.

    Parameters
    ----------
    number : int
        Number of the camera.
    pairs : list of LitParticles
        Particles of each pair.
    white : ndarray, shape (rows, columns)
        From `white_image`.
    static : StaticLight or None
        From `static_light`.
    """
    camera = scene.camera[number]
    if camera.dark_image:
        yield f"dark/{camera.name}.tif", np.zeros(white.shape)
    yield f"white/{camera.name}.tif", scene.exposure.white_counts * white
    yield from _board_images(scene, number)
    yield from _particle_images(scene, number, pairs, static)


def _board_images(scene: Scene, number: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and image [count] of each plane of the board."""
    renderer, seed = render_camera(scene.camera[number], seed=[scene.seed, 3, number]), _ray_seed(scene, number)
    truth = board_truth(scene)
    camera, board, exposure, quality = scene.camera[number], scene.board, scene.exposure, scene.quality
    rays = render.ray_table(quality.dot_rays, "disc", seed)
    for plane, depth in enumerate(board.planes_mm):
        path = f"board/{camera.name}/plane_{plane:02d}.tif"
        if board.inverted:
            image = collect.render_board(
                renderer,
                depth,
                dots=board.dots,
                spacing_mm=board.spacing_mm,
                dot_diameter_mm=board.dot_diameter_mm,
                dot_light=0.0,
                board_light=1.0,
                samples=quality.pixel_rays,
                seed=seed,
            )
            yield path, exposure.dot_counts * image
            continue
        dots = board.dots_mm(depth) if truth is None else truth.dots_mm[plane, truth.present]
        # number of microlenses that the image of a dot covers; each lights its whole microimage
        lenses = np.pi / 4 * board.dot_diameter_mm**2 * image_area(camera, dots)
        lenses /= abs(np.linalg.det(renderer.basis_mm))
        rng = np.random.default_rng([scene.seed, 5, number, plane])
        counts = exposure.dot_counts * renderer.microimage_px * lenses
        if truth is not None:
            counts = counts * truth.light[number, truth.present]
        yield path, render.render_sources(renderer, dots, counts, board.dot_diameter_mm / 2, rays, rng=rng)


def _particle_images(
    scene: Scene, number: int, pairs: list[LitParticles], static: StaticLight | None
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and image [count] of both frames of each pair."""
    name = scene.camera[number].name
    renderer, rays, size = _particle_renderer(scene, number)
    for pair, lit in enumerate(pairs):
        other = None if static is None else static.at_powers(lit.power)
        for pulse, frame in enumerate(FRAMES):
            counts = scene.exposure.particle_counts * renderer.microimage_px * lit.brightness[number, pulse]
            rng = np.random.default_rng([scene.seed, 6, number, pair, frame == "b"])
            image = render.render_sources(renderer, lit.placed.at_frame(frame), counts, size, rays, rng=rng)
            yield f"particles/{name}/pair_{pair:04d}_{frame}.tif", image if other is None else image + other[pulse]


def series_images(
    scene: Scene, number: int, instants: list[SeriesInstant], static: StaticLight | None
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and image [count] of each instant of a series.

    Parameters
    ----------
    number : int
        Number of the camera.
    instants : list of SeriesInstant
        Particles of each instant.
    static : StaticLight or None
        From `static_light`.
    """
    pattern, first, name = scene.particles.images, scene.particles.first, scene.camera[number].name
    renderer, rays, size = _particle_renderer(scene, number)
    for instant, placed in enumerate(instants):
        counts = scene.exposure.particle_counts * renderer.microimage_px * placed.brightness[number]
        rng = np.random.default_rng([scene.seed, 34, number, instant])
        image = render.render_sources(renderer, placed.position_mm, counts, size, rays, rng=rng)
        other = 0.0 if static is None else static.at_power(placed.power, instant % 2)
        yield pattern.format(camera=name, instant=first + instant), image + other


def _particle_renderer(scene: Scene, number: int) -> tuple[render.RenderCamera, np.ndarray, float]:
    """Return the camera as it records particles, the table of their rays, and their size [mm]."""
    particles = scene.particles
    renderer = render_camera(scene.camera[number].at_particles, seed=[scene.seed, 3, number])
    shape, seed = "ball" if particles.sigma_mm is None else "gaussian", _ray_seed(scene, number) + 1
    rays = render.ray_table(scene.quality.particle_rays, shape, seed)
    return renderer, rays, particles.sigma_mm or particles.radius_mm or 0.0


def expose(
    image: np.ndarray,
    camera: SceneCamera,
    noise: Noise,
    rng: np.random.Generator,
    *,
    sensor: Sensor | None = None,
    pattern: SensorPattern | None = None,
) -> np.ndarray:
    """Turn light into a stored image, uint16: blurred, with noise, in whole counts, flipped as the camera does.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Light [count].
    camera : SceneCamera
        The camera; of it `blur_px` and `image_flip` are used.
    noise : Noise
        Noise and level without light.
    rng : Generator
        Generator of the noise.
    sensor : Sensor, optional
        Range of the sensor; default: 12 bits.
    pattern : SensorPattern, optional
        Fixed pattern; default: none.
    """
    sensor = sensor or Sensor()
    if camera.blur_px > 0:
        image = gaussian_filter(image, camera.blur_px)
    if pattern is not None:
        image = image * pattern.gain + pattern.dark
    if noise.full_well_e > 0:
        per_count = noise.full_well_e / sensor.full_scale
        image = rng.poisson(image * per_count) / per_count
    image = image + noise.background + noise.read_noise * rng.standard_normal(image.shape)
    if pattern is not None:
        image = image + pattern.offset
    saturated = float((image > sensor.largest).mean())
    if saturated > 1e-3:
        log.warning("camera %s: %.1f %% of an image's pixels saturate; lower [exposure]", camera.name, 100 * saturated)
    image = np.clip(np.rint(image), 0, np.floor(sensor.largest)).astype(np.uint16)
    return np.ascontiguousarray(image[FLIPS[camera.image_flip]])
