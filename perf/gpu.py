"""Run the tests and the benchmarks on a machine with a GPU.

    python perf/gpu.py [--out FOLDER] [--paper]

Writes FOLDER/tests.txt, FOLDER/perf.jsonl and FOLDER/limits.json (the bandwidth of the GPU's memory), and prints a
table that compares the cases with this limit and with the times that ``gpu_model`` predicts. The
exit status is 1 if a test fails or a result is wrong, 2 without a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Predict = Callable[[str], float | None]
"""From the name of a case to its predicted time [s], None where there is no model of it."""

ROOT = Path(__file__).resolve().parents[1]
COPIED = 1 << 28
"""Number of floats copied to measure the bandwidth of the GPU's memory: 1 GiB read and 1 GiB written."""
REPEATS = 10


def limits() -> dict[str, float | str]:
    """Return the name of the GPU and its copy bandwidth, reads plus writes [byte/s]."""
    import warp as wp

    first, second = (wp.zeros(COPIED, dtype=float, device="cuda:0") for _ in range(2))
    seconds = []
    for _ in range(REPEATS):
        wp.synchronize()
        start = time.perf_counter()
        wp.copy(second, first)
        wp.synchronize()
        seconds.append(time.perf_counter() - start)
    device = wp.get_device("cuda:0")
    return {"gpu": device.name, "architecture": device.arch, "bytes_per_second": 8 * COPIED / float(np.min(seconds))}


def predicted_times(cases: Sequence[str]) -> dict[str, float | None]:
    """Return the times [s] that ``gpu_model`` predicts; None for cases of which there is no model, or where it fails.

    The model runs the kernels on the processor, so it has a process of its own that sees no GPU.
    """
    command = [sys.executable, str(ROOT / "perf/gpu_model.py"), "--cases", *cases]
    done = subprocess.run(command, env=os.environ | {"CUDA_VISIBLE_DEVICES": ""}, stdout=subprocess.PIPE, text=True)
    times: dict[str, float | None] = dict.fromkeys(cases)
    for line in done.stdout.splitlines():
        times |= json.loads(line)
    return times


def table(lines: list[dict[str, Any]], bytes_per_second: float, predicted: Predict) -> list[str]:
    """Return a row per case of the lines of ``perf/run.py``.

    A row has the measured time and the predicted one [s], and the least time in which the stored weights can be read
    once as a share of the measured one.
    """
    rows = [f"{'case':32s} {'measured':>12s} {'predicted':>12s} {'of bandwidth':>13s}"]
    for name in dict.fromkeys(line["case"] for line in lines):
        found = {line["metric"]: line["value"] for line in lines if line["case"] == name and "metric" in line}
        if "wall" in found:
            seconds, stored = predicted(name), found.get("stored_bytes")
            model = "" if seconds is None else f"{seconds:10.4f} s"
            share = "" if stored is None else f"{stored / found['wall'] / bytes_per_second:.2f}"
            rows.append(f"{name:32s} {found['wall']:10.4f} s {model:>12s} {share:>13s}".rstrip())
        elif "wrong" in found:
            rows.append(f"{name:32s} wrong: {found['wrong']}")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu"), help="folder of the results; made if it is missing")
    parser.add_argument("--paper", action="store_true", help="the published size too")
    given = parser.parse_args()
    from lfpiv_kernels import runtime

    try:
        runtime.start("cuda")
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 2
    given.out.mkdir(parents=True, exist_ok=True)
    machine = limits()
    (given.out / "limits.json").write_text(json.dumps(machine, indent=1))
    print(f"{machine['gpu']}: {machine['bytes_per_second'] / 1e9:.0f} GB/s")
    with (given.out / "tests.txt").open("w") as file:
        command = [sys.executable, "-m", "pytest", "-q", "--device", "cuda", str(ROOT / "tests")]
        tests = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT).returncode
    print((given.out / "tests.txt").read_text().splitlines()[-1])
    with (given.out / "perf.jsonl").open("w") as file:
        command = [sys.executable, str(ROOT / "perf/run.py"), "--device", "cuda", "--all", *["--paper"] * given.paper]
        wrong = subprocess.run(command, stdout=file).returncode
    lines = [json.loads(line) for line in (given.out / "perf.jsonl").read_text().splitlines()]
    cases = [line["case"] for line in lines if line.get("metric") == "wall"]
    times = predicted_times(list(dict.fromkeys(cases))) if cases else {}
    print("\n".join(table(lines, float(machine["bytes_per_second"]), times.get)))
    return int(bool(tests or wrong))


if __name__ == "__main__":
    sys.exit(main())
