"""The estimate of a GPU's memory against the arrays that loops for a GPU hold, counted with these emulated."""

import json
import os
import subprocess
import sys

import pytest

COUNT = """
import json, sys, weakref
import warp as wp

alive, peak = 0, 0


def add(size):
    global alive, peak
    alive += size
    peak = max(peak, alive)


made = wp.array.__init__


def counted(self, *arguments, **options):
    made(self, *arguments, **options)
    if options.get("copy", True) and "ptr" not in options and self.ptr:
        size = self.size * wp.types.type_size_in_bytes(self.dtype)
        add(size)
        weakref.finalize(self, add, -size)


wp.array.__init__ = counted

import numpy as np

import lfpiv
from lfpiv.weights.memory_left import BASE_BYTES, beside_bytes
from lfpiv_kernels import runtime

assert runtime.start("cpu").form == "gpu"
experiment = lfpiv.open_experiment(sys.argv[1])
calibration, grid = lfpiv.thin_lens(experiment), experiment.grid
built = lfpiv.build_weights(calibration, grid, particle_voxel=0.9)
weights = sum(built.projector(name).device_bytes for name in built.cameras)
peak = alive
images = [built(np.random.default_rng(seed).random(grid.shape, np.float32)) for seed in (1, 2)]
volumes = [lfpiv.reconstruct(built, one) for one in images]
lfpiv.correlate(*volumes)
needed = weights + beside_bytes(calibration.cameras.values(), grid) - BASE_BYTES
print(json.dumps({"peak": peak, "weights": weights, "needed": needed}))
"""


@pytest.mark.slow
def test_the_estimate_covers_the_arrays_of_loops_for_a_gpu(small_run):
    environment = {**os.environ, "LFPIV_EMULATE_GPU": "1"}
    arguments = [sys.executable, "-c", COUNT, str(small_run.experiment)]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["weights"] < found["peak"] <= found["needed"], found
