"""`lfpiv plan` against the run that it foretells. Times are not compared: they depend on the machine's other work."""

import dataclasses
import json
import math

import numpy as np
import pytest

import lfpiv
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.experiment.opening import read_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.planning import campaign
from lfpiv.planning.result import Disk, Memory
from lfpiv.report.summary import DeviceFigures
from lfpiv.results import netcdf
from lfpiv.runs import device_memory, memory
from lfpiv.runs.memory import GIB
from lfpiv.settings.processing import Bootstrap, Tracking
from lfpiv.weights.memory_left import rays_bytes
from lfpiv_kernels import runtime
from lfpiv_kernels.runtime import Device

COMPRESSION = 0.15
"""Relative error of a file's size: simulated vectors and volumes are compressed like recorded ones, not to the byte."""
FEW_PARTICLES = 4096  # bytes, the least of a file of linked particles
PAIRS, WORKERS = 1000, 2


@pytest.fixture(scope="module")
def planned(small_run):
    """Plan of the small run, with its own calibration and guard layers."""
    experiment = read_experiment(small_run.experiment)
    simulating = dataclasses.replace(experiment, bootstrap=Bootstrap(pairs=12))
    return lfpiv.plan(simulating, pairs=PAIRS, workers=WORKERS, out=small_run.out)


@pytest.mark.slow
def test_the_numbers_are_those_of_the_run(planned, small_run):
    summary, experiment = small_run.summary, read_experiment(small_run.experiment)
    file = small_run.out / "vectors" / "pair_0000.nc"
    assert list(planned.vectors) == summary["pairs"][0]["vectors"] == list(netcdf.read_vectors(file)["u"].shape)
    assert list(planned.shape) == summary["experiment"]["volume_shape"]
    assert planned.reconstructed_mm == pytest.approx(summary["refinement"]["voxel_mm"])
    guard = np.sum(summary["guard"]["thickness_mm"], axis=1)[::-1] / experiment.grid.voxel_mm  # z, y, x
    factor = summary["refinement"]["factor"]
    assert planned.reconstructed == tuple(math.ceil(n - 1e-6) for n in (planned.shape + guard) * factor)
    assert planned.disk.pair == pytest.approx(file.stat().st_size, rel=COMPRESSION)
    assert planned.disk.results == PAIRS * planned.disk.pair and planned.fits


def test_the_memory_is_what_a_run_announces(planned, small_run):
    experiment = read_experiment(small_run.experiment)
    reconstructed = Grid(shape=planned.reconstructed, voxel_mm=planned.reconstructed_mm, first_centre_mm=(0, 0, 0))
    finest = dataclasses.replace(experiment, grid=reconstructed)
    assert planned.memory.needed == memory.run_bytes(finest, planned.memory.weights, WORKERS)
    assert planned.memory.worker == memory.worker_bytes(finest)
    maps = sum(map(rays_bytes, lfpiv.load_calibration(small_run.out / "calibration.h5").cameras.values()))
    built = small_run.summary["weights"]["memory_mib"] * 2**20
    assert planned.memory.weights - maps == pytest.approx(built)
    assert built < planned.disk.weights == planned.memory.weights
    memory_of = planned.memory
    assert memory_of.device_needed is memory_of.device_free is None


def test_two_workers_share_pairs_and_threads(planned):
    steps, time = planned.time.steps, planned.time
    assert list(steps) == ["images", "reconstruction", "correlation", "writing"]
    assert time.pair.wall_s == pytest.approx(sum(one.wall_s for one in steps.values()))
    simulated = 13  # twelve and a pilot
    once = sum(one.wall_s for one in time.preparation.values()) + time.first.wall_s
    assert time.simulated.wall_s == pytest.approx(simulated * time.pair.wall_s)
    assert time.total_s == pytest.approx(once + (PAIRS / WORKERS + simulated) * time.pair.wall_s)
    assert set(time.preparation) == {"weights", "cameras"}
    card = planned.card().text()
    assert f"{math.prod(planned.vectors):,} per pair" in card and "1,000 pairs with 2 workers" in card


@pytest.mark.slow
def test_tracking_is_a_step_of_the_pair(planned, coarse_run):
    experiment = dataclasses.replace(read_experiment(coarse_run.experiment), tracking=Tracking(vectors="links"))
    tracked = lfpiv.plan(experiment, pairs=PAIRS, out=coarse_run.out)
    assert list(tracked.time.steps) == ["images", "reconstruction", "correlation", "tracking", "writing"]
    assert tracked.time.steps["tracking"].cpu_s > 0
    assert tracked.disk.pair > planned.disk.pair + FEW_PARTICLES
    assert not [text for text in tracked.assumptions if "tracking" in text]


