"""What the stages of `gpu_stages` measure with: findings on disk, commands, times, memory, and a pair of volumes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
TINY: dict[str, Any] = {"voxels": 16, "sensor": (400, 560)}
"""Volume and sensor that compute-sanitizer, which takes a hundred times as long, can look at."""
PROFILED = 40
"""Functions of a profile of the host."""
PROFILED_EDGE = 100
"""Largest cube of voxels whose weights are built three times."""


@dataclass
class Findings:
    """What a stage found. Each figure is written at once: a stage that is stopped loses none."""

    path: Path
    stage: str
    figures: dict[str, Any] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def add(self, name: str, value: Any) -> None:
        """Add a figure, or what several figures of one name are."""
        self.figures[name] = value
        print(f"{name}: {json.dumps(value, default=float)[:1500]}", flush=True)
        self.write("running")

    def require(self, good: bool, message: str) -> None:
        """Note a failure unless the result is right."""
        if not good:
            self.failures.append(message)
            print(f"FAILED {message}", flush=True)
            self.write("running")

    def write(self, status: str) -> None:
        """Write the file anew, whole."""
        text = {"stage": self.stage, "status": status, "failures": self.failures, "figures": self.figures}
        part = self.path.with_suffix(".part")
        part.write_text(json.dumps(text, indent=1, default=float))
        part.replace(self.path)


@dataclass(frozen=True)
class Job:
    """What a stage is given."""

    found: Findings
    scale: str
    deadline: float
    """Of `time.monotonic` [s]."""
    sample: Path | None = None
    """Folder of the sample data; None where it is not at hand."""

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        return self.found.path.parent

    @property
    def left(self) -> float:
        """Time that is left [s]."""
        return max(self.deadline - time.monotonic(), 1.0)

    def text(self, name: str) -> Path:
        """Return the file of what a command says."""
        return self.folder / f"{self.found.stage}-{name}.txt"


def device() -> str:
    """Return the kind of device of the stages."""
    return "cpu" if os.environ.get("LFPIV_EMULATE_GPU") else "cuda"


def command(job: Job, name: str, *arguments: str, **environment: str) -> tuple[int, float, str]:
    """Run a command until the stage's time is over; return its exit status, its time [s] and what it said.

    A variable of the environment that is given as "" is removed.
    """
    began, path = time.perf_counter(), job.text(name)
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    given = {name: value for name, value in (os.environ | {"PYTHONPATH": paths} | environment).items() if value}
    with path.open("w") as said:
        process = subprocess.Popen(arguments, cwd=ROOT, env=given, stdout=said, stderr=said)
        try:
            status = process.wait(job.left)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)  # pytest then says what failed so far
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()
            status = 124
    return status, time.perf_counter() - began, path.read_text("utf-8", "replace")


class Memory:
    """Free memory of the GPU, looked at every few milliseconds: the largest use is what a process needs."""

    def __init__(self) -> None:
        from lfpiv_kernels import runtime

        self._free, self._ended = runtime.free_bytes, threading.Event()
        self.at_first = self._free()
        self.least = self.at_first
        self._thread = threading.Thread(target=self._look, daemon=True)

    def _look(self) -> None:
        while not self._ended.wait(0.005):
            self.least = min(self.least, self._free())

    def __enter__(self) -> Memory:
        if self.at_first is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    @property
    def used(self) -> int | None:
        """Largest memory that was taken [byte]; None on the CPU."""
        return None if self.at_first is None else self.at_first - self.least


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result and the time [s] of a call, all launches included."""
    import warp as wp

    wp.synchronize()
    began = time.perf_counter()
    result = run()
    wp.synchronize()
    return result, time.perf_counter() - began


def profiled(run: Callable[[], Any]) -> list[str]:
    """Return the functions in which a call spends most of its time: number of calls, own and whole time [s], name."""
    import cProfile
    import pstats

    profiler = cProfile.Profile()
    profiler.runcall(run)
    found = pstats.Stats(profiler).get_stats_profile().func_profiles
    longest = sorted(found.items(), key=lambda one: -one[1].tottime)[:PROFILED]
    whole = sorted(found.items(), key=lambda one: -one[1].cumtime)[:PROFILED]
    return [
        f"{of.ncalls} {of.tottime:.3f} {of.cumtime:.3f} {Path(of.file_name).name}:{of.line_number} {name}"
        for name, of in (*longest, *whole)
    ]


@contextlib.contextmanager
def activities() -> Iterator[dict[str, list[float]]]:
    """Collect the times of launches and copies on the GPU [ms], by their names."""
    import warp as wp

    times: dict[str, list[float]] = {}
    if device() != "cuda":
        yield times
        return
    wp.timing_begin(cuda_filter=wp.TIMING_ALL)
    try:
        yield times
    finally:
        for one in wp.timing_end():
            times.setdefault(re.sub(r"_[0-9a-f]{8}\b", "", one.name), []).append(one.elapsed)


