"""Correlation: known displacements, symmetries, uncertainty, and the form of the result."""

import json

import numpy as np
import pytest
import scipy.ndimage
import xarray as xr
from support import plain_steps
from support.particle_volumes import TOLERANCE_PEAK, particle_pair, ring, shear, uniform

import lfpiv
from lfpiv.settings.processing import DEFAULT_WINDOWS
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.velocity.settings import CorrelationSettings, cut_windows
from lfpiv.velocity.validation import LEAST_SEEN
from lfpiv_kernels.correlation import correlate as kernel
from lfpiv_kernels.correlation import deform

pytestmark = pytest.mark.usefixtures("device")


def measured(result):
    return np.stack([result[f"displacement_{axis}"].values for axis in "zyx"], -1).astype(float)


def error_of(result, flow, window):
    """Error of every vector against the flow's mean over its window [voxel], for volumes with voxel_mm = 1."""
    centres = np.stack(np.meshgrid(*(result[axis].values for axis in "zyx"), indexing="ij"), -1)
    offset = (np.arange(6) + 0.5) / 6 - 0.5
    steps = np.stack(np.meshgrid(*(offset * edge for edge in np.broadcast_to(window, 3)), indexing="ij"), -1)
    truth = np.mean([flow(centres + step) for step in steps.reshape(-1, 3)], axis=0)
    return measured(result) - truth


def correlate(pair, **options):
    return plain_steps.correlate(*pair, dt_s=1e-3, voxel_mm=1.0, **options)


# --- known displacements -----------------------------------------------------------------------------------------

SHAPE = (40, 56, 56)
BIAS = {32: 0.01, 16: 0.01, 8: 0.02}
"""Largest mean error of a component by window edge [voxel]: the figures the product is held to."""


@pytest.mark.slow(but="[32 16]")
@pytest.mark.parametrize("passes", [("32", (32,)), ("32 16", (32, 16)), ("32 16 8", (32, 16, 8))], ids=lambda p: p[0])
def test_a_uniform_shift_has_no_bias(passes):
    windows = passes[1]
    errors = []
    for number, part in enumerate((0.0, 0.2, 0.4, 0.6, 0.8)):
        flow = uniform(part, 1 - part, part - 1)
        result = correlate(particle_pair(SHAPE, flow, seed=10 + number), windows=windows)
        errors.append(error_of(result, flow, windows[-1]) * (1, 1, -1))
        assert np.isfinite(errors[-1]).all()
    inner = [error[tuple(slice(1, -1) if n > 2 else slice(None) for n in error.shape[:3])] for error in errors]
    means = np.array([error.mean((0, 1, 2)) for error in inner])
    spread = np.mean([error.std((0, 1, 2)) / error[..., 0].size ** 0.5 for error in inner])
    assert np.abs(means).mean() < BIAS[windows[-1]] + spread
    assert np.abs(means).max() < 2 * BIAS[windows[-1]] + 3 * spread


def test_the_quarter_voxel_removes_the_bias_of_interpolation(monkeypatch):
    flow = uniform(0.5, 0.5, 0.5)  # where the phase errors of both volumes add up most
    pair = particle_pair(SHAPE, flow, seed=20)
    bias = {}
    for offset in (0.0, 0.25):
        monkeypatch.setattr(deform, "OFFSET", offset)
        bias[offset] = error_of(correlate(pair, windows=(16, 16)), flow, 16).mean()
    assert bias[0.0] > 0.01 > 2 * abs(bias[0.25])


