"""Intensity capping: the limit it takes from an image, and what it does to particles of unlike brightness."""

import numpy as np
import pytest
from support import plain_steps
from support.ideal_rig import two_cameras

import lfpiv
from lfpiv.reconstruction.image_preparation import prepare_images
from lfpiv.reconstruction.intensity_cap import CAP, POINT_CAP, typical_peak
from lfpiv.reconstruction.particle_size import ParticleSizer

NOISE = 2.0  # [counts]
PITCH_PX = 18.2
SEEDS = (3, 4, 5, 6)
LEAST_GAIN = 0.03  # of Q, mean of the seeds, brightness log-normal by 1 in each camera; measured 0.054
LARGEST_LOSS = 0.01  # of Q, mean of the seeds, equally bright particles; measured 0.005


def spots(counts, seed=0):
    """Image with a spot of 3 x 3 pixels of given counts in the middle of each of 20 x 20 squares, and noise."""
    image = np.random.default_rng(seed).normal(0, NOISE, (20 * 18 + 5, 20 * 18 + 5)).astype(np.float32)
    for number, count in enumerate(counts):
        row, column = 18 * (number // 20) + 8, 18 * (number % 20) + 8
        image[row : row + 3, column : column + 3] += count
    return image


def test_the_typical_peak_is_that_of_most_lit_microimages():
    """Dark microimages do not count, and few bright particles or hot pixels do not change it."""
    plain = spots([500.0] * 300)
    assert typical_peak(plain, PITCH_PX, NOISE) == pytest.approx(500, abs=3 * NOISE)
    bright = spots([500.0] * 280 + [50_000.0] * 20)
    assert typical_peak(bright, PITCH_PX, NOISE) == pytest.approx(500, abs=3 * NOISE)
    assert typical_peak(7 * plain, PITCH_PX, 7 * NOISE) == pytest.approx(7 * typical_peak(plain, PITCH_PX, NOISE))


def test_noise_alone_has_no_typical_peak():
    assert typical_peak(spots([]), PITCH_PX, NOISE) == np.inf


@pytest.fixture(scope="module")
def weights(device):
    """All of a small volume, seen by two cameras in the middle of their sensors."""
    return lfpiv.build_weights(
        two_cameras(), lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 1.2, 0.8), voxel_mm=0.1)
    )


def scene(weights, spread, seed, size=0.5, share=0.02):
    """Truth with equally bright particles, and images whose particles have a brightness of their own per camera."""
    grid, rng = weights.grid, np.random.default_rng(seed)
    count = round(share * grid.size)
    place = np.array(grid.first_centre_mm)[::-1] + grid.voxel_mm * (rng.random((count, 3)) * grid.shape[::-1] - 0.5)
    truth = 3e4 * lfpiv.metrics.truth_volume(place, None, grid, size).values
    images = {}
    for name in weights.cameras:
        brightness = np.exp(spread * rng.standard_normal(count) - spread**2 / 2)
        image = weights(3e4 * lfpiv.metrics.truth_volume(place, brightness, grid, size).values)[name]
        images[name] = image + rng.normal(0, NOISE, image.shape).astype(np.float32)
    return truth, images


def quality(weights, images, truth, cap):
    volume = plain_steps.reconstruct(weights, images, 20, intensity_cap=cap, tolerance=5e-4).values
    return float((volume * truth).sum() / np.sqrt(np.square(volume).sum() * np.square(truth).sum()))


@pytest.mark.slow
def test_counts_are_limited_by_each_pixel_s_gain_and_dim_ones_stay(weights):
    _, images = scene(weights, 1.0, 1)
    before, after = (
        prepare_images(weights, images, floor=None, floor_share=0.1, intensity_cap=cap) for cap in (0.0, CAP)
    )
    for name, image in images.items():
        pitch = weights.cameras[name].optics.microimage_pitch_px
        peak = typical_peak(before[name].image.reshape(image.shape), pitch, NOISE)
        assert before[name].image.max() > CAP * peak
        expected = np.minimum(before[name].image, CAP * peak * weights.gain(name))
        assert after[name].image == pytest.approx(expected, rel=0.02)  # the noise of the floor is measured
        assert after[name].light_outside == before[name].light_outside
        assert after[name].floor < before[name].floor


@pytest.mark.slow
def test_particles_of_unlike_brightness_are_found_better_and_equal_ones_as_well(weights):
    change = {}
    for spread in (1.0, 0.0):
        scenes = [scene(weights, spread, seed) for seed in SEEDS]
        quotients = [[quality(weights, images, truth, cap) for cap in (0.0, CAP)] for truth, images in scenes]
        change[spread] = float(np.diff(quotients).mean())
    assert change[1.0] > LEAST_GAIN
    assert change[0.0] > -LARGEST_LOSS


@pytest.fixture(scope="module")
def sizer(weights):
    return ParticleSizer(weights)


def test_the_scatter_of_the_brightness_is_that_of_a_log_normal_one(weights, sizer):
    """<a><a^3> / <a^2>^2 is exp(s^2), twice the number of particles or not; of some 20 particles it is hardly known."""

    def scatter(spread, share):
        scenes = (scene(weights, spread, seed, share=share)[1] for seed in range(8))
        return np.mean([sizer.brightness_scatter(sizer.fluctuations(images), 0.5) for images in scenes])

    for share in (0.02, 0.04):
        assert scatter(0.5, share) / scatter(0.0, share) == pytest.approx(np.exp(0.25), abs=0.12)


def test_the_scatter_of_the_brightness_does_not_depend_on_the_light(weights, sizer):
    _, images = scene(weights, 1.0, 2)
    dimmer = {name: image / 4 for name, image in images.items()}
    bright, dim = (sizer.brightness_scatter(sizer.fluctuations(seen), 0.5) for seen in (images, dimmer))
    assert dim == pytest.approx(bright, rel=1e-4)


def test_noise_has_no_scatter_of_the_brightness(weights, sizer):
    rng = np.random.default_rng(7)
    images = {name: rng.normal(0, NOISE, image.shape) for name, image in scene(weights, 0.0, 7)[1].items()}
    assert sizer.brightness_scatter(sizer.fluctuations(images), 0.5) is None
    assert (
        plain_steps.reconstruct(weights, images, 0, intensity_cap="auto", sieve_voxel="auto").intensity_cap == POINT_CAP
    )


@pytest.mark.parametrize(
    ("spread", "size", "sieve", "expected"),
    [
        (1.0, 0.0, "auto", POINT_CAP),
        (1.0, 0.9, "auto", CAP),
        (1.0, 0.0, 0.0, CAP),
        (0.0, 0.0, "auto", 0.0),
        (0.0, 0.9, "auto", 0.0),
    ],
)
def test_the_cap_suits_the_particles_brightness_and_size(weights, spread, size, sieve, expected):
    _, images = scene(weights, spread, 5, size)
    assert (
        plain_steps.reconstruct(weights, images, 0, intensity_cap="auto", sieve_voxel=sieve).intensity_cap == expected
    )
    assert plain_steps.reconstruct(weights, images, 0, sieve_voxel=sieve).intensity_cap == 0


@pytest.mark.parametrize("cap", [-1.0, float("nan"), "2"])
def test_a_cap_out_of_its_range_is_refused(weights, cap):
    _, images = scene(weights, 0.0, 5)
    with pytest.raises(ValueError, match="intensity_cap: expected a number >= 0"):
        plain_steps.reconstruct(weights, images, 1, intensity_cap=cap)