def rows(times: dict[str, list[float]]) -> dict[str, dict[str, float]]:
    """Return number, total and median time [ms] of each kind of activity, the longest total first."""
    ordered = sorted(times.items(), key=lambda item: -sum(item[1]))
    return {
        name: {"count": len(of), "total_ms": sum(of), "median_ms": float(np.median(of)), "largest_ms": max(of)}
        for name, of in ordered
    }


@dataclass(frozen=True)
class Pair:
    """Two volumes of particles of a rig, their images, and the weights."""

    weights: Any
    images: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]

    @cached_property
    def solver(self) -> Any:
        """The solver, which prepares once what all frames share."""
        from lfpiv.reconstruction.settings import SmartSettings
        from lfpiv.reconstruction.solver import SmartSolver

        return SmartSolver(self.weights, SmartSettings())

    def volumes(self) -> list[Any]:
        """Reconstruct both."""
        return [self.solver.solve(images).to_dataarray() for images in self.images]

    def vectors(self, volumes: list[Any]) -> Any:
        """Correlate them."""
        import lfpiv

        return lfpiv.correlate(*volumes, dt_s=1.0)


def size_of(scale: str) -> dict[str, Any]:
    """Return the voxels along an edge and the sensor of a scale."""
    import cases as benchmark

    return TINY if scale == "tiny" else benchmark.SCALES[scale]


def make_pair(edge: int, sensor: tuple[int, int], found: Findings) -> Pair:
    """Build the weights of a cube of voxels and project two volumes of particles."""
    import inputs
    from work import SHIFT, particles

    import lfpiv

    calibration, voxels = inputs.rig(sensor), inputs.grid({"voxels": edge})
    if device() == "cuda":
        from lfpiv.weights.checks import estimate_device_need

        need = estimate_device_need(calibration, voxels)
        found.add("memory foreseen [byte]", {"weights": need.weights, "whole": need.whole, "least": need.least})
    weights, seconds = timed(lambda: lfpiv.build_weights(calibration, voxels))
    found.add("weights [s]", seconds)
    if edge <= PROFILED_EDGE and found.stage == "paper":
        found.add("where the weights' time goes", profiled(lambda: lfpiv.build_weights(calibration, voxels)))
        found.add("weights again [s]", timed(lambda: lfpiv.build_weights(calibration, voxels))[1])
    found.add("weights stored [byte]", weights.memory_bytes)
    shape, rng = weights.grid.shape, np.random.default_rng(2)
    frames = []
    for shift in (0.0, SHIFT):
        images, seconds = timed(lambda shift=shift: weights(2e4 * particles(shape, shift)))
        frames.append({name: (one + rng.normal(0, 3, one.shape)).astype(np.float32) for name, one in images.items()})
    found.add("projection with copies of the weights [s]", seconds)
    return Pair(weights, tuple(frames))


def measure_pair(job: Job, pair: Pair, pairs: int) -> Any:
    """Time a first pair, then several in a row; count copies, launches and memory; return the vectors."""
    from work import SHIFT

    from lfpiv_kernels.transfer import count_transfers

    found = job.found
    with Memory() as memory:
        volumes, seconds = timed(pair.volumes)
        found.add("first two volumes [s]", seconds)
        vectors, seconds = timed(lambda: pair.vectors(volumes))
        found.add("first vectors [s]", seconds)
        with count_transfers() as moved, activities() as times:
            volumes, seconds = timed(pair.volumes)
        found.add("two volumes, timed launches [s]", seconds)
        found.add("activities of two volumes", rows(times))
        passes = [len(one.attrs["misfit"]) for one in volumes]
        copies = {"to device": len(moved.to_device), "to host": len(moved.to_host), "passes": passes}
        copies |= {"byte to device": sum(moved.to_device), "byte to host": sum(moved.to_host)}
        found.add("copies of two volumes", copies)
        with count_transfers() as moved, activities() as times:
            vectors, seconds = timed(lambda: pair.vectors(volumes))
        found.add("vectors, timed launches [s]", seconds)
        found.add("activities of the vectors", rows(times))
        found.add("copies of the vectors", {"byte to device": sum(moved.to_device), "byte to host": sum(moved.to_host)})
        found.add("where the host's time goes", profiled(lambda: pair.vectors(pair.volumes())))
        ours = [timed(pair.volumes)[1] for _ in range(3)], [timed(lambda: pair.vectors(volumes))[1] for _ in range(3)]
        found.add("two volumes [s]", min(ours[0]))
        found.add("vectors [s]", min(ours[1]))
        done, began = 0, time.perf_counter()
        while done < pairs and job.left > 60:
            pair.vectors(pair.volumes())
            done += 1
        if done:
            found.add("pairs in a row", {"pairs": done, "seconds per pair": (time.perf_counter() - began) / done})
    found.add("memory taken after the weights were built [byte]", memory.used)
    error = [float(abs(np.median(vectors[f"displacement_{a}"]) - s)) for a, s in zip("zyx", SHIFT, strict=True)]
    found.add("error of the median displacement (z, y, x) [voxel]", error)
    found.require(max(error) < 0.1, f"a median displacement off by {error} voxel")
    return vectors