@pytest.mark.parametrize(
    ("flow", "limit", "noisy_limit"), [(shear(SHAPE), 0.03, 0.2), (ring(SHAPE), 0.12, 0.25)], ids=["shear", "ring"]
)
def test_flows_are_recovered(flow, limit, noisy_limit):
    windows = (32, 16, 12, 12)  # limits: twice what was measured, mean over all vectors, edges included [voxel]
    for degraded, allowed in (({}, limit), ({"ghosts": 1.0, "noise": 0.05}, noisy_limit)):
        result = correlate(particle_pair(SHAPE, flow, seed=30, **degraded), windows=windows)
        error = np.linalg.norm(error_of(result, flow, 12), axis=-1)
        assert error.mean() < allowed
        assert float(result["valid"].mean()) > 0.95 and np.isfinite(measured(result)).all()
    assert json.loads(result.attrs["passes"])[-1]["valid"] == pytest.approx(float(result["valid"].mean()), abs=1e-4)


@pytest.mark.slow(but="24-16")
@pytest.mark.parametrize(("depth", "window"), [(30, 20), (30, 14), (24, 16)], ids=str)
def test_few_layers_of_vectors_are_enough(depth, window):
    shape = (depth, 56, 56)
    for degraded in ({}, {"ghosts": 1.0, "noise": 0.05}):
        result = correlate(particle_pair(shape, ring(shape), seed=3, **degraded), windows=(window, window))
        error = np.linalg.norm(error_of(result, ring(shape), window), axis=-1)
        assert float(result["valid"].mean()) > 0.9 and error.mean() < 0.3  # of a peak displacement of 2


def test_large_displacements_need_only_the_quarter_rule():
    flow = uniform(4.0, -6.5, 7.7)  # a quarter of 32 is 8
    result = correlate(particle_pair(SHAPE, flow, seed=31, ghosts=0.5), windows=(32, 16))
    assert np.abs(error_of(result, flow, 16)[1:-1, 1:-1, 1:-1]).mean() < 0.1  # ghosts leave 0.05 per component
    far = uniform(0, 0, 13.0)
    result = correlate(particle_pair(SHAPE, far, seed=32), windows=((32, 32, 40), 16), max_displacement_voxel=14)
    assert np.abs(error_of(result, far, 16)[1:-1, 1:-1, 1:-1]).mean() < 0.02


def test_swapping_the_volumes_negates_the_field():
    pair = particle_pair((36, 48, 48), ring((36, 48, 48)), seed=33)
    options = {"windows": (16, 12, 12), "max_displacement_voxel": 3}
    forward, backward = measured(correlate(pair, **options)), measured(correlate(pair[::-1], **options))
    np.testing.assert_allclose(forward, -backward, atol=TOLERANCE_PEAK)


@pytest.mark.slow(but="[8]")
@pytest.mark.parametrize("windows", [(32, 16, 16), (32, 16, 8)], ids=["16", "8"])
def test_the_uncertainty_agrees_with_the_errors(windows):
    flow = uniform(0.7, -1.3, 1.8)
    ratios = []
    for number, degraded in enumerate(({"lost": 0.2}, {"ghosts": 1.0}, {"noise": 0.1}, {"ghosts": 0.5, "lost": 0.1})):
        result = correlate(particle_pair(SHAPE, flow, seed=50 + number, **degraded), windows=windows)
        deviation = np.stack([result[f"uncertainty_{axis}"].values for axis in "zyx"], -1)
        known, valid = np.isfinite(deviation).all(-1), result["valid"].values
        assert not known[~valid].any() and known[valid].mean() > 0.97  # a poor window's peak may be too odd to judge
        np.testing.assert_allclose(result["uncertainty"].values ** 2, (deviation**2).sum(-1), rtol=1e-5)
        inner = (slice(1, -1),) * 3
        ratios.append(np.abs(error_of(result, flow, windows[-1]) / deviation)[inner][known[inner]].ravel())
    # Of a normal distribution 68 % lie within one standard deviation and 95 % within two. Overlapping windows leave
    # about 100 independent errors at 16 voxels: the first share is known to 5 %, the second to 2 %, one sigma.
    ratio = np.concatenate(ratios)
    assert 0.55 < (ratio < 1).mean() < 0.81
    assert 0.87 < (ratio < 2).mean()


