"""`lfpiv reproduce`: the contract of its results and page, resuming, and three of its cases at tiny sizes."""

import dataclasses
import json
import re
import sys
import types

import numpy as np
import pytest

import lfpiv
from lfpiv import reproduce
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.reproduce import angles, fig10, fig12, fig14, page, plots, rigs, store

# -- the framework, with cases that take no time -----------------------------------------------------------------------


@pytest.fixture
def cases(monkeypatch):
    """Two cases, one that fails until it is mended; `calls` lists what was run."""
    calls = []

    def good(scale, work, *, seed=0, progress):
        calls.append(("good", scale, seed))
        drawn = plots.figure(2, 1)
        drawn.subplots().plot([0, 1])
        plots.save(drawn, work / "good.png")
        return page.result(
            {"ratio": np.float32(0.5), "lost": float("nan"), "list": np.arange(3)},
            comparison=[
                page.compare("reached <b>", 0.01, paper=0.04, at_most=0.03, unit="pitch"),
                page.compare("missed", 0.7, paper="0.7–0.8", at_least=0.8),
                page.compare("not measured", float("nan"), at_most=1.0),
                page.compare("without a goal", 3),
            ],
            figures=[("good.png", 'a "quoted" caption')],
            tables=[{"caption": "numbers", "columns": ["name", "value"], "rows": [["a", 1.25], ["b", None]]}],
            notes=["1 < 2"],
        )

    def broken(scale, work, *, seed=0, progress):
        calls.append(("broken", scale, seed))
        store.cached(work / "part.json", {"seed": seed}, lambda: calls.append("part") or [1, 2])
        if not (work / "mended").exists():
            raise RuntimeError("power cut")
        return page.result({}, comparison=[])

    for key, run in (("good", good), ("broken", broken)):
        monkeypatch.setitem(sys.modules, f"lfpiv.reproduce.{key}", types.SimpleNamespace(TITLE=f"{key} & co", run=run))
    modules = {key: f"lfpiv.reproduce.{key}" for key in ("good", "broken")}
    monkeypatch.setattr(reproduce, "PAPER", dataclasses.replace(reproduce.PAPER, modules=modules))
    return calls


def test_results_are_kept_shown_and_resumed(cases, tmp_path):
    with pytest.raises(RuntimeError, match="power cut"):
        reproduce.reproduce(["all"], tmp_path)
    assert [call for call in cases if call == "part"] == ["part"]
    content = json.loads((tmp_path / "reproduce.json").read_text())  # what is finished shows although the rest failed
    assert set(content) == {"scale", "seed", "version", "good"}

    (tmp_path / "work" / "broken" / "mended").touch()
    seen = []
    returned = reproduce.reproduce(["broken", "good"], tmp_path, finished=lambda key, result: seen.append(key))
    assert cases == [("good", "small", 0), ("broken", "small", 0), "part", ("broken", "small", 0)], (
        "finished parts redone"
    )
    assert seen == ["good", "broken"]  # the paper's order, each once, kept ones too

    content = json.loads((tmp_path / "reproduce.json").read_text())
    assert content == returned
    good = content["good"]
    assert good["title"] == "good & co" and good["ratio"] == 0.5 and good["lost"] is None and good["list"] == [0, 1, 2]
    assert [row["reached"] for row in good["comparison"]] == [True, False, False, None]
    assert [row["goal"] for row in good["comparison"]] == ["<= 0.03", ">= 0.8", "<= 1", None]
    assert (tmp_path / "good.png").read_bytes().startswith(b"\x89PNG")
    assert not [path for path in tmp_path.rglob(".*")], "scratch files left behind"

    text = (tmp_path / "index.html").read_text()
    assert "1 of 3 goals reached" in text and "good &amp; co" in text and "1 &lt; 2" in text
    assert "reached &lt;b&gt;" in text and "<b>" not in text.replace("<b>small</b>", "")
    assert text.count("data:image/png;base64,") == 1 and 'name="viewport"' in text
    assert not re.search(r'(src|href)="(?!data:|#|reproduce\.json)', text), "the page needs other files"


def test_folders_of_other_settings_and_bad_requests_are_refused(cases, tmp_path):
    reproduce.reproduce(["good"], tmp_path / "out")
    for settings, name in (({"scale": "paper"}, "scale"), ({"seed": 3}, "seed")):
        with pytest.raises(InputError, match=f"results of {name}"):
            reproduce.reproduce(["good"], tmp_path / "out", **settings)
    for request in ({"cases": ["fig99"]}, {"cases": []}, {"scale": "large"}, {"seed": -1}, {"seed": True}):
        with pytest.raises(InputError, match=f"^{next(iter(request))}: expected"):
            reproduce.reproduce(**{"cases": ["good"], "out": tmp_path / "new", **request})
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be used"):
        reproduce.reproduce(["good"], tmp_path / "file")


