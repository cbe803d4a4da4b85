"""Simulate an experiment: render a scene's white, board and particle images and write them with their truth.

A camera consists of main lens, microlens array and sensor, misaligned as the scene states (Eqs. 1-3 and 9), with
windows and third-order aberrations. Images are rendered by rays, blurred, exposed, and read out with noise to 12 bits.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
from scipy.ndimage import gaussian_filter

from lfpiv.errors import InputError
from lfpiv.experiment.images import FLIPS
from lfpiv.progress import Progress, ignore_progress
from lfpiv.simulation.flows import Tracers
from lfpiv.simulation.scene import Noise, Scene, open_scene
from lfpiv.simulation.scene_camera import SceneCamera, true_mapping
from lfpiv_kernels.rendering import collect, real_optics, render

log = logging.getLogger(__name__)

FRAMES = ("a", "b")
"""Names of the two frames of a pair."""

FULL_SCALE = 4095
"""Largest count of the simulated 12-bit cameras."""

AREA_STEP_MM = 1e-3
"""Step of the differences that give the area of a dot's image [mm]."""

LEAST_INTENSITY = 0.3
"""Lower limit of a particle's intensity, relative to the mean."""


class PlacedParticles(NamedTuple):
    """Particles of one image pair."""

    position_mm: np.ndarray
    """Positions midway between the frames (x, y, z) [mm], shape (particle, 3)."""
    displacement_mm: np.ndarray
    """Displacements from the first to the second frame [mm], shape (particle, 3)."""
    intensity: np.ndarray
    """Intensities relative to the mean, shape (particle,)."""

    def at_frame(self, frame: str) -> np.ndarray:
        """Return the positions in frame "a" or "b", shape (particle, 3) [mm]."""
        return self.position_mm + (-0.5 if frame == "a" else 0.5) * self.displacement_mm


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
    spread = np.random.default_rng(seed).standard_normal(gain.shape)
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
        lens_gain=gain * np.maximum(0, 1 + camera.lens_gain_sd * spread),
        first_lens=(int(first[0]), int(first[1])),
        plates=camera.plates,
        aberrations=camera.seidel,
    )


def image_area(camera: SceneCamera, points_mm: np.ndarray) -> np.ndarray:
    """Return the area on the array per area of a plane of constant z, averaged over the pupil.

    Points have shape (n, 3) [mm], the result has shape (n,).
    """
    optics, points_mm = camera.optics, np.asarray(points_mm, float)
    if not camera.window and camera.aberrations is None:
        distance = optics.object_distance_mm - camera.local_mm(points_mm)[:, 2]
        scale: np.ndarray = abs(camera.rotation[2, 2]) * (optics.image_distance_mm / distance) ** 2
        return scale
    ring, angle = np.meshgrid(np.sqrt((np.arange(4) + 0.5) / 4), 2 * np.pi * np.arange(8) / 8)
    pupil = optics.pupil_radius_mm * np.stack([ring * np.cos(angle), ring * np.sin(angle)], -1).reshape(-1, 2)
    mapping, step = true_mapping(camera), AREA_STEP_MM * np.eye(3)[:2]
    at, pupil = np.repeat(points_mm, len(pupil), axis=0), np.tile(pupil, (len(points_mm), 1))
    along_x, along_y = ((mapping(at + h, pupil) - mapping(at - h, pupil)) / (2 * AREA_STEP_MM) for h in step)
    area: np.ndarray = np.abs(along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0])
    mean: np.ndarray = area.reshape(len(points_mm), -1).mean(axis=1)
    return mean


