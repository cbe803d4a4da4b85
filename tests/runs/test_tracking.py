"""A run with the table [tracking]: particles beside the vectors, kept, and made anew when their settings change."""

import logging
import shutil

import numpy as np
import pytest

import lfpiv
from lfpiv.runs import frame_work, pipeline


def with_tracking(coarse_run, folder, keys=""):
    experiment = coarse_run.images(folder)
    text = experiment.read_text("utf-8")
    experiment.write_text(f"{text}\n[tracking]\n{keys}", "utf-8")
    return experiment


@pytest.mark.slow
def test_particles_stand_beside_the_vectors_and_follow_their_settings(coarse_run, tmp_path, caplog, monkeypatch):
    frames_read, read = [], frame_work.frame_light
    monkeypatch.setattr(frame_work, "frame_light", lambda *given: frames_read.append(given[3].number) or read(*given))
    experiment, out = with_tracking(coarse_run, tmp_path / "data", "rounds = 2\n"), coarse_run.results(tmp_path / "out")
    shutil.rmtree(out / "volumes", ignore_errors=True)
    summary = pipeline.run(experiment, out, pairs=(0, 1))
    file = out / "particles" / "pair_0000.nc"
    table = lfpiv.open_particles(out)
    assert frames_read == [0, 1], "images are read once, for volumes and particles"
    figures = next(entry for entry in summary["pairs"] if entry["pair"] == 0)["particles"]
    assert figures["linked"] == table.sizes["particle"] > 20
    valid = table["valid"].values
    moved = np.stack([table[f"displacement_{axis}"].values for axis in "xyz"], axis=1)[valid]
    assert np.abs(np.median(moved, axis=0) - (0.8, -0.6, 0.4)).max() < 0.1

    made = file.stat().st_mtime_ns
    assert "vectors of pair 0" in " ".join(pipeline.run(experiment, out, pairs=(0, 1))["reused"])
    assert file.stat().st_mtime_ns == made

    experiment.write_text(experiment.read_text("utf-8").replace("rounds = 2", "rounds = 1"), "utf-8")
    caplog.set_level(logging.INFO, "lfpiv")
    pipeline.run(experiment, out, pairs=(0, 1))
    assert file.stat().st_mtime_ns > made and "tracking.rounds" in caplog.text
