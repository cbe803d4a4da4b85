"""Whole runs on images that break one assumption at a time, and all together; a page as of `lfpiv reproduce`.

python perf/accuracy/imperfections.py [--out DIR] [--scale small|paper] [--seed N]
"""

from __future__ import annotations

import argparse
import functools
import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import imperfect_scenes
import numpy as np
import xarray as xr
from imperfect_scenes import PAIRS, VOXEL_MM, Row

from lfpiv import files
from lfpiv.experiment.opening import open_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, rigs, store, study
from lfpiv.runs import pipeline
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.particles import place_particles
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import simulate
from lfpiv.velocity.cross_correlation import correlate

TITLE = "Imperfect experiments"

NODES = 10
"""Points along each edge of a window that average the flow over its fluid."""
LEAST_FLUID = 0.5
"""Fluid in a window whose error is judged; a valid vector of a window without fluid counts as bad."""
BAD_VOXEL = 1.0
"""Error of a bad vector."""
GOALS = {"ratio": 1.3, "within": 90.0, "bad": 1.0, "all": 0.25, "interior": 0.18}
"""Goals: single rows over the ideal one, % within two sigma, % of valid vectors that are bad, everything together."""
JUDGED = ("all", "interior", "valid", "within", "bad", "no_fluid")
"""Figures of a row that are means over its pairs."""
COLUMNS = (
    "all",
    "interior",
    "over ideal",
    "true",
    "valid",
    "x",
    "y",
    "z",
    "within 2σ",
    "bad kept",
    "no fluid",
    "warnings",
)


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Simulate, measure and judge every row; see the package for the arguments."""
    return compute(imperfect_scenes.rows(scale), scale, work, seed=seed, progress=progress)


def compute(rows: Mapping[str, Row], scale: str, work: Path, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Measure some rows, the first of which is the ideal one."""
    judged, left_out = {}, []
    for done, (key, row) in enumerate(rows.items()):
        progress(row.label, done / len(rows))
        if not imperfect_scenes.supported(row):
            left_out.append(row.label)
            continue
        scene = imperfect_scenes.scene(row, scale, seed)
        settings = {"scene": scene.model_dump(mode="json"), "keys": row.keys, "pairs": PAIRS[scale]}
        measure = functools.partial(_measure, scene, key, row, work, PAIRS[scale])
        judged[key] = store.cached(work / "rows" / f"{key}.json", settings, measure)
    progress("imperfections", 1.0)
    _draw({rows[key].label: one for key, one in judged.items()}, work / "imperfections.png")
    return _result(rows, judged, left_out, scale)


def _measure(scene: Scene, key: str, row: Row, work: Path, pairs: int) -> dict[str, Any]:
    """Simulate a row, run the whole method on its first pairs, and judge the vectors."""
    data, out = work / "data" / key, work / "runs" / key
    shutil.rmtree(data, ignore_errors=True)
    shutil.rmtree(out, ignore_errors=True)
    path = simulate(scene, data)
    with path.open("a", encoding="utf-8") as file:
        file.write(f"\n{row.keys}")
    out.mkdir(parents=True)
    calibration = _calibration(scene, work)
    if calibration.exists():
        shutil.copy(calibration, out / "calibration.h5")  # the run makes it again unless it fits the images
    summary = pipeline.run(open_experiment(path), out, pairs=(0, pairs))
    calibration.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(out / "calibration.h5", calibration)
    files_of_pairs = {pair: out / "vectors" / f"pair_{pair:04d}.nc" for pair in range(pairs)}
    judged = [_judge(scene, pair, path) for pair, path in files_of_pairs.items() if path.exists()]
    shutil.rmtree(data / "particles")  # the images of a row take a hundred times the room of its vectors
    return {
        **{name: _mean([one[name] for one in judged]) for name in JUDGED},
        "slope": np.mean([one["slope"] for one in judged], axis=0).tolist() if judged else [None] * 3,
        "true": _true_error(scene, work),
        "warnings": sorted({record["code"] for record in summary["warning_records"]}),
        "failed": len(summary["failed"]),
    }


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _calibration(scene: Scene, work: Path) -> Path:
    """Return where the calibration of equal white and board images is kept."""
    tables = scene.model_dump(mode="json", include={"camera", "board", "exposure", "noise", "quality", "seed"})
    for camera in tables["camera"]:
        camera.pop("moved")
    tables["exposure"].pop("particle_counts")
    return work / "calibrations" / f"{files.settings_hash(**tables)}.h5"