def place_particles(scene: Scene, pair: int) -> PlacedParticles:
    """Place the particles of one image pair.

    Parameters
    ----------
    scene : Scene
        The scene.
    pair : int
        Number of the pair, from 0. Each pair has its own particles.

    Returns
    -------
    PlacedParticles

    Raises
    ------
    InputError
        If the scene has less than one particle.
    """
    rng = np.random.default_rng([scene.seed, 1, pair])
    particles, volume = scene.particles, scene.volume
    size = particles.fill * np.asarray(volume.size_mm)
    count = particles.count
    if count is None:
        first = scene.camera[0]
        cell = abs(np.linalg.det(first.lattice.basis_mm)) / first.magnification**2  # area of a microlens in the volume
        count = round(particles.per_microlens * size[0] * size[1] / cell)
    if count < 1:
        raise InputError(
            f"particles.per_microlens: expected at least one particle, found {particles.per_microlens:g}, which "
            "gives none in this volume. Raise it, or give particles.count."
        )
    if isinstance(scene.flow, Tracers) and scene.flow.as_given:
        position, displacement = scene.flow.tracers()
        inside = np.flatnonzero((np.abs(position - volume.centre_mm) <= size / 2).all(1))
        if len(inside) < count:
            log.warning("pair %d: %d particles wanted, the tracer file has %d in the volume", pair, count, len(inside))
        chosen = rng.permutation(inside)[:count]
        position, displacement = position[chosen], displacement[chosen]
    else:
        position = np.asarray(volume.centre_mm) + rng.uniform(-0.5, 0.5, (count, 3)) * size
        displacement = scene.flow_of(pair)(position)
    intensity = np.maximum(LEAST_INTENSITY, 1 + particles.intensity_sd * rng.standard_normal(len(position)))
    return PlacedParticles(position, displacement, intensity)


def simulate(scene: Scene | str | Path, out: str | Path, *, progress: Progress | None = None) -> Path:
    """Render a scene and write it as an experiment with its truth.

    Parameters
    ----------
    scene : Scene, str or Path
        The scene or its file.
    out : str or Path
        Folder to write, absent or empty. It appears only when it is complete.
    progress : callable, optional
        Called as ``progress(step, fraction)``.

    Returns
    -------
    Path
        The experiment file.

    Raises
    ------
    InputError
        If the scene file is invalid, or the folder is not empty or cannot be written.
    """
    if not isinstance(scene, Scene):
        scene = open_scene(scene)
    pairs = [place_particles(scene, pair) for pair in range(scene.particles.pairs)]
    for camera in scene.camera:
        _check_positions(scene, camera, pairs)
    out = Path(out)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: expected an empty or absent folder to write to, found files. Name another folder.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise InputError(f"{out}: the folder cannot be written ({error.strerror}). Name another folder.") from None
    try:
        _write(scene, pairs, scratch, progress or ignore_progress)
        scratch.chmod(0o755)
        os.replace(scratch, out)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    return out / "experiment.toml"


def _check_positions(scene: Scene, camera: SceneCamera, pairs: list[PlacedParticles]) -> None:
    """Refuse dots and particles too near the lens, and log the share of them in the field of view."""
    optics = camera.optics
    half = np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / 2
    dots = np.concatenate([scene.board.dots_mm(depth) for depth in scene.board.planes_mm])
    particles = np.concatenate([placed.at_frame(frame) for placed in pairs for frame in FRAMES])
    for key, label, points in (("board.planes_mm", "the dots", dots), ("volume.size_mm", "the particles", particles)):
        _check_windows(camera, label, points)
        nearest = camera.local_mm(points)[:, 2].max()
        if not nearest < optics.object_distance_mm / 2:
            raise InputError(
                f"{key}: expected everything within {optics.object_distance_mm / 2:g} mm of the plane camera "
                f"{camera.name!r} focuses on, found a point {nearest:g} mm in front of it. Use a smaller extent."
            )
        chief = true_mapping(camera)(points, np.zeros((len(points), 2)))
        share = float((np.abs(chief) <= half).all(1).mean())
        level = logging.INFO if share > 0.5 else logging.WARNING
        log.log(level, "camera %s sees %.1f %% of %s", camera.name, 100 * share, label)


