"""The same command again: what is kept, what is noticed, and what the exit status says."""

import json
import os
import shutil

import h5py
import numpy as np
import pytest
import tifffile

from lfpiv import hdf5
from lfpiv.cli import commands
from lfpiv.runs import pipeline
from lfpiv.runs.run import open_run


def run(experiment, out, *more):
    """Run the command line quietly and return its exit status."""
    return commands.call(["run", str(experiment), "--out", str(out), "--quiet", *more])


@pytest.fixture
def finished(small_run, tmp_path):
    """Return experiment file and results of a finished run, as copies."""
    return small_run.images(tmp_path / "data"), small_run.results(tmp_path / "out")


def test_a_pair_without_a_valid_vector_is_not_done(finished, capfd):
    experiment, out = finished
    path = out / "vectors" / "pair_0002.nc"
    with h5py.File(path, "r+") as file:
        figures = json.loads(file.attrs["figures"]) | {"valid_fraction": 0.0}
        file.attrs["figures"] = json.dumps(figures)
    hdf5.seal(path)
    assert run(experiment, out, "--pairs", "0:2") == 0
    assert "no vector" not in capfd.readouterr().err
    assert run(experiment, out) == 3
    assert "no vector is valid in pair 2: see" in capfd.readouterr().err
    assert json.loads((out / "summary.json").read_text())["without_vectors"] == [2]


def unfinished(experiment, out):
    """Return the pairs that a run would do."""
    with open_run(experiment, out, None, None) as current:
        return current.unfinished(volumes=True).ahead()


def test_copied_and_touched_images_are_the_same_images(small_run, tmp_path):
    out = small_run.results(tmp_path / "out")
    data = tmp_path / "copied"
    shutil.copytree(small_run.experiment.parent, data, copy_function=shutil.copy)  # cp -r: new times
    experiment = data / small_run.experiment.name
    assert unfinished(experiment, out) == []
    image = data / "particles" / "left" / "pair_0001_a.tif"
    image.touch()
    assert unfinished(experiment, out) == []


def test_a_changed_byte_is_noticed_whatever_the_times_say(finished):
    experiment, out = finished
    image = experiment.parent / "particles" / "right" / "pair_0002_b.tif"
    times = image.stat()
    content = bytearray(image.read_bytes())
    content[len(content) // 2] ^= 1
    image.write_bytes(content)
    os.utime(image, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert image.stat().st_size == times.st_size
    assert unfinished(experiment, out) == [2]


def test_exchanged_images_of_one_size_are_noticed(finished):
    experiment, out = finished
    one, other = (experiment.parent / "particles" / "left" / f"pair_000{pair}_a.tif" for pair in (0, 3))
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)
    assert unfinished(experiment, out) == [0, 3]


def test_stamps_of_earlier_versions_are_read(finished):
    """They state path, size and one time of each image."""
    experiment, out = finished
    path = out / "vectors" / "pair_0001.nc"
    with h5py.File(path, "r+") as file:
        parts = json.loads(file.attrs["depends_on"])
        parts["images"] = [entry[:3] for entry in parts["images"]]
        file.attrs["depends_on"] = json.dumps(parts)
    hdf5.seal(path)
    assert unfinished(experiment, out) == []
    (experiment.parent / "particles" / "left" / "pair_0001_a.tif").touch()
    assert unfinished(experiment, out) == [1]


def arrays(path):
    """Return all arrays of an HDF5 file by their names."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return found


def interrupt_after(fraction):
    """Return a progress callback that interrupts the calibration behind a fraction of it."""

    def progress(step, done):
        if step == "calibration" and done > fraction:
            raise KeyboardInterrupt

    return progress


@pytest.fixture(scope="module")
def one_camera(small_run, tmp_path_factory):
    """Return the results of a calibration that was interrupted after the first of two cameras."""
    out = tmp_path_factory.mktemp("interrupted") / "out"
    with pytest.raises(KeyboardInterrupt):
        pipeline.calibrate(small_run.experiment, out, progress=interrupt_after(0.38))
    assert sorted(path.name for path in out.iterdir()) == ["calibration_left.h5"]
    return out


@pytest.fixture
def interrupted(small_run, one_camera, tmp_path):
    """Return an experiment and results of an interrupted calibration, as copies."""
    shutil.copytree(one_camera, tmp_path / "out")
    return small_run.images(tmp_path / "data"), tmp_path / "out"


def test_an_interrupted_calibration_goes_on_with_the_next_camera(small_run, interrupted, caplog):
    experiment, out = interrupted
    caplog.set_level("INFO", "lfpiv")
    pipeline.calibrate(experiment, out)
    assert "left: dots measured before, kept" in caplog.text and "right: dots measured before" not in caplog.text
    assert sorted(path.name for path in out.iterdir()) == ["calibration.h5", "summary.json"]
    whole, continued = arrays(small_run.out / "calibration.h5"), arrays(out / "calibration.h5")
    assert whole.keys() == continued.keys()
    assert all(np.array_equal(whole[name], continued[name], equal_nan=True) for name in whole)


@pytest.mark.parametrize("change", ["image", "damage"])
def test_a_kept_camera_that_does_not_fit_is_measured_again(interrupted, caplog, change):
    experiment, out = interrupted
    if change == "image":
        path = experiment.parent / "board" / "left" / "plane_00.tif"
        image = tifffile.imread(path)
        image[0, 0] ^= 1
        tifffile.imwrite(path, image)
    else:
        path = out / "calibration_left.h5"
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    caplog.set_level("INFO", "lfpiv")
    with pytest.raises(KeyboardInterrupt):
        pipeline.calibrate(experiment, out, progress=interrupt_after(0.1))
    assert "measured before" not in caplog.text
    assert ("damaged or foreign" in caplog.text) == (change == "damage")


def test_the_camera_after_the_kept_one_may_change(interrupted, caplog):
    experiment, out = interrupted
    (experiment.parent / "board" / "right" / "plane_00.tif").touch()
    text = experiment.read_text()
    assert text.count("nominal_angle_deg = -40.0") == 1
    experiment.write_text(text.replace("nominal_angle_deg = -40.0", "nominal_angle_deg = -41.0"))
    caplog.set_level("INFO", "lfpiv")
    with pytest.raises(KeyboardInterrupt):
        pipeline.calibrate(experiment, out, progress=interrupt_after(0.38))
    assert "left: dots measured before, kept" in caplog.text
