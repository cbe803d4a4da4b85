"""Compare volumes from the weights of nodes on planes with those from the weights of all voxels, on the same images.

    python perf/accuracy/depth_planes.py --cases blobs,points --conditions clean,real --flows ring,shear --seeds 11
    python perf/accuracy/depth_planes.py --cases blobs,points --angles=30,-30 --flows ring --seeds 11,12,13

The options are those of ``reconstruction_bench.py``. Volumes of its small scale have too few voxels for nodes, so that
they are used here whatever the number of voxels. Nodes are as far apart as in large volumes. No figure is kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

import reconstruction_ways
from reconstruction_bench import CACHE, measure, parse_cases
from reconstruction_ways import WAYS

from lfpiv.weights.forms import nodes as forms

FIGURES = ("error", "q", "misfit", "cpu_s")


@contextmanager
def nodes(used: bool) -> Iterator[None]:
    """Use nodes for volumes of any size, or for none."""
    before = forms.FEWEST_VOXELS, forms.LEAST_GAIN
    forms.FEWEST_VOXELS, forms.LEAST_GAIN = (0, 0.0) if used else (10**18, 0.0)
    reconstruction_ways.forget_weights()
    try:
        yield
    finally:
        forms.FEWEST_VOXELS, forms.LEAST_GAIN = before
        reconstruction_ways.forget_weights()


def main() -> None:
    """Print the figures of each case both ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option, default in (("cases", "blobs"), ("conditions", "clean"), ("cameras", "2"), ("flows", "ring,shear")):
        parser.add_argument(f"--{option}", default=default)
    parser.add_argument("--ppm", default="0.5")
    parser.add_argument("--seeds", default="11")
    parser.add_argument("--angles")
    parser.set_defaults(scale="small", frames=2)
    for case in parse_cases(parser.parse_args()):
        for used in (False, True):
            with nodes(used):
                found = measure(case, WAYS["ours"], CACHE)
            text = ", ".join(f"{name} {found[name]:.4g}" for name in FIGURES)
            print(f"{case.label}, seed {case.seed}, {'nodes' if used else 'all voxels'}: {text}", flush=True)


if __name__ == "__main__":
    main()
