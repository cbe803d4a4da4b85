"""Light that stands still in the images of a run: subtracted in every step and process, stored once, warned of."""

import json

import numpy as np
import pytest
import tifffile
from support.small_run import DISPLACEMENT_VOXEL, same_vectors, write_empty_report

from lfpiv.calibration.camera import load_calibration
from lfpiv.errors import InputError
from lfpiv.experiment.opening import read_experiment
from lfpiv.results import netcdf, provenance
from lfpiv.runs import background, pipeline

TOLERANCE_VOXEL = 0.2
"""Mean of the valid vectors against the flow, as without standing light."""

PEAK = 1500.0
"""Counts of the streak: some times those of a particle."""


def lit(small_run, folder):
    """Copy the experiment with a streak of light in all its particle images; return the file and the streak."""
    experiment = small_run.images(folder)
    opened = read_experiment(experiment)
    streaks = {}
    for camera in opened.cameras:
        white = opened.white(camera.name)
        across = np.exp(-0.5 * ((np.arange(white.shape[1]) - 150) / 8) ** 2)
        streaks[camera.name] = PEAK * across * np.clip(white - 60, 0, None) / white.max()
        for pair in range(opened.pairs):
            for power, frame in zip((1.0, 0.9), opened.frames, strict=True):
                path = opened.particle_path(camera.name, pair, frame)
                image = tifffile.imread(path) + power * streaks[camera.name]
                tifffile.imwrite(path, np.clip(np.rint(image), 0, 4095).astype(np.uint16))
    return experiment, streaks


def mean_displacement(out, pair):
    vectors = netcdf.read_vectors(out / "vectors" / f"pair_{pair:04d}.nc")
    return [float(vectors[f"displacement_{axis}"].where(vectors["valid"]).mean()) for axis in "xyz"]


def edited(experiment, old, new):
    text = experiment.read_text()
    assert old in text
    experiment.write_text(text.replace(old, new))
    return experiment


@pytest.mark.whole_run
@pytest.mark.slow
def test_a_streak_is_found_subtracted_and_stored_once(coarse_run, tmp_path, monkeypatch):
    experiment, _ = lit(coarse_run, tmp_path / "data")
    whole, part = (coarse_run.calibrated(tmp_path / name) for name in ("whole", "part"))
    summary = pipeline.run(experiment, whole, pairs=(0, 1))
    assert set(summary["background"]) == {"left", "right"}
    assert (whole / "report.html").read_text("utf-8").count("Light that stands still in left, frame") == 2
    assert all(0.02 < figures["standing_share"] < 0.5 for figures in summary["background"].values())
    assert not any("stands still" in text or "moved" in text for text in summary["warnings"])
    np.testing.assert_allclose(mean_displacement(whole, 0), DISPLACEMENT_VOXEL, atol=TOLERANCE_VOXEL)
    monkeypatch.setattr("lfpiv.report.page.write_report", write_empty_report)
    written = (whole / "background.h5").stat().st_mtime_ns
    again = pipeline.run(experiment, whole, pairs=(0, 1))
    assert "vectors of pair 0" in again["reused"] and again["background"] == summary["background"]
    assert (whole / "background.h5").stat().st_mtime_ns == written
    pipeline.reconstruct(experiment, part, pairs=(0, 1))
    pipeline.correlate(experiment, part, pairs=(0, 1))
    assert same_vectors(whole, part) == 1


@pytest.mark.slow
def test_standing_light_that_is_not_subtracted_is_named_with_the_remedy(coarse_run, tmp_path):
    experiment, _ = lit(coarse_run, tmp_path / "data")
    out = coarse_run.calibrated(tmp_path / "out")
    before = pipeline.run(edited(experiment, "[particles]\n", '[particles]\nbackground = "none"\n'), out, pairs=(0, 1))
    found = [record for record in before["warning_records"] if record["code"] == "standing"]
    assert {record["subject"] for record in found} == {"left", "right"}
    assert any("columns 1" in text and 'background = "auto"' in text for text in before["warnings"])
    assert provenance.background_content(out / "background.h5") is None
    after = pipeline.run(edited(experiment, 'background = "none"', 'background = "auto"'), out, pairs=(0, 1))
    assert "vectors of pair 0" not in after["reused"] and not any("stands still" in text for text in after["warnings"])


