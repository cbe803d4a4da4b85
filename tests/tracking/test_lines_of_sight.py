"""Particles that one camera shows, looked for along its line of sight."""

import numpy as np
import pytest
from scipy import sparse
from support.tracking_rig import SIGMA_VOXEL, VOXEL_MM, TrackingRig, noisy_scene

from lfpiv.tracking.lines_of_sight import LARGEST_LACK, STEP_VOXEL, Line, follow_lines
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, linearise, refine

LIGHT = 2e4
SCATTER = 0.5
TRUE = np.array([0.15, -0.1, 0.05])
"""Place of the particle [mm], near the axes of the cameras."""
FAR = np.array([[-0.5, 0.5, 0.3]])
"""Another particle that both cameras show."""
OFF_VOXEL = 2.1
"""How far off the particle a candidate is; it is no distance that is tried."""
NEAR_VOXEL = STEP_VOXEL
"""Places are half a step from the particle at most, and beside the axes a line of sight is slightly inclined."""
EXACT_VOXEL = 0.05
"""Error of positions by noise, a few standard errors."""
LIGHT_SHARE = 0.15
"""Error of the light a quarter voxel beside the particle."""


@pytest.fixture(scope="module")
def images(device):
    return ParticleImages(cameras=TrackingRig().cameras, voxel_mm=VOXEL_MM, sigma_voxel=SIGMA_VOXEL)


def axis(images, camera):
    """Return the direction of a camera's optical axis in space."""
    return np.asarray(list(images.cameras.values())[camera].pose)[2]


def followed(images, scene, cloud, chosen):
    normal = linearise(images, scene, cloud, SCATTER)
    return follow_lines(images, scene, cloud, normal, np.array(chosen))


def beside(images, camera, sign=1):
    """Return a place on the line of sight through the particle."""
    return TRUE + sign * OFF_VOXEL * VOXEL_MM * axis(images, camera)


@pytest.fixture(scope="module")
def both_shown(images):
    """Images of two particles that both cameras show."""
    return noisy_scene(images, np.vstack([TRUE, FAR]), np.array([[LIGHT, 0.5 * LIGHT], [LIGHT, LIGHT]]))


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_particle_of_one_camera_is_found_along_its_line_of_sight(images, both_shown, camera, sign):
    light = np.zeros((2, 2))
    light[0, camera], light[1] = LIGHT, LIGHT
    cloud = Cloud(positions_mm=np.vstack([beside(images, camera, sign), FAR]), light=light)
    found = followed(images, both_shown, cloud, [True, False])
    assert len(found) == 2
    np.testing.assert_array_equal(found.positions_mm[0], FAR[0])  # those that are confirmed come first
    assert np.linalg.norm(found.positions_mm[1] - TRUE) < NEAR_VOXEL * VOXEL_MM
    np.testing.assert_allclose(found.light[1], [LIGHT, 0.5 * LIGHT], rtol=LIGHT_SHARE)
    after, _ = refine(images, both_shown, found, iterations=6, scatter=SCATTER)
    assert np.linalg.norm(after.positions_mm[1] - TRUE) < EXACT_VOXEL * VOXEL_MM


def test_two_candidates_that_share_the_light_of_one_particle_become_one(images, both_shown):
    places = np.vstack([beside(images, 0), FAR, beside(images, 1, -1)])
    cloud = Cloud(positions_mm=places, light=np.array([[LIGHT, 0], [LIGHT, LIGHT], [0, 0.5 * LIGHT]]))
    found = followed(images, both_shown, cloud, [True, False, True])
    assert len(found) == 2
    assert np.linalg.norm(found.positions_mm[1] - TRUE) < NEAR_VOXEL * VOXEL_MM


