"""Damping by ghosts: estimated from simulated pairs, and taken off vectors."""

import json

import numpy as np
import pytest
import xarray as xr

from lfpiv.records import RecordError
from lfpiv.velocity.damping import ATTRIBUTE, DAMPING, AxisDamping, Damping
from lfpiv.velocity.damping_estimate import Simulated, estimate_damping

SHAPE = (5, 6, 7)
VOXEL_MM, DT_S = 0.1, 1e-3
SLOPES = {"z": 0.8, "y": 0.9, "x": 0.85}
OFFSETS = {"z": 0.1, "y": 0.0, "x": -0.05}


def vectors_of(displacement, sigma=0.1, valid=None):
    """Vectors of a displacement (z, y, x, 3) along (z, y, x) [voxel] with a stated uncertainty."""
    names = dict(zip("zyx", np.moveaxis(displacement, -1, 0), strict=True))
    distance = {axis: values - np.nanmean(values) for axis, values in names.items()}
    stated = {axis: np.sqrt(sigma**2 + (DAMPING * values) ** 2) for axis, values in distance.items()}
    variables = {f"displacement_{axis}": values for axis, values in names.items()}
    variables |= {f"uncertainty_{axis}": values for axis, values in stated.items()}
    variables |= {speed: names[axis] * VOXEL_MM * 1e-3 / DT_S for speed, axis in zip("uvw", "xyz", strict=True)}
    variables["uncertainty"] = np.sqrt(sum(values**2 for values in stated.values()))
    variables["valid"] = np.ones(displacement.shape[:3], bool) if valid is None else valid
    variables["seeded_share"] = variables["fluid_share"] = np.ones(displacement.shape[:3])
    axes = {axis: 0.6 * np.arange(count) for axis, count in zip("zyx", displacement.shape, strict=False)}
    dims = ("z", "y", "x")
    found = {name: (dims, values) for name, values in variables.items()}
    return xr.Dataset(found, axes, {"voxel_mm": [VOXEL_MM] * 3, "dt_s": DT_S})


def flow(rng, shape=SHAPE):
    return 2.0 + 0.6 * rng.standard_normal((*shape, 3))


def damped(imposed, rng, noise=0.1):
    mean = imposed.mean((0, 1, 2))
    slopes, offsets = (np.array([values[axis] for axis in "zyx"]) for values in (SLOPES, OFFSETS))
    return mean + slopes * (imposed - mean) + offsets + noise * rng.standard_normal(imposed.shape)


def simulated(seed, noise=0.1):
    rng = np.random.default_rng(seed)
    imposed = flow(rng)
    return Simulated(vectors=vectors_of(damped(imposed, rng, noise)), imposed=imposed)


def test_slope_and_offset_of_each_axis_come_with_true_standard_errors():
    known = [estimate_damping([simulated((k, j)) for j in range(2)]) for k in range(40)]
    for axis in "xyz":
        for name, exact in (("slope", SLOPES[axis]), ("offset", OFFSETS[axis])):
            values, errors = (
                np.array([getattr(one.axes[axis], f"{name}{end}") for one in known]) for end in ("", "_error")
            )
            assert abs(values.mean() - exact) < 3 * values.std() / np.sqrt(len(values))
            assert 0.7 < np.sqrt(np.mean(errors**2)) / values.std() < 1.4


def test_more_pairs_know_it_better():
    few, many = (estimate_damping([simulated((1, j)) for j in range(count)]) for count in (1, 16))
    assert many.axes["x"].slope_error < 0.5 * few.axes["x"].slope_error
    assert many.simulated == 16


def test_the_slope_of_unbiased_vectors_is_one():
    found = estimate_damping([simulated((2, j)) for j in range(8)])
    rng = np.random.default_rng(9)
    exact = flow(rng, (12, 14, 16))
    raw = vectors_of(damped(exact, rng))
    unbiased = found.unbiased(raw)
    for number, axis in enumerate("zyx"):
        true = exact[..., number] - exact[..., number].mean()

        def slope(name, true=true, axis=axis):
            return float((unbiased[f"{name}_{axis}"].values * true).sum() / (true**2).sum())

        assert abs(slope("displacement") - SLOPES[axis]) < 0.02
        assert abs(slope("displacement_unbiased") - 1) < 0.03
        errors = np.abs(unbiased[f"displacement_unbiased_{axis}"].values - exact[..., number])
        covered = (errors <= 2 * unbiased[f"uncertainty_unbiased_{axis}"].values).mean()
        raw_errors = np.abs(unbiased[f"displacement_{axis}"].values - exact[..., number])
        assert covered > 0.93 and (raw_errors <= 2 * unbiased[f"uncertainty_{axis}"].values).mean() > 0.93
        assert np.array_equal(unbiased[f"displacement_{axis}"], raw[f"displacement_{axis}"])  # raw vectors stay
    speeds = unbiased["displacement_unbiased_x"].values * VOXEL_MM * 1e-3 / DT_S
    assert np.allclose(unbiased["u_unbiased"], speeds) and unbiased["u_unbiased"].attrs["units"] == "m/s"
    assert json.loads(unbiased.attrs[ATTRIBUTE])["simulated"] == 8
    assert found.unbiased(unbiased) is unbiased  # taken off once


