"""The whole job on a small simulated experiment: right vectors, complete files, and only what changed done anew."""

import dataclasses
import html
import json
import os
import re
import shutil

import numpy as np
import pytest
from support.small_run import DISPLACEMENT_VOXEL, PAIRS

import lfpiv
from lfpiv import files
from lfpiv.experiment.opening import read_experiment
from lfpiv.results import netcdf, provenance, stamps
from lfpiv.results.folder import Folder
from lfpiv.results.provenance import Marks
from lfpiv.results.stamps import Inputs
from lfpiv.runs import guard, pair_figures, pipeline, refinement, rig
from lfpiv.runs.invocation import Invocation
from lfpiv.runs.run import open_run

TOLERANCE_VOXEL = 0.2
"""Mean of the valid vectors against the flow. Particles are few and two cameras blur depth; a wrong sign, axis, frame
order or scale misses by 0.4 voxel or more."""

STAGES = ("calibration", "network_training", "weights", "reconstruction", "correlation", "total")


@pytest.fixture(scope="module")
def finished(small_run, tmp_path_factory):
    """Experiment file, output folder and summary of a complete run that kept its volumes; a copy to work on."""
    return small_run.experiment, small_run.results(tmp_path_factory.mktemp("pipeline") / "out"), small_run.summary


def test_the_flow_comes_out(finished):
    _, out, summary = finished
    moved = summary["pairs"][0]["moved_voxel"]
    assert moved == pytest.approx(np.linalg.norm(DISPLACEMENT_VOXEL), abs=TOLERANCE_VOXEL)
    flow = np.reshape(summary["pairs"][0]["flow_voxel"], (3, 8)).mean(axis=1)
    assert flow == pytest.approx(DISPLACEMENT_VOXEL, abs=TOLERANCE_VOXEL)
    row = f"Median movement.*{moved:.3g} voxel = {100 * moved:.3g} um in 1 ms, {moved / 10:.3g} m/s, in pair 0"
    assert re.search(row, (out / "report.html").read_text("utf-8"))
    for pair in range(PAIRS):
        vectors = netcdf.read_vectors(out / "vectors" / f"pair_{pair:04d}.nc")
        assert vectors["u"].dims == ("z", "y", "x") and vectors.attrs["dt_s"] == 1e-3
        for axis, velocity, truth in zip("xyz", "uvw", DISPLACEMENT_VOXEL, strict=True):
            displacement = vectors[f"displacement_{axis}"]
            assert np.isfinite(displacement).all()
            assert float(displacement.where(vectors["valid"]).mean()) == pytest.approx(truth, abs=TOLERANCE_VOXEL)
            np.testing.assert_allclose(
                vectors[velocity], displacement * 0.1e-3 / 1e-3, rtol=1e-6
            )  # voxel 0.1 mm, dt 1 ms


def test_every_file_of_the_contract_is_there_and_whole(finished):
    _, out, summary = finished
    names = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert names == [
        ".record.json",
        "background.h5",
        "calibration.h5",
        "guard.json",
        "refinement.json",
        "report.html",
        "summary.json",
        *(f"vectors/pair_000{pair}.nc" for pair in range(PAIRS)),
        *(f"volumes/pair_000{pair}_{frame}.nc" for pair in range(PAIRS) for frame in "ab"),
    ]
    assert json.loads((out / "summary.json").read_text()) == files.plain(summary)
    timings = summary["timings_s"]
    assert all(timings[stage] > 0 for stage in STAGES)
    parts = sum(timings[stage] for stage in ("calibration", "weights", "reconstruction", "correlation"))
    assert timings["network_training"] < timings["calibration"] and parts < timings["total"]
    assert summary["peak_memory_mib"] > 50
    for camera in ("left", "right"):
        figures = summary["calibration"][camera]
        assert {"sigma_nor_test", "dots_found", "dots_expected", "lens_array_rms_px"} <= set(figures)
        assert 0 < figures["dots_found"] <= figures["dots_expected"] <= 5 * 5 * 3
        assert 0 < figures["network_correction_pitch"] < 0.1  # rendered by an ideal lens: hardly anything is left
    assert [len(pair["residual"]["a"]) for pair in summary["pairs"]] == [10] * PAIRS and summary["failed"] == []
    for figure in ("structure", "camera_gain", "light_outside", "light"):
        assert all(set(pair[figure]["b"]) == {"left", "right"} for pair in summary["pairs"])
    assert all(max(pair["camera_gain"]["a"].values()) == 1 for pair in summary["pairs"])
    assert not any("noise" in text for text in summary["warnings"])