# --- the product's form ------------------------------------------------------------------------------------------


def volumes(shape=(20, 24, 28), voxel=0.1, first=(-1.0, 2.0, 3.0), seed=40, **options):
    pair = particle_pair(shape, uniform(0.5, 1.0, -1.5), seed=seed, **options)
    places = {a: f + voxel * np.arange(n) for a, f, n in zip("zyx", first, shape, strict=True)}
    return [xr.DataArray(volume, places, ("z", "y", "x")) for volume in pair]


def test_the_dataset_has_units_and_positions():
    result = plain_steps.correlate(*volumes(), windows=((16, 16, 20), (8, 12, 8)), overlap=0.5, dt_s=2e-4)
    assert result["u"].dims == ("z", "y", "x") and dict(result.sizes) == {"z": 4, "y": 3, "x": 6}
    for name, axis in (("u", "x"), ("v", "y"), ("w", "z")):
        expected = result[f"displacement_{axis}"] * 0.1e-3 / 2e-4
        np.testing.assert_allclose(result[name], expected, rtol=1e-6)
        assert result[name].attrs["units"] == "m/s" and result[f"displacement_{axis}"].attrs["units"] == "voxel"
    assert result["valid"].dtype == bool and result["uncertainty"].attrs["units"] == "voxel"
    origin, _ = kernel.window_grid((20, 24, 28), (8, 12, 8), (4, 6, 4))
    assert float(result["z"][0]) == pytest.approx(-1.0 + 0.1 * (origin[0] + 3.5 + deform.OFFSET))
    assert float(result["x"][1] - result["x"][0]) == pytest.approx(0.4)
    settings, passes = (json.loads(result.attrs[key]) for key in ("settings", "passes"))
    assert CorrelationSettings.from_vectors(result).windows == ((16, 16, 20), (8, 12, 8))
    assert settings["windows"] == [[16, 16, 20], [8, 12, 8]] and len(passes) == 2
    assert result.attrs["verdict"] == Verdict.GOOD.value and result.attrs["dt_s"] == 2e-4


def test_intensity_scale_and_background_do_not_matter():
    pair = volumes(noise=0.02)
    plain, scaled = (plain_steps.correlate(*p, dt_s=1.0) for p in (pair, [1e6 * (v + 3) for v in pair]))
    # float32 holds the larger numbers to 0.25, 1e-7 of the largest: hardly visible at the peak
    np.testing.assert_allclose(scaled["u"], plain["u"], atol=1e-4 * TOLERANCE_PEAK)


def test_unrelated_and_empty_volumes_fail():
    first, second = volumes()[0], volumes(seed=41)[1]
    result = plain_steps.correlate(first, second, dt_s=1.0, windows=(12, 8, 8))
    # chance: three components within half the search range of their neighbours, (1/2)^3 of them, some more by consensus
    assert float(result["valid"].mean()) < 0.3 and result.attrs["verdict"] == Verdict.FAILED.value
    empty = plain_steps.correlate(0 * first, 0 * second, dt_s=1.0, windows=(12, 8))
    assert not empty["valid"].any() and np.isnan(empty["u"]).all()
    assert empty.attrs["verdict"] == Verdict.FAILED.value