def _check_windows(camera: SceneCamera, label: str, points: np.ndarray) -> None:
    """Refuse windows that are not between the points and the lens, or that rays meet at grazing incidence."""
    so, radius = camera.optics.object_distance_mm, camera.optics.pupil_radius_mm
    try:
        local = camera.local_mm(points)
    except ValueError as error:  # no camera position is in focus through these windows
        raise InputError(f"camera {camera.name!r}: {error}") from None
    edge = radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    pupil = np.column_stack([edge, np.full(len(edge), so)])
    for number, (normal, level, thickness) in enumerate((p[:3], p[3], p[4]) for p in camera.plates):
        key = f"camera {camera.name!r}, window[{number}]"
        inside, beyond = (local @ normal).max() - level, level + thickness - (pupil @ normal).min()
        if inside >= 0 or beyond >= 0:
            name, distance = (label, inside) if inside >= 0 else ("the lens's pupil", beyond)
            raise InputError(
                f"{key}: expected a plate between {label} and the lens, found {name} {distance:.3g} mm on the wrong "
                "side of it. Check point_mm (a point of the surface nearer to the particles), normal and thickness_mm."
            )
        ray = pupil[:, None] - local
        steepest = ((ray @ normal) / np.linalg.norm(ray, axis=-1)).min()
        if steepest < real_optics.STEEPEST:
            raise InputError(
                f"{key}: expected rays that enter it, found an angle of incidence of "
                f"{np.degrees(np.arccos(steepest)):.0f} degrees. Turn its normal towards the camera."
            )


def _write(scene: Scene, pairs: list[PlacedParticles], folder: Path, progress: Progress) -> None:
    """Write images, truth and experiment file."""
    total = len(scene.camera) * (1 + len(scene.board.planes_mm) + 2 * len(pairs))
    total += sum(camera.dark_image for camera in scene.camera)
    done = 0
    for number, camera in enumerate(scene.camera):
        for path, image in _images(scene, number, pairs):
            rng = np.random.default_rng([scene.seed, 2, number, done])
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            exposed = expose(image, camera, scene.noise, rng)
            tifffile.imwrite(folder / path, exposed, compression="zlib", metadata=None)
            done += 1
            progress("simulated images", done / total)
    (folder / "truth").mkdir()
    truth: dict[str, Any] = {}
    for pair, placed in enumerate(pairs):
        truth[f"pair_{pair:04d}_positions_mm"] = placed.position_mm
        truth[f"pair_{pair:04d}_displacement_mm"] = placed.displacement_mm
        truth[f"pair_{pair:04d}_velocity_m_s"] = placed.displacement_mm / scene.dt_s / 1000
        truth[f"pair_{pair:04d}_intensity"] = placed.intensity
    np.savez_compressed(folder / "truth" / "particles.npz", **truth)
    spec = scene.model_dump(mode="json", exclude={"smart", "correlation", "network", "compute"}, exclude_none=True)
    (folder / "truth" / "spec.json").write_text(json.dumps(spec, indent=1) + "\n", "utf-8")
    (folder / "experiment.toml").write_text(_experiment_text(scene), "utf-8")


