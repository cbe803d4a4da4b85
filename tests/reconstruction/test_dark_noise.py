"""Noise of dark pixels against the noise put into images of known light, cut off at 0 or not."""

import numpy as np
import pytest
from support.noisy_blobs import noisy_blobs

from lfpiv.reconstruction.dark_noise import LEAST_PIXELS, dark_noise

TOLERANCE_LIGHT = 0.1  # faint light beside dark pixels adds to their noise: measured up to 0.05
TOLERANCE_WHOLE = 0.25  # positive whole counts are at least 1: of noise of 1.5 counts 0.2 too much
WHOLE = 1 / np.sqrt(12)  # noise of rounding [counts]


@pytest.fixture(scope="module")
def lights(device):
    """Images of 1, 10 and 120 blobs without noise; the last one without its dark margin."""
    found = {}
    for count in (1, 10, 120):
        weights, truth, _ = noisy_blobs(count)
        image = weights(truth)["cam1"]
        rows, columns = (np.flatnonzero(weights(np.ones_like(truth))["cam1"].any(axis)) for axis in (1, 0))
        found[count] = image[rows[0] : rows[-1], columns[0] : columns[-1]] if count == 120 else image
    return found


def noisy(light, sigma, seed=0):
    return light + sigma * np.random.default_rng(seed).standard_normal(light.shape).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.3, 2.0, 8.0, 60.0])
@pytest.mark.parametrize("count", [1, 10, 120])
def test_the_noise_is_that_put_into_the_image_cut_off_or_not(lights, count, sigma):
    image = noisy(lights[count], sigma)
    lit = (lights[count] > sigma).mean()
    assert 0.01 < lit < 0.85
    assert dark_noise(image) == pytest.approx(sigma, rel=TOLERANCE_LIGHT)
    assert dark_noise(np.maximum(image, 0)) == dark_noise(image)


@pytest.mark.parametrize("sigma", [1.5, 3.0, 5.0])
def test_of_whole_counts_it_holds_the_noise_of_rounding(lights, sigma):
    found = dark_noise(np.rint(np.maximum(noisy(lights[120], sigma), 0)).astype(np.uint16))
    assert found == pytest.approx(np.hypot(sigma, WHOLE), rel=TOLERANCE_WHOLE)


@pytest.mark.parametrize("sigma", [0.3, 0.5])
def test_noise_below_a_count_is_that_of_one_count(lights, sigma):
    """No positive whole count is smaller. Five of them are hardly light."""
    found = dark_noise(np.rint(np.maximum(noisy(lights[120], sigma), 0)))
    assert found == pytest.approx(1, rel=TOLERANCE_LIGHT)


def test_hot_and_dead_pixels_and_areas_set_to_zero_change_nothing(lights):
    image, rng = np.maximum(noisy(lights[10], 8.0), 0), np.random.default_rng(1)
    found = dark_noise(image)
    hot, dead, area = image.copy(), image.copy(), image.copy()
    hot[rng.random(image.shape) < 1e-3] = 4095
    hot[200, 240] = 65535
    dead[rng.random(image.shape) < 0.02] = 0
    area[: len(area) // 5] = 0
    for changed in (hot, dead, area):
        assert dark_noise(changed) == pytest.approx(found, rel=TOLERANCE_LIGHT / 2)


def test_images_without_noise_and_without_dark_pixels_have_none(lights):
    assert [dark_noise(image) for image in lights.values()] == [0, 0, 0]
    raised = noisy(np.full((400, 400), 40, np.float32), 5.0)
    assert dark_noise(raised) == 0
    few = np.zeros((100, 100), np.float32)
    few[1:-1:2, 1:-1:10][: LEAST_PIXELS // 10, : LEAST_PIXELS // 10 - 1] = 3
    assert 0 < np.count_nonzero(few) < LEAST_PIXELS and dark_noise(few) == 0