def test_the_report_tells_of_this_run(finished):
    _, out, summary = finished
    page = (out / "report.html").read_text("utf-8")
    for text in (
        "left",
        "right",
        "2 cameras",
        f"{PAIRS} pairs finished",
        "correction to the thin lens",
        "brightness over the depth",
    ):
        assert text in page
    for warning in summary["warnings"]:
        assert html.escape(warning) in page


@pytest.mark.slow
def test_steps_one_at_a_time_give_the_same(finished):
    experiment, out, _ = finished
    path = out / "vectors" / "pair_0001.nc"
    before = netcdf.read_vectors(path)
    path.unlink()
    summary = pipeline.correlate(experiment, out)
    assert "vectors of pair 0" in summary["reused"] and "vectors of pair 1" not in summary["reused"]
    after = netcdf.read_vectors(path)
    assert after.equals(before)
    assert pipeline.report(experiment, out)["pairs"][1]["valid_fraction"] == float(before["valid"].mean())


def changed(experiment, folder, old, new):
    """The experiment file with one edit, beside the same images."""
    text = experiment.read_text()
    assert old in text
    file = experiment.with_name(f"{folder.name}.toml")
    file.write_text(text.replace(old, new, 1))
    return file


@pytest.mark.slow
def test_only_what_changed_is_done_anew(finished, tmp_path, caplog):
    """Other windows: vectors from the volumes that are there. Pairs not asked for stay, outside the summary."""
    experiment, out, _ = finished
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*.[hn][5c]")}
    file = changed(experiment, tmp_path, "[correlation]", "[correlation]\nsmoothing_voxel = 0.6")
    with caplog.at_level("INFO", "lfpiv"):
        summary = pipeline.run(file, out, pairs=(0, 1), keep_volumes=True)
    redone = {path for path, time in files.items() if path.stat().st_mtime_ns != time}
    assert redone == {out / "vectors" / "pair_0000.nc"}
    assert "correlation.smoothing_voxel changed: pair 0 made again" in caplog.text
    assert [pair["pair"] for pair in summary["pairs"]] == [0] and summary["timings_s"]["weights"] > 0


EDITS = {
    "correlation": ("[correlation]", "[correlation]\nsmoothing_voxel = 0.6", "vectors"),
    "search": ("[correlation]", "[correlation]\nmax_displacement_voxel = 2.5", "vectors, volumes"),
    "time between frames": ("dt_s = 0.001", "dt_s = 0.002", "vectors"),
    "smart": ("iterations = 8", "iterations = 9", "vectors, volumes"),
    "voxels": ("voxel_mm = 0.1", "voxel_mm = 0.09", "vectors, volumes"),
    "weights": ("[smart]", "[compute]\nweights_form = 'pixels'\n[smart]", "vectors, volumes"),
    "network": ("epochs = 60", "epochs = 61", "vectors, volumes, calibration"),
    "board": ("dot_diameter_mm = 0.1", "dot_diameter_mm = 0.11", "vectors, volumes, calibration"),
    "camera": ("f_number = 4.0", "f_number = 4.1", "vectors, volumes, calibration"),
    "threads": ("[smart]", "[compute]\nthreads = 1\n[smart]", ""),
    "name": ('name = "small"', 'name = "other"', ""),
}


@pytest.mark.parametrize("case", EDITS)
def test_each_setting_concerns_what_depends_on_it(small_run, tmp_path, case):
    old, new, concerned = EDITS[case]
    experiment = read_experiment(changed(small_run.experiment, tmp_path, old, new))
    wanted = stamps.of_calibration(experiment)
    folder = Folder(small_run.out)
    (measured, _), (sized, _) = guard.read(folder), refinement.read(folder)
    layers, finer = guard.layers(experiment, measured), refinement.factor(experiment, sized)
    of_pair = stamps.of_pair(experiment, Inputs(wanted.hash, guard=layers, refinement=finer), 1)
    marks = {
        "calibration": (small_run.out / "calibration.h5", wanted),
        "volumes": (small_run.out / "volumes" / "pair_0001_b.nc", of_pair.volumes[1]),
        "vectors": (small_run.out / "vectors" / "pair_0001.nc", of_pair.vectors),
    }
    differ = {name: stamp.changes(provenance.read_marks(path)) for name, (path, stamp) in marks.items()}
    assert {name for name, changes in differ.items() if changes} == set(filter(None, concerned.split(", "))), differ


