"""Likeness of simulated and recorded pairs: harder ones are told, from what vectors show without truth."""

import json

import numpy as np
import pytest
import xarray as xr

from lfpiv.velocity.damping import DAMPING, Damping
from lfpiv.velocity.damping_estimate import Simulated, estimate_damping
from lfpiv.velocity.likeness import compare

SHAPE = (6, 6, 6)


def flow(seed):
    return 0.6 * np.random.default_rng([seed, 1]).standard_normal((*SHAPE, 3))


def vectors_of(seed, *, valid=0.97, deviation=0.1, slope=0.85, stated=True):
    """Vectors of a flow, of which a share is valid, whose stated random deviation scatters by a tenth."""
    rng = np.random.default_rng(seed)
    found = slope * flow(seed) + deviation * rng.standard_normal((*SHAPE, 3))
    variables = {
        "valid": rng.uniform(size=SHAPE) < valid,
        "fluid_share": np.ones(SHAPE),
        "seeded_share": np.ones(SHAPE),
    }
    for k, axis in enumerate("zyx"):
        random = deviation * (1 + 0.1 * rng.standard_normal(SHAPE))
        ghosts = DAMPING * (found[..., k] - found[variables["valid"], k].mean())
        variables[f"displacement_{axis}"] = found[..., k]
        variables[f"uncertainty_{axis}"] = np.hypot(random, ghosts) if stated else np.full(SHAPE, np.nan)
    return xr.Dataset({name: (("z", "y", "x"), values) for name, values in variables.items()})


def several(first, count, **how):
    return [vectors_of(seed, **how) for seed in range(first, first + count)]


def damping(recorded, **how):
    return estimate_damping([Simulated(vectors=vectors_of(s, **how), imposed=flow(s)) for s in range(50, 56)], recorded)


def test_pairs_of_one_kind_are_alike():
    found = compare(several(0, 8), several(50, 6))
    assert not found.harder and found.doubt < 0.05
    assert abs(found.deviation_voxel.recorded - 0.1 * np.sqrt(3)) < 0.01
    assert abs(found.invalid_share.recorded - 0.03) < 0.02


@pytest.mark.parametrize("how", [{"valid": 0.85}, {"deviation": 0.14}])
def test_harder_pairs_correct_nothing(how):
    recorded = several(0, 8)
    alike, harder = damping(recorded), damping(recorded, **how)
    assert all(axis.applied for axis in alike.axes.values())
    assert harder.likeness.harder and not any(axis.applied for axis in harder.axes.values())
    assert all(axis.used_gain == 1.0 and axis.used_offset == 0.0 for axis in harder.axes.values())
    assert all(axis.pull > 0 for axis in harder.axes.values())
    assert Damping.from_json(json.loads(json.dumps(harder.to_json()))) == harder


def test_easier_pairs_still_correct_but_leave_a_doubt():
    recorded = several(0, 8)
    alike, easier = damping(recorded), damping(recorded, deviation=0.08)
    alone = damping(())  # not compared: the damping of the simulated pairs themselves
    for axis in "xyz":
        taken = 1 - np.array([one.axes[axis].slope for one in (alone, alike, easier)])
        assert abs(taken[1] / taken[0] - 1) < 0.05  # in proportion to the random errors of recorded pairs
        assert abs(taken[2] / alike.likeness.errors_ratio / taken[0] - 0.1 / 0.08) < 0.1
        assert abs(easier.axes[axis].raw_error / alike.axes[axis].raw_error - 1) < 0.2
    assert not easier.likeness.harder and easier.axes["x"].applied
    assert abs(easier.likeness.doubt - np.log(0.1 / 0.08)) < 0.05
    assert easier.axes["x"].slope_error > 2 * alike.axes["x"].slope_error


def test_a_difference_within_chance_is_none():
    few = compare(several(0, 1, valid=0.9), several(50, 1, valid=0.85))
    assert not few.harder and few.invalid_share.error > 0.01


def test_vectors_without_stated_deviation_are_compared_by_their_validity():
    single = compare(several(0, 4, stated=False), several(50, 4, stated=False, valid=0.8))
    assert single.deviation_voxel is None and single.doubt == 0.0 and single.harder
    assert compare([], several(50, 1)) is None