def test_windows_that_one_camera_sees_are_replaced():
    shape, window = (20, 24, 28), (8, 12, 8)
    first, second = volumes(shape)
    views = np.full(shape, 2, np.uint8)
    views[:, :12], views[3:9, 20:, :5] = 1, 0
    options = {"windows": (16, window), "overlap": 0.75, "dt_s": 1.0}
    anything = plain_steps.correlate(first, second, **options)
    assert anything["valid"].mean() > 0.95 and anything.attrs["seen_fraction"] == 1
    counted = [volume.assign_coords(views=(("z", "y", "x"), views)) for volume in (first, second)]
    result = plain_steps.correlate(*counted, **options)
    origin, count = kernel.window_grid(shape, window, (2, 3, 2))
    share = np.zeros(count)
    for cell in np.ndindex(*count):
        corner = [o + k * s for o, k, s in zip(origin, cell, (2, 3, 2), strict=True)]
        share[cell] = (views[tuple(slice(c, c + w) for c, w in zip(corner, window, strict=True))] >= 2).mean()
    enough = share >= LEAST_SEEN
    assert {0.0, LEAST_SEEN, 1.0} <= set(share.ravel())  # nothing, just enough, all
    good = result["valid"].values
    both = good & anything["valid"].values
    assert not good[~enough].any() and good[enough].mean() > 0.95
    assert result.attrs["seen_fraction"] == enough.mean() and result.attrs["valid_fraction"] == good.mean() < 0.8
    assert result.attrs["verdict"] == Verdict.GOOD.value  # of what can be measured nearly all is valid
    assert np.isfinite(measured(result)).all() and np.isnan(result["uncertainty"].values[~enough]).all()
    np.testing.assert_array_equal(measured(result)[both], measured(anything)[both])
    one = plain_steps.correlate(first, counted[1], **options)
    np.testing.assert_array_equal(one["valid"], good)
    nowhere = [volume.assign_coords(views=(("z", "y", "x"), 0 * views)) for volume in (first, second)]
    assert plain_steps.correlate(*nowhere, **options).attrs["verdict"] == Verdict.FAILED.value
    with pytest.raises(ValueError, match=r"views: expected a coordinate over \(z, y, x\)"):
        plain_steps.correlate(first.assign_coords(views=("z", [2] * 20)), second, **options)


def test_displacements_beyond_the_search_are_recognised():
    """Some vectors are valid by chance. The correlation of the whole volumes shows that the search was too short."""
    shape, windows = (28, 40, 48), (24, 12)  # searched up to 6 voxels along each axis
    for seed, flow, verdict in (
        (60, uniform(0.4, 0.2, 9.3), Verdict.TOO_FAR),
        (61, uniform(-8.6, 7.7, 0.5), Verdict.TOO_FAR),
        (62, uniform(0.4, 0.2, 5.3), Verdict.GOOD),
    ):
        result = correlate(particle_pair(shape, flow, seed=seed, ghosts=0.3), windows=windows)
        assert result.attrs["verdict"] == verdict.value
    seldom = [particle_pair(shape, uniform(0, 0, 0), seed=seed)[0] for seed in (63, 64)]  # different particles
    for power in (0.5, 1.0):
        lost = correlate(seldom, windows=windows, intensity_power=power).attrs["verdict"]
        assert lost in (Verdict.FAILED.value, Verdict.POOR.value)
        noisy = [np.random.default_rng(seed).random((40, 40, 40)) for seed in (65, 66)]
        lost = correlate(noisy, windows=(12, 12), intensity_power=power).attrs["verdict"]
        assert lost in (Verdict.FAILED.value, Verdict.POOR.value)


def test_vectors_too_far_apart_to_confirm_each_other_are_told_from_unlike_volumes():
    shape, wide, narrow = (17, 25, 33), ((14, 18, 18), (12, 14, 14), (12, 14, 14)), ((10, 12, 12), (8, 10, 10))
    middle = (np.array(shape) - 1) / 2

    def swirl(position):
        z, _, x = np.moveaxis(position - middle, -1, 0)
        rate = np.exp(0.5 - (z**2 + x**2) / 32)  # 4 voxels at a radius of 4
        return np.stack([rate * x, 0 * x, -rate * z], -1)

    for seed in (70, 71, 72):
        first, second = particle_pair(shape, swirl, seed=seed)
        result = correlate((first, second), windows=wide, max_displacement_voxel=4.5)
        assert result["valid"].size == 6 and result.attrs["verdict"] == Verdict.UNCONFIRMED.value
        closer = correlate((first, second), windows=narrow, max_displacement_voxel=4.5)  # as the verdict advises
        assert closer["valid"].mean() > 0.5
        other = particle_pair(shape, swirl, seed=seed + 10)[1]
        unlike = correlate((first, other), windows=wide, max_displacement_voxel=4.5)
        assert unlike.attrs["verdict"] == Verdict.FAILED.value


