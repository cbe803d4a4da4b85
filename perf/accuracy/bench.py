"""A bench beyond the paper's rigs: three misaligned, noisy cameras, and pairs of a ring vortex measured by any of them.

The cases `cameras`, `sweeps` and `choices` share one calibration of it, and every run that two of them need.
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
from lfpiv.experiment.settings import Correlation, Smart
from lfpiv.geometry.grid import AXES
from lfpiv.reproduce import rigs, store
from lfpiv.reproduce.study import Progress
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import FULL_SCALE, render_camera
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.weights.operator import Weights, build_weights
from lfpiv_kernels.rendering import render

SIZE_MM = {"small": (4.8, 4.8, 2.4), "paper": (10.0, 10.0, 5.0)}
"""Size of the volume (x, y, z)."""
DOTS = {"small": (6, 6), "paper": (11, 11)}
PLANES_MM = {"small": (-1.5, -0.75, 0.0, 0.75, 1.5), "paper": tuple(range(-3, 4))}
SENSOR_PX = {"small": (980, 1060), "paper": (1980, 2200)}
"""Rows and columns: what sees the volume and the board at 45 degrees."""
MISALIGNED = {
    "left": {"nominal_angle_deg": 45.0, "true_yaw_deg": 44.3, "true_pitch_deg": 0.4, "true_roll_deg": -0.3},
    "middle": {"nominal_angle_deg": 0.0, "true_yaw_deg": 0.8, "true_pitch_deg": -0.3, "true_roll_deg": 0.2},
    "right": {"nominal_angle_deg": -45.0, "true_yaw_deg": -45.7, "true_pitch_deg": 0.2, "true_roll_deg": 0.4},
}
"""The cameras, and how they truly stand, which nobody measures."""
SHARED: dict[str, dict[str, Any]] = {}
"""Tables that all scenes share; the others are the simulator's own."""
ONE, TWO, THREE = ("middle",), ("left", "right"), ("left", "middle", "right")
"""Cameras of a measurement. The one that works alone looks along z, so that its depth is the volume's."""
PARTICLE_RAYS = 16_384
"""Rays per particle: a pixel of the some 1,500 that it lights receives about ten, evenly spread ones."""
ABOUT_STANDARD_ERROR = "Windows overlap by a half along three axes, so an eighth of the vectors counts as independent."


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two frames of particles in a ring vortex."""

    ppm: float = 0.5
    """Seeding, particles per microlens of the volume's x-y face."""
    counts: float = 300.0
    """Level of a pixel lit by one particle alone, in focus [count]."""
    blob_voxel: float = rigs.BLOB_VOXEL
    """Standard deviation of the Gaussian particles [voxel]; 0 for points."""


DEFAULT = Pair()


