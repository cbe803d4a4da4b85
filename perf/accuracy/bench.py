"""A simulated bench of three misaligned, noisy cameras, and pairs of a ring vortex measured by some of them.

The cases `optics` and `choices` measure on it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lfpiv import metrics
from lfpiv.calibration.camera import CalibratedCamera, Calibration, load_calibration
from lfpiv.calibration.cameras import calibrate
from lfpiv.geometry.grid import AXES
from lfpiv.progress import Progress
from lfpiv.reproduce import rigs, store
from lfpiv.settings.processing import Correlation, Smart
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import FULL_SCALE, render_camera
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.velocity.settings import cut_windows
from lfpiv.weights.operator import Weights, build_weights
from lfpiv_kernels.rendering import render

SIZE_MM = {"small": (4.8, 4.8, 2.4), "paper": (10.0, 10.0, 5.0)}
"""Size of the volume (x, y, z)."""
DOTS = {"small": (6, 6), "paper": (11, 11)}
PLANES_MM = {"small": (-1.5, -0.75, 0.0, 0.75, 1.5), "paper": tuple(range(-3, 4))}
SENSOR_PX = {"small": (980, 1060), "paper": (1980, 2200)}
"""Rows and columns. They cover the volume and the board at 45 degrees."""
MISALIGNED = {
    "left": {"nominal_angle_deg": 45.0, "true_yaw_deg": 44.3, "true_pitch_deg": 0.4, "true_roll_deg": -0.3},
    "middle": {"nominal_angle_deg": 0.0, "true_yaw_deg": 0.8, "true_pitch_deg": -0.3, "true_roll_deg": 0.2},
    "right": {"nominal_angle_deg": -45.0, "true_yaw_deg": -45.7, "true_pitch_deg": 0.2, "true_roll_deg": 0.4},
}
"""Nominal and true poses of the cameras. The calibration does not know the true ones."""
SHARED: dict[str, dict[str, Any]] = {}
"""Tables that all scenes share. The other tables have the simulator's defaults."""
TWO = ("left", "right")
"""Cameras of a measurement."""
PARTICLE_RAYS = 16_384
"""Rays per particle. It lights some 1,500 pixels, so a pixel receives about ten evenly spread rays."""
ABOUT_STANDARD_ERROR = "Windows overlap by a half along three axes, so an eighth of the vectors counts as independent."


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two frames of particles in a ring vortex."""

    ppm: float = 0.5
    """Seeding, particles per microlens of the volume's x-y face."""
    counts: float = 300.0
    """Level of a pixel lit by one particle in focus [count]."""
    blob_voxel: float = rigs.BLOB_VOXEL
    """Standard deviation of the Gaussian particles [voxel]; 0 for points."""


DEFAULT = Pair()


COLUMNS = ("error", "±", "x", "y", "z", "valid", "Q", "Q, zero mean", "R_acc", "R_g", "ghosts")
"""Heads of the columns of `Judged.cells`."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Quality of one pair's measurement."""

    error: metrics.DisplacementError
    """Error of all vectors against the flow's mean over their windows [voxel]."""
    length: np.ndarray
    """Length of each vector's error [voxel], shape (z, y, x)."""
    valid: float
    """Part of the vectors that passed validation."""
    q: float
    """Q against blobs, mean of the two frames."""
    q_zero_mean: float
    """Q with the means subtracted, which ignores the haze of a dense volume."""
    accuracy: float
    """R_acc (Eq. 13), mean of the two frames."""
    ghost_ratio: float
    """R_g (Eq. 14), mean of the two frames."""
    ghosts: float
    """Peaks that are no particle per true particle, mean of the two frames."""
    elongation: float
    """Elongation of the particles along depth, mean of the two frames."""
    iterations: float
    """SMART iterations, mean of the two frames."""

    def cells(self) -> list[float]:
        """Return the figures of a table's row, in the order of `COLUMNS`."""
        errors = [self.error.mean, self.standard_error, *self.error.mean_absolute]
        return [*errors, self.valid, self.q, self.q_zero_mean, self.accuracy, self.ghost_ratio, self.ghosts]

    @property
    def standard_error(self) -> float:
        """Standard error of the mean error over the vectors of this pair [voxel]."""
        return standard_error_of_mean(self.length)

    def row(self) -> dict[str, Any]:
        """Return the figures of ``reproduce.json``."""
        return {
            "error_voxel": self.error.mean,
            "standard_error_voxel": self.standard_error,
            "error_axes_voxel": self.error.mean_absolute,
            "bias_axes_voxel": self.error.bias,
            "below_043": self.error.below,
            "valid": self.valid,
            "q": self.q,
            "q_zero_mean": self.q_zero_mean,
            "accuracy": self.accuracy,
            "ghost_ratio": self.ghost_ratio,
            "ghosts": self.ghosts,
            "elongation": self.elongation,
            "iterations": self.iterations,
        }