@pytest.mark.slow
def test_the_command_needs_neither_particle_images_nor_a_calibration(coarse_run, tmp_path, capfd):
    experiment = coarse_run.images(tmp_path / "data")
    for image in (experiment.parent / "particles").rglob("*.*"):
        image.unlink()
    assert commands.call(["plan", str(experiment), "--pairs", "3", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert set(found) == {
        *("experiment", "pairs", "workers", "threads", "device", "volume", "reconstructed", "vectors", "time"),
        *("memory_bytes", "disk_bytes", "fits", "limits", "assumptions"),
    }
    assert found["pairs"] == 3 and found["workers"] == 1 and found["device"]["kind"] == runtime.device().kind
    assert found["device"]["name"] == runtime.device().name
    assert set(found["time"]["preparation"]) == {"weights"}
    costs = [*found["time"]["preparation"].values(), *found["time"]["steps"].values(), found["time"]["pair"]]
    assert all(set(cost) == {"wall_s", "cpu_s"} and cost["wall_s"] >= 0 for cost in costs)
    assert found["vectors"]["count"] == math.prod(found["vectors"]["shape"])
    assert set(found["memory_bytes"]) == {field.name for field in dataclasses.fields(Memory)}
    assert set(found["disk_bytes"]) == {field.name for field in dataclasses.fields(Disk)}
    assert any("thin lenses" in text for text in found["assumptions"])
    assert any("no images yet" in text for text in found["assumptions"])
    assert not [path for path in tmp_path.iterdir() if path.name != "data"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--pairs", "0"), "--pairs: expected a whole number from 1"),
        (("--workers", "0"), "--workers: expected a whole number from 1 to 1024, found 0"),
        (("--out", "nowhere"), "--out: expected the folder of a run, found no folder nowhere"),
        (("--pairs", "many"), "valid integer"),
    ],
)
def test_bad_options_are_refused_before_any_work(small_run, monkeypatch, capfd, arguments, message):
    monkeypatch.setattr(campaign, "open_run", lambda *_, **__: pytest.fail("work began"))
    assert commands.call(["plan", str(small_run.experiment), *arguments]) == 2
    assert message in capfd.readouterr().err


def test_a_camera_without_orientation_needs_a_calibration(small_run):
    experiment = read_experiment(small_run.experiment)
    bare = tuple(dataclasses.replace(camera, orientation=None) for camera in experiment.cameras)
    with pytest.raises(InputError, match=r"camera 'left'.*lfpiv calibrate.*--out"):
        lfpiv.plan(dataclasses.replace(experiment, cameras=bare))


def test_what_does_not_fit_is_said(planned, small_run):
    finest = read_experiment(small_run.experiment)
    need = dataclasses.replace(planned.memory, needed=planned.memory.allowed + 1)
    disk = dataclasses.replace(planned.disk, free=planned.disk.results - 1)
    limits = list(campaign.limits_of(finest, need, disk, planned.time.steps, WORKERS))
    assert limits[0].startswith("memory: ") and limits[1].startswith("disk: ") and limits[2].startswith("time: ")
    assert not dataclasses.replace(planned, memory=need).fits and not dataclasses.replace(planned, disk=disk).fits


GPU = Device("cuda", 8, "gpu", name="NVIDIA TEST", memory_bytes=4 * GIB, driver="12.8")


def test_a_volume_that_cannot_fit_into_the_gpu_is_refused(small_run, monkeypatch):
    experiment = read_experiment(small_run.experiment)
    need = dataclasses.replace(device_memory.estimate_need(experiment), cameras=(GIB // 4, 3 * GIB // 4))
    assert need.whole > GIB + 4 * experiment.grid.size

    def require(free, sharing=1):
        monkeypatch.setattr(runtime, "free_bytes", lambda: free)
        device_memory.require(experiment, need, GPU, sharing=sharing)

    require(need.whole)
    require(3 * need.whole, sharing=3)
    with pytest.raises(InputError, match=r"GiB of the GPU's memory; .* free on NVIDIA TEST\. Raise"):
        require(need.whole - 1)
    with pytest.raises(InputError, match="Use at most 2 workers per GPU"):
        require(2 * need.whole, sharing=3)
    with pytest.raises(InputError, match=r"free on NVIDIA TEST\. Raise"):
        require(need.whole - 1, sharing=3)


def test_a_run_that_cannot_fit_into_the_gpu_begins_no_work(small_run, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(runtime, "free_bytes", lambda: GIB)
    out = tmp_path / "out"
    for arguments in (["run", str(small_run.experiment), "--out", str(out)], ["plan", str(small_run.experiment)]):
        assert commands.call(arguments) == 2
        assert "1.0 GiB are free on" in capfd.readouterr().err and not out.exists()


def test_the_device_is_said(small_run):
    assert GPU.sentence == "cuda, NVIDIA TEST, 4.0 GiB, driver for CUDA 12.8, 8 threads"
    fallen = Device("cpu", 1, reason="no CUDA device visible", name="A Processor")
    assert fallen.sentence == "cpu, A Processor, 1 thread (no CUDA device visible)"
    assert DeviceFigures(kind="cpu", threads=1, name="A Processor", reason=fallen.reason).sentence == fallen.sentence
    device = runtime.device()
    assert small_run.summary["device"] == device.figures()
    assert device.sentence in (small_run.out / "report.html").read_text()