def test_light_that_one_camera_alone_shows_stays_explained(images):
    scene = noisy_scene(images, TRUE[None], np.array([[LIGHT, 0.0]]))
    cloud = Cloud(positions_mm=beside(images, 0)[None], light=np.array([[0.9 * LIGHT, 10.0]]))
    found = followed(images, scene, cloud, [True])
    np.testing.assert_array_equal(found.positions_mm, cloud.positions_mm)
    assert found.light[0, 0] > LIGHT / 2 and found.light[0, 1] < 0.01 * LIGHT


def test_light_beside_the_line_makes_no_particle(images):
    """Places near it would lack light on one side."""
    aside = TRUE + [0.0, 1.2 * VOXEL_MM, 0.0]  # across both lines of sight
    scene = noisy_scene(images, np.vstack([TRUE, aside]), np.array([[LIGHT, 0.0], [0.0, LIGHT]]))
    cloud = Cloud(positions_mm=np.vstack([beside(images, 0)]), light=np.array([[LIGHT, 0.0]]))
    found = followed(images, scene, cloud, [True])
    np.testing.assert_array_equal(found.positions_mm, cloud.positions_mm)


def test_a_particle_whose_light_others_explain_is_left_out(images, both_shown):
    cloud = Cloud(
        positions_mm=np.vstack([TRUE, FAR, FAR + 0.02]), light=np.array([[LIGHT, LIGHT / 2], [LIGHT] * 2, [9, 9]])
    )
    assert len(followed(images, both_shown, cloud, [False, False, True])) == 2


def test_nothing_changes_with_one_camera_or_without_particles_to_move(images, both_shown):
    cloud = Cloud(positions_mm=np.vstack([TRUE, FAR]), light=np.full((2, 2), LIGHT))
    assert followed(images, both_shown, cloud, [False, False]) is cloud
    alone = ParticleImages(cameras=TrackingRig((20.0,)).cameras, voxel_mm=VOXEL_MM, sigma_voxel=SIGMA_VOXEL)
    scene = noisy_scene(alone, TRUE[None], np.array([[LIGHT]]))
    one = Cloud(positions_mm=TRUE[None], light=np.array([[LIGHT]]))
    assert followed(alone, scene, one, [True]) is one


def test_light_and_score_are_those_of_least_squares():
    rng = np.random.default_rng(2)
    places, pixels = 6, 40
    parts = [rng.random((places, pixels)) * (rng.random((places, pixels)) > 0.3) for _ in range(2)]
    weights, left = ([0.5 + rng.random(pixels) for _ in range(2)] for _ in range(2))
    lights = 50 + 20 * rng.random((places, 2))
    lights[2, 1] = 0.0
    for place in range(places):
        targets = [
            lights[place, camera] * part[place] + rng.standard_normal(pixels) for camera, part in enumerate(parts)
        ]
        if place == 3:
            targets[0] = targets[0] * (rng.random(pixels) > 0.6)  # lacks light
        left = [weight * target for weight, target in zip(weights, targets, strict=True)]
        information = np.stack([part**2 @ weight for part, weight in zip(parts, weights, strict=True)], axis=1)
        line = Line(
            positions_mm=np.zeros((places, 3)),
            images=[sparse.csr_array(part) for part in parts],
            information=information,
        )
        light, score = line.look(left, weights)
        gain, good = 0.0, []
        for camera, (part, weight, target) in enumerate(zip(parts, weights, targets, strict=True)):
            root, own = np.sqrt(weight), part[place]
            (expected,), *_ = np.linalg.lstsq((root * own)[:, None], root * target)
            assert light[place, camera] == pytest.approx(max(expected, 0.0))
            before, after = (weight @ (target - part_of * own) ** 2 for part_of in (0.0, max(expected, 0.0)))
            gain += before - after
            dark = np.minimum(target - expected * own, 0)
            lack = (own**2 @ (weight * dark**2 - 0.5)) / (own**2 @ (weight * (expected * own) ** 2))
            good.append(before - after > 25 and lack < LARGEST_LACK**2)
        if place:
            assert all(good) == (place not in (2, 3))
            assert score[place] == pytest.approx(gain - 25 if all(good) else 0.0)
