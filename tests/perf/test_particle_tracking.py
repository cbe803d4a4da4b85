"""`perf/accuracy/particle_tracking.py` on a tiny volume."""

import json

import particle_tracking
import pytest
import reconstruction_cases


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    """Folder of results; the small volume has 1.6 x 1.6 x 1.4 mm."""
    for cached in (reconstruction_cases.make_rig, reconstruction_cases.record):
        cached.cache_clear()
    monkeypatch.setitem(reconstruction_cases.SIZE_MM, "small", (1.6, 1.6, 1.4))
    yield tmp_path
    for cached in (reconstruction_cases.make_rig, reconstruction_cases.record):
        cached.cache_clear()


@pytest.mark.slow
def test_thin_seeding_is_found_and_known_rows_are_kept(tiny):
    out = tiny / "figures.json"
    words = ["--out", str(out), "--conditions", "clean", "--cameras", "2", "--ppm", "0.03", "--cache", str(tiny)]
    assert particle_tracking.main(words) == 0
    (row,) = json.loads(out.read_text())["rows"]
    figures = row["figures"]
    assert figures["particles"] >= 5 and figures["found"] > 0.8 and figures["position"] < 0.1
    row["figures"]["found"] = 0.5
    out.write_text(json.dumps({"rows": [row]}))
    assert particle_tracking.main(words) == 0
    assert json.loads(out.read_text())["rows"] == [row]
