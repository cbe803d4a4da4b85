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

import lfpiv
from lfpiv.experiment.opening import read_experiment
from lfpiv.planning import part
from lfpiv.weights.device_share import BASE_BYTES, beside_bytes
from lfpiv_kernels import runtime

assert runtime.start("cpu").form == "gpu"
experiment = read_experiment(sys.argv[1])
whole = part.Volume(
    experiment=experiment,
    guard=((1, 1),) * 3,
    refinement=1.0,
    calibration=lfpiv.thin_lens(experiment),
    particle_voxel=0.9,
)
forms = whole.forms()
peak = alive
part.measure(whole, forms, whole.per_voxel())
weights = sum(form.device_bytes for form in forms.values())
needed = weights + beside_bytes(whole.cameras.values(), whole.finest.grid) - BASE_BYTES
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
