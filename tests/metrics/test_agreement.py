"""Metrics of scattered vectors: known values, and what a shift, a scale or the order of vectors does to them."""

import numpy as np
import pytest

from lfpiv import metrics

COUNT = 4000


def errors(seed=0):
    return np.random.default_rng(seed).standard_normal(COUNT)


def test_a_line_is_found_whatever_the_weights():
    true = errors()
    for weight in (None, np.random.default_rng(1).random(COUNT)):
        found = metrics.linear_response(0.9 * true + 0.2, true, weight)
        centre = np.average(true, weights=weight)
        assert found.slope == pytest.approx(0.9) and found.offset == pytest.approx(0.2 - 0.1 * centre)


def test_the_slope_of_a_uniform_truth_is_unknown():
    found = metrics.linear_response(np.ones(5) + errors()[:5], np.ones(5))
    assert np.isnan(found.slope) and np.isfinite(found.offset)
    assert np.isnan(metrics.linear_response(np.empty(0), np.empty(0)).offset)


def test_a_weight_counts_like_as_many_vectors():
    true, weight = errors()[:50], np.arange(50) % 3
    measured = true + 0.1 * errors(2)[:50]
    once = metrics.linear_response(measured, true, weight.astype(float))
    repeated = metrics.linear_response(np.repeat(measured, weight), np.repeat(true, weight))
    assert (once.slope, once.offset) == pytest.approx((repeated.slope, repeated.offset))


def test_normal_errors_fit_their_standard_deviation():
    found = metrics.uncertainty_calibration(0.3 * errors(), np.full(COUNT, 0.3))
    four = 4 / np.sqrt(COUNT)  # standard errors of shares and widths are below 1 / sqrt(count)
    expected = (0.683, 0.954, 1.0, 1.0)
    assert (found.within_one, found.within_two, found.width, found.robust_width) == pytest.approx(expected, abs=four)
    twice = metrics.uncertainty_calibration(0.6 * errors(), np.full(COUNT, 0.3))
    assert twice.width == pytest.approx(2 * found.width) and twice.robust_width == pytest.approx(2 * found.robust_width)


def test_values_without_a_standard_deviation_are_left_out():
    error, sigma = np.array([1.0, np.nan, 5.0, 2.0]), np.array([1.0, 1.0, 0.0, np.nan])
    assert metrics.uncertainty_calibration(error, sigma).width == 1
    assert np.isnan(metrics.uncertainty_calibration(error[1:], sigma[1:]).within_one)


def test_quantiles_with_weights_are_those_of_repeated_values():
    values, weight = errors()[:60], 1 + np.arange(60) % 4
    for part in (0.1, 0.5, 0.9, 1.0):
        repeated = np.sort(np.repeat(values, weight))
        assert metrics.weighted_quantile(values, part, weight) == repeated[int(np.ceil(part * len(repeated))) - 1]


def test_the_curve_ends_where_vectors_end_and_ignores_their_order():
    length, size = np.array([0.3, 0.1, 0.2, 9.0]), np.array([1.0, 2.0, 1.0, 0.0])
    curve = metrics.error_curve(length, size, 8.0)
    assert curve.part.tolist() == [0.25, 0.375, 0.5] and curve.bound.tolist() == [0.1, 0.2, 0.3]
    assert curve.mean_at(0.5) == pytest.approx(0.175) and curve.bound_at(0.3) == 0.2 and np.isnan(curve.bound_at(0.51))
    again = metrics.error_curve(length[::-1], size[::-1], 8.0)
    assert np.array_equal(again.bound, curve.bound) and np.array_equal(again.part, curve.part)


def test_the_bootstrap_knows_the_error_of_a_mean():
    values = errors()

    def mean(weight):
        return {"mean": float(values @ weight / weight.sum())}

    alone = metrics.block_bootstrap(mean, np.arange(COUNT))["mean"]
    assert alone.value == pytest.approx(values.mean())
    assert alone.standard_error == pytest.approx(1 / np.sqrt(COUNT), rel=0.2)
    assert alone.low < alone.value < alone.high


def test_vectors_with_errors_in_common_are_fewer_samples():
    block = np.repeat(np.arange(100), 40)
    values = np.random.default_rng(3).standard_normal(100)[block]

    def mean(weight):
        return {"mean": float(values @ weight / weight.sum())}

    blocks, alone = (metrics.block_bootstrap(mean, one)["mean"] for one in (block, np.arange(COUNT)))
    assert blocks.standard_error == pytest.approx(0.1, rel=0.25)
    assert alone.standard_error < 0.3 * blocks.standard_error  # the wrong one
    few = metrics.block_bootstrap(mean, block // 40)["mean"]
    assert few.value == blocks.value and np.isnan(few.standard_error)


@pytest.mark.parametrize("bad", [np.array([1.0, np.nan]), np.ones((2, 2))])
def test_numbers_that_are_none_are_refused(bad):
    with pytest.raises(ValueError, match="finite numbers of shape"):
        metrics.linear_response(bad, np.ones(2))
    with pytest.raises(ValueError, match="weight"):
        metrics.weighted_quantile(np.ones(2), 0.5, -np.ones(2))