def test_a_new_image_concerns_its_pair_alone_and_a_lost_one_none(small_run, tmp_path):
    experiment, out = small_run.images(tmp_path / "data"), small_run.results(tmp_path / "out")

    def unfinished():
        with open_run(experiment, out, None, None) as run:
            return list(run.unfinished(volumes=True))

    assert unfinished() == []
    images = sorted((tmp_path / "data").rglob("*0002*"))
    images[-1].rename(tmp_path / "elsewhere")
    assert unfinished() == []
    shutil.copy(tmp_path / "elsewhere", images[-1])
    assert unfinished() == []
    shutil.copy(images[0], images[-1])
    assert unfinished() == [2]


def test_images_are_told_apart_by_their_whole_path(small_run, tmp_path):
    """Frames in folders, files of one name, one length and one second: exchanging the frames concerns everything."""
    file = small_run.images(tmp_path / "data")
    for path in sorted((file.parent / "particles").rglob("*.tif")):
        camera, (_, number, frame) = path.parent.name, path.stem.split("_")
        moved = file.parent / "particles" / frame / camera / f"{number}.tif"
        moved.parent.mkdir(parents=True, exist_ok=True)
        moved.write_bytes(b"image")
        os.utime(moved, (1.7e9, 1.7e9))
    text = re.sub('images = "particles.*"', 'images = "particles/{frame}/{camera}/{pair:04d}.tif"', file.read_text())
    file.write_text(text)
    experiment = read_experiment(file)

    def stamp(experiment):
        return stamps.of_pair(experiment, Inputs("calibration"), 0).vectors

    made, swapped = Marks(**stamp(experiment).attributes), dataclasses.replace(experiment.recording, names=("b", "a"))
    exchanged = dataclasses.replace(experiment, recording=swapped)
    assert stamp(exchanged).changes(made) == ["particles.frames", "images"]
    file.parent.rename(tmp_path / "elsewhere")  # the images with their experiment: nothing has changed
    there = read_experiment(tmp_path / "elsewhere" / file.name)
    assert stamp(there).changes(made) == []
    shutil.rmtree(tmp_path / "elsewhere" / "particles")  # gone, but stated to be others
    exchanged = dataclasses.replace(there, recording=swapped)
    assert stamp(there).changes(made) == []
    assert stamp(exchanged).changes(made) == ["particles.frames"]


@pytest.mark.slow
def test_figures_come_from_the_files_without_reading_them(finished, monkeypatch):
    """What is left of a run are its files: the summary is rebuilt from their heads alone."""
    experiment, out, _ = finished
    whole = pipeline.report(experiment, out)
    (out / "summary.json").unlink()
    for name in ("read_vectors", "read_reconstruction", "read_volume"):
        monkeypatch.setattr(netcdf, name, lambda path: pytest.fail(f"{path} is read as a whole"))
    with open_run(experiment, out, None, None) as run:
        assert run.finish(rig.load_calibration(run), Invocation(), report=False)["pairs"] == whole["pairs"]
    monkeypatch.undo()
    last = out / "vectors" / f"pair_{PAIRS - 1:04d}.nc"
    marks = dataclasses.replace(provenance.read_marks(last), figures=None)
    measured = pair_figures.read_figures(last, marks).to_json()  # of a file without figures of its own
    assert {"pair": PAIRS - 1, "file": last.name, **measured} == whole["pairs"][-1]


def test_a_failure_leaves_no_part_and_no_other_pair_undone(small_run, tmp_path, monkeypatch):
    out = small_run.results(tmp_path / "out")
    shutil.rmtree(out / "vectors")

    def fail(volumes, **settings):
        if volumes[0].attrs["pair"] == 1:
            raise RuntimeError("the power went off")
        return lfpiv.joint_vectors(volumes, **settings)

    monkeypatch.setattr("lfpiv.runs.pair_vectors.joint_vectors", fail)
    monkeypatch.setattr(netcdf, "read_volume", numbered(netcdf.read_volume))
    result = pipeline.correlate(small_run.experiment, out)
    assert result["failed"] == [{"pair": 1, "reason": "unexpected RuntimeError: the power went off"}]
    assert [pair["pair"] for pair in result["pairs"]] == [0, 2, 3]
    assert not list(out.rglob("*.tmp")) and not (out / ".lock").exists()


def numbered(read):
    """Volumes that know their pair."""

    def read_numbered(path, **options):
        volume = read(path, **options)
        volume.attrs["pair"] = int(path.stem.split("_")[1])
        return volume

    return read_numbered
