"""`lfpiv preview`: a picture of one pair of a calibrated rig, by the run's own steps on larger voxels."""

import json

import cv2
import numpy as np
import pytest
import xarray as xr
from scipy import ndimage

import lfpiv
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.report.preview import DPI, GOOD, WIDTH_INCH, Level
from lfpiv.runs import preview


def test_a_preview_is_drawn_and_nothing_else_is_written(small_run, tmp_path, capfd):
    out = small_run.calibrated(tmp_path / "out")
    status = commands.call(["preview", str(small_run.experiment), "-o", str(out), "--pair", "2", "--json"])
    found = json.loads(capfd.readouterr().out)
    assert status == 0 and found["picture"] == str(out / "preview" / "pair_2.png") and found["warnings"] == []
    assert sorted(path.name for path in out.iterdir()) == ["calibration.h5", "preview"]
    picture = cv2.imread(found["picture"])
    assert picture.shape[1] == WIDTH_INCH * DPI and picture.std() > 10
    assert [(level["camera"], level["frame"]) for level in found["levels"]] == [
        (camera, frame) for frame in ("frame a", "frame b") for camera in ("left", "right")
    ]
    for level in found["levels"]:
        assert level["verdict"] == GOOD and level["peak"] > 10 * level["noise"] > 0 and 0 < level["lit"] <= 1


def collected_on(volume, coarse):
    """The light of a volume on larger voxels, each in the one that it lies in, blurred over neighbours."""
    edges = [np.append(one - coarse_step(one) / 2, one[-1] + coarse_step(one) / 2) for one in axes(coarse)]
    places = np.stack(np.meshgrid(*axes(volume), indexing="ij"), axis=-1).reshape(-1, 3)
    return ndimage.gaussian_filter(np.histogramdd(places, edges, weights=volume.values.ravel())[0], 1)


def axes(volume):
    return [volume[axis].values for axis in "zyx"]


def coarse_step(places):
    return places[1] - places[0]


def test_the_coarse_volume_shows_the_particles_of_the_full_one(small_run, monkeypatch):
    """A volume mirrored along x, which has as much light at other places, does not agree."""
    shown = []
    monkeypatch.setattr(preview, "MOST_VOXELS", 1500)
    monkeypatch.setattr(preview, "draw", lambda one, path: shown.append(one))
    found = preview.preview(small_run.experiment, small_run.out, 1)
    coarse = shown[0].volumes["frame a"]
    assert found["voxel_mm"] == pytest.approx(coarse_step(coarse["x"].values)) and found["voxel_mm"] > 0.1
    with xr.open_dataarray(small_run.out / "volumes" / "pair_0001_a.nc") as full:
        expected = collected_on(full.transpose("z", "y", "x"), coarse)
    seen = ndimage.gaussian_filter(coarse.values, 1)
    alike, mirrored = (np.corrcoef(seen.ravel(), one.ravel())[0, 1] for one in (expected, expected[..., ::-1]))
    assert alike > 0.8 and mirrored < 0.5 * alike, (alike, mirrored)
    for name, stack in shown[0].refocused.items():
        light = ndimage.gaussian_filter(stack.values, 1)
        alike, mirrored = (np.corrcoef(light.ravel(), one.ravel())[0, 1] for one in (expected, expected[..., ::-1]))
        assert stack.shape == coarse.shape and alike > mirrored + 0.2, (name, alike, mirrored)


@pytest.mark.parametrize("most", [50, 1000, 10**6])
def test_a_coarse_volume_covers_the_same_place(tiny_experiment, monkeypatch, most):
    monkeypatch.setattr(preview, "MOST_VOXELS", most)
    experiment = lfpiv.open_experiment(tiny_experiment)
    grid, coarse = experiment.grid, preview.coarsened(experiment).grid
    assert np.allclose(coarse.centre_mm, grid.centre_mm)
    assert coarse.size <= 1.5 * most and (coarse == grid or coarse.voxel_mm > grid.voxel_mm)
    size, given = (np.array(one.shape) * one.voxel_mm for one in (coarse, grid))
    assert (np.abs(size - given) <= coarse.voxel_mm / 2 + 1e-9).all()


def test_a_rig_that_is_not_calibrated_says_so(small_run, tmp_path, capfd):
    assert commands.call(["preview", str(small_run.experiment), "-o", str(tmp_path / "out")]) == 2
    message = capfd.readouterr().err.splitlines()[-1]
    assert "lfpiv calibrate" in message and not (tmp_path / "out").exists()


def test_a_pair_that_does_not_exist_is_refused(small_run):
    with pytest.raises(InputError, match="pairs: expected A:B with 0 <= A < B <= 4"):
        preview.preview(small_run.experiment, small_run.out, 4)


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [({}, GOOD), ({"structure": 0.1}, "weak"), ({"structure": 0.01}, "hardly any"), ({"saturated": 0.1}, "saturated")],
)
def test_levels_are_judged(changed, verdict):
    good = {"camera": "left", "frame": "a", "dark": 40.0, "noise": 3.0, "peak": 500.0, "lit": 0.5, "saturated": 0.0}
    assert Level(**good | {"structure": 0.4} | changed).verdict == verdict
