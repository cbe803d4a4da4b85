"""A curve to fewer bits merges ever more counts into a value; a straight line merges equally many."""

import numpy as np
import pytest

from lfpiv.lightfield.merged_counts import MOST_VALUES, merged_exponent
from lfpiv.lightfield.tone_curve import tone_exponent

EXPONENT = 0.35
"""Largest error of a curve's exponent."""


@pytest.fixture(scope="module")
def linear():
    """Particles over a dark level of 60 counts, 12 bits."""
    rng = np.random.default_rng(5)
    light = rng.exponential(300, (1000, 1000)) * (rng.random((1000, 1000)) < 0.4)
    light = rng.poisson(2 * light) / 2  # two electrons a count
    return np.clip(np.round(60 + light + 4 * rng.standard_normal(light.shape)), 0, 4095)


def srgb(light):
    return np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def power(gamma):
    return lambda light: light ** (1 / gamma)


@pytest.mark.parametrize("store", [np.round, np.floor])
@pytest.mark.parametrize(
    ("curve", "gamma"), [(power(1.5), 1.5), (power(1.8), 1.8), (power(2.2), 2.2), (power(2.6), 2.6), (srgb, 2.2)]
)
def test_the_exponent_of_a_table_from_12_to_8_bits_is_found(linear, curve, gamma, store):
    curved = store(255 * curve(linear / 4095))
    assert abs(tone_exponent(curved) - gamma) < EXPONENT


@pytest.mark.parametrize("unit", [16, 257])
def test_a_curve_is_found_in_values_that_were_multiplied(linear, unit):
    assert tone_exponent(unit * np.round(255 * (linear / 4095) ** (1 / 2.2))) > 1.8


@pytest.mark.parametrize(
    "scaled",
    [
        pytest.param(lambda image: image // 16, id="upper 8 bits"),
        pytest.param(lambda image: np.round(image / 16), id="half rounded to even"),
        pytest.param(lambda image: np.round(image * 255 / 4095), id="full scale to full scale"),
        pytest.param(lambda image: image // 4, id="10 bits"),
        pytest.param(lambda image: np.clip(np.round(image / 3.3), 0, 255), id="stretched by 3.3 counts"),
        pytest.param(lambda image: np.clip(np.floor((image - 17) / 5.71), 0, 255), id="stretched by 5.71 counts"),
        pytest.param(lambda image: np.clip(np.round(image / 1.6), 0, 1023), id="stretched by 1.6 counts"),
        pytest.param(lambda image: np.round(np.round(2.7 * image) / 16), id="a digital gain before"),
        pytest.param(lambda image: np.round(image * np.where(np.arange(1000) % 2, 1.07, 1) / 4), id="two amplifiers"),
        pytest.param(lambda image: np.maximum(image - 63, 0) // 4, id="without a dark level"),
        pytest.param(lambda image: np.zeros_like(image), id="dark"),
    ],
)
def test_counts_in_proportion_to_light_are_not_doubted(linear, scaled):
    assert tone_exponent(scaled(linear)) == 1


def test_noise_alone_shows_no_curve():
    rng = np.random.default_rng(6)
    for level in (20, 100, 200):
        assert tone_exponent(np.clip(np.round(level + 6 * rng.standard_normal((1000, 1000))), 0, 255)) == 1


def test_single_values_with_more_pixels_show_no_curve(linear):
    image = linear // 16
    for value in (14, 25, 26, 40):  # such as those of replaced pixels
        image[np.random.default_rng(value).random(image.shape) < 1e-3] = value
    assert tone_exponent(image) == 1


def test_many_values_are_not_looked_at():
    assert merged_exponent(np.full(MOST_VALUES + 1, 1000)) == 1
