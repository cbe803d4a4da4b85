"""A time series of tracers in a turbulent flow, through simulator and run: error of each instant's vectors and Q.

The series is measured twice: each instant by itself, and each from the one before (`smart.predict`).
"""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import imperfect_scenes
import numpy as np
import xarray as xr
from imperfections import BAD_VOXEL
from reconstruction_cases import TRACERS_FILE
from scipy import ndimage

from lfpiv import metrics
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import open_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.reconstruction import frame as prepared_frame
from lfpiv.reconstruction.smart import ImageEquations
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.reproduce import page, plots, store
from lfpiv.results import netcdf
from lfpiv.results.folder import Folder
from lfpiv.runs import pipeline
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.selfcalibration.belonging import ImageFit
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.series import place_series
from lfpiv.simulation.simulator import simulate
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.update import Comparison

TITLE = "Time series of a turbulent flow"

DATA = TRACERS_FILE
"""Tracers in Rayleigh-Benard convection: 20,000 at 12 instants, in the unit cube."""
CUBE_MM = 8.0
"""Edge to which the cube is scaled."""
INSTANTS = {"small": 12, "paper": 12}
STEP = 4
"""Instants between the two that are correlated."""
VOXEL_MM = imperfect_scenes.VOXEL_MM
GOALS = {"within": 90.0, "bad": 1.0}
"""Goals as those of the case `imperfections`."""
WAYS = {"alone": False, "predicted": True}
"""Way of reconstructing the instants -> `smart.predict`."""
CAPTION = (
    "Mean length of the error against the mean displacement of all tracers over each window, of all vectors and of "
    "those that are not at the border [voxel]; mean displacement [voxel]; correlation coefficient of measured and true "
    "components; valid [%]; within two stated sigma [%]; valid vectors "
    f"off by more than {BAD_VOXEL:g} voxel [%]; Q of the instant's volume."
)
GAIN = 0.8
"""Goal of error, 1 - Q and twice the passes of predicted instants, relative to those of instants by themselves."""
BLOB_VOXEL, BLUR_VOXEL = 0.7, 0.6
"""Standard deviation of a particle in the true volume, and of the blur that gives points that size [voxel]."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Simulate the series, measure and judge it; see the package for the arguments."""
    if not DATA.exists():
        raise InputError(f"dns_series: expected the sample data {DATA}, found no such file.")
    scene = series_scene(scale, seed)
    settings = {"scene": scene.model_dump(mode="json", exclude={"flow": {"file"}})}
    measure = functools.partial(_measure, scene, work, progress)
    measured = store.cached(work / "series.json", settings, measure)
    progress("series", 1.0)
    _draw(measured, work / "dns_series.png")
    return _result(scene, measured)


def series_scene(scale: str, seed: int) -> Scene:
    """Return the rig of the case `imperfections` with ideal images, around the tracers."""
    tables = imperfect_scenes.ideal_tables(scale, seed)
    return Scene.model_validate(
        tables
        | {
            "name": "Rayleigh-Benard convection",
            "particles": tables["particles"] | {"instants": INSTANTS[scale], "step": STEP},
            "flow": {
                "kind": "tracers",
                "file": str(DATA),
                "series": "positions",
                "size_mm": (CUBE_MM,) * 3,
                "box": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
                "as_given": True,
            },
        }
    )


@dataclass
class Counts:
    """Work on the instants of a series."""

    instants: Counter[str] = field(default_factory=Counter)
    """How often the images of each instant were prepared for SMART, by their hash."""
    passes: float = 0.0
    """Passes over all rays: half of it is a projection, half a back-projection. A first guess is one."""
    cpu_s: float = 0.0
    """Computing time of reconstructions, with flow and moved volumes [s]."""


