"""Light that stands still in a series: found where it is, and nowhere else; at the laser's power of each image."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support import ideal_rig

from lfpiv.lightfield.background import (
    Series,
    median_light,
    overlapping_by_chance,
    recorded_light,
    standing_light,
)
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.standing_light import LARGE_REMAINS, mode, remains_warnings
from lfpiv.warn import Code

NOISE = 3.0  # counts
BRIGHT = 300.0  # counts of a particle
SATURATION = 4095.0
SHARE_LEFT = 0.1
"""Error of the standing light relative to it, root mean square: chance overlap of a few images' particles."""
POWER_ERROR = 0.03
"""Error of an image's laser power: a mode of some thousand pixels with photon noise, half of them lit by particles."""


@pytest.fixture(scope="module")
def decoder():
    """The decoder of an evenly lit sensor of 400 x 480 pixels."""
    optics, lattice = ideal_rig.optics(), ideal_rig.lattice()
    even = LightFieldDecoder.from_white(optics, lattice, np.full(optics.sensor_shape, 1000.0), np.zeros((400, 480)))
    return dataclasses.replace(even, counts_per_photon=0.4)


def particles(decoder, seed, count=400):
    """Light of particles [counts]: blobs at random places, each in several microimages."""
    rng = np.random.default_rng(seed)
    light = np.zeros(decoder.gain.shape)
    rows, columns = (rng.integers(0, n, (count, 9)) for n in light.shape)
    np.add.at(light, (rows, columns), 2 * np.pi * 2.0**2 * BRIGHT)
    return gaussian_filter(light, 2.0)


def record(light, seed):
    """Light as a camera of 12 bits records it, photon noise of 0.4 counts per count included."""
    rng = np.random.default_rng(seed)
    noisy = rng.poisson(np.maximum(light, 0) / 0.4) * 0.4 + NOISE * rng.standard_normal(light.shape)
    return np.minimum(np.rint(noisy), SATURATION).astype(np.float32)


def streak(decoder, peak=2000.0):
    """Standing light: a bar across the sensor [counts]."""
    columns = np.arange(decoder.gain.shape[1])
    return np.broadcast_to(peak * np.exp(-0.5 * ((columns - 150) / 10) ** 2), decoder.gain.shape)


def series(decoder, standing, pairs, *, power=None, level=1.0, second=0.9, at_rest=False):
    """Series of both frames: particles that move and light that stands, in the second frame times `second`."""
    found = Series(decoder, 0), Series(decoder, 1)
    for pair in range(pairs):
        for frame, one in enumerate(found):
            light = level * particles(decoder, [0, 0] if at_rest else [pair, frame])
            light = light + standing * (1 if power is None else power[pair]) * (second if frame else 1)
            image = record(light, [9, pair, frame])
            one.add(image, NOISE, image >= SATURATION)
    return found


@pytest.mark.parametrize(
    ("pairs", "level"), [(1, 1.0), (3, 0.2), (3, 1.0), pytest.param(8, 0.2, marks=pytest.mark.slow)]
)
def test_particles_alone_show_nothing_that_stands(decoder, pairs, level):
    found = standing_light(*series(decoder, np.zeros(decoder.gain.shape), pairs, level=level))
    assert not found.found and not found.light[0].any() and not found.pixels.any() and found.place == ""


def thin(decoder, standing, overlapping=None):
    """Series of four images of 9 particles, one of which is near the same place in all."""
    found = Series(decoder, 0, overlapping)
    for number in range(4):
        light = np.zeros(decoder.gain.shape)
        rng = np.random.default_rng([5, number])
        near = 200 + rng.integers(-6, 7), 240 + rng.integers(-6, 7)
        places = [near, *zip(*(rng.integers(40, n - 40, 8) for n in light.shape), strict=True)]
        for row, column in places:  # each in nine microimages
            light[row - 20 : row + 21 : 20, column - 20 : column + 21 : 20] += 2 * np.pi * 3.0**2 * BRIGHT
        image = record(gaussian_filter(light, 3.0) + standing, [9, number])
        found.add(image, NOISE, image >= SATURATION)
    return found


def test_few_particles_that_overlap_by_chance_do_not_stand(decoder):
    """Against all four images, shifted, their light stands: no others overlap. Two images overlap elsewhere."""
    nothing_stands = np.zeros(decoder.gain.shape)
    first = thin(decoder, nothing_stands)
    assert standing_light(first, None).region.any()
    few = overlapping_by_chance(first)
    assert few is not None and few < first.count
    assert not standing_light(thin(decoder, nothing_stands, few), None).region.any()
    assert standing_light(thin(decoder, streak(decoder), few), None).region[:, 150].mean() > 0.9
    assert overlapping_by_chance(series(decoder, nothing_stands, 3)[0]) is None  # dense


