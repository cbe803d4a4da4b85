"""Vector validation: outliers are replaced, good vectors of curved fields are not."""

import numpy as np
import pytest

from lfpiv.velocity import validation

pytestmark = pytest.mark.usefixtures("device")

SEARCH = (9, 9, 9)


def linear_field(shape, slope):
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    return index @ np.asarray(slope, float)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 2, 3), (1, 4, 5), (5, 6, 7)])
def test_steep_gradients_are_not_outliers(shape):
    field = linear_field(shape, [[2, 0, 1], [0, -3, 1], [1, 1, 2]])
    result, valid = validation.validate(field, np.full_like(field, np.nan), np.ones(shape, bool), SEARCH)
    assert valid.all()
    np.testing.assert_array_equal(result, field)


def test_outliers_are_found_and_replaced():
    rng = np.random.default_rng(6)
    shape = (8, 9, 10)
    truth = linear_field(shape, 0.3 * rng.normal(size=(3, 3)))
    field = truth + 0.05 * rng.normal(size=truth.shape)
    wrong = rng.random(shape) < 0.1
    field[wrong] += rng.choice((-1, 1), (wrong.sum(), 3)) * rng.uniform(2, 6, (wrong.sum(), 3))
    second = np.full_like(field, np.nan)
    rescued = wrong & (rng.random(shape) < 0.5)  # half of them have the truth as second peak
    second[rescued] = truth[rescued]
    missing = ~wrong & (rng.random(shape) < 0.05)
    field[missing] = np.nan
    result, valid = validation.validate(field, second, ~missing, SEARCH)
    assert not valid[wrong & ~rescued].any() and not valid[missing].any()
    assert valid[~wrong & ~missing].mean() > 0.98  # good vectors: noise is half of NOISE_VOXEL, rejections are rare
    assert valid[rescued].mean() > 0.9
    replaced = 0.5  # a median of linear neighbours at the edge of the grid misses by part of a step [voxel]
    assert np.abs(result - truth).max() < replaced


def test_a_known_field_helps_clear_peaks_only():
    rng = np.random.default_rng(9)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in (2, 9, 10)), indexing="ij"), -1).astype(float)
    bent = np.sin(1.5 * index[..., [2, 1, 2]] + index[..., [0, 0, 1]])  # bends from vector to vector, in two layers
    field = bent + 0.03 * rng.normal(size=bent.shape)
    wrong = rng.random(bent.shape[:3]) < 0.1
    field[wrong] += rng.choice((-1, 1), (wrong.sum(), 3)) * rng.uniform(1, 2, (wrong.sum(), 3))
    nowhere, measured = np.full_like(field, np.nan), np.ones(wrong.shape, bool)
    shares = []
    for ratio in (1.0, 4.0):
        known = {"predicted": bent + 0.2, "peak_ratio": np.full(wrong.shape, ratio)}
        valid = validation.validate(field, nowhere, measured, (3, 3, 3), **known)[1]
        assert valid[wrong].mean() < 0.2  # a few agree with what scatters around them
        shares.append(valid[~wrong].mean())
    plain = validation.validate(field, nowhere, measured, (3, 3, 3))[1]
    assert shares[0] == plain[~wrong].mean() < 0.8 and shares[1] > 0.98


def test_nothing_valid_gives_nothing():
    field = np.full((2, 3, 4, 3), np.nan)
    result, valid = validation.validate(field, field, np.zeros((2, 3, 4), bool), SEARCH)
    assert not valid.any() and np.isnan(result).all()
