"""Model the memory traffic and time of SMART's kernels on a GPU, on a machine without one.

    python perf/gpu_model.py [--scale small|medium|paper] [--refinement F] [--form profiles|pixels] [--json FILE]
    python perf/gpu_model.py --cases CASE ...  # of the benchmark: their times

The first guess, comparisons, iterations and epochs of `lfpiv.reconstruct` run on the arrays of a rig with the loops for
a GPU. `gpu_trace` notes what a sample of each launch's threads accesses, and `gpu_traffic` says how times follow. All
voxels take part. Of a projector's kernels only the sample runs. `gpu_correlation` models the correlation. Arithmetic is
left out.
"""

from __future__ import annotations

import argparse
import json
import traceback
from functools import cache
from pathlib import Path
from unittest.mock import patch

import gpu_correlation
import numpy as np
from cases import CASES, SCALES, prepare
from gpu_trace import Tracer, loops_for_a_gpu
from gpu_traffic import Traffic, Work, count_sectors, trace
from inputs import grid, rig

import lfpiv
from lfpiv.reconstruction.first_guess import multiplicative_guess
from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.ordered_subsets import CONFLICT, WHOLE_PASSES, Partition, iterate_epochs, subsets_of
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.smart import CameraEquation, ImageEquations, State
from lfpiv.reconstruction.steps import SharpenedStep, SmartStep
from lfpiv.weights.forms import shared_profiles
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.projector_gpu import TiledProjector
from lfpiv_kernels.reconstruction.voxels import ones
from lfpiv_kernels.transfer import zeros

PASSES = "lfpiv_kernels.reconstruction"
SAMPLED = (f"{PASSES}.projector_gpu",)
"""Modules whose kernels take most of the time. No launch's accesses depend on their results."""
MODULES = (
    *SAMPLED,
    "lfpiv_kernels.filters.blur_gpu",
    *(f"{PASSES}.{name}" for name in ("depth_planes_gpu", "first_guess", "pixel_rays_gpu", "sums", "update", "voxels")),
)
"""Modules whose kernels a reconstruction launches on a GPU."""
SIEVE_VOXEL = 0.6
"""Standard deviation of the sieve that is modelled [voxel]."""


class Passes:
    """Passes of a reconstruction over the rays of alike cameras; all are traced with the same light everywhere.

    Parameters
    ----------
    projector : Projector
        Weights of one of the cameras, as on a GPU.
    shape : tuple of int
        Voxel counts in stored order.
    cameras : int
        Number of cameras.
    """

    def __init__(self, projector: Projector, shape: tuple[int, int, int], cameras: int):
        self._projector, self._shape, self._cameras = projector, shape, cameras
        self._size = int(np.prod(shape))
        self._tracer: Tracer[Traffic] = Tracer(MODULES, count_sectors, SAMPLED)

    def _equations(self) -> ImageEquations:
        light = np.ones(int(np.prod(self._projector.microimages.sensor_shape)), np.float32)
        one = CameraEquation(image=light, gain=light, floor=1.0, projector=self._projector)
        return ImageEquations([one] * self._cameras)

    def projection(self, forward: bool) -> Work:
        """Return the traffic of the projections of a volume onto the cameras, or of their back projections."""
        pixels = int(np.prod(self._projector.microimages.sensor_shape))

        def run() -> None:
            for _ in range(self._cameras):
                if forward:
                    self._projector.project(ones(self._size), zeros(pixels))
                else:
                    self._projector.back_project(ones(pixels), zeros(self._size))

        return trace(run, self._tracer)

    def guess(self) -> Work:
        """Return the traffic of the first guess from the images."""

        def run() -> None:
            comparisons, light = self._equations().comparisons, ones(self._size)
            shown = [ones(one.image.size) for one in comparisons]
            multiplicative_guess(comparisons, [1.0] * self._cameras, light, light, shown)

        return trace(run, self._tracer)

    def comparison(self, sieve_voxel: float = SIEVE_VOXEL) -> Work:
        """Return the traffic of the comparison of a volume with the images."""
        sieve = Sieve(sieve_voxel, self._shape)
        return trace(lambda: self._equations().compare(sieve(ones(self._size))), self._tracer)

    def iteration(self, sieve_voxel: float = SIEVE_VOXEL) -> Work:
        """Return the traffic of an iteration over all rays: the first step is accepted. Without a sieve it is plain."""

        def run() -> None:
            equations, sieve = self._equations(), Sieve(sieve_voxel, self._shape)
            light = ones(self._size)
            step, momentum = SmartStep(light, sieve), None
            if sieve_voxel > 0:
                step, momentum = SharpenedStep(light, sieve), Momentum(light)
            exponent = equations.back_project(light)
            proposal = next(State(light, momentum, (step,)).proposals(exponent))
            equations.compare(sieve(proposal.coefficients))

        return trace(run, self._tracer)

    def epoch(self) -> Work:
        """Return the traffic of an epoch over two subsets of each camera, which larger ones may follow."""

        def run() -> None:
            subsets, light = subsets_of(self._cameras, 2), ones(self._size)
            state, sieve = State(light, None, ()), Sieve(SIEVE_VOXEL, self._shape)
            partition = Partition(subsets, (SharpenedStep(light, sieve),) * len(subsets), conflict=CONFLICT)
            for _ in iterate_epochs(self._equations(), state, sieve, partitions=(partition, partition), epochs=1):
                pass

        return trace(run, self._tracer)


