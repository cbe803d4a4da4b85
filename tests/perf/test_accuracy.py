"""Cases of `perf/accuracy`, at tiny sizes."""

import json

import bench
import cameras
import choices
import numpy as np
import optics
import pytest
import run
import sweeps

from lfpiv.reproduce.study import compute
from lfpiv.weights import counting

SEED = 3
PPM = 0.3
DIM = 4.0  # counts of a particle's pixels that are little more than the read-out noise of 3
FEW = ("no_momentum", "ten_iterations", "power_1", "drt", "gaussian_dots")
RAYS_PITCH = (
    0.08  # the project's bound is 0.015; a board of nine dots in three planes tells less than the published one
)
FAILS = 5.0  # DRT's rays through 10 mm of glass at 45 degrees miss by 0.6 pitch, this network's by 0.02
DEPTH = 2.0  # a single camera's depth error over that of two; 4 to 5 in volumes that hold more vectors
ROUNDING = 1e-9
SAMPLED = 0.05  # relative: statistics of 4,000 draws


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Output folder of the four cases on rigs of 2.4 mm."""
    patch = pytest.MonkeyPatch()
    for table, tiny_value in (
        (bench.SIZE_MM, (2.4, 2.4, 1.6)),
        (bench.DOTS, (3, 3)),
        (bench.PLANES_MM, (-1.0, 0.0, 1.0)),
        (bench.SENSOR_PX, (560, 640)),
        (cameras.PPM, (PPM,)),
        (sweeps.PPM, (PPM,)),
        (sweeps.COUNTS, (300.0, DIM)),
    ):
        patch.setitem(table, "small", tiny_value)
    pair = bench.Pair(ppm=PPM)
    coarse = {"quality": {"pixel_rays": 16, "dot_rays": 16_384}, "network": {"hidden": (10,), "epochs": 60}}
    for module, name, value in (
        (bench, "SHARED", coarse),
        (bench, "PARTICLE_RAYS", 8192),
        (sweeps, "DEFAULT", pair),
        (choices, "DEFAULT", pair),
        (choices, "CHOICES", {key: choices.CHOICES[key] for key in FEW}),
        (optics, "DEFAULT", pair),
        (optics, "OPTICS", {key: optics.OPTICS[key] for key in ("window",)}),
        (counting, "VOXELS", 1),  # the check by counted rays has tests of its own
    ):
        patch.setattr(module, name, value)
    out = tmp_path_factory.mktemp("beyond")
    try:
        compute(run.ACCURACY, "all", out, "small", seed=SEED)
        yield out
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def figures(tiny):
    return json.loads((tiny / "reproduce.json").read_text())


@pytest.mark.slow
def test_ray_tracing_fails_through_real_optics_and_the_network_does_not(figures):
    case = figures["optics"]
    for errors in case["mapping_error_pitch"].values():
        assert errors["network"]["mean"] <= RAYS_PITCH
        assert errors["drt"]["mean"] > FAILS * errors["network"]["mean"]
    window = case["mapping_error_pitch"]["window"]
    assert window["fitted"]["mean"] > 0.5 * window["drt"]["mean"]  # no pose mends astigmatism
    pair = case["pairs"]["window"]
    assert pair["network"]["q"] > pair["drt"]["q"] and pair["truth"]["q"] == pytest.approx(1)
    assert list(case["pairs"]) == ["window"]


@pytest.mark.slow
def test_more_cameras_see_depth(figures):
    runs = {run["cameras"]: run for run in figures["cameras"]["runs"]}
    assert set(runs) == {"truth", "one", "two", "three"}
    assert runs["one"]["q"] < runs["two"]["q"] < runs["three"]["q"] < runs["truth"]["q"]
    assert runs["one"]["error_axes_voxel"][2] > DEPTH * runs["two"]["error_axes_voxel"][2]
    assert runs["one"]["elongation"] > runs["two"]["elongation"]


@pytest.mark.slow
def test_noise_costs_quality(figures):
    bright, dim = figures["sweeps"]["noise"]
    assert bright["snr"] > dim["snr"] > 0 and bright["electrons"] == pytest.approx(dim["electrons"] * 300 / DIM)
    assert bright["q"] > dim["q"] and bright["error_voxel"] < dim["error_voxel"]
    assert bright["saturated"] == 0
    assert figures["sweeps"]["seeding"][0]["q"] == pytest.approx(bright["q"], abs=ROUNDING)  # one run, shown twice


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
    assert runs >= {f"{name}_{PPM:g}_ppm_300_counts" for name in ("one", "two", "three")}
    assert len([name for name in runs if name.startswith("two_")]) == 2  # of the sweep's two exposures
    assert not list((tiny / "work").rglob(".*")), "scratch files left behind"
    text = (tiny / "index.html").read_text()
    assert text.count("Beyond the paper</h1>") == 1
    for key in run.ACCURACY.modules:
        for figure in figures[key]["figures"]:
            assert (tiny / figure["file"]).stat().st_size > 10_000, figure


def test_standard_errors_are_those_of_independent_vectors():
    rng = np.random.default_rng(0)
    means = [rng.standard_normal((4, 4, 4)) for _ in range(4000)]
    told = np.mean([bench.standard_error_of_mean(np.kron(values, np.ones((2, 2, 2)))) for values in means])
    assert told == pytest.approx(np.std([values.mean() for values in means]), rel=SAMPLED)  # eight times the same


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["fig10"], "cases: expected some of optics, cameras"), (["--seed", "-1"], "seed: expected")],
)
def test_wrong_arguments_are_refused_in_one_line(tmp_path, capsys, arguments, message):
    assert run.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(message) and error.count("\n") == 1
