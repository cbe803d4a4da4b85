"""Measure instants of time series that start from those before them (`smart.predict`) against instants by themselves.

    python perf/accuracy/predicted_series.py [--scale small|paper] --flows dns,swirl,turbulence,points --seeds 1,3

Flows are the DNS series of `dns_series`, the same with realistic images, a swirl and a frozen turbulence of blobs, and
the turbulence of points. Each instant is reconstructed in both ways, one after the other, in one process, and the
computing time of all threads is summed, beside the time that passes. Images and calibrations are kept in a folder.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import dns_series
import imperfect_scenes
import numpy as np
import xarray as xr

from lfpiv import metrics
from lfpiv.experiment.opening import open_experiment
from lfpiv.reconstruction import frame as prepared_frame
from lfpiv.reconstruction.frame import PreparedFrame
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.runs import rig
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_vectors import measure_vectors
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.runs.run import open_run
from lfpiv.runs.sequences import Segment
from lfpiv.sequence import solver as sequence
from lfpiv.sequence.solver import SequenceSolver
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.series import place_series
from lfpiv.simulation.simulator import simulate

FLOWS = ("dns", "realistic", "swirl", "turbulence", "points")
INSTANTS = 12
BLOBS = {"per_microlens": 0.5, "sigma_mm": 0.07}
POINTS = {"per_microlens": 0.5, "sigma_mm": 0.02}
TURBULENCE = {"rms_mm": 0.1, "integral_scale_mm": 0.8, "smallest_mm": 0.8}
"""Wavelengths from 8 voxels, shorter than the windows of vectors."""
STILL = {"kind": "uniform", "displacement_mm": (0.0, 0.0, 0.0)}


def scene_of(flow: str, seed: int, scale: str) -> Scene:
    """Return the series of a flow; the rig differs with the seed."""
    if flow == "dns":
        return dns_series.series_scene(scale, seed)
    if flow == "realistic":
        return realistic(dns_series.series_scene(scale, seed), scale)
    tables = imperfect_scenes.ideal_tables(scale, seed)
    tables["particles"] = (POINTS if flow == "points" else BLOBS) | {"instants": INSTANTS, "step": 1}
    if flow != "swirl":
        tables |= {"flow": STILL, "turbulence": TURBULENCE}
    return Scene.model_validate(tables)


def realistic(scene: Scene, scale: str) -> Scene:
    """Return a series with all imperfections of the images, of board and lens arrays; the cameras have not moved."""
    tables = scene.model_dump(exclude_unset=True)
    for name, table in imperfect_scenes.rows(scale)["all"].tables.items():
        if name != "particles":  # those of the series
            tables[name] = tables[name] | table if isinstance(tables.get(name), dict) else table
    return Scene.model_validate(tables)


PARTS = {
    "images": (SmartSolver, "prepare"),
    "flow": (SequenceSolver, "_flow"),
    "guess": (sequence, "predicted_guess"),
    "check": (PreparedFrame, "sampled_misfit"),
    "guess of the correction": (sequence, "agreed_guess"),
    "first guess": (prepared_frame, "multiplicative_guess"),
    "subsets": (prepared_frame, "_run_epochs"),
    "whole passes": (PreparedFrame, "_solve_whole"),
    "all": (Reconstructor, "frame"),
    "followed": (Reconstructor, "follow"),
    "corrected": (Reconstructor, "correct"),
}
"""Part of a frame's computing time -> what is timed. The last three hold the others."""
WHOLE = ("all", "followed", "corrected")
STARTS = 2
"""Instants at the start of a series that are not predicted."""


@contextmanager
def timed_parts(seconds: dict[str, list[float]]) -> Iterator[None]:
    """Append the computing time of each call to those of its part, and the time that passes to its "wall" [s]."""

    def timed(name: str, of: Any) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            start, passing = time.process_time(), time.perf_counter()
            try:
                return of(*arguments, **options)
            finally:
                seconds[name].append(time.process_time() - start)
                if name in WHOLE:
                    seconds[f"{name} wall"].append(time.perf_counter() - passing)

        return call

    with ExitStack() as patches:
        for name, (owner, function) in PARTS.items():
            patches.enter_context(patch.object(owner, function, timed(name, getattr(owner, function))))
        yield


@contextmanager
def series_work(scene: Scene, data: Path) -> Iterator[PairWork]:
    """Yield the work on a series, simulated and calibrated if the folder `data` does not hold it yet."""
    path = data / "images" / "experiment.toml"
    if not path.exists():
        simulate(scene, path.parent, progress=lambda step, fraction: None)
    experiment = open_experiment(path)
    with open_run(experiment, data / "run", "cpu", None) as run:
        run, prepared = rig.prepare(run, rig.calibrate(run).calibration)
        weights, _ = rig.build_weights(run, prepared, list(run.numbers))
        yield rig.pair_work(run, weights, keep_volumes=False, calibration=prepared.calibration)


