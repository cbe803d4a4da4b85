"""Saturated pixels, found by the value at which the pixels of an image pile up."""

import numpy as np
import pytest

from lfpiv.lightfield.saturation import SATURATED, saturated_pixels, saturated_share

CLIPPED = np.exp(-4095 / 900) / np.exp(-4095 / 1800)  # of the bright pixels of exponential light with a mean of 900
NOISE = 0.012  # three standard deviations of that share, with a step of rounding at 8 bits


def light(seed=0):
    return np.random.default_rng(seed).exponential(900, (500, 500))


@pytest.mark.parametrize("level", [4095, 4064, 4047, 4031, 3300, 250, 187])
@pytest.mark.parametrize("step", [1, 16])
def test_the_share_is_the_same_at_every_clipping_level(level, step):
    """Ends of ranges, white levels of headers, levels less a dark level, look-up tables; hot pixels above or not."""
    image = (np.minimum(light() * level / 4095, level).round() * step).astype(np.float32)
    hot = image.copy()
    hot.flat[::25_000] = 65535
    assert saturated_share(image) == pytest.approx(CLIPPED, abs=NOISE)
    assert saturated_share(hot) == pytest.approx(CLIPPED, abs=NOISE)
    assert np.array_equal(saturated_pixels(image), image == image.max())
    assert np.array_equal(saturated_pixels(hot), hot >= image.max())


def test_a_pile_that_corrections_of_the_camera_spread_is_found():
    image = np.minimum(light(), 4047) - np.random.default_rng(1).normal(0, 3, (500, 500))
    assert saturated_share(image.round()) == pytest.approx(CLIPPED, abs=NOISE)


def test_light_within_the_range_does_not_pile_up():
    rng = np.random.default_rng(2)
    assert saturated_share((light() / 4).round()) == 0
    assert saturated_share((light() / 100).round()) == 0  # few counts
    plateau = rng.normal(180, 2, (500, 500)).round()  # a white image of 8 bits
    assert saturated_share(plateau) == 0
    even = np.full((500, 500), 40.0)
    even[100:140, 100:140] = 900  # one particle under one lens, without noise
    assert saturated_share(even) == 0
    assert saturated_share(np.full((500, 500), 2700.0) * (light() < 500), piles=False) == 0


def white_image():
    """A white image of 12 bits, of which more than half lies within microimages."""
    rng = np.random.default_rng(3)
    return np.where(rng.random((500, 500)) < 0.6, rng.normal(2700, 45, (500, 500)), rng.uniform(30, 2700, (500, 500)))


@pytest.mark.parametrize("gamma", [1, 1.8, 2.2, 2.6])
@pytest.mark.parametrize("end", [2900, 3100, 3500, 4095, 5000])
def test_the_middles_of_microimages_in_8_bits_are_no_pile(gamma, end):
    """Half of a white image is as bright as the median. A curve moves its levels together."""
    assert saturated_share((255 * np.clip(white_image() / end, 0, 1) ** (1 / gamma)).round()) == 0


@pytest.mark.parametrize("level", [255, 247, 239, 191])
@pytest.mark.parametrize("share", [0.1, 0.2])
def test_noise_beside_a_pile_of_few_bits_does_not_hide_it(level, share):
    """Noise of 2 % is five values wide in 8 bits, and each of them holds more than a quarter of the pile."""
    white = white_image()
    clipped = np.minimum((white * level / np.quantile(white, 1 - share)).round(), level)
    assert saturated_share(clipped) == pytest.approx((clipped == level).sum() / (clipped > level / 2).sum())


@pytest.mark.parametrize("noise", [0.45, 0.6, 0.8, 1.2, 2])
def test_even_tops_of_microimages_are_no_pile_where_there_is_noise(noise):
    tops = 200.3 + np.random.default_rng(4).normal(0, noise, (500, 500))
    assert saturated_share(np.where(white_image() > 2500, tops, white_image() / 15).round()) == 0


def test_a_white_image_that_is_mostly_clipped_is_saturated():
    assert saturated_share(np.minimum(white_image(), 2600).round()) > 0.5


def test_hot_pixels_at_the_end_of_the_range_are_no_saturated_light():
    image = (light() / 4).round()
    image.flat[:: 250_000 // 40] = 4095
    assert saturated_share(image) == 0
    assert saturated_pixels(image).sum() == 40  # but they measure nothing


def test_a_stated_white_level_shows_what_few_pixels_do_not():
    image = (light() / 4).round()
    assert not saturated_pixels(image, white_level=image.max() + 1).any()
    top = np.sort(image.ravel())[-2000]
    assert saturated_pixels(image, white_level=top).sum() >= 2000
    assert saturated_share(image, white_level=top) > SATURATED
