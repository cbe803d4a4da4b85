"""Run the tests and the benchmarks on a machine with a GPU.

    python perf/gpu.py [--out FOLDER] [--paper]

Writes FOLDER/tests.txt, FOLDER/perf.jsonl and FOLDER/limits.json (the bandwidth of the GPU's memory), and prints a
table that compares the cases with this limit. The exit status is 1 if a test fails or a result is wrong, 2 without a
GPU.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

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
    for name in dict.fromkeys(line["case"] for line in lines):
        found = {line["metric"]: line["value"] for line in lines if line["case"] == name and "metric" in line}
        if "wall" in found:
            stored = found.get("stored_bytes")
            share = f"{stored / found['wall'] / machine['bytes_per_second']:.2f} of the bandwidth" if stored else ""
            print(f"{name:32s} {found['wall']:10.4f} s  {share}")
        elif "wrong" in found:
            print(f"{name:32s} wrong: {found['wrong']}")
    return int(bool(tests or wrong))


if __name__ == "__main__":
    sys.exit(main())