def _judge(scene: Scene, pair: int, path: Path) -> dict[str, Any]:
    """Compare the vectors of one pair with the flow's mean over the fluid of their windows."""
    with xr.open_dataset(path, engine="h5netcdf") as stored:
        vectors = stored.load()
    exact, fluid = truth_of(scene, pair, vectors)
    field, spread = (
        np.stack([vectors[f"{name}_{axis}"].values for axis in "xyz"], axis=-1)
        for name in ("displacement", "uncertainty")
    )
    valid, judged = vectors["valid"].values.astype(bool), fluid >= LEAST_FLUID
    interior = np.zeros(valid.shape, bool)
    interior[tuple(slice(1, -1) if count > 2 else slice(None) for count in valid.shape)] = True
    error = field - exact
    length, told = np.linalg.norm(error, axis=-1), valid & judged & np.isfinite(spread).all(-1)
    used, dry = valid & judged, fluid == 0
    bad = (used & (length > BAD_VOXEL)).sum() + (valid & dry).sum()
    return {
        "all": float(np.nanmean(length[judged])),
        "interior": float(np.nanmean(length[judged & interior])),
        "valid": 100 * float(valid[judged].mean()),
        "within": 100 * float((np.abs(error[told]) <= 2 * spread[told]).mean()) if told.any() else None,
        "bad": 100 * float(bad / max(1, valid.sum())),
        "no_fluid": 100 * float(valid[dry].mean()) if dry.any() else None,
        "slope": [
            float(np.polyfit(exact[used, k], field[used, k], 1)[0]) if used.sum() > 5 else np.nan for k in range(3)
        ],
    }


def truth_of(scene: Scene, pair: int, vectors: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return the flow's mean over the fluid of each window (z, y, x, 3) [voxel], and the part that is fluid."""
    edge = np.array(json.loads(vectors.attrs["settings"])["windows"][-1][::-1]) * VOXEL_MM
    z, y, x = np.meshgrid(*(vectors[axis].values for axis in "zyx"), indexing="ij")
    centres, flow = np.stack([x, y, z], axis=-1).reshape(-1, 3), scene.flow_of(pair)
    shape = x.shape
    if scene.wall is None:
        mean = window_mean(flow, centres, tuple(edge.tolist()))
        return mean.reshape(*shape, 3) / VOXEL_MM, np.ones(shape)
    node = (np.arange(NODES) + 0.5) / NODES - 0.5
    points = np.stack(np.meshgrid(node, node, node, indexing="ij"), axis=-1).reshape(-1, 3) * edge
    mean, part = np.empty(centres.shape), np.empty(len(centres))
    for number, centre in enumerate(centres):
        wet = ~scene.solid(centre + points)
        part[number] = wet.mean()
        mean[number] = flow(centre + points[wet]).mean(0) if wet.any() else np.nan
    return mean.reshape(*shape, 3) / VOXEL_MM, part.reshape(shape)


def _true_error(scene: Scene, work: Path) -> float:
    """Return the error that the correlation of the true particles has in the first pair, of all vectors [voxel]."""
    tables = scene.model_dump(
        mode="json", include={"camera", "volume", "particles", "flow", "wall", "seed", "correlation"}
    )
    tables["particles"].pop("pairs")
    for camera in tables["camera"]:
        for key in ("sensor", "array", "moved"):
            camera.pop(key)

    def compute() -> float:
        volume, placed = scene.volume, place_particles(scene, 0)
        grid = Grid.from_extent(centre_mm=volume.centre_mm, size_mm=volume.size_mm, voxel_mm=volume.voxel_mm)
        volumes = [rigs.truth(placed.at_frame(frame), grid) for frame in "ab"]
        vectors = correlate(*volumes, dt_s=scene.dt_s, **scene.correlation.model_dump())
        exact, fluid = truth_of(scene, 0, vectors)
        field = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], axis=-1)
        return float(np.nanmean(np.linalg.norm(field - exact, axis=-1)[fluid >= LEAST_FLUID]))

    error: float = store.cached(work / "true" / f"{files.settings_hash(**tables)}.json", tables, compute)
    return error


