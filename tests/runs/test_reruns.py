"""The same command again: what is kept, what is noticed, and what the exit status says."""

import json
import os
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
import tifffile
from support.small_run import PAIRS, same_vectors

from lfpiv import hdf5
from lfpiv.cli import commands
from lfpiv.runs import pipeline, unchanged
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.runs.run import open_run


def run(experiment, out, *more):
    """Run the command line quietly and return its exit status."""
    return commands.call(["run", str(experiment), "--out", str(out), "--quiet", *more])


@pytest.fixture
def finished(coarse_run, tmp_path):
    """Return experiment file and results of a finished run, as copies."""
    return coarse_run.images(tmp_path / "data"), coarse_run.results(tmp_path / "out")


@pytest.mark.slow
def test_a_lost_volume_of_an_image_pair_is_fitted_again(coarse_run, tmp_path, monkeypatch):
    """The joint fit takes both frames; the volume that is there stays."""
    out, found, pair = coarse_run.results(tmp_path / "out"), [], Reconstructor.pair
    kept = (out / "volumes/pair_0001_a.nc").stat().st_mtime_ns
    for lost in ("volumes/pair_0001_b.nc", "vectors/pair_0001.nc"):
        (out / lost).unlink()
    monkeypatch.setattr(
        Reconstructor, "pair", lambda self, both, step: found.append(both[1].frame.label) or pair(self, both, step)
    )
    pipeline.run(coarse_run.experiment, out, keep_volumes=True)
    assert found == ["pair 1, frame b"] and same_vectors(coarse_run.out, out) == PAIRS
    assert (out / "volumes/pair_0001_a.nc").stat().st_mtime_ns == kept


@pytest.mark.slow
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


@pytest.mark.slow
def test_an_interrupted_calibration_goes_on_with_the_next_camera(small_run, interrupted, caplog):
    experiment, out = interrupted
    caplog.set_level("INFO", "lfpiv")
    pipeline.calibrate(experiment, out)
    assert "left: dots measured before, kept" in caplog.text and "right: dots measured before" not in caplog.text
    assert sorted(path.name for path in out.iterdir()) == ["calibration.h5", "summary.json"]
    whole, continued = arrays(small_run.out / "calibration.h5"), arrays(out / "calibration.h5")
    assert whole.keys() == continued.keys()
    assert all(np.array_equal(whole[name], continued[name], equal_nan=True) for name in whole)


@pytest.mark.slow
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


@pytest.mark.slow
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


OPTIONS = {"pairs": (0, None), "device": None, "keep_volumes": True, "workers": None, "scheduler": None}


def repeated(experiment, out, **changed):
    """Return what the same command answers without doing anything; None if it has to check everything."""
    return unchanged.repeat({"experiment": str(experiment), **OPTIONS, **changed}, out)


@pytest.fixture(scope="module")
def recorded(small_run, tmp_path_factory):
    """Return experiment file and results of a run that the command line repeated once, and its summary."""
    folder = tmp_path_factory.mktemp("recorded")
    experiment, out = small_run.images(folder / "data"), small_run.results(folder / "out")
    summary = pipeline.run(str(experiment), out, **OPTIONS)
    return experiment, out, summary


PROGRAM = """
import sys
from lfpiv.cli.commands import call
status = call(sys.argv[1:])
print(status, sorted({"taichi", "warp", "scipy", "xarray", "h5py", "matplotlib"} & {*sys.modules}))
"""


def test_an_unchanged_run_is_answered_without_loading_libraries(recorded):
    experiment, out, summary = recorded
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    command = [sys.executable, "-c", PROGRAM, "run", str(experiment), "--out", str(out), "--keep-volumes"]
    for _ in range(2):  # in another folder than the checkout, whose files would be another program
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=out)
        assert done.stdout.splitlines()[-1] == "0 []" and "nothing changed" in done.stderr
        assert "sigma_nor" in done.stdout and "100.0 % valid" in done.stdout
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert {path.name for path in after if after[path] != before.get(path)} == {"summary.json", ".record.json"}
    again = json.loads((out / "summary.json").read_text())
    for entry in ("digest", "timings_s"):
        del again[entry]
    assert again == {name: value for name, value in json.loads(json.dumps(summary)).items() if name in again}
    assert again["reused"] == ["calibration", *(f"vectors of pair {pair}" for pair in range(4))]


