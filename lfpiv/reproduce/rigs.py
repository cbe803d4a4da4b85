"""Simulate and calibrate the rig of the paper's numerical study (Table 2), and record particle images with it.

Several cases share the rig, so it is calibrated once and stored.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lfpiv import files, metrics
from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.camera import Calibration, load_calibration
from lfpiv.calibration.cameras import calibrate, thin_lens
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import open_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.progress import Progress
from lfpiv.reconstruction.volume import reconstruct
from lfpiv.settings.processing import Smart
from lfpiv.simulation.camera_images import expose, render_camera
from lfpiv.simulation.flows import Ring, window_mean
from lfpiv.simulation.scene import Scene, true_mapping
from lfpiv.simulation.sensor import FULL_SCALE
from lfpiv.simulation.simulator import simulate
from lfpiv.weights.operator import Weights, build_weights
from lfpiv_kernels import runtime
from lfpiv_kernels.rendering import render

log = logging.getLogger(__name__)

VOXEL_MM = 0.1
"""Edge of the paper's voxels [mm], one microlens."""
OPTICS = {
    "focal_length_mm": 100.0,
    "magnification": -1.0,
    "f_number": 4.0,
    "microlens_pitch_mm": 0.1,
    "microlens_focal_length_mm": 0.8,
    "pixel_um": 5.5,
}
"""Table 2: main lens, microlenses, and the numerical column's pixels."""
ANGLES_DEG = (45.0, -45.0)
"""Separation angles of the two cameras."""
ANGLE_ERRORS = {
    "plus": ((1.0, 0.0), (-1.0, 0.0)),
    "turned": ((1.0, 0.0), (1.0, 0.0)),
    "rolled": ((0.0, 0.5), (0.0, -0.5)),
}
"""Errors (yaw, roll) of each camera's angle in direct ray tracing, per degree. "plus": both separation angles are
overestimated (Eqs. 11-12). "turned": both cameras have the same error in the same sense. "rolled": the cameras are
rolled about their axes, half a degree each."""
ANGLE_ERRORS_DEG = (1, 2, 4)
"""Sizes of these errors [degree]; the paper has 1."""
TURNED_DEG = {"drt": ((0.0, 0.0), (0.0, 0.0))} | {
    f"drt_{kind}_{size}deg": tuple((size * yaw, size * roll) for yaw, roll in errors)
    for kind, errors in ANGLE_ERRORS.items()
    for size in ANGLE_ERRORS_DEG
}
"""Errors (yaw, roll) of each camera by the name of the mapping [degree]."""
BLOB_VOXEL = 0.7
"""Standard deviation of the particles, Gaussian blobs, in images and in the truth [voxel]."""
PARTICLE_COUNTS = 400.0
"""Level of a pixel lit by one particle in focus [count]: at 1 ppm the brightest pixels stay below full scale."""
PARTICLE_RAYS = 32_768
"""Rays per particle. It lights some 1,500 pixels, so a pixel receives about 20 rays."""
UNUSED_TABLES = {
    "volume": {"size_mm": (1.0, 1.0, 1.0), "voxel_mm": VOXEL_MM},
    "particles": {"count": 8, "sigma_mm": BLOB_VOXEL * VOXEL_MM},
    "flow": {"kind": "uniform", "displacement_mm": (0.0, 0.0, 0.0)},
}
"""Tables that a scene requires. The cases do not use them, because each renders its own particles."""
DT_S = 1e-4
"""Time between the frames [s]; the figures are in voxels and do not depend on it."""
RADIUS, CORE, PEAK = 0.25, 1 / 7, 0.3 / 14
"""Ring vortex of the paper, as shares of the volume's x edge: radius of the ring's core line, distance of the largest
displacement from it, and that displacement; 3.5, 2 and 0.3 mm in the paper's volume of 14 mm. Gradients in voxel per
voxel do not depend on the volume's size."""

SENSOR_PX = {"small": 1900, "paper": 4000}
"""Edge of the sensors [pixel]. At "small" the sensor is just large enough for the smaller volumes and the board."""
DEPTHS_MM = {"small": tuple(range(-4, 5, 2)), "paper": tuple(range(-10, 11))}
"""Planes of the board."""
DOTS = (7, 7)
WHITE_RAYS = 64
"""Rays per pixel of the white image."""