class Model:
    """Traffic of a rig's reconstruction, see ``cases.SCALES``, on voxels finer by `refinement`."""

    def __init__(self, scale: str, form: str, refinement: float):
        runtime.start("cpu")
        of = SCALES[scale]
        voxels = grid(of)
        if refinement != 1.0:
            edge = voxels.voxel_mm / refinement
            voxels = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.1 * of["voxels"],) * 3, voxel_mm=edge)
        with patch.object(shared_profiles, "are_possible", lambda *_: False):  # the weights of voxels
            weights = lfpiv.build_weights(rig(of["sensor"]), voxels, form=form)
        first, *others = map(weights.projector, weights.cameras)
        with loops_for_a_gpu():
            projector = type(first)(*first.parts)
            self.weights_bytes = projector.device_bytes + sum(TiledProjector(one.blocks).nbytes for one in others)
            """Memory of all cameras' weights on the GPU."""
        self.stored_bytes = weights.memory_bytes
        """The same on the CPU."""
        self.passes = Passes(projector, weights.stored.shape, len(weights.cameras))


@cache
def model(scale: str, form: str = "profiles", refinement: float = 1.0) -> Model:
    """Return the model of a rig."""
    return Model(scale, form, refinement)


CORRELATION = ("_correlate", "_deform", "_vectors")
"""Functions that prepare the cases of the correlation."""


def predicted(case: str) -> float | None:
    """Return the predicted time of a benchmark's case [s]; None if it is not modelled."""
    maker, settings, scale = CASES[case]
    form = settings.get("form", "profiles")
    if maker.__name__ == "_projection":
        return model(scale, form).passes.projection(settings["forward"]).seconds
    if maker.__name__ == "_smart":
        passes = model(scale, form).passes
        return passes.comparison(0.0).seconds + settings["iterations"] * passes.iteration(0.0).seconds
    if maker.__name__ in CORRELATION:
        found = trace(prepare(case).run, gpu_correlation.tracer())
        return found.seconds + found.host_s
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", choices=SCALES, default="small")
    parser.add_argument("--form", choices=("profiles", "pixels"), default="profiles")
    parser.add_argument("--refinement", type=float, default=1.0, help="how much finer voxels are than the case's")
    parser.add_argument("--json", type=Path, help="file for the tables")
    parser.add_argument(
        "--cases", nargs="+", choices=CASES, metavar="CASE", help="print their times [s] as JSON instead, one a line"
    )
    given = parser.parse_args()
    if given.cases:
        for case in given.cases:
            try:
                print(json.dumps({case: predicted(case)}), flush=True)
            except Exception:  # the others are predicted all the same
                traceback.print_exc()
        return
    found = model(given.scale, given.form, given.refinement)
    passes = found.passes
    epochs = SmartSettings().iterations - WHOLE_PASSES
    of_volume = {  # by the default passes: traffic of each, and how many there are
        "first guess": (passes.guess(), 1),
        "comparison": (passes.comparison(), 2),
        "epoch": (passes.epoch(), epochs),
        "iteration": (passes.iteration(), WHOLE_PASSES),
    }
    for name, (work, count) in of_volume.items():
        print("\n".join([f"{name}: {1e3 * work.seconds:.3f} ms, {count} times", *work.table(), ""]))
    pair_s = 2 * sum(count * work.seconds for work, count in of_volume.values())
    print(f"weights: {found.weights_bytes / 2**20:.0f} MiB, on the CPU {found.stored_bytes / 2**20:.0f} MiB")
    print(f"two volumes: {pair_s:.4f} s")
    if given.json:
        rows = {name: work.rows() for name, (work, _) in of_volume.items()}
        given.json.write_text(json.dumps({"work": rows, "pair_s": pair_s}, indent=1))


if __name__ == "__main__":
    main()