class Bench:
    """A calibrated rig and a volume. Reconstructions are stored in a folder and not computed twice."""

    def __init__(self, rig: rigs.Rig, size_mm: tuple[float, float, float], folder: Path, seed: int):
        self.rig, self.size_mm, self.folder, self.seed = rig, size_mm, folder, seed
        self.grid = rigs.volume_grid(size_mm)
        self.flow = rigs.ring(size_mm)
        self._images: tuple[Pair | None, list[dict[str, np.ndarray]]] = (None, [{}, {}])
        self._weights: tuple[tuple[CalibratedCamera, ...], Weights | None] = ((), None)

    def positions(self, pair: Pair) -> list[np.ndarray]:
        """Return the particles of both frames (n, 3) [mm]."""
        middle = rigs.random_particles(self.size_mm, pair.ppm, [self.seed, 31, round(1000 * pair.ppm)])
        displacement = self.flow(middle)
        return [middle - displacement / 2, middle + displacement / 2]

    def images(self, pair: Pair, cameras: tuple[str, ...]) -> list[dict[str, np.ndarray]]:
        """Return both frames of a pair by some cameras, with noise. The last pair stays in memory."""
        if self._images[0] != pair:
            self._images = (pair, [{}, {}])
        missing = [name for name in cameras if name not in self._images[1][0]]
        if missing:
            rays = render.ray_table(PARTICLE_RAYS, "gaussian", self.seed)
            draw = [self.seed, 32, round(1000 * pair.ppm), round(10 * pair.counts), round(10 * pair.blob_voxel)]
            size = pair.blob_voxel * rigs.VOXEL_MM
            for frame, at in enumerate(self.positions(pair)):
                self._images[1][frame] |= rigs.recorded_images(
                    self.rig, at, np.full(len(at), pair.counts), rays, size, seed=draw, frame=frame, cameras=missing
                )
        return self._images[1]

    def weights(self, calibration: Calibration, cameras: tuple[str, ...]) -> Weights:
        """Return the weights of some of a calibration's cameras. The last ones stay in memory."""
        chosen = Calibration({name: calibration.cameras[name] for name in cameras})
        key = tuple(chosen.cameras.values())
        last, weights = self._weights
        if weights is None or len(key) != len(last) or any(a is not b for a, b in zip(key, last, strict=True)):
            self._weights, weights = ((), None), None  # one set at a time: memory
            weights = build_weights(chosen, self.grid)
            self._weights = (key, weights)
        return weights

    def volumes(
        self,
        name: str,
        *,
        pair: Pair,
        cameras: tuple[str, ...] = TWO,
        calibration: Calibration | None = None,
        smart: Smart | None = None,
        floor: float | None = None,
        flat_guess: bool = False,
    ) -> tuple[list[xr.DataArray], dict[str, float]]:
        """Reconstruct both frames, or read them from the folder, and measure their images.

        Parameters
        ----------
        name : str
            Name of the file of the volumes. It must differ by calibration, which the file does not record.
        pair : Pair
            Recorded particles.
        cameras : tuple of str
            Cameras of the measurement.
        calibration : Calibration, optional
            Default: that of the rig.
        smart : Smart, optional
            Settings of SMART. Default: this software's.
        floor, flat_guess
            Noise floor [count], default: measured. Whether SMART starts from the same light in every voxel.

        Returns
        -------
        list of DataArray
            One volume of each frame.
        dict
            Means over all images: ``electrons`` that one camera receives of a particle; ``snr``, brightness
            sum I^2 / sum I over shot and read-out noise; ``saturated``, part of the pixels. Means over the volumes:
            ``iterations``, and ``sieve_voxel``, the size of their Gaussians.
        """
        smart = smart or Smart()
        settings = {
            "seed": self.seed,
            "size_mm": self.size_mm,
            "pair": asdict(pair),
            "cameras": cameras,
            "smart": smart.model_dump(),
            "floor": floor,
            "flat_guess": flat_guess,
            "scene": self.rig.scene.model_dump(mode="json"),
        }

        def compute() -> dict[str, ArrayLike]:
            weights = self.weights(calibration or self.rig.calibration, cameras)
            found, signals = [], []
            for images in self.images(pair, cameras):
                first = self._flat(weights, images) if flat_guess else None
                found.append(rigs.reconstruct_images(weights, images, smart, floor=floor, first=first))
                signals += [self._signal(weights, name, images[name], pair) for name in cameras]
            means = {key: np.mean([one[key] for one in signals]) for key in signals[0]}
            for key in ("iterations", "sieve_voxel"):
                means[key] = np.mean([volume.attrs[key] for volume in found])
            return {"volumes": np.stack([volume.values for volume in found]), **means}

        arrays = store.cached_arrays(self.folder / f"{name}.npz", settings, compute)
        return self.unpacked(arrays)

    def unpacked(self, arrays: Mapping[str, np.ndarray]) -> tuple[list[xr.DataArray], dict[str, float]]:
        """Return the volumes of both frames and the other figures from stored arrays."""
        figures = {key: float(value) for key, value in arrays.items() if key != "volumes"}
        coords = {axis: (axis, self.grid.axis_mm(number)) for number, axis in enumerate("zyx")}
        attributes = {"sieve_voxel": figures["sieve_voxel"]}  # the correlation adds the missing smoothing
        return [xr.DataArray(values, coords, AXES, attrs=attributes) for values in arrays["volumes"]], figures

    def judge(
        self,
        volumes: list[xr.DataArray],
        signal: Mapping[str, float],
        *,
        pair: Pair,
        correlation: Correlation | None = None,
    ) -> Judged:
        """Correlate a pair of volumes, and compare volumes and vectors with the truth."""
        settings = (correlation or Correlation()).model_dump()
        if settings["windows"] is not None:
            settings["windows"] = cut_windows(settings["windows"], volumes[0].shape)
        vectors = correlate(*volumes, dt_s=rigs.DT_S, **settings)
        field = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], axis=-1)
        edge = json.loads(vectors.attrs["settings"])["windows"][-1]
        axes = [vectors[axis].values for axis in "zyx"]
        exact = rigs.true_field(self.flow, axes, tuple(n * rigs.VOXEL_MM for n in edge[::-1])) / rigs.VOXEL_MM
        quality = []
        for volume, at in zip(volumes, self.positions(pair), strict=True):
            true, particles = rigs.truth(at, self.grid), metrics.particle_quality(volume, at)
            both = [metrics.reconstruction_quality(volume, true, zero_mean=zero_mean) for zero_mean in (False, True)]
            ghosts = (particles.found_count - particles.matched_count) / particles.true_count
            quality.append((*both, particles.accuracy, particles.ghost_ratio, ghosts, particles.elongation))
        q, q_zero_mean, accuracy, ghost_ratio, ghosts, elongation = (float(value) for value in np.mean(quality, axis=0))
        return Judged(
            error=metrics.displacement_error(field, exact),
            length=np.linalg.norm(field - exact, axis=-1),
            valid=float(vectors["valid"].values.mean()),
            q=q,
            q_zero_mean=q_zero_mean,
            accuracy=accuracy,
            ghost_ratio=ghost_ratio,
            ghosts=ghosts,
            elongation=elongation,
            iterations=signal.get("iterations", float("nan")),
        )

    def true_volumes(self, pair: Pair) -> list[xr.DataArray]:
        """Return both frames' particles as blobs on the voxels, the best possible reconstruction."""
        return [rigs.truth(at, self.grid) for at in self.positions(pair)]

    def _flat(self, weights: Weights, images: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return a volume of equal voxels with the light of the images."""
        flat = np.ones(self.grid.shape, np.float32)
        modelled = weights(flat)
        light = [
            (images[name][modelled[name] > 0] - weights.cameras[name].decoder.background(images[name])[0]).sum()
            for name in modelled
        ]
        return flat * np.float32(sum(light) / sum(float(image.sum()) for image in modelled.values()))

    def _signal(self, weights: Weights, name: str, image: np.ndarray, pair: Pair) -> dict[str, float]:
        """Measure signal and noise of one image. The squares of the noise are subtracted from sum I^2."""
        noise, number = self.rig.scene.noise, list(self.rig.calibration.cameras).index(name)
        per_count = noise.full_well_e / FULL_SCALE
        light = image.astype(float) - weights.cameras[name].decoder.background(image)[0]
        total = light.sum()
        signal = max(((light**2).sum() - light.size * noise.read_noise**2) / total - 1 / per_count, 0.0)
        pixels = render_camera(self.rig.scene.camera[number]).microimage_px
        return {
            "electrons": pair.counts * pixels * per_count,
            "snr": signal / np.sqrt(noise.read_noise**2 + signal / per_count),
            "saturated": (image >= FULL_SCALE).mean(),
        }


def open_bench(root: Path, scale: str, seed: int, progress: Progress) -> Bench:
    """Return the bench, simulated and calibrated in `root` unless `root` holds it."""
    rig = rigs.calibrated_rig(bench_scene(scale, seed), root / "rig", progress)
    return Bench(rig, SIZE_MM[scale], root / "runs", seed)


def bench_scene(scale: str, seed: int) -> Scene:
    """Return three cameras of Table 2's numerical column, turned by up to a degree, with shot and read-out noise."""
    return scene(scale, seed, MISALIGNED, name="bench of three cameras")


def scene(scale: str, seed: int, cameras: Mapping[str, Mapping[str, Any]], *, name: str, **shared: Any) -> Scene:
    """Return a scene of cameras around this bench's volume and board.

    Parameters
    ----------
    scale, seed
        As for `lfpiv.reproduce.study.compute`.
    cameras : mapping
        Name -> keys of ``[[camera]]`` without those of the optics.
    name : str
        Name of the scene.
    **shared
        Tables of the whole scene, such as ``window`` and ``aberrations``.
    """
    rows, columns = SENSOR_PX[scale]
    optics = {**rigs.OPTICS, "sensor_width_px": columns, "sensor_height_px": rows}
    return Scene.model_validate(
        {
            "name": name,
            "seed": seed,
            "dt_s": rigs.DT_S,
            "camera": [{"name": key, **optics, **table} for key, table in cameras.items()],
            "board": {
                "dots": DOTS[scale],
                "spacing_mm": 1.0,
                "dot_diameter_mm": 0.1,
                "planes_mm": tuple(float(z) for z in PLANES_MM[scale]),
            },
            **rigs.UNUSED_TABLES,
            **SHARED,
            **shared,
        }
    )


def run_name(pair: Pair, what: str) -> str:
    """Return the file name of a run, the same for all cases."""
    return f"{what}_{pair.ppm:g}_ppm_{pair.counts:g}_counts"


def difference(judged: Judged, reference: Judged) -> tuple[float, float]:
    """Return the mean error minus that of another measurement of the pair, and its standard error [voxel].

    With equal windows the standard error is that of the differences vector by vector.
    """
    if judged.length.shape != reference.length.shape:
        gap = judged.error.mean - reference.error.mean
        return gap, float(np.hypot(judged.standard_error, reference.standard_error))
    gaps = judged.length - reference.length
    return float(gaps.mean()), standard_error_of_mean(gaps)


def standard_error_of_mean(values: np.ndarray) -> float:
    """Return the standard error of a mean over vectors. Windows overlap by a half, so an eighth is independent."""
    return float(values.std() * np.sqrt(8 / values.size))


def recalibrated(bench: Bench, name: str, **network: Any) -> Calibration:
    """Calibrate two cameras from the same images with other settings of ``[network]``, or read that calibration."""
    stored = bench.folder / f"{name}.h5"
    experiment = bench.rig.experiment
    changed = replace(
        experiment,
        cameras=tuple(experiment.camera(camera) for camera in TWO),
        network=experiment.network.model_copy(update=network),
    )
    if not stored.exists():
        scratch = stored.with_name(f".{stored.name}")
        stored.parent.mkdir(parents=True, exist_ok=True)
        calibrate(changed).save(scratch)
        scratch.replace(stored)
    return load_calibration(stored)
