"""Imperfect experiments of `perf/accuracy`, at a tiny size."""

import json

import imperfect_scenes
import imperfections
import numpy as np
import pytest
import xarray as xr
from support.small_run import write_empty_report

from lfpiv.report import page

SEED = 3
every_row = imperfect_scenes.rows  # replaced by fewer rows while the case is computed
ROWS = every_row("small") | {"unknown": imperfect_scenes.Row(label="a key of tomorrow", needs="tomorrow")}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Output folder of the case on a rig of 2.4 mm."""
    patch = pytest.MonkeyPatch()
    for table, tiny_value in (
        (imperfect_scenes.SIZE_MM, (2.4, 2.4, 1.6)),
        (imperfect_scenes.SENSOR_PX, (420, 500)),
        (imperfect_scenes.DOTS, (4, 4)),
        (imperfect_scenes.PAIRS, 1),
    ):
        patch.setitem(table, "small", tiny_value)
    patch.setattr(imperfect_scenes, "rows", lambda scale: {key: ROWS[key] for key in ("ideal", "half", "unknown")})
    patch.setattr(page, "write_report", write_empty_report)  # of two runs; the page of the case is whole
    out = tmp_path_factory.mktemp("beyond")
    try:
        imperfections.main(["--out", str(out), "--seed", str(SEED)])
        yield out
    finally:
        patch.undo()


@pytest.mark.slow
def test_imperfect_images_are_measured_and_judged(tiny):
    case = json.loads((tiny / "reproduce.json").read_text())["imperfections"]
    assert not list((tiny / "work").rglob(".*")), "scratch files left behind"
    assert (tiny / "index.html").read_text().count("Beyond the paper</h1>") == 1
    assert all((tiny / figure["file"]).stat().st_size > 10_000 for figure in case["figures"])
    ideal, half = (case["rows"][key] for key in ("ideal", "half"))
    assert list(case["rows"]) == ["ideal", "half"] and "a key of tomorrow" in case["notes"][-1]
    assert ideal["true"] < ideal["all"] and ideal["no_fluid"] is None
    assert 0 <= ideal["bad"] <= 100 and 0 < ideal["within"] <= 100 and ideal["failed"] == 0
    assert half["true"] != ideal["true"] and half["no_fluid"] is not None
    table = case["tables"][0]
    assert [row[0] for row in table["rows"]] == [ROWS[key].label for key in case["rows"]]
    assert table["rows"][1][3] == pytest.approx(half["all"] / ideal["all"])


@pytest.mark.parametrize("scale", ["small", "paper"])
def test_every_row_is_a_valid_scene_of_the_same_rig(scale):
    every = every_row(scale)
    ideal = imperfect_scenes.scene(every["ideal"], scale, SEED)
    for key, row in every.items():
        scene = imperfect_scenes.scene(row, scale, SEED)
        assert scene.flow == ideal.flow and scene.volume == ideal.volume, key
        assert [c.true_yaw_deg for c in scene.camera] == [c.true_yaw_deg for c in ideal.camera]
        changed = scene.model_dump(exclude={"particles"}) != ideal.model_dump(exclude={"particles"})
        assert changed == (key != "ideal"), key
    other = imperfect_scenes.scene(every["ideal"], scale, SEED + 1)
    assert other.flow != ideal.flow and other.camera[0].true_yaw_deg != ideal.camera[0].true_yaw_deg


def test_the_flow_is_averaged_over_the_fluid_of_a_window():
    settings = json.dumps({"windows": [[12, 12, 12]]})
    axes = {"z": [0.0], "y": [0.3], "x": [-0.9, -0.3, 0.0, 0.3, 0.9]}
    vectors = xr.Dataset(coords=axes, attrs={"settings": settings})
    plain, half = (imperfect_scenes.scene(ROWS[key], "small", SEED) for key in ("ideal", "half"))
    everywhere, full = imperfections.truth_of(plain, 0, vectors)
    in_fluid, part = imperfections.truth_of(half, 0, vectors)
    assert (full == 1).all() and part[0, 0] == pytest.approx([1, 0.75, 0.5, 0.25, 0], abs=0.06)
    assert in_fluid[0, 0, 0] == pytest.approx(everywhere[0, 0, 0], abs=2e-3)  # midpoints instead of Gauss's nodes
    assert np.isnan(in_fluid[0, 0, -1]).all()
    assert in_fluid[0, 0, 3] == pytest.approx(everywhere[0, 0, 2], abs=0.4)  # fluid at the wall, not behind it
