"""Level and noise of the background between particles."""

import numpy as np
import pytest
from support.ideal_rig import lattice, optics

from lfpiv.lightfield.microimage_layout import microimage_centres
from lfpiv.tracking.surroundings import surroundings, whole_pixels

SHAPE = (240, 288)
LEVEL, NOISE = 12.0, 7.0
TOLERANCE = 0.15
"""Clipping of bright pixels shortens the upper tail of noise [noise]."""


def background(seed=0):
    return LEVEL + NOISE * np.random.default_rng(seed).standard_normal(SHAPE)


def everywhere():
    return np.ones(SHAPE, bool)


def test_level_and_noise_are_those_of_the_background_beside_particles():
    image = background()
    lit = np.random.default_rng(1).random(SHAPE) < 0.15
    image[lit] += 40 * NOISE
    level, noise = surroundings(image, 1.0, everywhere())
    assert np.abs(level - LEVEL).max() < 2 * TOLERANCE * NOISE
    assert np.abs(level.mean() - LEVEL) < TOLERANCE * NOISE
    assert noise.mean() == pytest.approx(NOISE, rel=TOLERANCE)


def test_dense_light_is_no_background():
    """Where few pixels are dark, the noise that is given holds and nothing is subtracted."""
    level, noise = surroundings(background(), 3.0, np.zeros(SHAPE, bool))
    assert np.all(level == 0) and np.all(noise == 3.0)


def test_remains_of_standing_light_have_their_own_level_and_noise():
    standing = np.zeros(SHAPE)
    standing[:, 100:180] = np.linspace(50, 400, 80)
    image = background() + 0.1 * standing
    image += np.sqrt(standing) * np.random.default_rng(2).standard_normal(SHAPE)
    level, noise = surroundings(image, 1.0, everywhere(), standing)
    inside = standing > 0
    assert np.abs(level - LEVEL - 0.1 * standing)[inside].mean() < 5 * TOLERANCE * NOISE
    true = np.sqrt(NOISE**2 + standing)
    assert np.abs(noise / true - 1)[inside].mean() < TOLERANCE
    assert level[:, :60].mean() == pytest.approx(LEVEL, abs=TOLERANCE * NOISE)


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_pixels_inside_microimages_are_near_their_centres(layout):
    camera, lenses = optics(rows=120, columns=140, layout=layout), lattice(layout, 0.3)
    inside = whole_pixels(camera, lenses)
    _, centres = microimage_centres(camera, lenses, 20)
    rows, columns = np.nonzero(inside)
    place = np.stack([columns, rows], axis=1) + 0.5
    nearest = np.sqrt(np.square(place[:, None] - centres.reshape(-1, 2)).sum(-1).min(1))
    radius = camera.pupil_radius_mm * camera.sensor_per_pupil / camera.pixel_mm
    assert nearest.max() < radius
    assert 0.4 < inside.mean() < 0.8
