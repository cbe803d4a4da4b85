"""Ways of reconstructing that `reconstruction_bench` compares: this software with any settings, and others.

A way is a function of the rig, the recording and settings. It returns the volumes on the voxels of the rig's grid.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr
from reconstruction_cases import Recorded, Rig
from refocused import refocused_volume

from lfpiv import metrics
from lfpiv.geometry.grid import AXES, Grid, Layers
from lfpiv.geometry.resampling import volume_on
from lfpiv.joint.pair import PairSolver
from lfpiv.reconstruction.beyond import light_beyond
from lfpiv.reconstruction.refinement import measure_size, needed_refinement
from lfpiv.reconstruction.settings import PLAIN, SmartSettings
from lfpiv.reconstruction.volume import reconstruct
from lfpiv.reproduce import rigs
from lfpiv.runs.guard import LEAST_LAYERS
from lfpiv.settings.processing import Smart
from lfpiv.weights.forms.image_errors import PARTICLE_VOXEL
from lfpiv.weights.operator import Weights, build_weights

_KEYS_SINCE = {"subsets": 1, "refinement": 1.0, "predict": False}
"""Keys of table ``[smart]`` that are younger than commit b2f8238, with the values that leave its method unchanged."""
TODAY = {
    "smart.iterations": 40,
    "smart.accelerate": True,
    "smart.sieve_voxel": "auto",
    "smart.intensity_cap": 0.0,
    "smart.floor_share": 0.1,
    "smart.tolerance": 5e-4,
    "volume.guard_mm": 0.0,
} | {f"smart.{key}": value for key, value in _KEYS_SINCE.items() if key in Smart.model_fields}
"""Settings of commit b2f8238, which had no intensity cap and no guard layers."""
PAPER = TODAY | {
    "smart.iterations": 10,
    "smart.accelerate": False,
    "smart.sieve_voxel": 0.0,
    "smart.floor_share": 0.0,
    "smart.tolerance": 0.0,
}
"""Settings of the paper."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What a way of reconstructing returns."""

    volumes: Sequence[xr.DataArray]
    """Volume of each frame on the voxels of the rig's grid."""
    passes: float
    """Passes over all rays, mean of the frames."""
    misfit: float
    """Misfit of the images at the end, mean of the frames [counts]; NaN if unknown."""
    cpu_s: float
    """CPU time of a frame without the preparation of the rig [s]."""
    vectors: Sequence[xr.Dataset] | None = None
    """Vectors between each frame and the next one. Default: the correlation of the volumes."""


Reconstruct = Callable[[Rig, Recorded, Mapping[str, Any]], Measured]
"""Reconstruct the frames of a recording with some settings."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way of reconstructing: a function, and its settings as keys of the experiment file, "smart.iterations"."""

    label: str
    reconstruct: Reconstruct
    settings: Mapping[str, Any] = field(default_factory=dict)


def by_smart(rig: Rig, recorded: Recorded, settings: Mapping[str, Any]) -> Measured:
    """Reconstruct each frame by SMART, as `lfpiv run` does."""
    smart = Smart(**table_of(settings, "smart"))
    weights, factor = _weights_of_run(rig, recorded, smart, settings.get("volume.guard_mm", "auto"))
    start, found = time.process_time(), []
    for light, noise in _light_and_noise(rig, recorded):
        found.append(reconstruct(weights, light, floor=noise, **smart.of_one_frame(factor)))
    return Measured(
        cpu_s=(time.process_time() - start) / len(found),
        volumes=[_as_written(volume, rig.grid) for volume in found],
        passes=float(np.mean([volume.attrs["iterations"] for volume in found])),
        misfit=float(np.mean([volume.attrs["misfit"][-1] for volume in found])),
    )


def by_joint_fit(rig: Rig, recorded: Recorded, settings: Mapping[str, Any]) -> Measured:
    """Fit one volume and one displacement to both frames, as `lfpiv run` does with ``smart.estimate = "joint"``."""
    smart = Smart(**table_of(settings, "smart") | {"estimate": "joint"})
    weights, factor = _weights_of_run(rig, recorded, smart, settings.get("volume.guard_mm", "auto"))
    weights.volume = rig.grid
    solver = PairSolver(weights, SmartSettings(**smart.of_one_frame(factor)), estimate=smart.estimate)
    start = time.process_time()
    found = solver.solve(*zip(*_light_and_noise(rig, recorded), strict=True)).to_dataarrays(rig.grid)
    return Measured(
        cpu_s=(time.process_time() - start) / len(found),
        volumes=[volume.drop_vars("views", errors="ignore") for volume in found],
        passes=float(np.mean([volume.attrs["iterations"] for volume in found])),
        misfit=float("nan"),
    )


def _weights_of_run(rig: Rig, recorded: Recorded, smart: Smart, guard: Any) -> tuple[Weights, float]:
    """Return the weights that a run builds for a recording, and the refinement of their voxels."""
    guarded = rig.grid.padded(guard_layers(rig, recorded) if guard == "auto" else rig.grid.layers(guard))
    size = particle_size(rig, recorded)
    factor = needed_refinement(size) if smart.refinement == "auto" else float(smart.refinement)
    return weights_of(rig, guarded.refined(factor), (size or 0.0) * factor), factor


