"""A time series of tracers in a turbulent flow, through simulator and run: error of each instant's vectors."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imperfect_scenes
import numpy as np
import xarray as xr
from imperfections import BAD_VOXEL

from lfpiv.errors import InputError
from lfpiv.experiment.opening import open_experiment
from lfpiv.progress import Progress
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.reproduce import page, plots, store
from lfpiv.results.folder import Folder
from lfpiv.runs import pipeline
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import simulate

TITLE = "Time series of a turbulent flow"

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "dns-tracers" / "rayleigh_benard_series.npz"
"""Tracers in Rayleigh-Benard convection: 20,000 at 12 instants, in the unit cube."""
CUBE_MM = 8.0
"""Edge to which the cube is scaled."""
INSTANTS = {"small": 12, "paper": 12}
STEP = 4
"""Instants between the two that are correlated."""
VOXEL_MM = imperfect_scenes.VOXEL_MM
GOALS = {"within": 90.0, "bad": 1.0}
"""Goals as those of the case `imperfections`."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Simulate the series, measure and judge it; see the package for the arguments."""
    if not DATA.exists():
        raise InputError(f"dns_series: expected the sample data {DATA}, found no such file.")
    scene = series_scene(scale, seed)
    settings = {"scene": scene.model_dump(mode="json", exclude={"flow": {"file"}})}
    measure = functools.partial(_measure, scene, work, progress)
    measured = store.cached(work / "series.json", settings, measure)
    progress("series", 1.0)
    _draw(measured["instants"], work / "dns_series.png")
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


@contextmanager
def counted_reconstructions(cameras: int) -> Iterator[Counter[str]]:
    """Count how often SMART is started on each instant's images of all cameras in this process."""
    count: Counter[str] = Counter()
    original = SmartSolver.solve

    def solve(self: SmartSolver, images: Mapping[str, np.ndarray], **options: Any) -> Any:
        if len(self.weights.cameras) == cameras:  # the check for moved cameras reconstructs from one at a time
            digest = hashlib.sha256()
            for name in sorted(images):
                digest.update(np.ascontiguousarray(images[name]).tobytes())
            count[digest.hexdigest()] += 1
        return original(self, images, **options)

    SmartSolver.solve = solve  # type: ignore[method-assign]
    try:
        yield count
    finally:
        SmartSolver.solve = original  # type: ignore[method-assign]


def _measure(scene: Scene, work: Path, progress: Progress) -> dict[str, Any]:
    """Simulate the series, run the whole method on it, and judge the vectors of every instant."""
    data, out = work / "data", work / "run"
    shutil.rmtree(data, ignore_errors=True)
    shutil.rmtree(out, ignore_errors=True)
    path = simulate(scene, data, progress=lambda step, fraction: progress(step, fraction / 4))
    experiment = open_experiment(path)
    with counted_reconstructions(len(experiment.cameras)) as count:
        summary = pipeline.run(experiment, out)
    folder = Folder(out, experiment.series)
    judged = [{"instant": number, **_judge(scene, number, folder.vectors(number))} for number in experiment.numbers]
    shutil.rmtree(data / "particles")
    return {
        "instants": judged,
        "reconstructed": sorted(count.values()),
        "warnings": sorted({record["code"] for record in summary["warning_records"]}),
    }


def _judge(scene: Scene, number: int, path: Path) -> dict[str, float]:
    """Compare the vectors of one instant with the mean displacement of all tracers over their windows."""
    with xr.open_dataset(path, engine="h5netcdf") as stored:
        vectors = stored.load()
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
    judged, counts = measured["instants"], measured["reconstructed"]
    needed = {instant for one in judged for instant in (one["instant"], one["instant"] + scene.particles.step)}
    columns = ("all", "interior", "moved", "correlation", "valid", "within", "bad")
    mean = {name: float(np.mean([one[name] for one in judged])) for name in columns}
    comparison = [
        page.compare("mean error of all vectors", mean["all"], unit="voxel"),
        page.compare("mean error of interior vectors", mean["interior"], unit="voxel"),
        page.compare("part within two stated sigma", mean["within"], at_least=GOALS["within"], unit="%"),
        page.compare("part of valid vectors that are bad", mean["bad"], at_most=GOALS["bad"], unit="%"),
        page.compare("instants reconstructed", float(len(counts)), at_least=float(len(needed))),
        page.compare("most reconstructions of one instant", float(max(counts)), at_most=1.0),
    ]
    rows = [[f"{one['instant']}", *(one[name] for name in columns)] for one in judged]
    rows.append(["mean", *(mean[name] for name in columns)])
    return page.result(
        {"instants": judged, "reconstructed": counts},
        comparison=comparison,
        figures=[("dns_series.png", "Mean error of all and of interior vectors at each instant.")],
        tables=[
            {
                "caption": "Mean length of the error against the mean displacement of all tracers over each window, of "
                "all vectors and of those that are not at the border [voxel]; mean displacement [voxel]; correlation "
                "coefficient of measured and true components; valid [%]; within two stated sigma [%]; valid vectors "
                f"off by more than {BAD_VOXEL:g} voxel [%].",
                "columns": ["instant", *columns],
                "rows": rows,
            }
        ],
        notes=[
            f"Warnings of the run: {', '.join(measured['warnings']) or 'none'}.",
            f"The rig of imperfect experiments with ideal images; the tracers' cube is {CUBE_MM:g} mm wide, and "
            f"instant k is correlated with instant k + {STEP}.",
        ],
    )


def _draw(judged: list[dict[str, float]], path: Path) -> None:
    drawn = plots.figure(6, 3)
    axes = drawn.subplots()
    for part, colour in (("all", plots.COLOURS["network"]), ("interior", plots.COLOURS["no_sieve"])):
        axes.plot([one["instant"] for one in judged], [one[part] for one in judged], "o-", color=colour, label=part)
    axes.set(xlabel="instant", ylabel="mean error [voxel]", ylim=(0, None))
    axes.legend(frameon=False, fontsize=8)
    plots.plain(axes)
    plots.save(drawn, path)
