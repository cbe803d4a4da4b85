"""The stages of `gpu`: each runs in a process of its own and writes what it finds, as it finds it, to a JSON file.

    python perf/gpu_stages.py STAGE FOLDER [--scale tiny|medium|paper] [--minutes M] [--sample FOLDER]

Without a GPU the stages run on the CPU: with ``LFPIV_EMULATE_GPU=1`` by the loops for a GPU, at scale "tiny". So their
own code is tested. Times then mean nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gpu_measure import ROOT, Findings, Job, command, device, make_pair, measure_pair, size_of, timed

TESTS = ("tests/kernels", "tests/weights", "tests/reconstruction", "tests/velocity")
"""Folders of the tests that launch kernels; their twins of NumPy are the judges."""
TAICHI_TESTS = (
    "tests/simulation", "tests/calibration/test_network.py", "tests/weights/test_operator.py",
    "tests/weights/test_counted_grid.py",
)  # fmt: skip
PAIRS = 20
"""Pairs in a row of the throughput."""
VECTORS_VOXEL = 0.02
"""Largest rms difference of the vectors of two devices [voxel]: sums in another order move a fit of SMART by a tenth of
its error, which is 0.1 to 0.2 voxel."""
COPIED = {"tiny": 1 << 20, "paper": 1 << 28}
"""Floats that a copy reads and writes to measure the bandwidth of the memory."""
REPEATS = 10
SLOWEST = 5
"""Kernels that the profiler looks at."""


def run_tests(job: Job, name: str, *arguments: str) -> None:
    """Run tests on the device in several processes, and note which of them failed."""
    processes = str(max((os.cpu_count() or 4) - 3, 1)) if device() == "cuda" else "2"
    where = ["--device", "cuda"] if device() == "cuda" else ["--emulate-gpu"]
    options = ["-q", "-n", processes, "-rfE", "--tb=short", "-p", "no:cacheprovider"]
    status, seconds, said = command(job, name, sys.executable, "-m", "pytest", *options, *where, *arguments)
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)(?: - (.*))?$", said, re.MULTILINE)
    last = next((line for line in reversed(said.splitlines()) if re.search(r"\d+ (passed|failed|error)", line)), "")
    job.found.add(
        name, {"status": status, "seconds": seconds, "summary": last, "failed": [list(one) for one in failed]}
    )
    job.found.require(status == 0, f"{name}: {last or said[-300:]}")


def kernels(job: Job) -> None:
    """Run the tests of kernels, weights, reconstruction and velocity on the device."""
    from lfpiv_kernels import runtime

    runtime.start(device())
    job.found.add("modules", load_modules())
    small = ("tests/kernels/test_blur.py", "tests/kernels/test_voxels.py")
    run_tests(job, "tests", *(TESTS if job.scale == "paper" else small))


def load_modules() -> dict[str, float]:
    """Compile every module of Warp for the device, and return the time of each [s]."""
    import importlib
    import pkgutil

    import gpu_static
    import warp as wp

    import lfpiv_kernels
    from lfpiv_kernels import runtime

    seconds = {}
    for found in pkgutil.walk_packages(lfpiv_kernels.__path__, "lfpiv_kernels."):
        importlib.import_module(found.name)
        short, module = found.name.rpartition(".")[2], wp.get_module(found.name)
        if module.kernels and (short not in gpu_static.CPU_MODULES or device() == "cpu"):
            began = time.perf_counter()
            try:
                module.load(wp.get_device(runtime.device().warp))
                seconds[short] = time.perf_counter() - began
            except Exception as error:  # the other modules are compiled all the same
                seconds[short] = -1.0
                print(f"{found.name}: {error}", flush=True)
    return seconds


def taichi(job: Job) -> None:
    """Run Taichi's kernels: the mapping's tests, and its cases and counts of rays with their times."""
    small = ("tests/calibration/test_network.py",)
    run_tests(job, "tests", *(TAICHI_TESTS if job.scale == "paper" else small), "-k", "not weights or count_kernel")
    names = ("mapping", "count") if job.scale != "paper" else ("mapping", "count", "train")
    cases(job, *(f"{name}_small" for name in names))
    if job.scale == "paper":
        cases(job, "mapping_paper", "count_paper")


def cases(job: Job, *names: str) -> None:
    """Run cases of the benchmark and add their figures."""
    where = "cuda" if device() == "cuda" else "cpu"
    arguments = [one for name in names for one in ("--case", name)]
    _, _, said = command(job, names[0], sys.executable, str(ROOT / "perf/run.py"), "--device", where, *arguments)
    lines = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    for name in names:
        figures = {line["metric"]: line["value"] for line in lines if line.get("case") == name and "metric" in line}
        job.found.add(name, figures)
        job.found.require("wall" in figures, f"{name}: {figures.get('wrong', said[-600:])}")


def job_of_users(job: Job) -> None:
    """Run the demo and the sample data on the device and on the CPU, and compare vectors and times."""
    scratch = job.folder.parent / "gpu-scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    experiments = {"demo": scratch / "scene" / "experiment.toml"}
    simulation = (sys.executable, "-m", "lfpiv", "simulate", str(ROOT / "lfpiv/cli/demo_scene.toml"), "--out")
    status, _, said = command(job, "simulate", *simulation, str(experiments["demo"].parent))
    job.found.require(status == 0, f"simulate: {said[-600:]}")
    if job.sample is not None:
        experiments["sample"] = job.sample / "experiment.toml"
    elif job.scale == "paper":
        job.found.require(False, "the sample data are not at hand: --sample FOLDER")
    for name, experiment in experiments.items():
        places = {}
        for kind in ("cuda", "cpu"):
            emulated = {"LFPIV_EMULATE_GPU": "1" if kind == "cuda" else ""} if device() == "cpu" else {}
            out = scratch / f"{name}-{kind}"
            where = device() if kind == "cuda" else "cpu"
            run = (sys.executable, "-m", "lfpiv", "run", str(experiment), "--out", str(out), "--device", where)
            status, seconds, said = command(job, f"{name}-{kind}", *run, **emulated)
            job.found.add(f"{name} {kind}", {"status": status, "seconds": seconds, "said": said[-1500:]})
            job.found.require(status == 0, f"{name} on {kind}: {said[-600:]}")
            if (out / "summary.json").exists():
                places[kind] = out
                job.found.add(
                    f"{name} {kind} summary", stages_of(json.loads((out / "summary.json").read_text("utf-8")))
                )
        if len(places) == 2:
            found = difference(*places.values())
            job.found.add(f"{name} vectors, cuda - cpu", found)
            job.found.require(found["rms_voxel"] < VECTORS_VOXEL, f"{name}: vectors differ by {found}")
    shutil.rmtree(scratch, ignore_errors=True)


def stages_of(summary: dict[str, Any]) -> dict[str, Any]:
    """Return what a summary says of times and the device."""
    return {name: value for name, value in summary.items() if re.search("second|time|device|memory|valid", name)}


def difference(first: Path, second: Path) -> dict[str, float]:
    """Return how far the vectors of two runs are apart [voxel]."""
    import lfpiv

    with lfpiv.open_results(first) as one, lfpiv.open_results(second) as other:
        apart = [np.asarray(one[f"displacement_{axis}"] - other[f"displacement_{axis}"]) for axis in "xyz"]
        both = np.asarray(one["valid"].astype(bool) & other["valid"].astype(bool))
        share = float(np.mean(np.asarray(one["valid"] == other["valid"])))
    length = np.sqrt(sum(part**2 for part in apart))[both]
    return {
        "rms_voxel": float(np.sqrt(np.mean(length**2))),
        "median_voxel": float(np.median(length)),
        "largest_voxel": float(length.max()),
        "same_validity": share,
        "vectors": int(length.size),
    }


def paper(job: Job) -> None:
    """Measure a pair of the published size, and 20 pairs in a row."""
    from lfpiv_kernels import runtime

    runtime.start(device())
    of = size_of(job.scale)
    pair = make_pair(of["voxels"], of["sensor"], job.found)
    measure_pair(job, pair, PAIRS if job.scale == "paper" else 1)


def large(job: Job) -> None:
    """Measure pairs of 300^3 and 500^3 voxels, each in a process of its own."""
    for edge in (300, 500) if job.scale == "paper" else (24, 28):
        done, seconds, said = command(
            job, str(edge), sys.executable, __file__, "cube", str(job.folder), "--scale", job.scale,
            "--edge", str(edge), "--minutes", f"{(job.left - 10) / 60:.2f}",
        )  # fmt: skip
        if (path := job.folder / "cube.json").exists():
            part = json.loads(path.read_text())
            job.found.add(f"{edge}", part["figures"] | {"failures": part["failures"]})
            path.unlink()
        job.found.require(done == 0, f"{edge}^3: exit status {done} after {seconds:.0f} s: {said[-600:]}")


def cube(job: Job, edge: int) -> None:
    """Measure a pair of a cube of voxels, with a sensor just large enough."""
    from lfpiv_kernels import runtime

    runtime.start(device())
    sensor = (round(20.5 * edge) + 64, round(28 * edge) + 104)
    measure_pair(job, make_pair(edge, sensor, job.found), 0)


def limits(job: Job) -> None:
    """Measure the bandwidth of the memory and of the bus, the time of a launch, and the cases of the kernels."""
    import warp as wp

    from lfpiv_kernels import runtime

    running = runtime.start(device())
    place, size = running.warp, COPIED[job.scale]
    first, second = (wp.zeros(size, dtype=float, device=place) for _ in range(2))
    seconds = [timed(lambda: wp.copy(second, first))[1] for _ in range(REPEATS)]
    job.found.add("device", running.figures())
    job.found.add("bandwidth [byte/s]", 8 * size / float(np.min(seconds)))
    host = wp.zeros(size // 4, dtype=float, device="cpu", pinned=device() == "cuda")
    part = first[: size // 4]
    for name, (to, source) in {"to device": (part, host), "to host": (host, part)}.items():
        best = min(timed(lambda to=to, source=source: wp.copy(to, source))[1] for _ in range(REPEATS))
        job.found.add(f"bus, page-locked, {name} [byte/s]", size / best)
    short = wp.zeros(32, dtype=float, device=place)
    began = timed(lambda: [short.zero_() for _ in range(1000)])[1]
    job.found.add("a launch [s]", began / 1000)
    del part
    names = ["project", "back_project", "smart", "correlate_8", "deform", "vectors", "footprint", "smart_subsets"]
    import cases as benchmark

    scale = "small" if job.scale != "paper" else "medium"
    known = [f"{name}_{scale}" for name in names if f"{name}_{scale}" in benchmark.CASES]
    cases(job, *(known if job.scale == "paper" else known[:1]))


def profile(job: Job) -> None:
    """Look at the slowest kernels by Nsight Compute, and at a small pair by compute-sanitizer."""
    slowest = slowest_kernels(job.folder / "paper.json")
    ncu, sanitizer = shutil.which("ncu"), shutil.which("compute-sanitizer")
    job.found.add("kernels looked at", slowest)
    script = (sys.executable, __file__, "launch", str(job.folder), "--scale")
    sections = ("SpeedOfLight", "MemoryWorkloadAnalysis", "Occupancy", "WarpStateStats", "LaunchStats")
    if ncu:
        options = [ncu, "--clock-control", "none", "--target-processes", "all", "--csv", "--page", "details"]
        options += [one for name in sections for one in ("--section", name)]
        for kernel in slowest:
            few = ["--kernel-name", f"regex:{kernel}", "--launch-skip", "6", "--launch-count", "2"]
            status, seconds, said = command(job, f"ncu{kernel}", *options, *few, *script, job.scale)
            job.found.add(f"ncu {kernel}", {"status": status, "seconds": seconds} | counters(said))
            job.found.require(status == 0, f"ncu {kernel}: {said[-300:]}")
    else:
        job.found.add("ncu", "not installed")
    for tool in ("memcheck", "racecheck"):
        if not sanitizer:
            job.found.add("compute-sanitizer", "not installed")
            break
        options = ("--report-api-errors", "no", "--error-exitcode", "9", "--print-limit", "20")
        status, seconds, said = command(job, tool, sanitizer, "--tool", tool, *options, *script, "tiny")
        job.found.add(tool, {"status": status, "seconds": seconds, "said": said[-1500:]})
        job.found.require(status == 0, f"{tool}: {said[-600:]}")


def slowest_kernels(path: Path) -> list[str]:
    """Return the kernels that take most of a pair's time, by the figures of the stage `paper`; a guess without them."""
    found: dict[str, float] = {}
    if path.exists():
        figures = json.loads(path.read_text())["figures"]
        for part in ("activities of two volumes", "activities of the vectors"):
            for name, row in figures.get(part, {}).items():
                if name.startswith("forward kernel "):
                    found[name.removeprefix("forward kernel ")] = row["total_ms"]
    return sorted(found, key=lambda name: -found[name])[:SLOWEST] or ["_scatter", "_gather"]