def test_command_prints_ours_beside_the_papers(cases, tmp_path, capsys):
    assert commands.call(["reproduce", "good", "--out", str(tmp_path), "--seed", "4"]) == 0
    out = capsys.readouterr().out
    assert "reached <b>: 0.01 pitch, paper 0.04, goal <= 0.03: reached" in out
    assert "missed: 0.7, paper 0.7–0.8, goal >= 0.8: NOT reached" in out and str(tmp_path / "index.html") in out
    assert cases == [("good", "small", 4)]
    assert commands.call(["reproduce", "fig99", "--out", str(tmp_path)]) == 2
    assert "fig99" in capsys.readouterr().err


def test_a_result_may_not_hide_figures_nor_hold_crooked_tables():
    with pytest.raises(ValueError, match="notes"):
        page.result({"notes": 3}, comparison=[])
    with pytest.raises(ValueError, match="rows of 2 values as 'numbers' has columns, got 1"):
        page.result({}, comparison=[], tables=[{"caption": "numbers", "columns": ["a", "b"], "rows": [[1, 2], [3]]}])


def test_arrays_are_kept_for_the_same_settings_only(tmp_path):
    path, calls = tmp_path / "a" / "b.npz", []

    def compute():
        calls.append(1)
        return {"field": np.arange(6.0).reshape(2, 3), "number": 3.5}

    for settings, expected in (({"x": (1, 2)}, 1), ({"x": [1, 2]}, 1), ({"x": (1, 3)}, 2)):
        arrays = store.cached_arrays(path, settings, compute)
        assert len(calls) == expected and set(arrays) == {"field", "number"}
        np.testing.assert_array_equal(arrays["field"], np.arange(6.0).reshape(2, 3))


# -- the cases ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Output folder of all three cases on a small rig, with volumes of 2 to 3 mm."""
    patch = pytest.MonkeyPatch()
    for table, tiny_value in (
        (rigs.SENSOR_PX, 700),
        (rigs.DEPTHS_MM, (-1.0, 0.0, 1.0)),
        (fig10.COUNTS, 4),
        (fig12.SIZE_MM, (1.6, 1.6, 1.6)),
        (fig12.PPM, (0.1, 0.5)),
        (fig12.POINTS_PPM, (0.1,)),
        (fig14.SIZE_MM, (2.4, 2.4, 2.4)),
        (fig14.PPM, (0.5,)),
    ):
        patch.setitem(table, "small", tiny_value)
    for module, name, value in (
        (rigs, "DOTS", (3, 3)),
        (rigs, "WHITE_RAYS", 16),
        (rigs, "PARTICLE_RAYS", 8192),
        (fig14, "SCHEDULES", {"default": (24, 12), "8": (24, 8)}),
    ):
        patch.setattr(module, name, value)
    out = tmp_path_factory.mktemp("reproduce")
    try:
        reproduce.reproduce(["fig10", "fig12", "fig14"], out, seed=5)
        yield out
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def figures(tiny):
    return json.loads((tiny / "reproduce.json").read_text())


SSIM_TINY = 0.97  # the goal; a calibration from 27 dots is cruder than the paper's from 1,029
COUNT_L2 = 0.025  # footprint against counts: 0.02 is the goal, four counts have a noise of 0.007


@pytest.mark.slow
def test_weights_agree_with_ray_tracing_and_with_counted_rays(figures):
    case = figures["fig10"]
    assert case["ssim"] >= SSIM_TINY
    for camera in case["cameras"].values():
        assert camera["ssim_whole_sensor"] >= camera["ssim"]  # dark pixels agree
        assert camera["ssim_paper_sampling"] < camera["ssim_converged_counts"]  # noise costs similarity
        assert camera["drt_against_count_l2"] <= COUNT_L2 and camera["network_against_count_l2"] <= COUNT_L2
        assert 0 < camera["count_noise_l2"] < camera["paper_sampling_against_count_l2"]


@pytest.mark.slow
def test_network_and_ray_tracing_reconstruct_alike(figures):
    case = figures["fig12"]
    runs = {(run["particles"], run["mapping"], run["ppm"]): run for run in case["runs"]}
    kinds = ["blobs"] * 4 + ["from_truth", "points"] + ["paper", "no_sieve"] * 2
    assert sorted(run["particles"] for run in case["runs"]) == sorted(kinds) and len(runs) == len(kinds)
    assert case["q_mean"]["network"] == pytest.approx(
        np.mean([runs["blobs", "network", ppm]["q"] for ppm in (0.1, 0.5)])
    )
    for ppm in (0.1, 0.5):
        ours, traced = runs["blobs", "network", ppm], runs["blobs", "drt", ppm]
        assert ours["q"] == pytest.approx(traced["q"], abs=0.03)  # true geometry: what is left are calibration errors
        assert ours["particles_true"] == round(256 * ppm)
    from_truth, ours = (runs[particles, "network", 0.5]["q"] for particles in ("from_truth", "blobs"))
    assert from_truth > max(0.95, ours)  # the truth is a fixed point
    assert runs["blobs", "network", 0.1]["q"] > 0.7  # sparse: hardly a ghost
    for run in case["runs"]:  # the correlation smooths by what the sieve has not
        as_it_is = run["q_as_correlated"] == pytest.approx(run["q"], abs=1e-12)
        assert as_it_is == (run["sieve_voxel"] >= fig12.CORRELATED_VOXEL), run
    assert runs["blobs", "network", 0.5]["sieve_voxel"] > 0 == runs["paper", "network", 0.5]["sieve_voxel"]
    assert all(runs["blobs", "network", ppm]["q"] > runs["no_sieve", "network", ppm]["q"] for ppm in (0.1, 0.5))
    assert (
        runs["points", "network", 0.1]["q"] < runs["blobs", "network", 0.1]["q"]
    )  # points do not fit the truth's blobs