@dataclass(frozen=True)
class Rig:
    """A calibrated simulated rig."""

    scene: Scene
    experiment: Experiment
    calibration: Calibration

    def labels(self, name: str) -> BoardDots:
        """Return the labels that a camera was calibrated with."""
        dots = self.calibration.cameras[name].dots
        if dots is None:
            raise ValueError(f"{name}: expected a camera calibrated from a board, got one without dots.")
        return dots

    def weights(self, grid: Grid, mapping: str, particle_voxel: float = 0.0) -> Weights:
        """Build the weights of a grid by "network", or by direct ray tracing with a key of `TURNED_DEG`.

        `particle_voxel` is the size of the particles, as of `build_weights`.
        """
        calibration = self.calibration if mapping == "network" else self.ray_tracing(mapping)
        return build_weights(calibration, grid, particle_voxel=particle_voxel)

    def ray_tracing(self, mapping: str) -> Calibration:
        """Return thin lenses at the nominal angles, turned by the errors of `TURNED_DEG`."""
        cameras = {}
        for number, (name, camera) in enumerate(self._nominal.cameras.items()):
            yaw, roll = TURNED_DEG[mapping][number]
            lens = thin_lens_model(camera.optics, ANGLES_DEG[number] + yaw)
            sine, cosine = np.sin(np.radians(roll)), np.cos(np.radians(roll))
            about_z = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
            cameras[name] = replace(camera, baseline=replace(lens, rotation=about_z @ lens.rotation))
        return Calibration(cameras)

    @cached_property
    def _nominal(self) -> Calibration:
        return thin_lens(self.experiment)


def numerical_scene(scale: str, seed: int) -> Scene:
    """Return Table 2's numerical column: two ideal cameras at 45 degrees and a board of 7 x 7 dots.

    The images are rounded to 12 bits and have no other noise, as in the paper. "small" has the same optics on a smaller
    sensor and fewer planes of the board.
    """
    edge = SENSOR_PX[scale]
    sensor = {"sensor_width_px": edge, "sensor_height_px": edge}
    return table2_scene(
        "table 2, numerical",
        seed,
        ({**sensor, "nominal_angle_deg": angle} for angle in ANGLES_DEG),
        board={"dots": DOTS, "spacing_mm": 1.0, "planes_mm": tuple(map(float, DEPTHS_MM[scale]))},
        quality={"pixel_rays": WHITE_RAYS},
        noise={"background": 0.0, "read_noise": 0.0, "full_well_e": 0.0},
    )


def table2_scene(
    name: str, seed: int, cameras: Iterable[Mapping[str, Any]], *, board: Mapping[str, Any], **tables: Any
) -> Scene:
    """Return a scene of numbered cameras with the optics of Table 2, unless they state others, and dots of 0.1 mm."""
    numbered = [{"name": f"camera{number}", **OPTICS, **camera} for number, camera in enumerate(cameras, 1)]
    known = {"name": name, "seed": seed, "dt_s": DT_S, "camera": numbered, "board": {"dot_diameter_mm": 0.1, **board}}
    return Scene.model_validate(known | UNUSED_TABLES | tables)


def numerical_rig(folder: Path, scale: str, seed: int, progress: Progress) -> Rig:
    """Return the calibrated rig of `numerical_scene`, see `calibrated_rig`."""
    return calibrated_rig(numerical_scene(scale, seed), folder, progress)


def calibrated_rig(scene: Scene, folder: Path, progress: Progress) -> Rig:
    """Simulate the board of a scene and calibrate from it, unless `folder` holds both for the same scene."""
    runtime.device()
    path, marker = folder / "experiment" / "experiment.toml", folder / "scene.json"
    content = files.plain(scene.model_dump(mode="json"))
    if not marker.exists() or json.loads(marker.read_text("utf-8")) != content:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        files.write_json(content, marker)
    if not path.exists():
        simulate(scene, path.parent, progress=progress)
    experiment = open_experiment(path)
    stored = folder / "calibration.h5"
    if not stored.exists():
        scratch = folder / ".calibration.h5"
        calibration = calibrate(experiment, progress=lambda fraction: progress("calibration", fraction))
        calibration.save(scratch)
        scratch.replace(stored)
    return Rig(scene, experiment, load_calibration(stored))


def volume_grid(size_mm: tuple[float, float, float]) -> Grid:
    """Return a grid of the paper's voxels around the origin, size (x, y, z) [mm]."""
    return Grid.from_extent(centre_mm=(0.0, 0.0, 0.0), size_mm=size_mm, voxel_mm=VOXEL_MM)


def ring(size_mm: tuple[float, float, float]) -> Ring:
    """Return the paper's ring vortex in a volume of a size (x, y, z) [mm]."""
    edge = size_mm[0]
    return Ring(radius_mm=RADIUS * edge, core_mm=CORE * edge, peak_mm=PEAK * edge)


def random_particles(size_mm: tuple[float, float, float], ppm: float, seed: list[int]) -> np.ndarray:
    """Draw positions (n, 3) [mm] evenly over a volume, `ppm` particles per microlens of its x-y face."""
    count = round(ppm * size_mm[0] * size_mm[1] / VOXEL_MM**2)
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * size_mm