def counters(said: str) -> dict[str, Any]:
    """Return the metrics that Nsight Compute prints as CSV, by name; of several launches the last."""
    import csv

    lines = [line for line in said.splitlines() if line.startswith('"')]
    return {
        f"{row['Metric Name']} [{row['Metric Unit']}]": row["Metric Value"]
        for row in csv.DictReader(lines)
        if row.get("Metric Name")
    }


def launch(job: Job) -> None:
    """Reconstruct and correlate a pair once, for the profiler."""
    from lfpiv_kernels import runtime

    runtime.start(device())
    of = size_of(job.scale)
    pair = make_pair(of["voxels"], of["sensor"], job.found)
    pair.vectors(pair.volumes())


def threads(job: Job) -> None:
    """Reconstruct on the CPU with more and more threads: a frame of 64^3 voxels."""
    for count in (1, 2, 4, 8, os.cpu_count() or 1) if job.scale == "paper" else (1, 2):
        done, seconds, said = command(
            job, str(count), sys.executable, __file__, "frame", str(job.folder), "--edge", str(count), "--scale",
            "medium" if job.scale == "paper" else "tiny", LFPIV_EMULATE_GPU="",
        )  # fmt: skip
        if (path := job.folder / "frame.json").exists():
            job.found.add(f"{count} threads", json.loads(path.read_text())["figures"])
            path.unlink()
        job.found.require(done == 0, f"{count} threads: exit status {done} after {seconds:.0f} s: {said[-600:]}")