def measure(scene: Scene, work: PairWork) -> dict[str, dict[str, float]]:
    """Return error [voxel], lost Q, part within two sigma [%], passes and computing times [s] of both ways."""
    recording = work.experiment.recording
    numbers = recording.frames
    light = {number: work.light_again(recording.frame(number)) for number in numbers}
    spent = {way: defaultdict[str, list[float]](list) for way in ("alone", "predicted")}
    passes, volumes = Counter[str](), {way: dict[int, xr.DataArray]() for way in spent}
    with patch.object(PairWork, "light_again", lambda self, frame: light[frame.number]):
        work.reconstructor.frame(light[numbers[0]], ignore_step)  # compiles
        Segment(work, 0).reach(recording.frame(numbers[0]), ignore_step)  # the same
        predicted = Segment(work, 0)
        for number in numbers:
            calls: dict[str, Callable[[], Any]] = {
                "alone": lambda number=number: work.reconstructor.frame(light[number], ignore_step),
                "predicted": lambda number=number: predicted.reach(recording.frame(number), ignore_step).volume,
            }
            for way, call in calls.items():
                with timed_parts(spent[way]), dns_series.counted_reconstructions(len(work.cameras)) as counts:
                    volumes[way][number] = call().volume
                passes[way] += counts.passes / len(numbers)
    truth = [one.position_mm for one in place_series(scene)]
    figures = {}
    for way, found in volumes.items():
        fields = [judged(scene, work, found, number) for number in work.experiment.numbers]
        quality = [_quality(scene, found[k], truth[k], work) for k in numbers]
        part_s = {part: sum(spent[way][part]) / len(numbers) for part in PARTS if part not in WHOLE}
        whole, wall = [spent[way][part] for part in WHOLE], [spent[way][f"{part} wall"] for part in WHOLE]
        costs = {
            "cpu_s": sum(sum(each) for each in whole) / len(numbers),
            "cpu_s without starts": sum(sum(each[STARTS:]) for each in whole) / (len(numbers) - STARTS),
            "wall_s without starts": sum(sum(each[STARTS:]) for each in wall) / (len(numbers) - STARTS),
        }
        mean = {name: float(np.mean([one[name] for one in fields])) for name in fields[0]}
        figures[way] = mean | {"lost": 1 - float(np.mean(quality)), "passes": passes[way], **costs, **part_s}
    return figures


def ignore_step(fraction: float) -> None:
    """Take no notice of progress."""


def judged(scene: Scene, work: PairWork, volumes: dict[int, xr.DataArray], number: int) -> dict[str, float]:
    """Compare the vectors of one pair with the flow."""
    vectors = measure_vectors(volumes[number], volumes[number + scene.particles.step], work.experiment)
    return dns_series.judged(scene, number, vectors)


def _quality(scene: Scene, volume: xr.DataArray, position_mm: np.ndarray, work: PairWork) -> float:
    if scene.particles.sigma_mm < BLOBS["sigma_mm"]:
        return dns_series.quality(volume, position_mm, work.experiment.grid)
    truth = metrics.truth_volume(position_mm, None, work.experiment.grid, BLOBS["sigma_mm"] / imperfect_scenes.VOXEL_MM)
    return float(metrics.reconstruction_quality(volume, truth.values))


def main() -> None:
    """Measure the flows and print a table of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flows", default=",".join(FLOWS), help=", ".join(FLOWS))
    parser.add_argument("--seeds", default="1,3")
    parser.add_argument("--scale", default="small", choices=["small", "paper"], help="size of volume and sensors")
    parser.add_argument("--folder", type=Path, default=Path("predicted_series"), help="for images and calibrations")
    options = parser.parse_args()
    for flow in options.flows.split(","):
        for seed in map(int, options.seeds.split(",")):
            scene = scene_of(flow, seed, options.scale)
            with series_work(scene, options.folder / f"{options.scale}_{flow}_{seed}") as work:
                found = measure(scene, work)
            print(f"{flow}, seed {seed}, {options.scale}")
            for name in found["predicted"] | found["alone"]:
                alone, predicted = (found[way].get(name, 0.0) for way in ("alone", "predicted"))
                ratio = predicted / alone if alone else float("nan")
                print(f"  {name:24s} {alone:9.4f} {predicted:9.4f} {ratio:6.3f}", flush=True)


if __name__ == "__main__":
    main()