@contextmanager
def counted_reconstructions(cameras: int) -> Iterator[Counts]:
    """Count the work of SMART on images of all cameras in this process."""
    counts = Counts()

    def prepare(of: Any, self: SmartSolver, images: Mapping[str, np.ndarray], **options: Any) -> Any:
        if len(self.weights.cameras) == cameras:  # disparities are measured in volumes of one camera
            digest = hashlib.sha256()
            for name in sorted(images):
                digest.update(np.ascontiguousarray(images[name]).tobytes())
            counts.instants[digest.hexdigest()] += 1
        return of(self, images, **options)

    def half(of: Any, self: ImageEquations, *arguments: Any) -> Any:
        counts.passes += 0.5 * (len(self.cameras) == cameras)
        return of(self, *arguments)

    def half_of(equations: ImageEquations, camera: int, ray_set: int) -> float:
        sets = 1 if ray_set == ALL else equations.cameras[camera].projector.ray_sets
        return 0.5 / sets / cameras * (len(equations.cameras) == cameras)

    def part(of: Any, self: ImageEquations, camera: int, ray_set: int, *arguments: Any) -> Any:
        counts.passes += half_of(self, camera, ray_set)
        return of(self, camera, ray_set, *arguments)

    def back(of: Any, self: ImageEquations, parts: Sequence[tuple[int, int]], *arguments: Any) -> Any:
        counts.passes += sum(half_of(self, *one) for one in parts)  # the comparisons are counted by themselves
        return of(self, parts, *arguments)

    def guess(of: Any, views: Sequence[Comparison], *arguments: Any, **part: Any) -> Any:
        of_all = sum(view.projector.ray_sets for view in views)
        share = 1 if part.get("subset") is None else len(part["subset"].parts) / of_all
        counts.passes += share * (len(views) == cameras)
        return of(views, *arguments, **part)

    def uncounted(of: Any, *arguments: Any) -> Any:
        before = counts.instants.copy(), counts.passes
        found = of(*arguments)
        counts.instants, counts.passes = before
        return found

    def timed(of: Any, *arguments: Any) -> Any:
        start = time.process_time()
        found = of(*arguments)
        counts.cpu_s += time.process_time() - start
        return found

    with ExitStack() as patches:
        for owner, name, call in (
            (SmartSolver, "prepare", prepare),
            (ImageEquations, "compare", half),
            (ImageEquations, "back_project", half),
            (ImageEquations, "compare_part", part),
            (ImageEquations, "exponent_of", back),
            (prepared_frame, "multiplicative_guess", guess),
            (ImageFit, "unexplained", uncounted),  # the check of the cameras
            (Reconstructor, "frame", timed),
            (Reconstructor, "follow", timed),
            (Reconstructor, "correct", timed),
        ):
            patches.enter_context(patch.object(owner, name, _wrapped(call, getattr(owner, name))))
        yield counts


def _wrapped(call: Any, original: Any) -> Any:
    """Return a function that calls `call` with the original one and its arguments."""

    @functools.wraps(original)
    def function(*arguments: Any, **options: Any) -> Any:
        return call(original, *arguments, **options)

    return function


def _measure(scene: Scene, work: Path, progress: Progress) -> dict[str, Any]:
    """Simulate the series, run the whole method on it in each way, and judge vectors and volumes."""
    data = work / "data"
    shutil.rmtree(data, ignore_errors=True)
    path = simulate(scene, data, progress=lambda step, fraction: progress(step, fraction / 4))
    experiment = open_experiment(path)
    at = [instant.position_mm for instant in place_series(scene)]
    measured = {}
    for number, (way, predict) in enumerate(WAYS.items()):
        out = work / f"run_{way}"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        if number:
            shutil.copy2(work / f"run_{next(iter(WAYS))}" / "calibration.h5", out)
        part = replace(experiment, smart=experiment.smart.model_copy(update={"predict": predict}))
        measured[way] = _measure_way(scene, part, out, at)
        progress("series", 0.25 + 0.75 * (number + 1) / len(WAYS))
    shutil.rmtree(data / "particles")
    return measured


def _measure_way(scene: Scene, experiment: Experiment, out: Path, at: Sequence[np.ndarray]) -> dict[str, Any]:
    """Run the method on the series in one way, and judge vectors and volumes."""
    with counted_reconstructions(len(experiment.cameras)) as counts:
        summary = pipeline.run(experiment, out, keep_volumes=True)
    folder = Folder(out, experiment.recording)
    fields = ((number, xr.load_dataset(folder.vectors(number), engine="h5netcdf")) for number in experiment.numbers)
    each = [{"instant": number, **judged(scene, number, field)} for number, field in fields]
    volumes = {number: netcdf.read_volume(folder.volume(number, 0)) for number in _used(experiment)}
    return {
        "instants": each,
        "quality": {str(number): quality(volume, at[number], experiment.grid) for number, volume in volumes.items()},
        "reconstructed": sorted(counts.instants.values()),
        "passes": counts.passes / len(volumes),
        "cpu_s": counts.cpu_s / len(volumes),
        "warnings": sorted({record["code"] for record in summary["warning_records"]}),
    }


def _used(experiment: Experiment) -> list[int]:
    """Return the instants of all pairs."""
    return sorted({frame.number for pair in experiment.numbers for frame in experiment.pair_frames(pair)})


def quality(volume: xr.DataArray, position_mm: np.ndarray, grid: Grid) -> float:
    """Return Q of a volume of points, after a blur, against blobs at the true positions."""
    truth = metrics.truth_volume(position_mm, None, grid, BLOB_VOXEL)
    blurred = ndimage.gaussian_filter(volume.values, BLUR_VOXEL, mode="constant")
    return float(metrics.reconstruction_quality(blurred, truth.values))


