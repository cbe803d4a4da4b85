"""Simulate an experiment: render a scene's white, board and particle images and write them with their truth.

A camera consists of main lens, microlens array and sensor, misaligned as the scene states (Eqs. 1-3 and 9), with
windows, aberrations and faults. Images are rendered by rays, blurred, exposed, and read out with noise.
"""

from __future__ import annotations

import glob
import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.errors import InputError
from lfpiv.files import remove_leftovers, replacing_folder, require_empty
from lfpiv.progress import Progress, ignore_progress
from lfpiv.simulation import truth
from lfpiv.simulation.camera_images import (
    FRAMES,
    StaticLight,
    board_truth,
    camera_images,
    expose,
    series_images,
    static_light,
    white_image,
)
from lfpiv.simulation.image_files import ImageWriter
from lfpiv.simulation.particles import LitParticles, lit_particles, place_particles, seeded_size_mm
from lfpiv.simulation.scene import Scene, open_scene
from lfpiv.simulation.scene_camera import SceneCamera, true_mapping
from lfpiv.simulation.sensor import SensorPattern, draw_pattern
from lfpiv.simulation.series import SeriesInstant, place_series
from lfpiv_kernels.rendering import real_optics

__all__ = ["place_particles", "simulate"]

log = logging.getLogger(__name__)


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
    series = scene.particles.instants is not None
    pairs = [] if series else [lit_particles(scene, pair) for pair in range(scene.particles.pairs)]
    instants = place_series(scene) if series else []
    _check_sheet(scene)
    places = [lit.placed.at_frame(frame) for lit in pairs for frame in FRAMES] + [one.position_mm for one in instants]
    for camera in scene.camera:
        _check_positions(scene, camera, np.concatenate(places))
    out = Path(out)
    require_empty(out)
    remove_leftovers(out.parent, f".{glob.escape(out.name)}.*.tmp")
    with replacing_folder(out) as scratch:
        try:
            scratch.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"{out}: the folder cannot be written ({error.strerror}). Name another folder.") from None
        with ImageWriter(scratch) as files:
            _write(scene, pairs, instants, files, scratch, progress or ignore_progress)
    return out / "experiment.toml"


def _check_positions(scene: Scene, at_board: SceneCamera, particles: np.ndarray) -> None:
    """Refuse dots and particles too near the lens, and log the share of them in the field of view.

    `at_board` is the camera where it stood before it moved, `particles` are positions, shape (n, 3) [mm].
    """
    optics = at_board.optics
    half = np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / 2
    board = board_truth(scene)
    dots = np.concatenate(
        [scene.board.dots_mm(depth) for depth in scene.board.planes_mm] if board is None else board.dots_mm
    )
    seen = (
        ("board.planes_mm", "the dots", dots, at_board),
        ("volume.size_mm", "the particles", particles, at_board.at_particles),
    )
    for key, label, points, camera in seen:
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
    """Refuse windows that are not between points (n, 3) [mm] and the lens, or that rays meet at grazing incidence."""
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


def _check_sheet(scene: Scene) -> None:
    """Warn of a sheet that lights fluid beyond the seeded region, where the scene has no particles."""
    sheet = scene.sheet
    if sheet is None or sheet.thickness_mm is None:
        return
    direction = np.asarray(sheet.direction, float) / np.linalg.norm(sheet.direction)
    half, centre = np.abs(direction) @ seeded_size_mm(scene) / 2, direction @ scene.volume.centre_mm
    lit = np.array([sheet.lit_mm(pulse) for pulse in (0, 1)])
    beyond = np.abs(lit - centre).max() - half
    if beyond > 1e-3 * half:
        log.warning(
            "the sheet lights up to %.2g mm beyond the seeded region, where there are no particles; "
            "set particles.margin_mm",
            beyond,
        )


def _write(
    scene: Scene,
    pairs: list[LitParticles],
    instants: list[SeriesInstant],
    files: ImageWriter,
    folder: Path,
    progress: Progress,
) -> None:
    """Write images, truth and experiment file."""
    total = len(scene.camera) * (1 + len(scene.board.planes_mm) + 2 * len(pairs) + len(instants))
    total += sum(camera.dark_image for camera in scene.camera)
    total += 0 if scene.background is None else len(scene.camera) * len(_background_names(scene))
    written, numbered = 0, 0
    (folder / "truth").mkdir(parents=True)
    for number, camera in enumerate(scene.camera):
        white = white_image(scene, number)
        static = static_light(scene, number, white)
        pattern = _pattern(scene, number)
        for path, image, seed in _camera_images(scene, number, pairs, instants, white, static):
            rng = np.random.default_rng([scene.seed, 2, number, numbered] if seed is None else seed)
            numbered += seed is None
            files.write(path, expose(image, camera, scene.noise, rng, sensor=camera.sensor, pattern=pattern))
            written += 1
            progress("simulated images", written / total)
        if scene.background is not None:
            for frame, name in enumerate(_background_names(scene)):
                path = name.format(camera=camera.name)
                files.write(path, _background_image(scene, number, frame, static, pattern))
                written += 1
                progress("simulated images", written / total)
        truth.write_camera(scene, number, folder / "truth", static=static, pattern=pattern)
    truth.write_scene(scene, instants or pairs, folder / "truth")
    (folder / "experiment.toml").write_text(_experiment_text(scene), "utf-8")