@pytest.mark.slow
def test_vectors_are_those_of_the_flow(figures):
    case = figures["fig14"]
    error, peak = case["error_mean_voxel"], case["flow"]["peak_mm"] / rigs.VOXEL_MM
    assert error["network"] == pytest.approx(error["drt"], rel=0.3)  # true geometry again
    assert error["network"] < peak and case["contrast"] == pytest.approx(error["drt_plus_1deg"] / error["drt"])
    assert set(case["below_043"]) == {"network", "drt", "drt_plus_1deg"}
    for kind, errors in case["error_voxel_by_angle_error"].items():
        assert case["angle_error_deg"] == [0, 1, 2, 4] and len(errors) == 4, kind
        assert all(0 < value < 2 * peak for value in errors), kind
    truth = [run for run in case["runs"] if run["mapping"] == "truth"]
    assert truth and all(run["error_analytic_voxel"] < 0.3 * peak for run in truth)


def test_the_angle_error_at_a_contrast_lies_between_those_computed():
    assert angles.SIZES_DEG == (0, 1, 2, 4)
    assert angles.reached([0.1, 0.11, 0.2, 0.3], 1.5) == pytest.approx(1 + 4 / 9)
    assert angles.reached([0.1, 0.11, 0.12, 0.16], 1.2) == pytest.approx(2)
    assert angles.reached([0.1, 0.11, 0.12, 0.14], 1.5) is None
    text = angles.describe({kind: [0.1, 0.11, 0.12, 0.16] for kind in angles.LABELS}, 0.03, 1.1, 1.5, 0.5)
    assert text.count("at 3.5 degrees") == 3 and "contrast of 2 is not found: 1.10" in text


@pytest.mark.slow
def test_equal_angle_errors_stretch_the_volume_and_roll_tears_it(tiny):
    rig = rigs.numerical_rig(tiny / "work" / "rig", "small", 5, lambda step, fraction: None)
    rng = np.random.default_rng(3)
    points = rng.uniform(-2, 2, (200, 3))
    chief = np.zeros((200, 2))
    true, wrong, rolled = (rig.ray_tracing(name).cameras for name in ("drt", "drt_plus_1deg", "drt_rolled_1deg"))
    library = lfpiv.thin_lens(rig.experiment, angle_error_deg=1.0).cameras
    half = np.radians([45.0, 46.0])
    stretch = np.array([np.cos(half[0]) / np.cos(half[1]), 1.0, np.sin(half[0]) / np.sin(half[1])])
    offsets = []
    for name in true:
        np.testing.assert_allclose(wrong[name].map(points, chief), library[name].map(points, chief), atol=1e-9)
        seen = true[name].map(points, chief)
        unstretched = np.abs(wrong[name].map(points, chief) - seen).mean()
        assert np.abs(wrong[name].map(points * stretch, chief) - seen).mean() < 0.2 * unstretched  # perspective remains
        offsets.append((rolled[name].map(points, chief) - seen)[:, 1])
    # a roll turns x_c = x cos(a) -+ z sin(a) into y_c, in the two cameras in opposite senses
    torn = offsets[0] - offsets[1]
    expected = np.radians(1.0) * points[:, 0] * np.cos(half[0])
    assert np.abs(np.abs(torn) - np.abs(expected)).max() < 0.1 * np.abs(expected).max()


@pytest.mark.slow
def test_every_figure_is_drawn_and_shown(tiny, figures):
    for key in ("fig10", "fig12", "fig14"):
        for figure in figures[key]["figures"]:
            assert (tiny / figure["file"]).stat().st_size > 10_000, figure
    assert (tiny / "index.html").read_text().count("<figure>") == sum(
        len(figures[key]["figures"]) for key in ("fig10", "fig12", "fig14")
    )


def test_particles_and_images_follow_the_seed():
    first = rigs.random_particles((4.0, 3.0, 2.0), 0.5, [1, 2])
    np.testing.assert_array_equal(first, rigs.random_particles((4.0, 3.0, 2.0), 0.5, [1, 2]))
    assert first.shape == (600, 3) and (np.abs(first) <= (2.0, 1.5, 1.0)).all()
    assert not np.array_equal(first, rigs.random_particles((4.0, 3.0, 2.0), 0.5, [1, 3]))
