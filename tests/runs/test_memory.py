"""Memory that control groups leave, by trees of files in the forms that the kernel gives them."""

import dataclasses
import gc
import math
import tracemalloc

import numpy as np
import pytest
from support.ideal_rig import optics, two_cameras

import lfpiv
from lfpiv.experiment.opening import read_experiment
from lfpiv.experiment.recording import Recording
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.runs import memory
from lfpiv.runs.memory import GIB
from lfpiv.weights.forms import shared_profiles
from lfpiv.weights.forms.shared_profiles import ray_sets
from lfpiv_kernels import runtime

LEAST_KEPT = 0.9
"""Share of the estimated constants that a solver keeps at least: the estimate is rounded up."""

PROGRAMS, CACHE, SHARED = 1, 12, 2
"""What a group holds [GiB]: programs, files that the kernel may drop, and shared memory, which counts as a file, too,
but which it may not drop."""

NAMES = {2: ("memory.max", "memory.current", ""), 1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")}


def write_group(folder, limit_gib, version):
    """Files of one group; None: without limit, in the word or the number that stands for it."""
    limit, used, total = NAMES[version]
    folder.mkdir(parents=True, exist_ok=True)
    endless = "max" if version == 2 else str(2**63 - 4096)
    (folder / limit).write_text(f"{endless if limit_gib is None else limit_gib * GIB}\n")
    (folder / used).write_text(f"{(PROGRAMS + CACHE + SHARED) * GIB}\n")
    stat = {"file": CACHE + SHARED, "inactive_file": 0, "active_file": 0}
    stat |= {f"{total}inactive_file": CACHE - 4, f"{total}active_file": 4, "shmem": SHARED}
    (folder / "memory.stat").write_text("".join(f"{name} {value * GIB}\n" for name, value in stat.items()))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("own", "limits", "available"),
    [
        ("/", {}, 64),
        ("/", {"": 16}, 13),  # a container: its own group is the root of all it sees
        ("/docker/f00d", {"": 16}, 13),  # one that names a group which it does not see
        ("/../f00d", {"": 16, "f00d": 4}, 13),  # a group beside the container's, whatever the container has by its name
        ("/slurm/job_1/step_0", {"": None, "slurm": None, "slurm/job_1": 20, "slurm/job_1/step_0": None}, 17),
        ("/slurm/job_1", {"": None, "slurm": 18, "slurm/job_1": 20, "slurm/job_2": 4}, 15),
        ("/user.slice", {"": None, "user.slice": 2}, 0),  # more is in use than may be: the limit was lowered
        ("/user.slice", {"": None, "user.slice": 500}, 64),
    ],
)
def test_memory_is_what_the_tightest_group_above_the_process_leaves(
    tmp_path, monkeypatch, version, own, limits, available
):
    root = tmp_path / ("memory" if version == 1 else "")
    for name, limit_gib in limits.items():
        write_group(root / name, limit_gib, version)
    (tmp_path / "own").write_text(f"3:cpu,cpuacct:/\n2:memory:{own}\n0::/\n" if version == 1 else f"0::{own}\n")
    monkeypatch.setattr(memory, "GROUPS", tmp_path)
    monkeypatch.setattr(memory, "OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(memory, "meminfo", lambda key: 64 * GIB)
    assert memory.available_bytes() == available * GIB


def test_without_control_groups_the_machine_alone_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "GROUPS", tmp_path / "none")
    monkeypatch.setattr(memory, "OWN_GROUPS", tmp_path / "none either")
    monkeypatch.setattr(memory, "meminfo", lambda key: 64 * GIB)
    assert memory.available_bytes() == 64 * GIB


def test_a_sequence_holds_the_instants_between_those_of_a_pair(small_run):
    experiment = read_experiment(small_run.experiment)
    alone = experiment.smart.model_copy(update={"estimate": "correlation"})
    predicting = alone.model_copy(update={"predict": True})

    def needed(step, smart):
        recording = Recording() if step is None else Recording.of_series(40, step=step)
        return memory.worker_bytes(dataclasses.replace(experiment, recording=recording, smart=smart))

    assert needed(None, predicting) == needed(None, alone) == needed(8, alone)
    pixels = sum(math.prod(camera.optics.sensor_shape) for camera in experiment.cameras)
    assert needed(8, predicting) - needed(1, predicting) == 7 * 4 * (experiment.grid.size + pixels)
    assert needed(1, predicting) > needed(1, alone)
    assert needed(None, experiment.smart) > needed(None, alone), "a joint fit holds more volumes"


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True], ids=["blocks", "shared profiles"])
def test_the_estimate_has_room_for_what_a_solver_keeps_and_works_on(shared, device, monkeypatch):
    """Both volumes are held, as in a run; two cameras whose rays are cut into four subsets, or into rows of pixels."""
    if runtime.device().form == "gpu":
        pytest.skip("memory of a device is not traced")
    monkeypatch.setattr(shared_profiles, "FEWEST_VOXELS", 0 if shared else math.inf)
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.4,) * 3, voxel_mm=0.08)
    weights = lfpiv.build_weights(two_cameras(optics=optics(rows=300, columns=320)), grid, form="profiles")
    assert (weights.rows > 1) == shared
    images = weights(np.random.default_rng(0).random(grid.shape, np.float32))
    pixels = sum(image.size for image in images.values())
    gc.collect()
    tracemalloc.start()
    solver = SmartSolver(weights, SmartSettings(iterations=6, sieve_voxel=0.6, intensity_cap=0.0))
    both = [solver.solve(images) for _ in range(2)]
    peak = tracemalloc.get_traced_memory()[1]
    del both
    gc.collect()
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert len(solver.subsets) == (ray_sets(weights.cameras) if shared else 4)
    constants = (memory.KEPT_BYTES + 2 * memory.BYTES_PER_VOXEL_AND_CAMERA) * grid.size
    per_pixel = memory.BYTES_PER_PIXEL * pixels
    assert kept < constants + per_pixel
    assert shared or kept > LEAST_KEPT * constants  # shared profiles keep less: one step size for all subsets
    assert peak < (memory.BYTES_PER_VOXEL + 2 * memory.BYTES_PER_VOXEL_AND_CAMERA) * grid.size + per_pixel