def _light_and_noise(rig: Rig, recorded: Recorded) -> Iterator[tuple[dict[str, np.ndarray], dict[str, float]]]:
    """Yield the light of each frame, and the noise of its images, by camera."""
    for images in recorded.images:
        yield (
            {name: rig.light(name, image) for name, image in images.items()},
            {name: rig.noise(name, image) for name, image in images.items()},
        )


def true_particles(rig: Rig, recorded: Recorded, settings: Mapping[str, Any]) -> Measured:
    """Return the true particles as blobs: the error that correlation itself has."""
    volumes = [
        metrics.truth_volume(at, light, rig.grid, rigs.BLOB_VOXEL)
        for at, light in zip(recorded.positions_mm, recorded.light, strict=True)
    ]
    return Measured(volumes=volumes, passes=0.0, misfit=float("nan"), cpu_s=0.0)


def by_first_guess(rig: Rig, recorded: Recorded, settings: Mapping[str, Any]) -> Measured:
    """Return SMART's multiplicative first guess: the mean logarithm of the light that each voxel's rays meet (MLOS)."""
    weights = weights_of(rig, rig.grid)
    start = time.process_time()
    light = [{name: rig.light(name, image) for name, image in images.items()} for images in recorded.images]
    found = [reconstruct(weights, images, 0, floor_share=0.0, **PLAIN) for images in light]
    return Measured(
        volumes=found,
        passes=1.0,
        misfit=float(np.mean([volume.attrs["misfit"][-1] for volume in found])),
        cpu_s=(time.process_time() - start) / len(found),
    )


def by_refocusing(rig: Rig, recorded: Recorded, settings: Mapping[str, Any]) -> Measured:
    """Refocus the light field of each camera, and combine the stacks."""
    start, volumes = time.process_time(), []
    for images in recorded.images:
        light = {name: rig.light(name, image) for name, image in images.items()}
        values = refocused_volume(rig.calibration, light, rig.grid, **table_of(settings, "refocused"))
        volumes.append(xr.DataArray(values, rig.grid.coordinates(), AXES))
    cpu_s = (time.process_time() - start) / len(volumes)
    return Measured(volumes=volumes, passes=0.0, misfit=float("nan"), cpu_s=cpu_s)


WAYS = {
    "ours": Way(label="ours", reconstruct=by_smart),
    "joint": Way(label="joint", reconstruct=by_joint_fit),
    "today": Way(label="today", reconstruct=by_smart, settings=TODAY),
    "paper": Way(label="paper", reconstruct=by_smart, settings=PAPER),
    "printed": Way(label="printed", reconstruct=by_smart, settings=PAPER | {"smart.normalisation": "paper"}),
    "mlos": Way(label="mlos", reconstruct=by_first_guess),
    "refocused": Way(label="refocused", reconstruct=by_refocusing),
    "truth": Way(label="truth", reconstruct=true_particles),
}
"""Ways by name: the defaults of the code, the joint fit of both frames, commit b2f8238, the paper's ten plain
iterations normalised by the column sum and as printed, the multiplicative first guess alone, refocused stacks, and
the true particles."""


def weights_of(rig: Rig, grid: Grid, particle_voxel: float = 0.0) -> Weights:
    """Return the weights of a rig on a grid, which know its volume. Those of the last few rigs stay in memory."""
    key = (tuple(camera.model_dump_json() for camera in rig.cameras), grid, particle_voxel >= PARTICLE_VOXEL)
    if key not in _WEIGHTS:
        while len(_WEIGHTS) >= 2:
            _WEIGHTS.pop(next(iter(_WEIGHTS)))
        _WEIGHTS[key] = build_weights(rig.calibration, grid, particle_voxel=particle_voxel)
    _WEIGHTS[key].volume = rig.grid
    return _WEIGHTS[key]


_WEIGHTS: dict[Any, Weights] = {}


def table_of(settings: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the keys of one table of settings such as "smart.iterations"."""
    return {key.split(".", 1)[1]: value for key, value in settings.items() if key.startswith(name + ".")}


@lru_cache(maxsize=64)
def guard_layers(rig: Rig, recorded: Recorded) -> Layers:
    """Return the guard layers that the images demand, as a run finds them."""
    light = [{name: rig.light(name, image) for name, image in images.items()} for images in recorded.images]
    counts = [[LEAST_LAYERS, LEAST_LAYERS] for _ in range(3)]
    for face in light_beyond(rig.calibration, rig.grid, [light[:2]]):
        count = round(face.guard_mm / rig.grid.voxel_mm)
        counts[face.axis][face.side] = max(count, LEAST_LAYERS)
    z, y, x = ((low, high) for low, high in counts)
    return z, y, x


@lru_cache(maxsize=64)
def particle_size(rig: Rig, recorded: Recorded) -> float | None:
    """Return the size of the particles [voxel], as a run finds it."""
    light = [{name: rig.light(name, image) for name, image in images.items()} for images in recorded.images]
    return measure_size(rig.calibration, rig.grid, light)


def _as_written(volume: xr.DataArray, grid: Grid) -> xr.DataArray:
    written = volume_on(volume, grid)
    return written.drop_vars([name for name in written.coords if written.coords[name].ndim == 3])
