"""Model the memory traffic and time of the correlation of a pair on a GPU, on a machine without one.

    python perf/gpu_correlation.py [--scale small|medium|paper] [--json FILE]

`lfpiv.correlate` runs with its default settings on two volumes of particles, with the loops for a GPU: deformation,
correlation, validation and uncertainty. `gpu_trace` notes what a sample of each launch's threads accesses. What the
host does between launches is timed on this processor. Arithmetic is left out.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path

from cases import SCALES, SHIFT
from gpu_trace import Tracer
from gpu_traffic import Traffic, Work, count_sectors, trace
from work import particles

import lfpiv
from lfpiv_kernels import runtime

MODULES = tuple(
    f"lfpiv_kernels.correlation.{name}"
    for name in (
        "blocks_gpu", "deform_gpu", "filters_gpu", "interpolation_gpu", "neighbours_gpu", "peaks_gpu", "split_gpu",
        "sums_gpu", "uncertainty_gpu", "voxelwise_gpu", "windows_gpu",
    )
)  # fmt: skip
"""Modules whose kernels a pair's correlation launches on a GPU."""


def tracer() -> Tracer[Traffic]:
    """Return a tracer of the correlation's kernels."""
    runtime.start("cpu")
    return Tracer(MODULES, count_sectors)


@cache
def model(scale: str) -> Work:
    """Model the correlation of two volumes of particles by the default settings, see ``cases.SCALES``."""
    shape = SCALES[scale]["volume"]
    first, second = particles(shape), particles(shape, SHIFT)
    return trace(lambda: lfpiv.correlate(first, second, dt_s=1.0, voxel_mm=0.1), tracer())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", choices=SCALES, default="small")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args()
    found = model(given.scale)
    print("\n".join(found.table()))
    host = f"{1e3 * found.host_s:.0f} ms of this processor between them"
    print(f"{len(found.launches)} launches: {1e3 * found.seconds:.1f} ms; {host}")
    if given.json:
        figures = {"kernels": found.rows(), "seconds": found.seconds, "host_s": found.host_s}
        given.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
