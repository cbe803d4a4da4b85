"""Images of two bytes a pixel: exchanged bytes and low bytes of noise are found, and nothing else is."""

import numpy as np
import pytest
from scipy import ndimage

from lfpiv.experiment.pixel_bytes import fault

SHAPE = (200, 300)


@pytest.fixture(params=[0, 1, 2])
def light(request):
    """Spots on a dark level of 40 counts, 12 bits, noise of 3 counts."""
    rng = np.random.default_rng(request.param)
    spots = ndimage.gaussian_filter((rng.random(SHAPE) < 0.01) * rng.exponential(1, SHAPE), 2) * 30
    return np.clip(40 + 3000 * spots + rng.normal(0, 3, SHAPE), 0, 4095).round().astype(np.uint16)


def test_recorded_images_are_right(light):
    rng = np.random.default_rng(9)
    for sound in (light, light * 16, light // 16 * 256, light + rng.normal(0, 60, SHAPE), light / 7):
        assert fault(np.maximum(sound, 0).astype(np.float32)) is None
        assert fault(np.maximum(sound, 0).round().astype(np.float32)) is None
    for share in (0.001, 0.01, 0.05):  # dim light, and hot pixels that outweigh it
        points = np.where(rng.random(SHAPE) < share, rng.exponential(1500, SHAPE), 0).round()
        for dim in (light // 8, rng.poisson(light / 20), 60 + rng.normal(0, 8, SHAPE).round()):
            assert fault(np.minimum(dim + points, 4095).astype(np.float32)) is None
    for noise in (rng.integers(0, 4096, SHAPE), rng.normal(2000, 300, SHAPE).round(), rng.integers(0, 256, SHAPE)):
        assert fault(noise.astype(np.float32)) is None


def test_exchanged_bytes_and_a_low_byte_of_noise_are_named(light):
    rng = np.random.default_rng(9)
    points = np.where(rng.random(SHAPE) < 0.001, 3000, 0).astype(np.uint16)
    for image in (light, light * 16, np.maximum(light, points)):
        assert "two bytes are exchanged" in fault(image.byteswap().astype(np.float32))
    noise = rng.integers(0, 256, SHAPE)
    assert "low byte is noise" in fault((256 * (light > 2000) + noise).astype(np.float32))


@pytest.mark.parametrize(("dtype", "step"), [(np.uint16, 1), (np.uint8, 16)])
def test_numbers_below_zero_without_a_sign_are_named(light, dtype, step):
    below = (light.astype(int) - 40) // step
    assert "below zero" in fault(below.astype(dtype).astype(np.float32))
    assert fault(np.maximum(below, 0).astype(np.float32)) is None
    saturated = np.minimum(np.maximum(below, 0) * 12, np.iinfo(dtype).max)
    assert fault(saturated.astype(np.float32)) is None


def test_rows_of_two_exposures_in_turn_are_named(light):
    later = np.roll(light, 4, axis=1)
    later[::2] = light[::2]
    assert "interlaced" in fault(later.astype(np.float32))
    assert "interlaced" in fault((later // 16).astype(np.float32))
    assert fault((light * np.where(np.arange(len(light)) % 2, 1.05, 1)[:, None]).round().astype(np.float32)) is None


@pytest.mark.parametrize("pitch", [1.9, 2.0, 2.2])
def test_microimages_of_two_pixels_are_not_interlaced(pitch):
    y, x = np.indices(SHAPE)
    lattice = (1 + np.cos(2 * np.pi * x / pitch)) * (1 + np.cos(2 * np.pi * y / pitch))
    noise = np.random.default_rng(3).normal(0, 3, SHAPE)
    assert fault((40 + 500 * lattice + noise).round().clip(0).astype(np.float32)) is None
