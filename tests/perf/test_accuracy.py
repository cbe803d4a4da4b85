"""Cases of `perf/accuracy`, at tiny sizes."""

import json

import bench
import choices
import imperfect_scenes
import imperfections
import numpy as np
import pytest
import run
import xarray as xr
from support.small_run import write_empty_report

from lfpiv import report
from lfpiv.reproduce.study import compute

SEED = 3
PPM = 0.3
STUDIES = ["choices", "imperfections"]  # those of optics and of a series repeat what tests of these packages show
FEW = ("ten_iterations", "power_1", "drt", "gaussian_dots")
FAILS = 5.0  # DRT's rays through 10 mm of glass at 45 degrees miss by 0.6 pitch, this network's by 0.02
ROUNDING = 1e-9
every_row = imperfect_scenes.rows  # replaced by fewer rows while the cases are computed
ROWS = every_row("small") | {"unknown": imperfect_scenes.Row(label="a key of tomorrow", needs="tomorrow")}
SAMPLED = 0.05  # relative: statistics of 4,000 draws


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Output folder of the cases on rigs of 2.4 mm."""
    patch = pytest.MonkeyPatch()
    for table, tiny_value in (
        (bench.SIZE_MM, (2.4, 2.4, 1.6)),
        (bench.DOTS, (3, 3)),
        (bench.PLANES_MM, (-1.0, 0.0, 1.0)),
        (bench.SENSOR_PX, (560, 640)),
        (imperfect_scenes.SIZE_MM, (2.4, 2.4, 1.6)),
        (imperfect_scenes.SENSOR_PX, (420, 500)),
        (imperfect_scenes.DOTS, (4, 4)),
        (imperfect_scenes.PAIRS, 1),
    ):
        patch.setitem(table, "small", tiny_value)
    pair = bench.Pair(ppm=PPM)
    coarse = {"quality": {"pixel_rays": 16, "dot_rays": 16_384}, "network": {"hidden": (10,), "epochs": 60}}
    for module, name, value in (
        (bench, "SHARED", coarse),
        (bench, "PARTICLE_RAYS", 8192),
        (choices, "DEFAULT", pair),
        (choices, "CHOICES", {key: choices.CHOICES[key] for key in FEW}),
        (imperfect_scenes, "rows", lambda scale: {key: ROWS[key] for key in ("ideal", "half", "unknown")}),
        (report, "write_report", write_empty_report),  # of two runs; the pages of the cases are whole
    ):
        patch.setattr(module, name, value)
    out = tmp_path_factory.mktemp("beyond")
    try:
        compute(run.ACCURACY, STUDIES, out, "small", seed=SEED)
        yield out
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def figures(tiny):
    return json.loads((tiny / "reproduce.json").read_text())


@pytest.mark.slow
def test_choices_are_held_against_the_defaults(figures):
    case = figures["choices"]
    default, made = case["default"], case["choices"]
    assert list(made) == list(FEW)
    for one in made.values():
        assert one["q_difference"] == pytest.approx(one["q"] - default["q"], abs=ROUNDING)
        assert one["error_difference_voxel"] == pytest.approx(one["error_voxel"] - default["error_voxel"], abs=1e-6)
    assert made["power_1"]["q"] == pytest.approx(default["q"], abs=ROUNDING)  # the same volumes, correlated otherwise
    assert made["ten_iterations"]["iterations"] == 10 < default["iterations"]
    assert made["drt"]["q"] < default["q"]  # the cameras do not stand where they are said to
    assert case["mapping_error_pitch"]["drt"] > FAILS * case["mapping_error_pitch"]["default"]
    assert case["mapping_error_pitch"]["gaussian_dots"] > case["mapping_error_pitch"]["default"]


def test_only_what_changes_the_volumes_is_reconstructed():
    every = choices.OPEN | choices.OWN
    kept = {key for key, choice in every.items() if not choice.reconstructs}
    assert kept == {"power_1", "windows_8", "windows_16"}
    assert all(choice.like is None or choice.like in every for choice in every.values())


@pytest.mark.slow
def test_cases_share_their_runs_and_the_page_tells_them_apart(tiny, figures):
    runs = {path.stem for path in (tiny / "work" / "bench" / "runs").glob("*.npz")}
    assert [name for name in runs if name.startswith("two_")] == [f"two_{PPM:g}_ppm_300_counts"]
    assert not list((tiny / "work").rglob(".*")), "scratch files left behind"
    text = (tiny / "index.html").read_text()
    assert text.count("Beyond the paper</h1>") == 1
    for key in STUDIES:
        for figure in figures[key]["figures"]:
            assert (tiny / figure["file"]).stat().st_size > 10_000, figure


@pytest.mark.slow
def test_imperfect_images_are_measured_and_judged(figures):
    case = figures["imperfections"]
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


def test_standard_errors_are_those_of_independent_vectors():
    rng = np.random.default_rng(0)
    means = [rng.standard_normal((4, 4, 4)) for _ in range(4000)]
    told = np.mean([bench.standard_error_of_mean(np.kron(values, np.ones((2, 2, 2)))) for values in means])
    assert told == pytest.approx(np.std([values.mean() for values in means]), rel=SAMPLED)  # eight times the same


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["fig10"], "cases: expected some of optics, choices"), (["--seed", "-1"], "seed: expected")],
)
def test_wrong_arguments_are_refused_in_one_line(tmp_path, capsys, arguments, message):
    assert run.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(message) and error.count("\n") == 1