@pytest.mark.parametrize("pairs", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_a_reflection_is_found_where_it_is(decoder, pairs):
    true = streak(decoder)
    found = standing_light(*series(decoder, true, pairs))
    error = [np.sqrt(np.mean((light - part * true) ** 2)) for light, part in zip(found.light, (1, 0.9), strict=True)]
    assert max(error) < SHARE_LEFT * np.sqrt(np.mean(true**2))
    assert found.ratio == pytest.approx(0.9, abs=POWER_ERROR)
    assert found.pixels[:, 150].all() and not found.pixels[:, 250:].any()


@pytest.mark.slow
@pytest.mark.parametrize("estimate", ["minimum", "median"])
def test_the_minimum_and_the_median_of_sparse_particles_are_the_reflection(decoder, estimate):
    """Both take every pixel, brighter than chance or not; few particles overlap in half of nine images."""
    standing, found, images = streak(decoder), (Series(decoder, 0), Series(decoder, 1)), ([], [])
    for pair in range(9):
        for frame, one in enumerate(found):
            image = record(particles(decoder, [pair, frame], count=40) + standing, [9, pair, frame])
            one.add(image, NOISE, image >= SATURATION)
            images[frame].append(image)
    light = median_light(*found, images) if estimate == "median" else standing_light(*found, everywhere=True)
    for frame in light.light:
        assert np.sqrt(np.mean((frame - standing) ** 2)) < SHARE_LEFT * np.sqrt(np.mean(standing**2))
    assert not light.unusable.any()


@pytest.mark.parametrize("everywhere", [False, True])
def test_noise_cut_off_at_0_neither_stands_nor_sticks(decoder, everywhere):
    """The smallest count of most dark pixels is 0 then, which noise has not lowered further."""
    standing, found = streak(decoder), (Series(decoder, 0), Series(decoder, 1))
    for pair in range(6):
        for frame, one in enumerate(found):
            image = np.maximum(record(particles(decoder, [pair, frame], count=40) + standing, [8, pair, frame]), 0)
            one.add(image, NOISE, image >= SATURATION)
    light = standing_light(*found, everywhere=everywhere)
    assert not light.unusable.any()
    for frame in light.light:
        assert np.sqrt(np.mean((frame - standing) ** 2)) < SHARE_LEFT * np.sqrt(np.mean(standing**2))
        assert frame[:, 300:].mean() < NOISE / 2


def test_frames_lit_by_unlike_lasers_have_backgrounds_of_their_own(decoder):
    one, other = series(decoder, streak(decoder), 8)
    moved = Series(decoder, 1)
    for pair in range(8):
        image = record(particles(decoder, [pair, 5]) + np.roll(streak(decoder), 200, 1), [7, pair])
        moved.add(image, NOISE, image >= SATURATION)
    found = standing_light(one, moved)
    assert found.ratio is None and other.count == moved.count
    assert found.light[0][:, 150].mean() > 1500 and found.light[1][:, 350].mean() > 1500
    assert found.light[0][:, 350].mean() < 100 and found.light[1][:, 150].mean() < 100


def test_smooth_stray_light_is_found_in_one_pair(decoder):
    found = standing_light(*series(decoder, np.full(decoder.gain.shape, 60.0), 1, second=1.0))
    assert found.stray == pytest.approx(60, abs=2 * NOISE) and not found.region.any()


def test_saturated_and_stuck_pixels_are_unusable(decoder):
    standing = np.zeros(decoder.gain.shape)
    standing[100:200, 100:200] = 2 * SATURATION
    images = series(decoder, standing, 3)
    for one in images:  # a hot pixel reads the same in every image
        one.smallest[300, 300] = one.largest[300, 300] = 3000
    found = standing_light(*images)
    assert found.unusable[110:190, 110:190].all() and found.unusable[300, 300]
    assert not found.unusable[:, 210:290].any()
    light, _ = found.subtract(record(standing, 1), NOISE, 0)
    assert (light[found.unusable] == 0).all()


def test_one_pair_shows_saturated_areas_but_not_saturated_particles(decoder):
    standing = np.zeros(decoder.gain.shape)
    standing[100:220, 100:220] = 2 * SATURATION
    assert standing_light(*series(decoder, standing, 1)).place.startswith("columns ")
    for level in (10, 40):
        images = series(decoder, np.zeros(decoder.gain.shape), 1, level=level, at_rest=True)
        assert (images[0].saturated > 0).any() and not standing_light(*images).found


def test_particles_at_rest_are_no_background(decoder):
    found = standing_light(*series(decoder, np.zeros(decoder.gain.shape), 4, at_rest=True))
    assert found.at_rest and not found.found


def test_the_lasers_power_of_each_image_counts(decoder):
    found = standing_light(*series(decoder, streak(decoder), 6))
    pure = particles(decoder, [50, 0])
    for power in (0.9, 1.0, 1.15):
        image = record(pure + power * streak(decoder), 77)
        relative = found.power(image, 0) * found.light[0][:, 150].mean() / 2000
        assert relative == pytest.approx(power, abs=POWER_ERROR)
        left, noise = found.subtract(image, NOISE, 0)
        assert abs(np.mean((left - pure)[found.region])) < SHARE_LEFT * 300 and noise >= NOISE


def test_light_that_stays_after_subtraction_is_named(decoder):
    found = standing_light(*series(decoder, streak(decoder), 6))
    frames = [record(particles(decoder, [50, frame]) + streak(decoder), [3, frame]) for frame in (0, 1)]
    (warning,) = remains_warnings(found, *frames, "left")
    assert warning.code is Code.STANDING and "columns 1" in warning.sentence and "left" in warning.sentence
    subtracted = [found.subtract(image, NOISE, number)[0] for number, image in enumerate(frames)]
    assert found.remains(*subtracted) < LARGE_REMAINS / 2 and not remains_warnings(found, *subtracted, "left")


def test_a_background_image_is_subtracted_as_it_is(decoder):
    image = record(streak(decoder), 1)
    clipped = np.zeros(image.shape, bool)
    found = recorded_light([(image, NOISE, clipped), (image, NOISE, clipped)], decoder)
    left, _ = found.subtract(record(streak(decoder), 2), NOISE, 1)
    assert abs(left.mean()) < NOISE and found.found and found.region[:, 150].all()


def test_the_mode_ignores_a_tail_on_one_side():
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(5, 1, 20000), 5 + rng.exponential(50, 20000)])
    assert mode(values) == pytest.approx(5, abs=0.5)
    assert mode(np.array([2.0])) == 2