COLUMNS = ("error", "±", "x", "y", "z", "valid", "Q", "Q, zero mean", "R_acc", "R_g", "ghosts")
"""Heads of the figures that tables show of a pair: `Judged.cells`."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What one pair's measurement is worth."""

    error: metrics.DisplacementError
    """Of the vectors, all of them, against the flow's mean over their windows [voxel]."""
    length: np.ndarray
    """Length of each vector's error [voxel], shape (z, y, x)."""
    valid: float
    """Part of the vectors that passed validation."""
    q: float
    """Q against blobs, mean of the two frames."""
    q_zero_mean: float
    """The same with the mean subtracted, to which the haze of a dense volume adds nothing."""
    accuracy: float
    """R_acc (Eq. 13), mean of the two frames."""
    ghost_ratio: float
    """R_g (Eq. 14), likewise."""
    ghosts: float
    """Peaks that are no particle, for each true one, likewise."""
    elongation: float
    """Of the particles along depth, likewise."""
    iterations: float
    """SMART iterations, likewise."""

    def cells(self) -> list[float]:
        """Figures for a table, below `COLUMNS`."""
        errors = [self.error.mean, self.standard_error, *self.error.mean_absolute]
        return [*errors, self.valid, self.q, self.q_zero_mean, self.accuracy, self.ghost_ratio, self.ghosts]

    @property
    def standard_error(self) -> float:
        """Standard error of the mean error over the vectors of this pair [voxel]."""
        return _standard_error(self.length)

    def row(self) -> dict[str, Any]:
        """Figures for ``reproduce.json``."""
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
    """A calibrated rig, a volume, and what was reconstructed in it; finished runs are kept in a folder."""

    def __init__(self, rig: rigs.Rig, size_mm: tuple[float, float, float], folder: Path, seed: int):
        self.rig, self.size_mm, self.folder, self.seed = rig, size_mm, folder, seed
        self.grid = rigs.volume_grid(size_mm)
        self.flow = rigs.ring(size_mm)
        self._images: tuple[Pair | None, list[dict[str, np.ndarray]]] = (None, [{}, {}])
        self._weights: tuple[tuple[CalibratedCamera, ...], Weights | None] = ((), None)

    def positions(self, pair: Pair) -> list[np.ndarray]:
        """Particles of both frames (n, 3) [mm]."""
        middle = rigs.random_particles(self.size_mm, pair.ppm, [self.seed, 31, round(1000 * pair.ppm)])
        displacement = self.flow(middle)
        return [middle - displacement / 2, middle + displacement / 2]

    def images(self, pair: Pair, cameras: tuple[str, ...]) -> list[dict[str, np.ndarray]]:
        """Both frames of a pair by some cameras, with noise; the last pair's are kept at hand."""
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
        """Weights of some of a calibration's cameras; the last ones are kept at hand."""
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
        """Reconstruct both frames, or take them from the folder, and say what the images were like.

        Parameters
        ----------
        name : str
            File to keep the volumes in. It stands for the calibration, which is not compared with the file's.
        pair : Pair
            What is recorded.
        cameras : tuple of str
            Which cameras are used.
        calibration : Calibration, optional
            In place of the rig's own.
        smart : Smart, optional
            SMART's settings; default: this software's.
        floor, flat_guess
            SMART's noise floor [count] in place of the measured one; the same light in every voxel to start with.

        Returns
        -------
        list of DataArray
            One volume of each frame.
        dict
            Means of all images: ``electrons`` that one camera receives of a particle; ``snr``: the image's brightness
            sum I^2 / sum I over its shot and read-out noise; ``saturated``: part of the pixels. And ``iterations``, and
            ``sieve_voxel``, the size of the Gaussians that the volumes are made of.
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

        kept = store.kept_arrays(self.folder / f"{name}.npz", settings, compute)
        coords = {axis: (axis, self.grid.axis_mm(number)) for number, axis in enumerate("zyx")}
        pair_values, signal = kept.pop("volumes"), {key: float(value) for key, value in kept.items()}
        attributes = {"sieve_voxel": signal["sieve_voxel"]}  # the correlation smooths what is not smooth already
        return [xr.DataArray(values, coords, AXES, attrs=attributes) for values in pair_values], signal

    def judge(
        self,
        volumes: list[xr.DataArray],
        signal: Mapping[str, float],
        *,
        pair: Pair,
        correlation: Correlation | None = None,
    ) -> Judged:
        """Correlate the volumes of `volumes` and compare everything with the truth."""
        vectors = correlate(*volumes, dt_s=rigs.DT_S, **(correlation or Correlation()).model_dump())
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
        """Both frames' particles drawn on the voxels: what reconstruction cannot better."""
        return [rigs.truth(at, self.grid) for at in self.positions(pair)]

    def _flat(self, weights: Weights, images: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the same light in every voxel, as much as the images hold."""
        flat = np.ones(self.grid.shape, np.float32)
        modelled = weights(flat)
        light = [
            (images[name][modelled[name] > 0] - weights.cameras[name].decoder.background(images[name])[0]).sum()
            for name in modelled
        ]
        return flat * np.float32(sum(light) / sum(float(image.sum()) for image in modelled.values()))

    def _signal(self, weights: Weights, name: str, image: np.ndarray, pair: Pair) -> dict[str, float]:
        """Tell how strong one image is against its noise, whose own squares are taken off sum I^2."""
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
    """Return the three cameras' bench, simulated and calibrated in `root` or taken from there."""
    rig = rigs.calibrated_rig(bench_scene(scale, seed), root / "rig", progress)
    return Bench(rig, SIZE_MM[scale], root / "runs", seed)


def bench_scene(scale: str, seed: int) -> Scene:
    """Cameras of Table 2's numerical column, off their plan by up to a degree, with shot and read-out noise."""
    return scene(scale, seed, MISALIGNED, name="bench of three cameras")


def scene(scale: str, seed: int, cameras: Mapping[str, Mapping[str, Any]], *, name: str, **shared: Any) -> Scene:
    """Scene of cameras around this bench's volume and board.

    Parameters
    ----------
    scale, seed
        See the package.
    cameras : mapping
        Name -> keys of ``[[camera]]`` beside the optics'.
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
            # the data set's own particles only complete it: the cases render their own
            "volume": {"size_mm": (1.0, 1.0, 1.0), "voxel_mm": rigs.VOXEL_MM},
            "particles": {"count": 8, "sigma_mm": rigs.BLOB_VOXEL * rigs.VOXEL_MM},
            "flow": {"kind": "uniform", "displacement_mm": (0.0, 0.0, 0.0)},
            **SHARED,
            **shared,
        }
    )


def run_name(pair: Pair, what: str) -> str:
    """File name of a run: the cases that share the bench find one another's by it."""
    return f"{what}_{pair.ppm:g}_ppm_{pair.counts:g}_counts"


def difference(judged: Judged, reference: Judged) -> tuple[float, float]:
    """Mean error less that of another measurement of the same pair, and its standard error [voxel].

    Where both have the same windows the difference is taken vector by vector.
    """
    if judged.length.shape != reference.length.shape:
        gap = judged.error.mean - reference.error.mean
        return gap, float(np.hypot(judged.standard_error, reference.standard_error))
    gaps = judged.length - reference.length
    return float(gaps.mean()), _standard_error(gaps)


def _standard_error(values: np.ndarray) -> float:
    """Of the mean over a pair's vectors: windows overlap by a half along three axes, so an eighth is independent."""
    return float(values.std() * np.sqrt(8 / values.size))


def recalibrated(bench: Bench, name: str, **network: Any) -> Calibration:
    """Calibrate two cameras of a bench again from the same images, with other settings of ``[network]``; kept."""
    stored = bench.folder / f"{name}.h5"
    experiment = bench.rig.experiment
    asked = replace(
        experiment,
        cameras=tuple(experiment.camera(camera) for camera in TWO),
        network=experiment.network.model_copy(update=network),
    )
    if not stored.exists():
        scratch = stored.with_name(f".{stored.name}")
        stored.parent.mkdir(parents=True, exist_ok=True)
        calibrate(asked).save(scratch)
        scratch.replace(stored)
    return load_calibration(stored)
