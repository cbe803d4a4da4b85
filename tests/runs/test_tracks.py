"""Tracks of a run on a time series: made after its pairs, kept, made anew when settings change, and removed."""

import numpy as np
import pytest
from support.series_run import FIRST, write_series

import lfpiv
from lfpiv.runs import pipeline


@pytest.mark.slow
def test_tracks_follow_the_pairs_of_a_series(small_run, tmp_path):
    """Two successive instants show the same particles, so that every track is short."""
    experiment, out = write_series(small_run, tmp_path / "data"), small_run.calibrated(tmp_path / "out")
    text = experiment.read_text("utf-8")
    experiment.write_text(f"{text}\n[tracking]\nrounds = 1\n", "utf-8")
    summary = pipeline.run(experiment, out)
    table = lfpiv.open_tracks(out)
    last = FIRST + int(table["instant"].max()) - FIRST
    assert summary["tracks"]["tracks"] == table.attrs["tracks"] == len(np.unique(table["track"][table["valid"]]))
    assert set(table["instant"].values.tolist()) == set(range(FIRST, last + 1)) and last > FIRST
    assert np.allclose(table["time"], (table["instant"] - FIRST) * table.attrs["dt_s"])
    first = table.isel(particle=table["track_length"].values == 2)
    moved = np.stack([first[f"found_{axis}"].values for axis in "xyz"], axis=1)
    assert np.abs(np.median(moved[1::2] - moved[::2], axis=0) - (0.08, -0.06, 0.04)).max() < 0.02
    assert "<h3>Tracks</h3>" in (out / "report.html").read_text("utf-8")

    made = (out / "tracks.nc").stat().st_mtime_ns
    pipeline.run(experiment, out, pairs=(FIRST, FIRST + 1))
    assert (out / "tracks.nc").stat().st_mtime_ns == made, "tracks are of all finished pairs, not of the chosen ones"

    experiment.write_text(text, "utf-8")
    assert pipeline.run(experiment, out)["tracks"] is None
    assert not (out / "tracks.nc").exists()
