"""Run benchmark cases, one JSON line per metric, or compare two checkouts by interleaved runs.

    python perf/run.py [--case NAME ...] [--small | --all] [--paper] [--device auto]
    python perf/run.py --against COMMIT [--case NAME ...]

A comparison without names takes the most used kernels and all calls of users (`calls`).
Each case runs in its own process, so that its peak memory is measured. Times are 10th percentiles after a warm-up: wall
time, and CPU time of all threads. A case with a wrong result prints the reason and no time, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from work import Work, WrongResult

# before the first import of Taichi: standard output is for JSON
os.environ.update(ENABLE_TAICHI_HEADER_PRINT="0", TQDM_DISABLE="1")
ROOT = Path(__file__).resolve().parents[1]
PERCENTILE = 10
SECONDS, FEWEST, MOST, ENOUGH = 4.0, 3, 30, 20.0
"""Time for the samples of a case [s], their least and largest number, and the time [s] above which a run is measured
once, without a warm-up."""
TURNS, SHARE = 8, 0.5
"""Least number of turns of a peer, and our time in each turn as a part of the peer's."""
ROUNDS, BLOCKS, LEAST_BAND, SIDE_SECONDS = 30, 5, 0.03, 20.0
"""Most samples per side of a comparison, blocks of these samples, least band of ratios without a difference, and time
per side [s] above which there are fewer samples, at least one a block."""
CALL = "call_"
"""Begin of the names of users' calls."""
COMPARED = ("mapping", "count", "footprint", "project", "back_project", "smart", "correlate_8", "deform", "train")


def sample(run) -> tuple[object, float, float]:
    """Return the result, the wall time and the CPU time of one run [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = run()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def low(run) -> tuple[object, float, float, int]:
    """Return the result of a warm-up, low percentiles of wall and CPU time of the samples [s], and their number."""
    result, first, cpu = sample(run)
    times = [(first, cpu)] if first > ENOUGH else []
    while first <= ENOUGH and len(times) < MOST:
        times.append(sample(run)[1:])
        if len(times) >= FEWEST and sum(wall for wall, _ in times) > SECONDS:
            break
    return result, *np.percentile(times, PERCENTILE, axis=0), len(times)


def interleaved(run, peer) -> tuple[object, np.ndarray, list[float]]:
    """Return the result of a peer, low percentiles of the peer's and our times [s], and the range of their ratio.

    The machine's speed drifts by a third within minutes, so both take turns: after each run of the peer, ours runs for
    `SHARE` of its time. The times have the shape (peer and ours, wall and CPU). The range is the 10th to the 90th
    percentile of the ratio of wall times per turn.
    """
    result, first, cpu = sample(peer)
    theirs, ours, ratios = [(first, cpu)] if first > ENOUGH else [], [], []
    while first <= ENOUGH and len(theirs) < MOST:
        theirs.append(sample(peer)[1:])
        ours += (turn := _for_seconds(run, SHARE * theirs[-1][0]))
        ratios.append(theirs[-1][0] / np.percentile(turn, PERCENTILE, axis=0)[0])
        if len(theirs) >= TURNS and sum(wall for wall, _ in theirs) > SECONDS:
            break
    if not ours:
        ours = _for_seconds(run, SHARE * first)
        ratios = [first / np.percentile(ours, PERCENTILE, axis=0)[0]]
    low_times = np.array([np.percentile(times, PERCENTILE, axis=0) for times in (theirs, ours)])
    return result, low_times, list(np.percentile(ratios, [PERCENTILE, 100 - PERCENTILE]))


def _for_seconds(run, seconds: float) -> list[tuple[float, float]]:
    """Return wall and CPU times of runs that take this long in total, `MOST` runs at most."""
    times: list[tuple[float, float]] = []
    while len(times) < MOST and sum(wall for wall, _ in times) < seconds:
        times.append(sample(run)[1:])
    return times


def limits() -> dict[str, float]:
    """Measure the machine on all cores: streaming reads [byte/s] and float32 matrix products [flop/s]."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parts, matrix = [np.ones(1 << 24, np.uint64) for _ in range(cores)], np.ones((2048, 2048), np.float32)
    with ThreadPoolExecutor(cores) as pool:
        read = min(sample(lambda: list(pool.map(np.add.reduce, parts)))[1] for _ in range(4))
    product = min(sample(lambda: matrix @ matrix)[1] for _ in range(4))
    return {"bytes": 8 * cores * (1 << 24) / read, "flops": 2 * 2048**3 / product}