def _images(scene: Scene, number: int, pairs: list[PlacedParticles]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and noise-free image [count] of everything one camera records."""
    camera = scene.camera[number]
    renderer = render_camera(camera, seed=[scene.seed, 3, number])
    seed = int(np.random.default_rng([scene.seed, 4, number]).integers(2**31))
    if camera.dark_image:
        yield f"dark/{camera.name}.tif", np.zeros(renderer.sensor_shape)
    white = collect.render_white(renderer, samples=scene.quality.pixel_rays, seed=seed)
    yield f"white/{camera.name}.tif", scene.exposure.white_counts * white
    yield from _board_images(scene, number, renderer, seed)
    yield from _particle_images(scene, number, renderer, seed + 1, pairs)


def _board_images(
    scene: Scene, number: int, renderer: render.RenderCamera, seed: int
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and image [count] of each plane of the board."""
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
        dots = board.dots_mm(depth)
        # number of microlenses that the image of a dot covers; each lights its whole microimage
        lenses = np.pi / 4 * board.dot_diameter_mm**2 * image_area(camera, dots)
        lenses /= abs(np.linalg.det(renderer.basis_mm))
        rng = np.random.default_rng([scene.seed, 5, number, plane])
        counts = exposure.dot_counts * renderer.microimage_px * lenses
        yield path, render.render_sources(renderer, dots, counts, board.dot_diameter_mm / 2, rays, rng=rng)


def _particle_images(
    scene: Scene, number: int, renderer: render.RenderCamera, seed: int, pairs: list[PlacedParticles]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and image [count] of both frames of each pair."""
    particles, name = scene.particles, scene.camera[number].name
    rays = render.ray_table(scene.quality.particle_rays, "ball" if particles.sigma_mm is None else "gaussian", seed)
    size = particles.sigma_mm or particles.radius_mm or 0.0
    for pair, placed in enumerate(pairs):
        counts = scene.exposure.particle_counts * renderer.microimage_px * placed.intensity
        for frame in FRAMES:
            rng = np.random.default_rng([scene.seed, 6, number, pair, frame == "b"])
            image = render.render_sources(renderer, placed.at_frame(frame), counts, size, rays, rng=rng)
            yield f"particles/{name}/pair_{pair:04d}_{frame}.tif", image


def expose(image: np.ndarray, camera: SceneCamera, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Turn light [count] into a stored image: blurred, with noise, 12 bits, flipped as the camera does."""
    if camera.blur_px > 0:
        image = gaussian_filter(image, camera.blur_px)
    if noise.full_well_e > 0:
        per_count = noise.full_well_e / FULL_SCALE
        image = rng.poisson(image * per_count) / per_count
    image = image + noise.background + noise.read_noise * rng.standard_normal(image.shape)
    saturated = float((image > FULL_SCALE).mean())
    if saturated > 1e-3:
        log.warning("camera %s: %.1f %% of an image's pixels saturate; lower [exposure]", camera.name, 100 * saturated)
    image = np.clip(np.rint(image), 0, FULL_SCALE).astype(np.uint16)
    return np.ascontiguousarray(image[FLIPS[camera.image_flip]])


def _experiment_text(scene: Scene) -> str:
    """Return the text of the experiment file. It contains nominal values only, none of the truth."""
    lines = [
        "# Light-field PIV experiment: nominal values. Paths are relative to this file.",
        "",
        *_rows({"name": scene.name, "dt_s": scene.dt_s}),
    ]
    for camera in scene.camera:
        known = {"name": camera.name, "white_image": f"white/{camera.name}.tif"}
        if camera.dark_image:
            known["dark_image"] = f"dark/{camera.name}.tif"
        if camera.image_flip != "none":
            known["image_flip"] = camera.image_flip
        optics = ("focal_length_mm", "magnification", "f_number", "microlens_pitch_mm", "microlens_focal_length_mm")
        for key in (*optics, "pixel_um", "microlens_layout", "nominal_angle_deg"):
            known[key] = getattr(camera, key)
        lines += ["", "[[camera]]", *_rows(known)]
    board = scene.board.model_dump(include={"dots", "spacing_mm", "dot_diameter_mm", "planes_mm"})
    board["images"] = "board/{camera}/plane_{plane:02d}.tif"
    particles = {
        "images": "particles/{camera}/pair_{pair:04d}_{frame}.tif",
        "pairs": scene.particles.pairs,
        "frames": FRAMES,
    }
    volume = {"centre_mm": scene.volume.centre_mm} | scene.volume.model_dump(exclude_unset=True)
    tables = {"board": board, "volume": volume, "particles": particles}
    for name in ("smart", "correlation", "network", "compute"):
        tables[name] = getattr(scene, name).model_dump(exclude_unset=True, exclude_none=True)
    for name, table in tables.items():
        if table:
            lines += ["", f"[{name}]", *_rows(table)]
    return "\n".join(lines) + "\n"


def _rows(table: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items()]
