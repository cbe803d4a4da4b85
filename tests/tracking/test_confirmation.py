"""False particles: without light in a camera, and pieces of a brighter particle; clipped pixels."""

import numpy as np
import pytest
from support.tracking_rig import READ_NOISE, SIGMA_VOXEL, VOXEL_MM, TrackingRig

from lfpiv import find_particles
from lfpiv.metrics.particles import match_particles
from lfpiv.tracking import confirmation
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Scene, linearise, rendered

SCATTER = 0.3
PLACES = np.array([[-0.4, -0.4, -0.2], [0.4, 0.4, 0.2], [-0.4, 0.45, 0.1]])


@pytest.fixture(scope="module")
def rig(device):
    return TrackingRig()


def model_of(rig):
    return ParticleImages(cameras=rig.cameras, voxel_mm=VOXEL_MM, sigma_voxel=SIGMA_VOXEL)


def scene_of(images, positions, light, seed=0):
    true = rendered(images, images.lists(positions), light)
    noise = READ_NOISE * np.random.default_rng(seed).standard_normal(true.shape)
    return Scene(counts=(true + noise).astype(np.float32), read_variance=np.full_like(true, READ_NOISE**2))


def test_light_is_told_by_the_images_alone(rig):
    """The light of the other camera must not stand for light that a camera does not show."""
    images, light = model_of(rig), np.full((3, 2), 2e4)
    scene = scene_of(images, PLACES, light * [[1, 1], [1, 0], [1, 1]])
    normal = linearise(images, scene, Cloud(positions_mm=PLACES, light=light), 0.05)
    found = confirmation.signals(normal, 0.05)
    assert confirmation.shown(normal, found, 0.02, 0.0).tolist() == [[True, True], [True, False], [True, True]]
    assert found.ratio[1] < confirmation.SIGNIFICANCE < found.ratio[0]
    assert found.light[0] == pytest.approx(2e4, rel=0.1)


def test_light_within_the_error_of_a_brighter_particle_is_not_confirmed(rig):
    images = model_of(rig)
    places = np.array([[0.0, 0.0, 0.0], [0.12, 0.05, 0.0]])
    light = np.array([[1e5, 1e5], [4e3, 4e3]])
    normal = linearise(images, scene_of(images, places, light), Cloud(positions_mm=places, light=light), SCATTER)
    found = confirmation.signals(normal, SCATTER)
    assert confirmation.shown(normal, found, 0.005, 0.0).all(1).tolist() == [True, True]
    assert confirmation.shown(normal, found, 0.2, 0.0).all(1).tolist() == [True, False]


def test_error_of_the_model_is_measured(rig):
    images, light = model_of(rig), np.full((3, 2), 5e4)
    cloud = Cloud(positions_mm=PLACES, light=light)
    errors = []
    for wrong in (1.0, 1.15):
        scene = scene_of(images.of_size(SIGMA_VOXEL * wrong), PLACES, light)
        normal = linearise(images, scene, cloud, SCATTER)
        whole, _ = confirmation.misfits(images, scene, cloud, normal)
        errors.append(confirmation.model_error(whole, confirmation.signals(normal, SCATTER)))
    assert errors[0] < 0.04 < errors[1] < 0.3


def test_light_that_the_images_lack_makes_a_false_particle(rig):
    images, light = model_of(rig), np.full((3, 2), 5e4)
    scene = scene_of(images, PLACES, light)
    shifted = PLACES + [[0, 0, 0], [0.0, 0.08, 0], [0, 0, 0]]
    normal = linearise(images, scene, Cloud(positions_mm=shifted, light=light), SCATTER)
    _, lacking = confirmation.misfits(images, scene, Cloud(positions_mm=shifted, light=light), normal)
    good = confirmation.fitting(lacking, 0.02, confirmation.signals(normal, SCATTER))
    assert good.tolist() == [True, False, True]


def test_clipped_pixels_tell_that_light_is_not_less(rig):
    true = np.array([[0.1, -0.2, 0.05], [-0.5, 0.4, 0.1]])
    images = rig.images(true, 3)
    top = {name: 0.35 * image.max() for name, image in images.items()}
    cut = {name: np.minimum(image, top[name]) for name, image in images.items()}
    clipped = {name: images[name] >= top[name] for name in images}
    whole = find_particles(rig.weights, images, noise=READ_NOISE, sigma_voxel=SIGMA_VOXEL)
    told = find_particles(rig.weights, cut, noise=READ_NOISE, sigma_voxel=SIGMA_VOXEL, clipped=clipped)
    blind = find_particles(rig.weights, cut, noise=READ_NOISE, sigma_voxel=SIGMA_VOXEL)
    assert len(match_particles(told.positions_mm, true, VOXEL_MM)) == len(told) == 2
    assert np.median(told.light) == pytest.approx(np.median(whole.light), rel=0.05)
    assert np.max(blind.light) < 0.95 * np.max(whole.light)


def test_clipped_pixels_of_another_shape_are_refused(rig):
    images = rig.images(PLACES, 3)
    with pytest.raises(ValueError, match="clipped"):
        find_particles(rig.weights, images, clipped={name: np.ones((2, 2), bool) for name in images})
