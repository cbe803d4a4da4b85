"""A gamma curve shows in counts that never occur; images in proportion to light show none, however they were scaled."""

import numpy as np
import pytest

from lfpiv.lightfield.tone_curve import tone_exponent

EXPONENT = 0.03
"""Largest error of a gamma curve's exponent."""


@pytest.fixture(scope="module")
def linear():
    """Particles over a dark level of 30 counts, 12 bits."""
    rng = np.random.default_rng(3)
    light = rng.exponential(200, (400, 400)) * (rng.random((400, 400)) < 0.3)
    return np.clip(np.round(30 + light + 4 * rng.standard_normal(light.shape)), 0, 4095)


@pytest.mark.parametrize("largest", [4095, 65535])
@pytest.mark.parametrize("gamma", [1.5, 1.8, 2.2, 2.6])
def test_the_exponent_of_a_gamma_curve_is_found(linear, gamma, largest):
    curved = np.round(largest * (linear / 4095) ** (1 / gamma)).astype(np.float32)
    assert abs(tone_exponent(curved) - gamma) < EXPONENT


@pytest.mark.parametrize(
    "scaled",
    [
        pytest.param(lambda image, noise: image, id="as recorded"),
        pytest.param(lambda image, noise: 16 * image, id="12 bits in 16"),
        pytest.param(lambda image, noise: np.round(16 * image * (1 + 0.02 * noise)), id="each pixel with a gain"),
        pytest.param(lambda image, noise: np.round(image / 16), id="8 bits"),
        pytest.param(lambda image, noise: image / 4095, id="between 0 and 1"),
        pytest.param(lambda image, noise: np.round(1.37 * image), id="stretched"),
        pytest.param(lambda image, noise: np.where(noise < -3, 0, image), id="dead pixels"),
        pytest.param(lambda image, noise: np.maximum(image - 60, 0), id="clipped at the dark level"),
        pytest.param(lambda image, noise: np.round((image / 4095) ** 2 * 4095), id="darkened"),
        pytest.param(lambda image, noise: np.full_like(image, 7.0), id="uniform"),
    ],
)
def test_images_without_a_gamma_curve_are_not_doubted(linear, scaled):
    noise = np.random.default_rng(4).standard_normal(linear.shape)
    assert tone_exponent(scaled(linear, noise).astype(np.float32)) == 1
