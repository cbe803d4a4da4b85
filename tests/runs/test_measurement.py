"""Measure a pair by calls: the same numbers as `lfpiv run`, in the short and in the long form."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.series_run import FIRST, write_series

import lfpiv

README = Path(__file__).resolve().parents[2] / "README.md"


def script():
    """The Python of the README."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```$", README.read_text("utf-8"), re.MULTILINE | re.DOTALL))


def assert_same(found, expected):
    """All arrays of the expected dataset are in the other one, byte by byte."""
    assert list(expected.variables)
    for name in expected.variables:
        assert found[name].dtype == expected[name].dtype and found[name].dims == expected[name].dims, name
        assert found[name].values.tobytes() == expected[name].values.tobytes(), name


@pytest.fixture(scope="module")
def rig(coarse_run):
    calibration = lfpiv.load_calibration(coarse_run.out / "calibration.h5")
    return lfpiv.prepare(lfpiv.open_experiment(coarse_run.experiment), calibration)


@pytest.mark.slow
def test_the_script_of_the_readme_gives_what_the_command_gives(coarse_run, tmp_path, monkeypatch):
    coarse_run.images(tmp_path / "data")
    monkeypatch.chdir(tmp_path / "data")
    names = {}
    exec(compile(script(), str(README), "exec"), names)
    assert_same(names["vectors"], xr.load_dataset(coarse_run.out / "vectors" / "pair_0000.nc", engine="h5netcdf"))


def test_each_pair_and_its_volumes_are_those_of_the_run(coarse_run, rig):
    seen = []
    vectors = lfpiv.measure_pair(rig, 2, progress=lambda step, fraction: seen.append(fraction))
    stored = xr.load_dataset(coarse_run.out / "vectors" / "pair_0002.nc", engine="h5netcdf")
    assert_same(vectors, stored)
    assert seen == sorted(seen) and seen[-1] == 1.0
    for name in ("dt_s", "pair", "experiment", "verdict", "settings", "passes", "valid_fraction", "warnings"):
        assert np.array_equal(vectors.attrs[name], stored.attrs[name]), name
    for frame, volume in zip("ab", rig.volumes(2), strict=True):
        path = coarse_run.out / "volumes" / f"pair_0002_{frame}.nc"
        assert_same(volume.to_dataset(name="intensity"), xr.load_dataset(path, engine="h5netcdf"))


@pytest.mark.slow
def test_the_long_form_gives_the_same(rig):
    light, grid = rig.light(1), rig.experiment.grid
    images, floor = [one.images for one in light], [one.noise for one in light]
    volumes = lfpiv.reconstruct_pair(rig.weights, images, floor=floor, grid=grid, **rig.smart)
    vectors = lfpiv.joint_vectors(volumes, dt_s=rig.experiment.dt_s, **rig.correlation)
    assert_same(lfpiv.measure_pair(rig, 1), vectors)


@pytest.mark.slow
@pytest.mark.parametrize("predict", ["false", "true"])
def test_an_instant_of_a_series_is_measured_as_in_its_run(small_run, tmp_path, predict):
    file = write_series(small_run, tmp_path / "data")
    file.write_text(file.read_text("utf-8").replace("[smart]\n", f"[smart]\npredict = {predict}\n"), "utf-8")
    assert lfpiv.open_experiment(file).in_sequence == (predict == "true")
    out = small_run.calibrated(tmp_path / "out")
    lfpiv.run(file, out, pairs=(FIRST, FIRST + 2))
    found = lfpiv.measure_pair(file, FIRST + 1, calibration=lfpiv.load_calibration(out / "calibration.h5"))
    assert_same(found, xr.load_dataset(out / f"vectors/instant_{FIRST + 1:06d}.nc", engine="h5netcdf"))


def test_wrong_calls_are_refused(coarse_run, rig):
    for wrong in (4, -1, 0.5, True, "0"):
        with pytest.raises(ValueError, match="pair: expected the number of a pair, 0 to 3"):
            lfpiv.measure_pair(rig, wrong)
    with pytest.raises(ValueError, match="calibration: expected none with a rig"):
        lfpiv.measure_pair(rig, 0, calibration=rig.calibration)
    one = lfpiv.Calibration({"left": rig.calibration.cameras["left"]})
    with pytest.raises(lfpiv.InputError, match="expected the cameras left, right"):
        lfpiv.prepare(coarse_run.experiment, one)