def particle_images(
    rig: Rig, positions_mm: np.ndarray, seed: list[int], *, blob_voxel: float = BLOB_VOXEL
) -> dict[str, np.ndarray]:
    """Render equally bright particles, rounded to 12 bits: camera -> (rows, columns), float32 [count]."""
    rays = render.ray_table(PARTICLE_RAYS, "gaussian", seed[0])
    images = {}
    for number, camera in enumerate(rig.scene.camera):
        eye = render_camera(camera, seed=[rig.scene.seed, 3, number])
        counts = np.full(len(positions_mm), PARTICLE_COUNTS * eye.microimage_px)
        rng = np.random.default_rng([*seed, number])
        image = render.render_sources(eye, positions_mm, counts, blob_voxel * VOXEL_MM, rays, rng=rng)
        lost = float((image > FULL_SCALE).mean())
        if lost > 1e-4:
            log.warning("%s: %.2f %% of the pixels saturate", camera.name, 100 * lost)
        images[camera.name] = np.clip(np.rint(image), 0, FULL_SCALE).astype(np.float32)
    return images


def recorded_images(
    rig: Rig,
    positions_mm: np.ndarray,
    counts: np.ndarray,
    rays: np.ndarray,
    size_mm: float,
    *,
    seed: list[int],
    frame: int,
) -> dict[str, np.ndarray]:
    """Record particles with blur, noise and 12 bits: camera -> (rows, columns), float32 [count].

    Parameters
    ----------
    rig : Rig
        The cameras and their noise.
    positions_mm : ndarray, shape (n, 3)
        Particles (x, y, z) [mm].
    counts : ndarray, shape (n,)
        Level of a pixel lit by one particle in focus [count].
    rays : ndarray
        From `render.ray_table`.
    size_mm : float
        Radius or standard deviation of the particles, by the kind of `rays` [mm].
    seed : list of int
        Seed of the noise. The numbers of camera and frame are added to it.
    frame : int
        Number of the frame.
    """
    images = {}
    for number, camera in enumerate(rig.scene.camera):
        eye = render_camera(camera, seed=[rig.scene.seed, 3, number])
        draw = np.random.default_rng([*seed, number, frame])
        image = render.render_sources(eye, positions_mm, counts * eye.microimage_px, size_mm, rays, rng=draw)
        images[camera.name] = expose(image, camera, rig.scene.noise, draw).astype(np.float32)
    return images


def reconstruct_images(weights: Weights, images: Mapping[str, np.ndarray], smart: Smart) -> xr.DataArray:
    """Reconstruct a volume from raw images by SMART on the voxels of its weights.

    Parameters
    ----------
    weights : Weights
        The operator. Its cameras' decoders measure each image's background level and noise.
    images : mapping of str to ndarray
        Camera name -> raw image, shape (rows, columns) [count]; other cameras are ignored.
    smart : Smart
        SMART's settings.
    """
    light, noise = {}, {}
    for name, camera in weights.cameras.items():
        level, noise[name] = camera.decoder.background(images[name])
        light[name] = images[name] - np.float32(level)
    return reconstruct(weights, light, floor=noise, **smart.of_one_frame())


def truth(positions_mm: np.ndarray, grid: Grid) -> xr.DataArray:
    """Return the particles as blobs on the voxels, which may be finer than the paper's."""
    return metrics.truth_volume(positions_mm, None, grid, BLOB_VOXEL * VOXEL_MM / grid.voxel_mm)


def true_field(
    flow: Callable[[np.ndarray], np.ndarray], axes_mm: Sequence[ArrayLike], edge_mm: float | tuple[float, float, float]
) -> np.ndarray:
    """Return the mean displacement of a flow over windows centred on axes (z, y, x) [mm], shape (z, y, x, 3) [mm].

    `edge_mm` is the edge of the windows, or their edges (x, y, z).
    """
    z, y, x = np.meshgrid(*axes_mm, indexing="ij")
    centres = np.stack([x, y, z], axis=-1)
    return window_mean(flow, centres.reshape(-1, 3), edge_mm).reshape(centres.shape)


def mapping_errors_pitch(rig: Rig, grid: Grid, seed: int) -> dict[str, float]:
    """Return the mean distance of mapped from true rays over a volume by camera [microlens pitch]."""
    return {name: float(error.mean()) for name, error in ray_errors_pitch(rig, rig.calibration, grid, seed).items()}


def ray_errors_pitch(rig: Rig, calibration: Calibration, grid: Grid, seed: int) -> dict[str, np.ndarray]:
    """Return the distances of a calibration's rays from the true ones by camera [microlens pitch], shape (ray,).

    The rays start at random points of a volume and cross the pupil at random points.
    """
    rng = np.random.default_rng([seed, 77])
    low = np.array(grid.first_centre_mm[::-1])
    extent = grid.voxel_mm * (np.array(grid.shape[::-1]) - 1)
    points = low + rng.random((4000, 3)) * extent
    errors = {}
    for camera in rig.scene.camera:
        if camera.name not in calibration.cameras:
            continue
        pupil = random_on_pupil(camera.optics.pupil_radius_mm, len(points), rng)
        miss = calibration.cameras[camera.name].map(points, pupil) - true_mapping(camera)(points, pupil)
        errors[camera.name] = np.linalg.norm(miss, axis=1) / camera.microlens_pitch_mm
    return errors