def test_a_background_image_is_checked_like_the_others(coarse_run, tmp_path):
    experiment, streaks = lit(coarse_run, tmp_path / "data")
    edited(experiment, 'name = "left"\n', 'name = "left"\nbackground_image = "empty_{frame}.tif"\n')
    with pytest.raises(InputError, match=r"empty_a\.tif \(background_image of camera 'left'\).*no such file"):
        read_experiment(experiment)
    for frame in "ab":
        tifffile.imwrite(experiment.parent / f"empty_{frame}.tif", np.rint(streaks["left"] + 40).astype(np.uint16))
    opened = read_experiment(experiment)
    assert opened.background_image("left", "b").max() == pytest.approx(streaks["left"].max() + 40, abs=1)
    assert opened.background_image("right", "b") is None
    tifffile.imwrite(experiment.parent / "empty_b.tif", np.zeros((10, 10), np.uint16))
    with pytest.raises(InputError, match=r"empty_b\.tif.*pixels \(rows, columns\) as in the white image"):
        read_experiment(experiment)
    edited(experiment, "empty_{frame}", "empty_{camera}")
    with pytest.raises(InputError, match=r"background_image: expected only \{frame\}, found \{camera\}"):
        read_experiment(experiment)


def test_two_ways_to_a_background_are_refused(coarse_run, tmp_path):
    experiment = coarse_run.images(tmp_path / "data")
    edited(experiment, 'name = "left"\n', 'name = "left"\nbackground_image = "empty.tif"\n')
    edited(experiment, "[particles]\n", '[particles]\nbackground = "median"\n')
    with pytest.raises(InputError, match=r"background_image: expected particles\.background"):
        read_experiment(experiment)


@pytest.mark.slow
def test_with_a_background_image_the_vectors_are_true(coarse_run, tmp_path):
    experiment, streaks = lit(coarse_run, tmp_path / "data")
    text = experiment.read_text()
    for name in streaks:
        tifffile.imwrite(experiment.parent / f"{name}.tif", np.rint(streaks[name] + 40).astype(np.uint16))
        text = text.replace(f'name = "{name}"\n', f'name = "{name}"\nbackground_image = "{name}.tif"\n')
    experiment.write_text(text)
    out = coarse_run.calibrated(tmp_path / "out")
    summary = pipeline.run(experiment, out, pairs=(0, 1))
    np.testing.assert_allclose(mean_displacement(out, 0), DISPLACEMENT_VOXEL, atol=TOLERANCE_VOXEL)
    assert json.loads((out / "summary.json").read_text())["background"] == summary["background"] != {}


@pytest.mark.slow
def test_a_streak_is_found_in_a_time_series(small_run, tmp_path):
    """The images of the pairs as instants: a streak stands still, and particles of other pairs are elsewhere."""
    experiment, _ = lit(small_run, tmp_path / "data")
    opened = read_experiment(experiment)
    count = 2 * opened.pairs
    for camera in opened.cameras:
        for instant in range(count):
            path = opened.particle_path(camera.name, instant // 2, "ab"[instant % 2])
            path.rename(path.with_name(f"instant_{instant}.tif"))
    text = experiment.read_text("utf-8")
    before, after = text.split("[particles]\n")
    rest = after.partition("\n\n")[2]
    table = f'[particles]\nimages = "particles/{{camera}}/instant_{{instant}}.tif"\ninstants = {count}\n\n'
    experiment.write_text(before + table + rest, "utf-8")
    series = read_experiment(experiment)
    calibration = load_calibration(small_run.out / "calibration.h5")
    found = background.estimate(series, calibration.cameras, background.series(series), lambda fraction: None)
    assert set(found.figures) == {"left", "right"}
    for light in found.cameras.values():
        columns = np.flatnonzero(light.region.any(axis=0))
        assert 130 < np.median(columns) < 170 and light.region.mean() < 0.5
