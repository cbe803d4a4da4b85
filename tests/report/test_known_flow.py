"""The report of a simulated experiment compares its vectors with the true flow."""

import dataclasses
import json
import re

import numpy as np
import pytest
from support import report_run

from lfpiv.report import known_flow
from lfpiv.simulation.scene import stored_scene

TRUE_VOXEL = (0.5, 0.0, 0.0)
"""The flow of the run's scene: 0.05 mm along x, in voxels of 0.1 mm."""


@pytest.fixture
def scene(reported):
    return stored_scene(reported.experiment.path.parent / "truth")


def errors(vectors):
    """Measured minus true displacement of the inner vectors, by hand."""
    inner = vectors.isel(x=slice(1, -1), y=slice(1, -1), z=slice(1, -1))
    parts = [inner[f"displacement_{axis}"].values.ravel() - true for axis, true in zip("xyz", TRUE_VOXEL, strict=True)]
    return np.stack(parts)


def test_errors_are_those_of_the_inner_vectors(scene):
    vectors = report_run.field(0)
    found = known_flow.compare(vectors, scene, 0)
    assert np.allclose(found.true_voxel, np.reshape(TRUE_VOXEL, (3, 1, 1, 1)))
    assert np.allclose(found.error_voxel, errors(vectors))
    assert found.largest_voxel == pytest.approx(0.5)
    lost = vectors.assign(displacement_x=vectors["displacement_x"].where(vectors["x"] < 0))
    assert known_flow.compare(lost, scene, 0).error_voxel.shape[1] == 2 * 4 * 3  # columns with x < 0, without the first


def test_stated_uncertainty_is_compared_with_the_errors(scene):
    exact = report_run.field(0)
    for axis, true in zip("xyz", TRUE_VOXEL, strict=True):
        exact[f"displacement_{axis}"] = exact[f"displacement_{axis}"] * 0 + true
    exact["displacement_y"] += 0.25  # the uncertainty is 0.1
    assert known_flow.compare(exact, scene, 0).covered.tolist() == [1.0, 0.0, 1.0]
    assert known_flow.compare(exact.drop_vars("uncertainty"), scene, 0).covered is None


def test_the_page_states_the_error_in_voxels_and_as_a_velocity(reported):
    text = reported.page.read_text("utf-8")
    mean = np.linalg.norm(errors(report_run.field(0)), axis=0).mean()
    said = re.search(r"off by ([\d.]+) voxel \(([\d.]+) mm/s\) on average, .* up to 0.5 voxel \(50 mm/s\)", text)
    assert float(said[1]) == pytest.approx(mean, abs=0.005)
    assert float(said[2]) == pytest.approx(100 * mean, rel=0.05)  # a voxel is 100 mm/s, written with two digits
    assert 'aria-label="measured, slice at' in text.replace("Measured", "measured") and "rue, slice at" in text


def elsewhere(reported, folder, spec):
    """Write the section of an experiment in another folder, with another file of truth."""
    if spec is not None:
        (folder / "truth").mkdir()
        (folder / "truth" / "spec.json").write_text(spec)
    moved = dataclasses.replace(reported.experiment, path=folder / "experiment.toml")
    return known_flow.section(moved, reported.vectors)


def test_an_experiment_without_truth_has_no_section(reported, tmp_path):
    assert elsewhere(reported, tmp_path, None) == ""
    assert known_flow.section(reported.experiment, {}) == ""


@pytest.mark.parametrize("spec", ["{", "{}", json.dumps({"name": "x"})])
def test_a_damaged_truth_is_told(reported, tmp_path, spec):
    assert "cannot be read" in elsewhere(reported, tmp_path, spec)


def test_a_missing_file_of_the_flow_is_told(reported, tmp_path, scene):
    stored = json.loads((reported.experiment.path.parent / "truth" / "spec.json").read_text())
    stored["flow"] = {"kind": "tracers", "file": "gone.npz", "size_mm": [2.0, 2.0, 2.0]}
    assert "gone.npz" in elsewhere(reported, tmp_path, json.dumps(stored))


def test_of_many_vectors_a_part_is_compared(reported, monkeypatch):
    monkeypatch.setattr(known_flow, "MOST_COMPARED", 60)
    assert "on average" in known_flow.section(reported.experiment, reported.vectors)