def _result(
    rows: Mapping[str, Row], judged: Mapping[str, dict[str, Any]], left_out: list[str], scale: str
) -> dict[str, Any]:
    ideal, size = judged["ideal"], imperfect_scenes.SIZE_MM[scale]
    singles = {key: one["all"] / ideal["all"] for key, one in judged.items() if rows[key].single and key != "ideal"}
    comparison = [page.compare("mean error, ideal images", ideal["all"], unit="voxel")]
    comparison += [
        page.compare(f"error over the ideal one, {rows[key].label}", ratio, at_most=GOALS["ratio"])
        for key, ratio in singles.items()
    ]
    for key in judged:
        if not rows[key].single:
            comparison += [
                page.compare(f"mean error, {rows[key].label}, {part} vectors", judged[key][part], at_most=GOALS[part])
                for part in ("all", "interior")
            ]
    comparison += [
        page.compare(
            "least part within two stated sigma", _least(judged, "within"), at_least=GOALS["within"], unit="%"
        ),
        page.compare(
            "largest part of valid vectors that are bad", -_least(judged, "bad", -1), at_most=GOALS["bad"], unit="%"
        ),
    ]
    table = [
        [
            rows[key].label,
            *(one[name] for name in ("all", "interior")),
            one["all"] / ideal["all"],
            one["true"],
            one["valid"],
            *one["slope"],
            *(one[name] for name in ("within", "bad", "no_fluid")),
            ", ".join(one["warnings"]) or "none",
        ]
        for key, one in judged.items()
    ]
    return page.result(
        {"rows": dict(judged), "size_mm": size},
        comparison=comparison,
        figures=[
            (
                "imperfections.png",
                "Mean error of all and of interior vectors in each row. Ticks: the correlation of the true particles. "
                f"Dotted: {GOALS['ratio']:g} times the ideal row's error of all vectors.",
            )
        ],
        tables=[
            {
                "caption": "Mean length of the error against the flow's mean over the fluid of each window, of all "
                "vectors and of those that are not at the border [voxel]; over ideal: ratio of all to the first row's; "
                "true: all, of the true particles' correlation; valid [%]; x, y, z: slope of measured over true "
                f"components; within two stated sigma, per component [%]; valid vectors off by more than {BAD_VOXEL:g} "
                "voxel or without fluid [%]; valid among windows without fluid [%]; codes of the run's warnings.",
                "columns": ["", *COLUMNS],
                "rows": table,
            }
        ],
        notes=[
            f"Two cameras at angles and in places drawn from the seed, {' x '.join(f'{edge:g}' for edge in size)} mm, "
            f"{imperfect_scenes.PPM:g} particles per microlens, a vortex with a jet along its axis; "
            f"{PAIRS[scale]} pairs in each row, measured by `lfpiv run` with its defaults.",
            f"Windows of less than {100 * LEAST_FLUID:g} % fluid are not judged, but for the last but one column.",
            *([f"Left out, because experiments have no such key: {'; '.join(left_out)}."] if left_out else []),
        ],
    )


def _least(judged: Mapping[str, dict[str, Any]], name: str, sign: int = 1) -> float:
    return min(sign * one[name] for one in judged.values() if one[name] is not None)


def _draw(judged: Mapping[str, dict[str, Any]], path: Path) -> None:
    drawn = plots.figure(8, 0.8 + 0.3 * len(judged))
    axes, place = drawn.subplots(), np.arange(len(judged))[::-1]
    for offset, part, colour in (
        (0.18, "all", plots.COLOURS["network"]),
        (-0.18, "interior", plots.COLOURS["no_sieve"]),
    ):
        axes.barh(place + offset, [one[part] for one in judged.values()], height=0.34, color=colour, label=part)
    truth = [one["true"] for one in judged.values()]
    axes.plot(truth, place, "|", color=plots.COLOURS["truth"], ms=14, label="true particles, all")
    axes.axvline(GOALS["ratio"] * next(iter(judged.values()))["all"], ls=":", color=plots.COLOURS["paper"])
    axes.set_yticks(place, list(judged))
    axes.set(xlabel="mean error [voxel]", xlim=(0, None))
    axes.margins(y=0.02)
    axes.legend(frameon=False, fontsize=8)
    plots.plain(axes)
    plots.save(drawn, path)


def main(arguments: list[str] | None = None) -> None:
    """Measure all rows, or read those that are in the folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="accuracy", help="folder for the results")
    parser.add_argument("--scale", choices=study.SCALES, default="small")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    about = "Runs on a rig with the main lens and microlenses of the paper and a smaller volume"
    page_of = study.Study(title="Beyond the paper", about=about, modules={"imperfections": "imperfections"})
    study.compute(
        page_of,
        ["all"],
        options.out,
        options.scale,
        seed=options.seed,
        progress=lambda step, fraction: print(f"{100 * fraction:3.0f} % {step}", file=sys.stderr),
    )


if __name__ == "__main__":
    main()