def test_default_windows_are_cut_to_the_volume_and_others_refused():
    first, second = volumes()
    edges = [tuple(min(edge, n) for n in first.shape) for edge in DEFAULT_WINDOWS]
    cut, same = lfpiv.correlate(first, second), lfpiv.correlate(first, second, windows=edges)
    assert cut["displacement_x"].values.tobytes() == same["displacement_x"].values.tobytes()
    whole = max(first.shape)  # the error names the largest window that fits
    with pytest.raises(ValueError, match=rf"got {whole} along z, which has {len(first)} voxels.*{len(first)}, "):
        lfpiv.correlate(first, second, windows=(whole, 12))


def test_windows_are_cut_where_that_is_wanted():
    assert cut_windows((32, (16, 12, 16), 8), (12, 40, 14)) == ((12, 32, 14), (12, 12, 14), (8, 8, 8))


def test_a_number_is_the_window_of_a_single_pass():
    pair = volumes()
    one, same = lfpiv.correlate(*pair, windows=12), lfpiv.correlate(*pair, windows=(12,))
    xr.testing.assert_identical(one, same)
    with pytest.raises(ValueError, match="got 64 along z"):
        lfpiv.correlate(*pair, windows=64)


def test_arrays_without_any_size_give_displacements_at_indices():
    pair = volumes()
    bare = [volume.values for volume in pair]
    found, scaled = lfpiv.correlate(*bare, windows=(12, 8)), lfpiv.correlate(*pair, dt_s=1e-3, windows=(12, 8))
    assert not {"u", "v", "w"} & set(found) and not {"dt_s", "voxel_mm"} & set(found.attrs)
    np.testing.assert_array_equal(found["displacement_y"], scaled["displacement_y"])
    voxel_mm = float(pair[0].x[1] - pair[0].x[0])
    for axis in "zyx":
        assert found[axis].attrs["units"] == "voxel"
        np.testing.assert_allclose(found[axis], (scaled[axis] - pair[0][axis][0]) / voxel_mm, atol=1e-9)
    in_mm = lfpiv.correlate(*bare, voxel_mm=voxel_mm, windows=(12, 8))
    assert "u" not in in_mm and in_mm["x"].attrs["units"] == "mm" and in_mm.attrs["voxel_mm"] == [voxel_mm] * 3
    whole = lfpiv.correlate(*bare, voxel_mm=voxel_mm, dt_s=1e-3, windows=(12, 8))
    np.testing.assert_array_equal(whole["u"], scaled["u"])
    assert list(whole)[:6] == ["u", "v", "w", "displacement_x", "displacement_y", "displacement_z"]


def test_a_mask_of_an_array_has_its_indices():
    first, second = (volume.values for volume in volumes())
    solid = np.zeros(first.shape, bool)
    solid[:, :, :12] = True
    found = lfpiv.correlate(first, second, windows=(12, 8), mask=solid)
    assert found["masked"].sel(x=slice(None, 6)).all() and not found["masked"].sel(x=slice(18, None)).any()
    spoilt = np.where(solid, 1e6, first)
    xr.testing.assert_identical(lfpiv.correlate(spoilt, second, windows=(12, 8), mask=solid), found)


