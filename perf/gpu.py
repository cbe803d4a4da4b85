"""Measure and test on a machine with a GPU, in stages.

    python perf/gpu.py --out FOLDER [--stage NAME ...] [--minutes M] [--sample FOLDER] [--again]
    python perf/gpu.py --out FOLDER --emulate  # without a GPU: the stages' own code, on small cases

Stages, see `gpu_stages`: limits, kernels, job, paper, large, profile, taichi. Each is a process of its own, ends within
`--minutes`, and writes FOLDER/STAGE.json (status, failures, figures) and FOLDER/STAGE.txt. A stage that passed is not
repeated. `docs/contribute.md` says how to bring the project to a machine without a network. The exit status is 1 if a
stage fails, 2 without a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from gpu_stages import STAGES

ROOT = Path(__file__).resolve().parents[1]
GRACE_S = 40.0
"""Time after the end of a stage's minutes in which it may end by itself [s]."""


def visible() -> bool:
    """Return whether there is a GPU; Warp is asked in a process of its own."""
    asked = (
        "import warp as wp; wp.config.log_level = wp.LOG_ERROR; wp.init(); raise SystemExit(not wp.is_cuda_available())"
    )
    return subprocess.run([sys.executable, "-c", asked], capture_output=True).returncode == 0


def run_stage(name: str, given: argparse.Namespace) -> dict[str, Any]:
    """Run a stage and return what it wrote; its status is "timed out" if it had to be stopped, else as it says."""
    path = given.out / f"{name}.json"
    if path.exists() and not given.again and json.loads(path.read_text())["status"] == "passed":
        return json.loads(path.read_text())
    path.unlink(missing_ok=True)
    arguments = [
        name,
        str(given.out),
        "--scale",
        "tiny" if given.emulate else "paper",
        "--minutes",
        str(given.minutes),
    ]
    arguments += ["--sample", str(given.sample)] if given.sample else []
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths} | ({"LFPIV_EMULATE_GPU": "1"} if given.emulate else {})
    began = time.monotonic()
    with (given.out / f"{name}.txt").open("w") as said:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "perf/gpu_stages.py"), *arguments], env=environment, stdout=said, stderr=said
        )
        try:
            process.wait(60 * given.minutes + GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    found = json.loads(path.read_text()) if path.exists() else {"stage": name, "failures": [], "figures": {}}
    if found.get("status") not in ("passed", "failed"):
        found["status"] = "timed out" if process.returncode == -9 else "broke off"
        found["failures"].append((given.out / f"{name}.txt").read_text("utf-8", "replace")[-1000:])
    found["seconds"] = time.monotonic() - began
    path.write_text(json.dumps(found, indent=1))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu"), help="folder of the results; made if it is missing")
    parser.add_argument("--stage", action="append", choices=STAGES, help="default: all, in their order")
    parser.add_argument("--minutes", type=float, default=8.0, help="time of each stage")
    parser.add_argument("--sample", type=Path, help="folder with the sample experiment, for the stage `job`")
    parser.add_argument("--again", action="store_true", help="repeat stages that passed")
    parser.add_argument("--emulate", action="store_true", help="run the loops for a GPU on the CPU, on small cases")
    given = parser.parse_args()
    if not given.emulate and not visible():
        print("device: no GPU is visible; --emulate runs the stages on the CPU.", file=sys.stderr)
        return 2
    given.out.mkdir(parents=True, exist_ok=True)
    statuses = []
    for name in given.stage or STAGES:
        found = run_stage(name, given)
        statuses.append(found["status"])
        print(f"{name}: {found['status']}, {found.get('seconds', 0):.0f} s", flush=True)
        for failure in found["failures"]:
            print(f"    {failure[:1000]}", flush=True)
    return int(any(status != "passed" for status in statuses))


if __name__ == "__main__":
    sys.exit(main())
