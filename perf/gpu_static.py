"""Show what the CUDA compiler makes of the Warp kernels, on a machine without a GPU.

    pip install '.[gpu-check]'
    python perf/gpu_static.py [--arch 75 80 90 100] [--json FILE]
    python perf/gpu_static.py --arch 75 80 90 100 --json docs/figures/gpu_static.json  # the table of the pages

Warp compiles each module to PTX, and ptxas assembles it: registers, stack and spilled bytes of each kernel, and the
share of a multiprocessor's threads for which the registers suffice (occupancy). Kernels that only the CPU runs are
left out.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import pkgutil
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

REGISTERS = 65536
"""Of a multiprocessor."""
THREADS = {75: 1024, 80: 2048, 90: 2048, 100: 2048}
"""Of a multiprocessor, by compute capability."""
BLOCK = 256
"""Threads of a block: Warp's default."""
REGISTER_UNIT = 256
"""Registers are given to warps of 32 threads in units of this many."""
ARCHITECTURES = (75, 80, 90, 100)
"""Compute capabilities. The compiler in Warp no longer knows 7.0."""
AT_ONCE = 2
"""Architectures that are compiled side by side, each by a process of some 1 GiB."""
CPU_MODULES = (
    "blocks", "blur", "box_sum", "deform", "depth_planes", "line_shares", "neighbours", "peaks", "pixel_rays", "planes",
    "projector", "projector_separable", "separable", "spectra", "windows",
)  # fmt: skip
"""Modules without a kernel for a GPU; their headers need not compile for one."""
CPU_ONLY = {
    "footprint": ("_fill_blocks", "_pack_blocks"),
    "particle_normal": ("_multiply_images",),
    "projector_gpu": ("_count_entries", "_write_entries"),
    "update": ("_compare",),
}
"""Kernels of the other modules that a GPU never runs: it has other kernels in their place."""


@dataclass(frozen=True)
class Kernel:
    """What ptxas says of a kernel."""

    module: str
    name: str
    architecture: int
    registers: int
    stack: int
    """Bytes per thread."""
    spilled: int
    """Bytes that are stored and loaded for want of registers."""
    shared: int
    """Bytes of shared memory per block."""

    @property
    def occupancy(self) -> float:
        """Share of a multiprocessor's threads for which the registers suffice."""
        per_warp = -(-self.registers * 32 // REGISTER_UNIT) * REGISTER_UNIT
        blocks = REGISTERS // max(per_warp * BLOCK // 32, 1)
        return min(1.0, blocks * BLOCK / THREADS[self.architecture])


def assembler() -> str | None:
    """Return the path of the extra's ptxas; None without it. Others may be older than the compiler in Warp."""
    installed = Path(sysconfig.get_paths()["purelib"]).glob("nvidia/*/bin/ptxas")
    return next((str(path) for path in installed), None)


def measure(architecture: int) -> Iterator[Kernel]:
    """Compile and assemble all kernels for a GPU of one architecture.

    Raises
    ------
    RuntimeError
        If ptxas is missing or refuses a module.
    """
    import warp as wp

    import lfpiv_kernels

    for found in pkgutil.walk_packages(lfpiv_kernels.__path__, "lfpiv_kernels."):
        module, short = importlib.import_module(found.name), found.name.rpartition(".")[2]
        if short in CPU_MODULES or not wp.get_module(found.name).kernels:
            continue
        for kernel in _assemble(module, short, architecture):
            if kernel.name not in CPU_ONLY.get(short, ()):
                yield kernel


def _assemble(module: object, short: str, architecture: int) -> Iterator[Kernel]:
    import warp as wp

    ptxas = assembler()
    if ptxas is None:
        raise RuntimeError("ptxas: expected the CUDA assembler, found none; pip install 'lfpiv[gpu-check]'.")
    with tempfile.TemporaryDirectory() as folder:
        (path,) = map(Path, wp.compile_aot_module(module, arch=architecture, module_dir=folder, use_ptx=True))
        path.write_bytes(path.read_bytes().replace(b"\0", b""))  # Warp ends its PTX with a zero, which ptxas refuses
        command = [ptxas, "-v", f"--gpu-name=sm_{architecture}", str(path), "-o", str(Path(folder) / "cubin")]
        said = subprocess.run(command, capture_output=True, text=True)
    if said.returncode:
        raise RuntimeError(f"{short}: ptxas refuses it for sm_{architecture}: {said.stderr.strip()}")
    entries = r"Compiling entry function '(\S+?)_[0-9a-f]{8}_cuda\S*'(.*?)(?=Compiling entry|\Z)"
    for name, text in re.findall(entries, said.stderr, re.DOTALL):

        def number(pattern: str, text: str = text) -> int:
            found = re.search(pattern, text)
            return int(found[1]) if found else 0

        spilled = number(r"(\d+) bytes spill stores") + number(r"(\d+) bytes spill loads")
        numbers = number(r"Used (\d+) registers"), number(r"(\d+) bytes stack"), spilled, number(r"(\d+) bytes smem")
        yield Kernel(short, name, architecture, *numbers)


@contextmanager
def _leaving_nothing() -> Iterator[None]:
    """Let a signal to terminate raise `SystemExit`, so that folders are removed and processes ended on the way out."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def measure_all(architectures: Sequence[int]) -> list[Kernel]:
    """Compile and assemble all kernels for several architectures, each in a process of its own.

    Raises
    ------
    RuntimeError
        If a process fails; with the end of what it said.
    """
    waiting, running = list(architectures), {}
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    with _leaving_nothing(), tempfile.TemporaryDirectory() as folder:
        table = {one: Path(folder) / f"{one}.json" for one in architectures}
        try:
            while waiting or running:
                while waiting and len(running) < AT_ONCE:
                    one = waiting.pop(0)
                    command = [sys.executable, __file__, "--arch", str(one), "--json", str(table[one])]
                    with table[one].with_suffix(".txt").open("w") as said:
                        environment = os.environ | {"PYTHONPATH": paths}
                        running[one] = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
                time.sleep(0.1)
                for one in [one for one, process in running.items() if process.poll() is not None]:
                    if running.pop(one).returncode:
                        said = table[one].with_suffix(".txt").read_text("utf-8", "replace")
                        raise RuntimeError(f"sm_{one}: the kernels could not be measured: {said[-2000:]}")
        finally:
            for process in running.values():
                process.terminate()
            for process in running.values():
                process.wait()
        rows = [row for path in table.values() for row in json.loads(path.read_text("utf-8"))]
    return [Kernel(**{name: value for name, value in row.items() if name != "occupancy"}) for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--arch",
        type=int,
        nargs="+",
        default=[90],
        choices=ARCHITECTURES,
        help="compute capabilities, without the point",
    )
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args()
    if len(given.arch) > 1:
        rows = measure_all(given.arch)
    else:
        with _leaving_nothing():
            rows = list(measure(*given.arch))
    print(f"{'kernel':36s} {'sm':>4s} {'registers':>9s} {'occupancy':>9s} {'stack':>6s} {'spilled':>7s}")
    for row in sorted(rows, key=lambda row: (row.occupancy, row.module, row.name)):
        name = f"{row.module}.{row.name.lstrip('_')}"
        print(
            f"{name:36s} {row.architecture:4d} {row.registers:9d} {row.occupancy:9.2f} {row.stack:6d} {row.spilled:7d}"
        )
    if given.json:
        given.json.write_text(json.dumps([asdict(row) | {"occupancy": row.occupancy} for row in rows], indent=1))


if __name__ == "__main__":
    main()
