"""Compare volumes and vectors from counted rays with those from footprints, on the same images.

    python perf/accuracy/counted_weights.py --cases blobs --conditions clean --flows ring --rays 4096,16384 \\
        --cameras 2 --seeds 11,12,13

The other options are those of ``reconstruction_bench.py``. No figure is kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import reconstruction_ways
from reconstruction_bench import CACHE, measure, parse_cases
from reconstruction_ways import WAYS

from lfpiv.weights.operator import build_weights

FIGURES = ("error", "q", "misfit", "cpu_s")


@contextmanager
def counted(rays: int | None) -> Iterator[None]:
    """Count so many rays per voxel and camera; None: integrate footprints of every voxel, pixel by pixel."""
    exact = partial(build_weights, form="pixels", planes=False)
    reconstruction_ways.build_weights = exact if rays is None else partial(build_weights, method="count", rays=rays)
    reconstruction_ways.forget_weights()
    try:
        yield
    finally:
        reconstruction_ways.build_weights = build_weights
        reconstruction_ways.forget_weights()


def main() -> None:
    """Print the figures of each case with footprints and with counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option, default in (("cases", "blobs"), ("conditions", "clean"), ("cameras", "2"), ("flows", "ring")):
        parser.add_argument(f"--{option}", default=default)
    parser.add_argument("--ppm", default="0.5")
    parser.add_argument("--seeds", default="11")
    parser.add_argument("--rays", default="4096,16384")
    parser.set_defaults(angles=None, scale="small", frames=2)
    arguments = parser.parse_args()
    for rays in (None, *map(int, arguments.rays.split(","))):
        with counted(rays):  # of all cases: seeds share their rig's weights
            for case in parse_cases(arguments):
                found = measure(case, WAYS["ours"], CACHE)
                text = ", ".join(f"{name} {found[name]:.4g}" for name in FIGURES)
                of = "footprints" if rays is None else f"{rays} rays"
                print(f"{case.label}, seed {case.seed}, {of}: {text}", flush=True)


if __name__ == "__main__":
    main()
