"""The sample data's turbulent flow as a time series: equal vectors from every form of file, each instant once."""

import shutil
import time
from collections import Counter

import numpy as np
import pytest
import xarray as xr
from support import small_run
from support.series_forms import (
    CAMERAS,
    FORMS,
    INSTANTS,
    PAIRS,
    STEP,
    CountedProcesses,
    as_pairs,
    make_series,
    series_scene,
)

from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.runs import pipeline
from lfpiv.simulation.flows import window_mean

pytestmark = pytest.mark.slow

RUN_S = 240.0
"""Longest time that a run in another process may take before the test fails [s]."""
WINDOW_MM = 1.2
"""Edge of the last window."""


@pytest.fixture(scope="module")
def sample_file(sample_data):
    return sample_data / "dns-tracers" / "rayleigh_benard_series.npz"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, sample_file, device):
    """Folder of the experiment files of one series in all forms."""
    return make_series(sample_file, tmp_path_factory.mktemp("recorded"))


@pytest.fixture(scope="module")
def counted():
    """Count how often the images of an instant are reconstructed in this process, which writes no reports."""
    patch, count = pytest.MonkeyPatch(), Counter()
    original = SmartSolver.solve

    def solve(self, images, **options):
        if len(self.weights.cameras) == len(CAMERAS):  # not the check for moved cameras, camera by camera
            count[b"".join(images[name].tobytes() for name in CAMERAS)] += 1
        return original(self, images, **options)

    patch.setattr(SmartSolver, "solve", solve)
    patch.setattr("lfpiv.report.write_report", lambda *arguments: None)
    yield count
    patch.undo()


@pytest.fixture(scope="module")
def single(recorded, counted, tmp_path_factory, device):
    """Output folder of the series as single files with its volumes, and how often each instant was reconstructed."""
    out = tmp_path_factory.mktemp("single") / "out"
    counted.clear()
    pipeline.run(recorded / "single.toml", out, device=device.kind, keep_volumes=True)
    return out, sorted(counted.values())


def calibrated(single, folder):
    """Create an output folder that holds the calibration; return it."""
    folder.mkdir()
    shutil.copy2(single[0] / "calibration.h5", folder)
    return folder


def test_each_instant_is_reconstructed_once(single):
    out, counts = single
    assert counts == [1] * INSTANTS
    assert sorted(path.name for path in (out / "vectors").iterdir()) == [f"instant_{pair:06d}.nc" for pair in PAIRS]
    names = sorted(path.name for path in (out / "volumes").iterdir())
    assert names == [f"instant_{instant:06d}.nc" for instant in range(INSTANTS)]


@pytest.mark.parametrize("form", [form for form in FORMS if form != "single"])
def test_every_form_of_file_gives_equal_vectors(recorded, single, counted, tmp_path, device, form):
    out = calibrated(single, tmp_path / "out")
    counted.clear()
    summary = pipeline.run(recorded / f"{form}.toml", out, device=device.kind)
    assert sorted(counted.values()) == [1] * INSTANTS
    assert small_run.same_vectors(single[0], out) == len(PAIRS) and not summary["failed"]


def test_independent_pairs_of_the_same_images_give_equal_vectors(recorded, single, counted, tmp_path, device):
    """What a series changes is the number of reconstructions, nothing else."""
    out = calibrated(single, tmp_path / "out")
    counted.clear()
    pipeline.run(as_pairs(recorded), out, device=device.kind)
    assert sum(counted.values()) == 2 * len(PAIRS)
    for pair in PAIRS:
        one = xr.load_dataset(single[0] / "vectors" / f"instant_{pair:06d}.nc", engine="h5netcdf")
        other = xr.load_dataset(out / "vectors" / f"pair_{pair:04d}.nc", engine="h5netcdf")
        for name in one.data_vars:
            assert np.array_equal(one[name].values, other[name].values, equal_nan=one[name].dtype.kind == "f"), name


def test_vectors_are_those_of_the_flow(single, sample_file):
    """Vectors of each instant against the displacement of all tracers to `step` instants later, over its windows."""
    scene = series_scene(sample_file)
    errors, moved = [], []
    for pair in PAIRS:
        vectors = xr.load_dataset(single[0] / "vectors" / f"instant_{pair:06d}.nc", engine="h5netcdf")
        z, y, x = np.meshgrid(*(vectors[axis].values for axis in "zyx"), indexing="ij")
        true = window_mean(scene.flow_of(pair), np.stack([x, y, z], -1).reshape(-1, 3), WINDOW_MM) / 0.1
        found = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], -1).reshape(-1, 3)
        errors.append(np.linalg.norm(found - true, axis=1).mean())
        moved.append(np.linalg.norm(true, axis=1).mean())
    assert max(errors) < 0.5 * np.mean(moved)  # as many tracers as windows hold in a small volume show no more


def test_two_workers_reconstruct_each_instant_once(recorded, single, tmp_path, device):
    out, processes = calibrated(single, tmp_path / "out"), CountedProcesses(tmp_path)
    process = small_run.start("run", recorded / "cine.toml", "--out", out, "--workers", 2, env=processes.environment())
    messages = process.communicate(timeout=RUN_S)[1]
    assert process.returncode == 0, messages
    assert sorted(processes.counts().values()) == [1] * INSTANTS
    assert small_run.same_vectors(single[0], out) == len(PAIRS)


def test_a_killed_run_continues_with_equal_numbers(recorded, single, tmp_path):
    out = calibrated(single, tmp_path / "out")
    arguments = ("run", recorded / "tiff.toml", "--out", out)
    process, deadline = small_run.start(*arguments), time.monotonic() + RUN_S
    while len(list(out.glob("vectors/*.nc"))) < 2:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()[1]
        time.sleep(0.01)
    process.kill()
    process.communicate()
    left = [pair for pair in PAIRS if not (out / "vectors" / f"instant_{pair:06d}.nc").exists()]
    assert left, "the run was killed too late"
    processes = CountedProcesses(tmp_path)
    process = small_run.start(*arguments, env=processes.environment())
    messages = process.communicate(timeout=RUN_S)[1]
    assert process.returncode == 0, messages
    needed = {instant for pair in left for instant in (pair, pair + STEP)}
    assert sorted(processes.counts().values()) == [1] * len(needed)
    assert small_run.same_vectors(single[0], out) == len(PAIRS)