def judged(scene: Scene, number: int, vectors: xr.Dataset) -> dict[str, float]:
    """Compare the vectors of one instant with the mean displacement of all tracers over their windows."""
    edge = np.array(json.loads(vectors.attrs["settings"])["windows"][-1][::-1]) * VOXEL_MM
    z, y, x = np.meshgrid(*(vectors[axis].values for axis in "zyx"), indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    exact = window_mean(scene.flow_of(number), centres, tuple(edge.tolist())).reshape(*x.shape, 3) / VOXEL_MM
    field, spread = (
        np.stack([vectors[f"{name}_{axis}"].values for axis in "xyz"], axis=-1)
        for name in ("displacement", "uncertainty")
    )
    valid, error = vectors["valid"].values.astype(bool), field - exact
    length, told = np.linalg.norm(error, axis=-1), valid & np.isfinite(spread).all(-1)
    interior = tuple(slice(1, -1) if edges > 2 else slice(None) for edges in valid.shape)
    return {
        "all": float(length.mean()),
        "interior": float(length[interior].mean()),
        "valid": 100 * float(valid.mean()),
        "within": 100 * float((np.abs(error[told]) <= 2 * spread[told]).mean()),
        "bad": 100 * float((length[valid] > BAD_VOXEL).mean()),
        "moved": float(np.linalg.norm(exact, axis=-1).mean()),
        "correlation": float(np.corrcoef(field[valid].ravel(), exact[valid].ravel())[0, 1]),
    }


def _result(scene: Scene, measured: Mapping[str, Any]) -> dict[str, Any]:
    columns = ("all", "interior", "moved", "correlation", "valid", "within", "bad")
    mean = {
        way: {name: float(np.mean([one[name] for one in found["instants"]])) for name in columns}
        | {
            "lost": 1 - float(np.mean(list(found["quality"].values()))),
            "passes": found["passes"],
            "cpu_s": found["cpu_s"],
        }
        for way, found in measured.items()
    }
    alone, predicted = (mean[way] for way in WAYS)
    counts = measured["alone"]["reconstructed"]
    numbers = {one["instant"] for one in measured["alone"]["instants"]}
    needed = numbers | {number + scene.particles.step for number in numbers}
    comparison = [
        page.compare("mean error of all vectors", alone["all"], unit="voxel"),
        page.compare("mean error of interior vectors", alone["interior"], unit="voxel"),
        page.compare("part within two stated sigma", alone["within"], at_least=GOALS["within"], unit="%"),
        page.compare("part of valid vectors that are bad", alone["bad"], at_most=GOALS["bad"], unit="%"),
        page.compare("instants reconstructed", float(len(counts)), at_least=float(len(needed))),
        page.compare("most reconstructions of one instant", float(max(counts)), at_most=1.0),
        page.compare("error predicted over alone", predicted["all"] / alone["all"], at_most=GAIN),
        page.compare("1 - Q predicted over alone", predicted["lost"] / alone["lost"], at_most=GAIN),
        page.compare("twice the passes predicted over alone", 2 * predicted["passes"] / alone["passes"], at_most=1.0),
        page.compare("twice the time predicted over alone", 2 * predicted["cpu_s"] / alone["cpu_s"], at_most=1.0),
        page.compare("predicted: part within two sigma", predicted["within"], at_least=GOALS["within"], unit="%"),
    ]
    tables = []
    for way, found in measured.items():
        rows = [
            [f"{one['instant']}", *(one[name] for name in columns), found["quality"][str(one["instant"])]]
            for one in found["instants"]
        ]
        rows.append(["mean", *(mean[way][name] for name in columns), 1 - mean[way]["lost"]])
        tables.append({"caption": f"Instants {way}. {CAPTION}", "columns": ["instant", *columns, "Q"], "rows": rows})
    warnings = sorted({code for found in measured.values() for code in found["warnings"]})
    return page.result(
        dict(measured),
        comparison=comparison,
        figures=[("dns_series.png", "Mean error of all vectors at each instant, and Q.")],
        tables=tables,
        notes=[
            f"Warnings of the runs: {', '.join(warnings) or 'none'}.",
            f"Passes over the rays for an instant: {alone['passes']:.1f} alone, {predicted['passes']:.1f} predicted; "
            f"computing time {alone['cpu_s']:.2f} and {predicted['cpu_s']:.2f} s.",
            f"The rig of imperfect experiments with ideal images; the tracers' cube is {CUBE_MM:g} mm wide, and "
            f"instant k is correlated with instant k + {STEP}.",
        ],
    )


def _draw(measured: Mapping[str, Any], path: Path) -> None:
    drawn = plots.figure(6, 4)
    error, quality = drawn.subplots(2, 1, sharex=True)
    for way, colour in zip(WAYS, (plots.COLOURS["no_sieve"], plots.COLOURS["network"]), strict=True):
        errors = {one["instant"]: one["all"] for one in measured[way]["instants"]}
        error.plot(list(errors), list(errors.values()), "o-", color=colour, label=way)
        of = measured[way]["quality"]
        quality.plot([int(number) for number in of], list(of.values()), "o-", color=colour, label=way)
    error.set(ylabel="mean error [voxel]", ylim=(0, None))
    quality.set(xlabel="instant", ylabel="Q")
    error.legend(frameon=False, fontsize=8)
    for axes in (error, quality):
        plots.plain(axes)
    plots.save(drawn, path)
