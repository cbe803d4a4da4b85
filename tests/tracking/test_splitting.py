"""Two particles in place of one that the images do not fit."""

import numpy as np
import pytest
from scipy import optimize, sparse
from support.tracking_rig import SIGMA_VOXEL, VOXEL_MM, TrackingRig, noisy_scene

from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, refine
from lfpiv.tracking.splitting import DIRECTIONS, HALF_DISTANCES, fit_pairs, split

SCATTER = 0.3
LIGHT = 2e4
HALF_VOXEL = 0.85
"""Half of the distance of two particles, which give one candidate; it is no distance that is tried."""
NEAR_VOXEL = 0.7
"""Least squares lead from here to the places."""
EXACT_VOXEL = 0.05
"""Error of positions by noise, a few standard errors."""


@pytest.fixture(scope="module")
def images(device):
    return ParticleImages(cameras=TrackingRig().cameras, voxel_mm=VOXEL_MM, sigma_voxel=SIGMA_VOXEL)


def fitted(images, scene, places_mm, light):
    """Return candidates at places of least squares, and their equations."""
    cloud = Cloud(positions_mm=np.array(places_mm), light=np.array(light))
    return refine(images, scene, cloud, iterations=8, scatter=SCATTER)


def distances_voxel(positions_mm, places_mm):
    """Return how far each place is from the nearest position."""
    return np.linalg.norm(positions_mm[:, None] - places_mm, axis=2).min(0) / VOXEL_MM


@pytest.mark.parametrize("along", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.8, -0.5, 0.33)])
def test_two_particles_take_the_place_of_one_between_them(images, along):
    along = np.array(along) / np.linalg.norm(along)
    far, middle = np.array([-0.4, 0.4, 0.2]), np.array([0.2, -0.1, 0.05])
    places = np.stack([middle + sign * HALF_VOXEL * VOXEL_MM * along for sign in (1, -1)])
    light = np.array([[LIGHT, 1.3 * LIGHT], [1.2 * LIGHT, LIGHT], [LIGHT, LIGHT]])
    scene = noisy_scene(images, np.concatenate([places, [far]]), light)
    cloud, normal = fitted(images, scene, [middle, far], [light[:2].sum(0), light[2]])
    pair = split(images, scene, cloud, normal, np.array([True, True]))
    assert len(pair) == 2  # the particle that is one stays one
    assert (distances_voxel(pair.positions_mm, places) < NEAR_VOXEL).all()
    both = pair.joined(cloud[np.array([False, True])])
    after, _ = fitted(images, scene, both.positions_mm, both.light)
    assert (distances_voxel(after.positions_mm, places) < EXACT_VOXEL).all()


def test_nothing_is_split_that_is_not_chosen(images):
    places = np.array([[0.1, 0.1, 0.0], [0.1 + 1.7 * VOXEL_MM, 0.1, 0.0]])
    scene = noisy_scene(images, places, np.full((2, 2), LIGHT))
    cloud, normal = fitted(images, scene, [places.mean(0)], [[2 * LIGHT, 2 * LIGHT]])
    assert len(split(images, scene, cloud, normal, np.array([False]))) == 0
    assert len(split(images, scene, cloud, normal, np.array([True]))) == 2


def test_light_of_pairs_is_that_of_least_squares_without_negative_light():
    rng = np.random.default_rng(1)
    pairs, pixels = 40, 30
    values = rng.random((1 + 2 * pairs, pixels)) * (rng.random((1 + 2 * pairs, pixels)) > 0.4)
    weight, target = 0.1 + rng.random(pixels), rng.standard_normal(pixels) + 0.3
    light, explained = fit_pairs(sparse.csr_array(values), weight, target)
    root = np.sqrt(weight)
    alone = optimize.nnls((root * values[0])[:, None], root * target)[1]
    for number in range(pairs):
        both = (root * values[[1 + number, 1 + pairs + number]]).T
        expected, left = optimize.nnls(both, root * target)
        np.testing.assert_allclose(light[number], expected, atol=1e-10)
        assert explained[number] == pytest.approx(alone**2 - left**2)
    assert (light == 0).any() and (light > 0).all(1).any()


def test_directions_are_half_of_a_cubes_neighbours():
    assert len(DIRECTIONS) == 13 and np.allclose(np.linalg.norm(DIRECTIONS, axis=1), 1)
    opposite = np.abs(DIRECTIONS[:, None] + DIRECTIONS).max(2)
    assert opposite.min() > 0.1
    assert max(HALF_DISTANCES) <= 1.0  # farther ones are told apart as peaks