def _camera_images(
    scene: Scene,
    number: int,
    pairs: list[LitParticles],
    instants: list[SeriesInstant],
    white: np.ndarray,
    static: StaticLight | None,
) -> Iterator[tuple[str, np.ndarray, list[int] | None]]:
    """Yield path and noise-free image [count] of one camera, and the seed of its noise; None: by its number.

    An instant of a series has a seed of its own, so its noise does not depend on the length of the series.
    """
    for path, image in camera_images(scene, number, pairs, white=white, static=static):
        yield path, image, None
    for instant, (path, image) in enumerate(series_images(scene, number, instants, static)):
        yield path, image, [scene.seed, 30, number, instant]


def _background_names(scene: Scene) -> list[str]:
    """Return the paths of the images without particles: for pairs a path per frame, for a series a single path."""
    if scene.particles.instants is not None:
        return ["background/{camera}.tif"]
    return [f"background/{{camera}}_{frame}.tif" for frame in FRAMES]


def _pattern(scene: Scene, number: int) -> SensorPattern | None:
    """Draw the fixed pattern of a camera's sensor; None without a table ``[sensor]``."""
    camera = scene.camera[number]
    if camera.sensor is None:
        return None
    return draw_pattern(camera.sensor, camera.optics.sensor_shape, np.random.default_rng([scene.seed, 24, number]))


def _background_image(
    scene: Scene, number: int, frame: int, static: StaticLight | None, pattern: SensorPattern | None
) -> np.ndarray:
    """Return the stored image of one camera and frame without particles, a mean of some recordings.

    In a series the recordings are of both pulses in turn.
    """
    assert scene.background is not None
    camera, count = scene.camera[number], scene.background.averaged
    rng = np.random.default_rng([scene.seed, 28, number, frame])
    pulses = np.random.default_rng([scene.seed, 29, frame])  # equal for all cameras
    mean = np.zeros(camera.optics.sensor_shape)
    for recording in range(count):
        power = np.ones(2) if scene.sheet is None else scene.sheet.powers(pulses)
        pulse = frame if scene.particles.instants is None else recording % 2
        light = mean * 0 if static is None else static.at_powers(power)[pulse]
        mean += expose(light, camera, scene.noise, rng, sensor=camera.sensor, pattern=pattern) / count
    return np.rint(mean).astype(np.uint16)


def _experiment_text(scene: Scene) -> str:
    """Return the text of the experiment file. It contains nominal values only, none of the truth."""
    lines = [
        "# Light-field PIV experiment: nominal values. Paths are relative to this file.",
        "",
        *_rows({"name": scene.name, "dt_s": scene.dt_s}),
    ]
    for camera in scene.camera:
        known: dict[str, Any] = {"name": camera.name, "white_image": f"white/{camera.name}.tif"}
        if camera.dark_image:
            known["dark_image"] = f"dark/{camera.name}.tif"
        if scene.background is not None:
            frame = "_{frame}" if scene.particles.instants is None else ""
            known["background_image"] = f"background/{camera.name}{frame}.tif"
        known["image_flip"] = camera.image_flip
        optics = ("focal_length_mm", "magnification", "f_number", "microlens_pitch_mm", "microlens_focal_length_mm")
        for key in (*optics, "pixel_um", "microlens_layout", "nominal_angle_deg", "nominal_direction"):
            known[key] = getattr(camera, key)
        known = {key: value for key, value in known.items() if value is not None}
        if camera.nominal_roll_deg:
            known["nominal_roll_deg"] = camera.nominal_roll_deg
        lines += ["", "[[camera]]", *_rows(known)]
    board = scene.board.model_dump(include={"dots", "spacing_mm", "dot_diameter_mm", "planes_mm"})
    if scene.board.mark:
        board["mark"] = scene.board.mark
    board["images"] = "board/{camera}/plane_{plane:02d}.tif"
    volume = {"centre_mm": scene.volume.centre_mm} | scene.volume.model_dump(exclude_unset=True)
    tables = {"board": board, "volume": volume, "particles": _particles_table(scene)}
    for name in ("smart", "correlation", "network", "compute"):
        tables[name] = getattr(scene, name).model_dump(exclude_unset=True, exclude_none=True)
    for name, table in tables.items():
        if table:
            lines += ["", f"[{name}]", *_rows(table)]
    return "\n".join(lines) + "\n"


def _particles_table(scene: Scene) -> dict[str, Any]:
    """Return the table ``[particles]`` of the experiment file."""
    particles = scene.particles
    if particles.instants is not None:
        return {name: getattr(particles, name) for name in ("images", "instants", "first", "step")}
    images = "particles/{camera}/pair_{pair:04d}_{frame}.tif"
    return {"images": images, "pairs": particles.pairs, "frames": FRAMES}


def _rows(table: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items()]