def prepare(name: str) -> Work:
    """Prepare a case, which is not timed. Cases of calls import public names only, as other commits have them."""
    if name.startswith(CALL):
        import calls

        return calls.CALLS[name]()
    import cases

    return cases.prepare(name)


def measure(name: str) -> bool:
    """Print the metrics of one case. Return whether its result is right."""
    from lfpiv.runs.memory import peak_mib

    def emit(metric, value, unit="1", **more):
        line = {"case": name, "metric": metric, "value": value, "unit": unit, **more}
        print(json.dumps(line, default=float), flush=True)

    began = peak_mib()
    work = prepare(name)
    try:
        result, wall, cpu, count = low(work.run)
        peak = peak_mib()
        quality = work.check(result)
    except WrongResult as wrong:
        emit("wrong", str(wrong))
        return False
    del result
    emit("wall", wall, "s", samples=count)
    emit("cpu", cpu, "s")
    emit("peak_memory", peak, "MiB", before=began)
    for unit, amount in work.amounts.items():
        emit(f"{unit}_per_second", amount / wall, f"{unit}/s", per_cpu_second=amount / cpu, in_one_run=amount)
    for metric, value in quality.items():
        emit(metric, value)
    if work.read_bytes or work.flops:
        machine = limits()
        seconds = {"bytes": work.read_bytes / machine["bytes"], "flops": work.flops / machine["flops"]}
        by = max(seconds, key=seconds.get)
        emit("times_hardware_limit", wall / seconds[by], by=by, limit_s=seconds[by], machine_per_second=machine[by])
    for peer, run in work.peers.items():
        try:
            done, ((peer_wall, peer_cpu), (wall, cpu)), ratios = interleaved(work.run, run)
            quality = (work.peer_check or work.check)(done)
        except WrongResult as wrong:
            emit("peer_wrong", str(wrong), peer=peer)
            continue
        share = work.peer_share
        between = [ratio / share for ratio in ratios]
        seconds = {"peer_s": peer_wall / share, "ours_s": wall}
        emit("faster_than_peer", peer_wall / share / wall, peer=peer, turns=between, **seconds, **quality)
        emit("less_cpu_than_peer", peer_cpu / share / cpu, peer=peer)
    return True


def serve(name: str) -> None:
    """Prepare a case and time one run per line of standard input, for `compare`."""
    import lfpiv

    work = prepare(name)
    work.check(work.run())
    seconds = sample(work.run)[1]
    print("READY", seconds, Path(lfpiv.__file__).resolve().parents[1], flush=True)
    for _ in sys.stdin:
        print("TIME", *sample(work.run)[1:], flush=True)
    if name.startswith(CALL):
        import calls

        calls.remove()


