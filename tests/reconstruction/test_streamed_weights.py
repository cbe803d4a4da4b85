"""Volumes from weights that are streamed through a GPU's memory, with its loops emulated: those of weights that fit."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

STREAM = """
import json, logging, sys, weakref
import warp as wp

alive, peak = 0, 0  # memory that a GPU would hold [byte]


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
        self.released = weakref.finalize(self, add, -size)


wp.array.__init__ = counted

import numpy as np
from support.ideal_rig import optics, two_cameras

import lfpiv
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights import depth_planes
from lfpiv.weights.checks import estimate_device_need
from lfpiv.weights.device_share import BASE_BYTES
from lfpiv_kernels import runtime, transfer
from lfpiv_kernels.reconstruction import projector_streamed

allocated = transfer.host_bytes


def on_host(size, **options):
    memory = allocated(size, **options)
    memory.released()  # what is on the host does not count
    return memory


projector_streamed.host_bytes = on_host
depth_planes.FEWEST_VOXELS = depth_planes.LEAST_GAIN = 0  # nodes even where they are more than voxels, or coarse
depth_planes.LARGEST_ERROR = depth_planes.WORST_ERROR = float("inf")
projector_streamed.SLAB_BYTES = 96 << 10
assert runtime.start("cpu").form == "gpu"
form, planes, subsets = sys.argv[1], sys.argv[2] == "planes", int(sys.argv[3])
rig = two_cameras(optics=optics(rows=300, columns=320))
grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.0, 1.0, 1.4), voxel_mm=0.1)
truth = np.where(np.random.default_rng(0).random(grid.shape) < 0.02, 4e5, 0).astype(np.float32)
logging.basicConfig(level="INFO", stream=sys.stderr)


def solve(weights, images):
    settings = SmartSettings(iterations=5, subsets=subsets, sieve_voxel=0.6)
    found = SmartSolver(weights, settings).solve(images)
    return found.to_dataarray().values, np.array(found.misfit), weights.camera_sums, weights.affected_pixels


def build():
    return lfpiv.build_weights(rig, grid, form=form, planes=planes)


whole = build()
projectors = [whole.projector(name) for name in whole.cameras]
assert not any(one.streamed for one in projectors) and all((one.planes is not None) == planes for one in projectors)
images, need = whole(truth), estimate_device_need(rig, grid, form)
expected, sizes = solve(whole, images), [one.device_bytes for one in projectors]
del whole, projectors
share = int(0.6 * sum(sizes))
free = need.beside + share
runtime.free_bytes = lambda: free
before, peak = alive, alive
streamed = build()
weights_alive = alive - before
found = solve(streamed, images)
assert (streamed.T(images) == build().T(images)).all()
slabs = [streamed.projector(name).streamed for name in streamed.cameras]
with transfer.count_transfers() as moved:
    streamed.projector(list(streamed.cameras)[-1]).scatter(truth.ravel())
print(json.dumps({
    "equal": [bool((a == b).all()) for a, b in zip(found, expected, strict=True)],
    "brightest": float(found[0].max()),
    "resident": [None if one is None else one.resident for one in slabs],
    "count": [None if one is None else one.count for one in slabs],
    "held": sum(streamed.projector(name).device_bytes for name in streamed.cameras),
    "share": share,
    "peak": peak - before,
    "allowed": free - BASE_BYTES,
    "moved": moved.to_device,
    "pass": slabs[-1].pass_bytes[0],
}))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "planes", "subsets"),
    [("profiles", "planes", 4), ("pixels", "planes", 4), ("pixels", "voxels", 1)],
)
def test_a_volume_from_streamed_weights_is_that_from_weights_that_fit(form, planes, subsets):
    tests = Path(__file__).resolve().parents[1]
    path = os.pathsep.join([str(tests), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "LFPIV_EMULATE_GPU": "1", "PYTHONPATH": path}
    arguments = [sys.executable, "-c", STREAM, form, planes, str(subsets)]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["equal"] == [True] * 4 and found["brightest"] > 0, found
    assert found["count"][-1] > found["resident"][-1], found
    assert found["held"] <= found["share"] and found["peak"] <= found["allowed"], found
    assert sum(found["moved"]) - 4 * 10 * 10 * 14 == found["pass"], found
    slabs, resident = found["count"][-1], found["resident"][-1]
    assert f"{slabs} slabs, {resident} stay on the GPU; a projection copies" in done.stderr