def axis_of(**changed):
    values = {"slope": 0.8, "slope_error": 0.02, "offset": 0.1, "offset_error": 0.01, "fluctuation": 0.5}
    return AxisDamping(**{**values, "uncertainty_factor": 1.0, **changed})


@pytest.mark.parametrize(
    "changed",
    [
        {"slope_error": 0.15},
        {"slope": 0.7, "slope_error": 0.09},
        {"fluctuation": 0.05},
        {"slope": 0.45},
        {"slope": 1.5},
        {"slope": 0.85, "fluctuation": 0.2, "scatter": 0.2},
    ],
)
def test_what_is_not_significant_is_not_corrected(changed):
    assert axis_of().applied and axis_of().used_gain == 1 / 0.8
    left = axis_of(**changed)
    assert not left.applied and left.used_gain == 1.0 and left.pull_left == left.pull > 0
    assert axis_of(offset_error=0.06).used_offset == 0.0 and axis_of().used_offset == 0.1


def test_the_damping_of_raw_vectors_is_part_of_their_uncertainty():
    found = Damping(axes={axis: axis_of(offset=0.0) for axis in "xyz"}, simulated=1)
    raw = vectors_of(flow(np.random.default_rng(0)))
    whole = found.unbiased(raw)
    distance = raw["displacement_x"].values - raw["displacement_x"].values.mean()
    expected = 0.1**2 + 0.01**2 + ((1 / 0.8 - 1) ** 2 + (0.02 / 0.64) ** 2) * distance**2
    assert np.allclose(whole["uncertainty_x"].values ** 2, expected)
    assert (whole["uncertainty"].values > raw["uncertainty"].values).all()


def test_masked_vectors_stay_without_number():
    displacement = flow(np.random.default_rng(1))
    displacement[0] = np.nan
    valid = np.isfinite(displacement).all(-1)
    found = Damping(axes={axis: axis_of() for axis in "xyz"}, simulated=1).unbiased(
        vectors_of(displacement, valid=valid)
    )
    assert np.array_equal(np.isfinite(found["displacement_unbiased_z"].values), valid)


def test_it_survives_its_stored_form_and_other_forms_are_refused():
    found = estimate_damping([simulated(3)])
    assert Damping.from_json(json.loads(json.dumps(found.to_json()))) == found
    stored = found.to_json()
    for wrong in ({}, {**stored, "simulated": None}, {**stored, "axes": {"x": stored["axes"]["x"]}}):
        with pytest.raises(RecordError):
            Damping.from_json(wrong)


def test_too_few_valid_vectors_say_so():
    pair = simulated(4)
    nothing = Simulated(vectors=pair.vectors.assign(valid=~pair.vectors["valid"]), imposed=pair.imposed)
    with pytest.raises(ValueError, match="valid"):
        estimate_damping([nothing])


def test_the_error_of_a_slope_is_that_of_pairs_where_these_scatter_more():
    rng = np.random.default_rng(8)
    pairs = []
    for slope in (0.6, 0.7, 0.9, 1.0):
        imposed = flow(rng)
        mean = imposed.mean((0, 1, 2))
        pairs.append(Simulated(vectors=vectors_of(mean + slope * (imposed - mean)), imposed=imposed))
    few, enough = (estimate_damping(pairs[:count]).axes["x"] for count in (3, 4))
    scatter = np.std([0.6, 0.7, 0.9, 1.0], ddof=1) / np.sqrt(4)
    assert abs(enough.slope_error / scatter - 1) < 0.1 and few.slope_error < scatter


def waves(rng, shape=(10, 12, 14)):
    """Flow of long waves only."""
    z, y, x = (np.arange(count) / count for count in shape)
    phases = rng.uniform(0, 2 * np.pi, 3)
    wave = [np.sin(2 * np.pi * (z[:, None, None] + y[:, None] + x) + phase) for phase in phases]
    return 2.0 + 0.8 * np.stack(wave, -1)


def test_short_errors_are_not_amplified_and_the_slope_is_one():
    rng = np.random.default_rng(5)
    pairs = []
    for _ in range(6):
        imposed = waves(rng)
        pairs.append(Simulated(vectors=vectors_of(damped(imposed, rng, noise=0.3)), imposed=imposed))
    found = estimate_damping(pairs)
    exact = waves(rng)
    whole = found.unbiased(vectors_of(damped(exact, rng, noise=0.3)))
    for number, axis in enumerate("zyx"):
        known, true = found.axes[axis], exact[..., number] - exact[..., number].mean()
        assert known.applied and len(known.coherence) > 5
        unbiased = whole[f"displacement_unbiased_{axis}"].values
        assert abs(float((unbiased * true).sum() / (true**2).sum()) - 1) < 0.03
        error = (unbiased - exact[..., number]).std()
        assert abs(error / known.unbiased_error - 1) < 0.1
        assert known.unbiased_error < 0.95 * 0.3 / SLOPES[axis]  # as division by the slope would leave it
        raw = (whole[f"displacement_{axis}"].values - exact[..., number]).std()
        assert abs(raw / known.raw_error - 1) < 0.1
        assert {"raw_error", "unbiased_error"} <= set(found.to_json()["axes"][axis])