def compare(name: str, base: Path, device: str) -> None:
    """Print the ratio of this checkout's time to another's, from interleaved samples of processes theirs, ours, theirs.

    Each checkout runs its own ``perf/cases.py``, because modules may have moved, and the ``perf/calls.py`` of this one.
    The largest difference between the two processes of one checkout, block by block, is the band of ratios without a
    difference.
    """
    with contextlib.ExitStack() as stack:
        sides = []
        for tree in (base, ROOT, base):
            place = ROOT if name.startswith(CALL) else tree
            command = [sys.executable, str(place / "perf" / "run.py"), "--serve", name, "--device", device]
            environment = os.environ | {"PYTHONPATH": str(tree)}
            side = subprocess.Popen(command, env=environment, stdin=-1, stdout=-1, text=True)
            stack.callback(end, side)
            ready = next((line.split() for line in side.stdout if line.startswith("READY")), [""])
            if ready[-1] != str(tree.resolve()):
                print(json.dumps({"case": name, "metric": "wrong", "value": f"{tree}: no right result from {ready}"}))
                return
            sides.append(side)
        seconds = float(ready[1]) if len(ready) > 2 else 0.0  # states before this figure was stated
        rounds = BLOCKS * int(np.clip(SIDE_SECONDS / max(seconds, 1e-3) / BLOCKS, 1, ROUNDS // BLOCKS))
        times = np.empty((rounds, 3, 2))
        for turn in range(rounds):
            for place in np.roll([0, 1, 2], turn):
                sides[place].stdin.write("go\n")
                sides[place].stdin.flush()
                answer = next(line for line in sides[place].stdout if line.startswith("TIME"))
                times[turn, place] = [float(value) for value in answer.split()[1:]]
    wall, cpu = np.percentile(times, PERCENTILE, axis=0).T
    again = [np.divide(*np.percentile(block[:, ::2, 0], PERCENTILE, axis=0)) for block in np.split(times, BLOCKS)]
    band = max(LEAST_BAND, *(abs(ratio - 1) for ratio in again))
    ratio = wall[1] / wall[::2].mean()
    verdict = "slower" if ratio > 1 + band else "faster" if ratio < 1 / (1 + band) else "no difference"
    cpu_ratio = cpu[1] / cpu[::2].mean()
    line = {"case": name, "metric": "ratio", "value": ratio, "band": band, "cpu_ratio": cpu_ratio, "verdict": verdict}
    print(json.dumps(line), flush=True)


def end(side: subprocess.Popen) -> None:
    """Let a process that serves a case finish; it removes what it wrote."""
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        side.stdin.close()
        side.wait(10)
    side.kill()


def stop(*_: object) -> None:
    """End the process so that the other checkout is removed, which a second signal must not interrupt."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(143)


def machine() -> dict:
    """Return the facts about the machine and the checkout that the figures depend on."""
    model = platform.processor()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {
        "case": "machine",
        "cpu": model,
        "cores": cores,
        "load": load,
        "python": platform.python_version(),
        "commit": commit,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", help="case by name, e.g. smart_small; may be repeated")
    parser.add_argument("--small", action="store_true", help="the small cases and the demo; the default")
    parser.add_argument("--all", action="store_true", help="the small and the medium cases, and the demo")
    parser.add_argument("--paper", action="store_true", help="the cases of the published size: about 9 GiB of memory")
    parser.add_argument("--against", metavar="COMMIT", help="compare this checkout with another commit")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="cpu")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve or given.measure:
        from lfpiv_kernels import runtime

        runtime.start(given.device)
        return serve(given.serve) or 0 if given.serve else 1 - measure(given.measure)

    from calls import CALLS, FOLDER, SIMULATED, simulate
    from cases import CASES

    scales = ["paper"] if given.paper and not (given.small or given.all) else ["small"]
    scales += ["medium"] * given.all + ["paper"] * (given.paper and scales != ["paper"])
    names = given.case or [name for scale in scales for name in CASES if name.endswith(f"_{scale}")]
    unknown = [name for name in names if name not in {**CASES, **CALLS}]
    if unknown:
        parser.error(f"--case: unknown {', '.join(unknown)}; there are {', '.join([*CASES, *CALLS])}")
    print(json.dumps(machine()), flush=True)
    if given.against:
        signal.signal(signal.SIGTERM, stop)
        names = given.case or [*(f"{op}_small" for op in COMPARED), *CALLS]
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder) / "base"
            if set(names) & SIMULATED:
                simulate(Path(folder))
                os.environ[FOLDER] = folder
            subprocess.run(
                ["git", "-C", str(ROOT), "worktree", "add", "--quiet", "--detach", str(tree), given.against], check=True
            )
            try:
                for name in names:
                    compare(name, tree, given.device)
            finally:
                subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(tree)], check=True)
        return 0
    names += ["demo"] if not given.case and not given.paper else []
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    }
    command = [sys.executable, __file__, "--device", given.device, "--measure"]
    return int(any([subprocess.run([*command, name], env=environment).returncode for name in names]))


if __name__ == "__main__":
    sys.exit(main())
