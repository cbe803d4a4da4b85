"""Cases of `lfpiv reproduce` beyond the paper, at tiny sizes; and what the injector's averages are made of."""

import json

import numpy as np
import pytest

from lfpiv import reproduce
from lfpiv.reproduce import bench, cameras, choices, lsi, lsi_twin, optics, sweeps
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
        reproduce.reproduce(reproduce.BEYOND, out, seed=SEED)
        yield out
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def figures(tiny):
    return json.loads((tiny / "reproduce.json").read_text())


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


def test_more_cameras_see_depth(figures):
    runs = {run["cameras"]: run for run in figures["cameras"]["runs"]}
    assert set(runs) == {"truth", "one", "two", "three"}
    assert runs["one"]["q"] < runs["two"]["q"] < runs["three"]["q"] < runs["truth"]["q"]
    assert runs["one"]["error_axes_voxel"][2] > DEPTH * runs["two"]["error_axes_voxel"][2]
    assert runs["one"]["elongation"] > runs["two"]["elongation"]


def test_noise_costs_quality(figures):
    bright, dim = figures["sweeps"]["noise"]
    assert bright["snr"] > dim["snr"] > 0 and bright["electrons"] == pytest.approx(dim["electrons"] * 300 / DIM)
    assert bright["q"] > dim["q"] and bright["error_voxel"] < dim["error_voxel"]
    assert bright["saturated"] == 0
    assert figures["sweeps"]["seeding"][0]["q"] == pytest.approx(bright["q"], abs=ROUNDING)  # one run, shown twice


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


def test_cases_share_their_runs_and_the_page_tells_them_apart(tiny, figures):
    runs = {path.stem for path in (tiny / "work" / "bench" / "runs").glob("*.npz")}
    assert runs >= {f"{name}_{PPM:g}_ppm_300_counts" for name in ("one", "two", "three")}
    assert len([name for name in runs if name.startswith("two_")]) == 2  # of the sweep's two exposures
    assert not list((tiny / "work").rglob(".*")), "scratch files left behind"
    text = (tiny / "index.html").read_text()
    assert text.index("Beyond the paper</h1>") < text.index(f"<h2 id='{reproduce.BEYOND[0]}'>")
    assert text.count("Beyond the paper</h1>") == 1
    for key in reproduce.BEYOND:
        for figure in figures[key]["figures"]:
            assert (tiny / figure["file"]).stat().st_size > 10_000, figure
    assert reproduce.CASES == (*reproduce.PAPER, *reproduce.BEYOND)


def test_standard_errors_are_those_of_independent_vectors():
    rng = np.random.default_rng(0)
    means = [rng.standard_normal((4, 4, 4)) for _ in range(4000)]
    told = np.mean([bench._standard_error(np.kron(values, np.ones((2, 2, 2)))) for values in means])
    assert told == pytest.approx(np.std([values.mean() for values in means]), rel=SAMPLED)  # eight times the same


# -- the injector's averages -------------------------------------------------------------------------------------------


def test_profiles_between_layers_are_not_smoothed():
    twin = lsi_twin.Twin(lsi.SIZES["small"], seed=1)
    axes = [np.linspace(-6, 6, 9), np.linspace(-3, 3, 5), np.array([-1.0, 0.0, 1.0])]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    field = np.stack([z**3 - z + y, 2 - z**2 + x], axis=-1)
    found = lsi._along(twin, axes, field)
    depth, y = np.meshgrid(twin.depths_mm, axes[1], indexing="ij")
    expected = np.stack([depth**3 - depth + y, 2 - depth**2 + twin.profile_x_mm], axis=-1)
    np.testing.assert_allclose(found, expected, atol=1e-9)  # a cubic, at depths between the layers
    field[4, 2] = np.nan  # a window that no pair measured, in the layer at z = 0
    found = lsi._along(twin, axes, field)
    lost = np.isnan(found).any(-1)
    assert lost[1, 2] and lost.sum() == 1


def test_error_by_pairs_tells_chance_from_bias():
    twin = lsi_twin.Twin(lsi.SIZES["small"], seed=1)
    axes = [np.linspace(-6, 6, 60), np.linspace(-3, 3, 40), np.array([-1.0, 0.0, 1.0])]
    rng, pairs, bias, spread = np.random.default_rng(2), 40, 0.2, 0.1
    each = rng.standard_normal((pairs, 1, 40, 1, 3)) * spread * np.ones((1, 60, 1, 3, 1))
    each[..., 1] += bias
    reference = np.ones((3, 40, 2)) / 1000 / twin.dt_s  # as large as a displacement of 1 mm
    told = lsi.error_by_pairs(twin, {"axes_mm": axes, "departures_mm": each}, reference)
    assert told["pairs"] == [1, 2, 5, 10, 20, 40]
    for count, error, chance in zip(told["pairs"], told["error"], told["chance"], strict=True):
        expected = spread * np.sqrt(2 / np.pi / count)
        assert chance == pytest.approx([expected] * 2, rel=0.1)  # forty pairs at forty heights
        assert error[0] == pytest.approx(expected, rel=0.5)  # forty heights of one average
    assert told["error"][-1][1] == pytest.approx(bias, rel=0.05)