def test_intensity_power_keeps_bright_spots_from_outweighing_particles():
    pair = volumes()  # displacement (0.5, 1.0, -1.5) voxel along z, y, x
    spot = np.zeros(pair[0].shape)
    spot[4::10, 4::10, 4::10] = 40.0 * float(pair[0].max())
    spot = scipy.ndimage.gaussian_filter(spot, 0.7)  # does not move

    def error(**options):
        result = plain_steps.correlate(*(volume + spot for volume in pair), dt_s=1.0, windows=(12, 12), **options)
        fields = [result[f"displacement_{axis}"] - d for axis, d in zip("zyx", (0.5, 1.0, -1.5), strict=True)]
        return float(np.sqrt(sum(field**2 for field in fields)).mean())

    assert error() == error(intensity_power=1.0)
    assert error(intensity_power=0.5) < 0.8 * error()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"volume_b": np.zeros((20, 24, 27))}, r"volume_b: expected the shape of volume_a, \(20, 24, 28\), got"),
        ({"volume_a": np.full((20, 24, 28), np.nan)}, "volume_a: expected finite intensities, found 13440"),
        ({"volume_a": np.zeros((20, 24)), "volume_b": np.zeros((20, 24))}, "volume_a: expected a volume"),
        (
            {"windows": (16, (32, 16, 16))},
            "windows: expected edges within the volume, got 32 along z, which has 20 voxels",
        ),
        ({"windows": ()}, "windows: expected at least one pass"),
        ({"windows": "16"}, "windows: expected a window or a sequence"),
        ({"windows": 2}, "windows: expected edges of whole voxels >= 4"),
        ({"windows": (16, 2)}, "windows: expected edges of whole voxels >= 4"),
        ({"windows": ((16, 16),)}, "windows: expected edges of whole voxels >= 4"),
        ({"overlap": 1.0}, "overlap: expected 0 <= overlap < 1, got 1.0"),
        ({"dt_s": 0.0}, "dt_s: expected a positive time"),
        ({"windows": (None,)}, "windows: expected edges of whole voxels >= 4"),
        ({"volume_a": [[1, 2], [3]]}, "volume_a: expected a volume of numbers"),
        ({"volume_b": np.ma.masked_equal(np.zeros((20, 24, 28)), 0)}, "volume_b: expected finite intensities"),
        ({"voxel_mm": None}, "dt_s: velocities of arrays need the voxel edge too"),
        ({"voxel_mm": -0.1}, "voxel_mm: expected the voxel edge"),
        ({"smoothing_voxel": -1.0}, "smoothing_voxel: expected a value >= 0"),
        ({"intensity_power": 0.0}, "intensity_power: expected a value > 0"),
        ({"max_displacement_voxel": 40.0}, "max_displacement_voxel: expected a value > 0 and within the volume"),
    ],
)
def test_bad_input_is_refused(change, message):
    good = {"volume_a": np.zeros((20, 24, 28)), "volume_b": np.zeros((20, 24, 28)), "dt_s": 1e-3, "voxel_mm": 0.1}
    with pytest.raises(ValueError, match=message):
        plain_steps.correlate(**{**good, **change})


def test_coordinates_must_agree():
    first, second = volumes()
    with pytest.raises(ValueError, match="volume_b: expected the coordinates x of volume_a"):
        plain_steps.correlate(first, second.assign_coords(x=second["x"] + 0.05), dt_s=1.0)
    with pytest.raises(ValueError, match="evenly spaced coordinates y"):
        plain_steps.correlate(*(v.assign_coords(y=v["y"].values ** 2) for v in (first, second)), dt_s=1.0)
    with pytest.raises(ValueError, match="volume_a: expected dims"):
        plain_steps.correlate(*(v.transpose("x", "y", "z").transpose("x", "z", "y") for v in (first, second)), dt_s=1.0)
    with pytest.raises(ValueError, match="voxel_mm: expected no value with DataArrays"):
        plain_steps.correlate(first, second, dt_s=1.0, voxel_mm=0.1)
    for pair, other in (((first, second.values), "volume_b"), ((first.values, second), "volume_a")):
        with pytest.raises(ValueError, match=f"{other}: expected a DataArray, as volume_. is"):
            plain_steps.correlate(*pair, dt_s=1.0, voxel_mm=0.2)