def frame(job: Job, count: int) -> None:
    """Reconstruct a frame on some threads of the CPU."""
    from lfpiv_kernels import runtime

    runtime.start("cpu", threads=count)
    of = size_of(job.scale)
    pair = make_pair(of["voxels"], of["sensor"], job.found)
    pair.solver.solve(pair.images[0])
    job.found.add("a frame [s]", min(timed(lambda: pair.solver.solve(pair.images[1]))[1] for _ in range(2)))


STAGES: dict[str, Callable[[Job], None]] = {
    "limits": limits, "kernels": kernels, "job": job_of_users, "paper": paper, "large": large, "profile": profile,
    "taichi": taichi, "threads": threads,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", choices=[*STAGES, "cube", "frame", "launch"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scale", choices=("tiny", "medium", "paper"), default="paper")
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--sample", type=Path, help="folder with the sample experiment")
    parser.add_argument("--edge", type=int, default=32, help="voxels of an edge of `cube`; threads of `frame`")
    given = parser.parse_args()
    found = Findings(given.folder / f"{given.stage}.json", given.stage)
    job = Job(found, given.scale, time.monotonic() + 60 * given.minutes, given.sample)
    more = {
        "cube": lambda job: cube(job, given.edge), "frame": lambda job: frame(job, given.edge), "launch": launch,
    }  # fmt: skip
    try:
        (STAGES | more)[given.stage](job)
    except Exception as error:
        traceback.print_exc()
        found.failures.append(f"{type(error).__name__}: {error}")
    found.write("failed" if found.failures else "passed")
    return int(bool(found.failures))


if __name__ == "__main__":
    sys.exit(main())
