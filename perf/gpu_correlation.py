"""Model the memory traffic and time of the correlation of a pair on a GPU, on a machine without one.

    python perf/gpu_correlation.py [--scale small|medium|paper] [--json FILE]

`lfpiv.correlate` runs with its default settings on two volumes of particles, with the loops for a GPU: deformation,
correlation, validation and uncertainty. `gpu_trace` notes what a sample of each launch's threads accesses. Of a launch
the GPU's memory moves at most its arrays once. What the host does between
launches is timed on this processor. Arithmetic is left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

from cases import SCALES, SHIFT
from gpu_trace import Accesses, Tracer
from gpu_traffic import Traffic, count_sectors, total
from inputs import particles

import lfpiv
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.projector_gpu import SECTOR

MODULES = tuple(
    f"lfpiv_kernels.correlation.{name}"
    for name in (
        "blocks_gpu", "deform_gpu", "filters_gpu", "interpolation_gpu", "neighbours_gpu", "peaks",
        "peaks_gpu", "split_gpu",
        "sums_gpu", "uncertainty_gpu", "voxelwise_gpu", "windows_gpu",
    )
)  # fmt: skip
"""Modules whose kernels a pair's correlation launches on a GPU."""


def traffic(name: str, found: Accesses) -> Traffic:
    """Return the traffic of a launch from the accesses of a sample."""
    of = count_sectors(name, found.events, found.exchanges, found.scale, 0.0, found.warps, found.warps_of_block)
    return dataclasses.replace(of, memory=min(float(found.nbytes), SECTOR * of.by_block))


@dataclasses.dataclass(frozen=True)
class Work:
    """Traffic of some work of the correlation."""

    launches: list[Traffic]
    host_s: float
    """Processor time between the launches [s]."""

    @property
    def seconds(self) -> float:
        """Predicted time of the launches [s]."""
        return sum(one.seconds for one in self.launches)

    def by_kernel(self) -> list[tuple[Traffic, float]]:
        """Return the traffic and the time [s] of each kernel, slowest first."""
        names = dict.fromkeys(one.kernel for one in self.launches)
        groups = [[one for one in self.launches if one.kernel == name] for name in names]
        rows = [(total(of[0].kernel, of), sum(one.seconds for one in of)) for of in groups]
        return sorted(rows, key=lambda row: -row[1])


def trace(run: Callable[[], object]) -> Work:
    """Run some work of the correlation twice, and return the traffic of the second time.

    Raises
    ------
    RuntimeError
        If the accesses of a launch could not be noted.
    """
    runtime.start("cpu")
    tracer = Tracer(MODULES, traffic)
    with tracer.running():
        run()  # finds out how much of a launch can be noted
        tracer.launches.clear()
        start, tracer.kernel_s = time.process_time(), 0.0
        run()
        host = time.process_time() - start - tracer.kernel_s
    launches = [one for one in tracer.launches if one is not None]
    if len(launches) < len(tracer.launches):
        raise RuntimeError("a launch has more accesses than can be noted.")
    return Work(launches, host)


@cache
def model(scale: str) -> Work:
    """Model the correlation of two volumes of particles by the default settings, see ``cases.SCALES``."""
    shape = SCALES[scale]["volume"]
    first, second = particles(shape), particles(shape, SHIFT)
    return trace(lambda: lfpiv.correlate(first, second, dt_s=1.0, voxel_mm=0.1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", choices=SCALES, default="small")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args()
    found = model(given.scale)
    print("kernel                              launches  touched /needed /packed by block /filled       ms  limit")
    for one, seconds in found.by_kernel():
        limit = max(one.limits_s, key=lambda name: one.limits_s[name])
        print(
            f"{one.kernel:36s} {one.launches:7d} {one.touched / 1e6:8.2f}M {one.ratio:6.2f} {one.strict:7.2f} "
            f"{one.by_block / 1e6:7.2f}M {one.filled:7.2f} {1e3 * seconds:8.3f}  {limit}"
        )
    host = f"{1e3 * found.host_s:.0f} ms of this processor between them"
    print(f"{len(found.launches)} launches: {1e3 * found.seconds:.1f} ms; {host}")
    if given.json:
        rows = [dataclasses.asdict(one) | {"seconds": seconds} for one, seconds in found.by_kernel()]
        given.json.write_text(json.dumps({"kernels": rows, "seconds": found.seconds, "host_s": found.host_s}, indent=1))


if __name__ == "__main__":
    main()