def flipped(path):
    """Change a byte of a file and set its time back."""
    times, content = path.stat(), bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


CHANGES = {
    "image": lambda data, out: flipped(data / "particles" / "left" / "pair_0001_a.tif"),
    "board": lambda data, out: flipped(data / "board" / "left" / "plane_00.tif"),
    "experiment": lambda data, out: (data / "experiment.toml").touch(),
    "image gone": lambda data, out: (data / "particles" / "left" / "pair_0001_a.tif").unlink(),
    "calibration": lambda data, out: flipped(out / "calibration.h5"),
    "vectors": lambda data, out: flipped(out / "vectors" / "pair_0000.nc"),
    "vectors gone": lambda data, out: (out / "vectors" / "pair_0003.nc").unlink(),
    "volume gone": lambda data, out: (out / "volumes" / "pair_0003_b.nc").unlink(),
    "report gone": lambda data, out: (out / "report.html").unlink(),
    "summary": lambda data, out: flipped(out / "summary.json"),
    "record": lambda data, out: flipped(out / ".record.json"),
    "background came": lambda data, out: (out / "self_calibration.h5").touch(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_any_change_has_everything_checked(recorded, tmp_path, change):
    experiment, out, _ = recorded
    shutil.copytree(experiment.parent, tmp_path / "data")
    shutil.copytree(out, tmp_path / "out")
    experiment, out = tmp_path / "data" / experiment.name, tmp_path / "out"
    assert repeated(experiment, out) is None, "the record is of another folder"
    record_of(experiment, out)
    assert repeated(experiment, out) is not None
    CHANGES[change](experiment.parent, out)
    assert repeated(experiment, out) is None


def record_of(experiment, out):
    """Write the record of a finished run."""
    with open_run(experiment, out, None, None) as current:
        summary = json.loads((out / "summary.json").read_text())
        command = {"experiment": str(experiment), **OPTIONS}
        unchanged.record(command, current.folder, current.experiment, unchanged.look_at(current.experiment), summary)


@pytest.mark.parametrize("changed", [{"pairs": (0, 2)}, {"device": "cpu"}, {"keep_volumes": False}, {"workers": 1}])
def test_another_command_has_everything_checked(recorded, changed):
    experiment, out, _ = recorded
    assert repeated(experiment, out, **changed) is None


def test_another_program_and_another_folder_of_the_same_name_have_everything_checked(recorded, monkeypatch, tmp_path):
    experiment, out, _ = recorded
    shutil.copytree(experiment.parent, tmp_path / "data")
    monkeypatch.chdir(experiment.parent)
    record_of(experiment.name, out)
    assert repeated(experiment.name, out) is not None
    monkeypatch.chdir(tmp_path / "data")
    assert repeated(experiment.name, out) is None
    monkeypatch.chdir(experiment.parent)
    monkeypatch.setattr(unchanged, "program", lambda: "another")
    assert repeated(experiment.name, out) is None


@pytest.mark.slow
def test_an_image_stored_again_with_another_pixel_is_named(finished, capfd):
    """Files and their hashes differ. The right camera's images stay as they are."""
    experiment, out = finished
    first, last = (experiment.parent / "particles" / "left" / f"pair_000{pair}_a.tif" for pair in (0, 3))
    image = tifffile.imread(first)
    image[len(image) // 2, 100] += 1
    tifffile.imwrite(last, image, compression="zlib")
    run(experiment, out)
    said = json.loads((out / "summary.json").read_text())["warnings"]
    (named,) = [text for text in said if "has the same pixels" in text]
    assert named.startswith("pair 3: an image has the same pixels, all or nearly all, as an image of pair 0")


@pytest.mark.slow
def test_a_second_frame_that_is_the_first_one_but_for_a_pixel_fails_its_pair(finished, capfd):
    experiment, out = finished
    first, second = (experiment.parent / "particles" / "left" / f"pair_0002_{frame}.tif" for frame in "ab")
    image = tifffile.imread(first)
    image[len(image) // 2, 100] = image.max() + 1
    tifffile.imwrite(second, image)
    run(experiment, out)
    ((failed),) = json.loads((out / "summary.json").read_text())["failed"]
    assert failed["pair"] == 2 and "found the same image as left, pair 2, frame a" in failed["reason"]
