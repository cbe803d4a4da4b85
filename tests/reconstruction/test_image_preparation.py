"""Images as SMART takes them: hot pixels, light from elsewhere, cameras of unlike brightness."""

import numpy as np
import pytest
from support import plain_steps
from support.ideal_rig import IdealCamera, IdealRig, optics, rotation, two_cameras

import lfpiv
from lfpiv.reconstruction import image_preparation
from lfpiv.reconstruction.intensity_cap import CAP

NOISE = 2.0  # [counts]
TOLERANCE_F32 = 2e-4  # as in test_volume: float32 steps
TOLERANCE_FLOOR = 0.02  # of an image's brightness that a hot pixel, cut at the brightest of 20,000, adds
TOLERANCE_SHARE = 0.02  # signed noise of 190,000 pixels, 0.5 % of 1e6 counts of light, twice, four deviations
LEAST_LOSS = (
    0.025  # of Q, by the noise of a camera that is 10 times dimmer: 0.021 here; its brightness untold costs 0.046
)
HALF_STEP = np.log(image_preparation.GAIN_STEP) / 2


def particles(grid, seed, per_voxel=0.01, size=0.7):
    """Particles of 30,000 counts at random places of a grid."""
    count = max(1, round(per_voxel * grid.size))
    place = np.array(grid.first_centre_mm)[::-1] + grid.voxel_mm * (
        np.random.default_rng(seed).random((count, 3)) * grid.shape[::-1] - 0.5
    )
    return 3e4 * lfpiv.metrics.truth_volume(place, None, grid, size).values


def recorded(weights, volume, seed, gain=1.0, noise=NOISE):
    """Images with noise, the last camera's light times `gain`."""
    rng, images = np.random.default_rng(seed), weights(volume)
    images[list(images)[-1]] *= gain
    return {name: image + rng.normal(0, noise, image.shape).astype(np.float32) for name, image in images.items()}


def quality(volume, truth):
    return float((volume.values * truth).sum() / np.sqrt(np.square(volume.values).sum() * np.square(truth).sum()))


@pytest.fixture(scope="module")
def weights(device):
    """All of a small volume, seen by two cameras in the middle of their sensors."""
    return lfpiv.build_weights(
        two_cameras(), lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 1.2, 0.8), voxel_mm=0.1)
    )


@pytest.fixture(scope="module")
def half_seen(device):
    """A volume of which each camera misses a fifth, at unlike angles."""
    rig = {"a": IdealCamera("a", rotation(0), optics=optics()), "b": IdealCamera("b", rotation(45), optics=optics())}
    grid = lfpiv.Grid.from_extent(centre_mm=(0.3, 0, 0), size_mm=(3.4, 2.4, 1.6), voxel_mm=0.1)
    return lfpiv.build_weights(IdealRig(rig), grid)


def test_light_that_no_voxel_lights_changes_nothing_and_is_stated(weights):
    """A reflection beside the volume's image is no noise, and no floor, and no misfit that an iteration could lower."""
    truth = particles(weights.grid, 0)
    images, everywhere = recorded(weights, truth, 0), weights(np.ones_like(truth))
    glare = {name: image.copy() for name, image in images.items()}
    for name, image in glare.items():
        spot = np.zeros(image.shape, bool)
        spot[5:45, 20:60] = True
        assert not everywhere[name][spot].any()
        image[spot] = 4095.0
    floors = [plain_steps.reconstruct(weights, seen, 0, floor_share=0.0).floor for seen in (images, glare)]
    assert floors[1] == pytest.approx(floors[0], rel=TOLERANCE_FLOOR)
    keywords = {"iterations": 20, "tolerance": 5e-4, "floor": NOISE}
    plain, beside = (plain_steps.reconstruct(weights, seen, **keywords) for seen in (images, glare))
    assert beside.values.tobytes() == plain.values.tobytes()
    assert beside.misfit == plain.misfit and beside.residual == plain.residual
    for name, share, before in zip(glare, beside.light_outside, plain.light_outside, strict=True):
        outside = everywhere[name] == 0
        assert share == pytest.approx(glare[name][outside].sum() / glare[name].sum(), abs=TOLERANCE_F32)
        assert before < TOLERANCE_SHARE < 0.5 < share


@pytest.mark.parametrize("per_voxel", [0.01, 0.0])
def test_a_hot_pixel_raises_no_floor_and_no_particle_is_cut(weights, per_voxel):
    """Many particles or a single one: the brightness follows their light."""
    truth = particles(weights.grid, 1, per_voxel)
    images, clean = recorded(weights, truth, 1), weights(truth)
    hot = {name: image.copy() for name, image in images.items()}
    for image in hot.values():
        image[200, 240] = 65535.0
    plain, spoilt = (
        plain_steps.reconstruct(weights, seen, 0, floor=0.0, floor_share=1.0).floor for seen in (images, hot)
    )
    assert spoilt == pytest.approx(plain, rel=TOLERANCE_FLOOR)
    everywhere = weights(np.ones_like(truth))
    for floor, name in zip(plain, images, strict=True):
        light = np.maximum(images[name][everywhere[name] > 0], 0).astype(float)
        assert floor == pytest.approx((light**2).sum() / light.sum(), rel=TOLERANCE_FLOOR)
        assert floor < clean[name].max()
    default = plain_steps.reconstruct(weights, hot, 0, floor_share=0.0).floor
    assert default == pytest.approx([NOISE] * 2, rel=2 * TOLERANCE_FLOOR)  # dark pixels tell the noise


@pytest.mark.parametrize("cap", [0.0, CAP])
def test_images_cut_off_at_0_are_prepared_as_those_that_are_not(weights, cap):
    """Their noise is as well known, so it lights no dark microimages, and the limit cuts no more light."""
    images = recorded(weights, particles(weights.grid, 7), 7)
    signed, cut = (
        image_preparation.prepare_images(weights, seen, floor=None, floor_share=0.0, intensity_cap=cap)
        for seen in (images, {name: np.maximum(image, 0) for name, image in images.items()})
    )
    for name, one in cut.items():
        np.testing.assert_array_equal(one.image, signed[name].image)
        assert one.floor == signed[name].floor == pytest.approx(NOISE, rel=2 * TOLERANCE_FLOOR)
        assert one.camera_gain == signed[name].camera_gain


@pytest.mark.parametrize("gain", [0.5, 0.25, 0.1])
def test_cameras_of_unlike_brightness_are_nearly_as_good_as_like_ones(weights, gain):
    """With photon noise the dim one tells less; untold, its brightness would cost far more than its noise does."""
    truth = particles(weights.grid, 3)
    like, unlike = (
        plain_steps.reconstruct(
            weights, recorded(weights, truth, 3, light, noise=0.5), 40, tolerance=5e-4, sieve_voxel="auto"
        )
        for light in (1.0, gain)
    )
    assert abs(np.log(unlike.camera_gain[1] / gain)) <= HALF_STEP * (1 + TOLERANCE_SHARE)
    assert quality(unlike, truth) > quality(like, truth) - LEAST_LOSS
    assert unlike.residual[-1] < 2 * like.residual[-1]  # untold it would be above 0.3


@pytest.mark.parametrize("seed", range(3))
def test_cameras_that_see_different_parts_are_not_taken_for_unlike_ones(half_seen, seed):
    """Where few particles are must not matter, and a camera that is far dimmer is told all the same."""
    truth = particles(half_seen.grid, seed, per_voxel=[0.0005, 0.002, 0.01][seed])
    assert half_seen.views.min() < 2
    like, dim = (recorded(half_seen, truth, seed, light, noise=0.2) for light in (1.0, 0.2))
    assert plain_steps.reconstruct(half_seen, like, 0).camera_gain == [1.0, 1.0]
    found = plain_steps.reconstruct(half_seen, dim, 0).camera_gain
    assert found[0] == 1.0 and 0.1 < found[1] < 0.4


def test_a_reflection_is_not_taken_for_a_brighter_camera(weights):
    """In the middle of the volume, 14 times as bright as particles and with twenty times the light of them all."""
    images = recorded(weights, particles(weights.grid, 6), 6)
    images["cam2"][180:220, 220:260] = 4095.0
    found = plain_steps.reconstruct(weights, images, 0).camera_gain
    assert found[1] == 1.0 and found[0] > 0.5  # by all its light it would be 0.055


@pytest.mark.parametrize("least", [-np.inf, 0.0])
def test_an_image_of_noise_is_not_brightened(weights, least):
    """Noise that is cut off at 0 is no light, either."""
    images = recorded(weights, particles(weights.grid, 4), 4)
    images["cam2"] = np.random.default_rng(4).normal(0, NOISE, images["cam2"].shape).clip(least).astype(np.float32)
    assert plain_steps.reconstruct(weights, images, 0).camera_gain == [1.0, 1.0]


def test_the_noise_of_images_cut_off_does_not_make_a_dim_camera_brighter(weights):
    """Noise is as strong as the light, and what is left of it would add more than a step."""
    truth = particles(weights.grid, 8)
    light = weights(truth)["cam1"]
    images = recorded(weights, truth, 8, 0.25, noise=float(light[light > 0].mean()) / 2)
    cut = {name: np.maximum(image, 0) for name, image in images.items()}
    signed, found = (plain_steps.reconstruct(weights, seen, 0).camera_gain for seen in (images, cut))
    assert found == signed and found[1] < 0.4


def test_an_image_that_is_dark_where_the_volume_is_seen_is_named(weights):
    images = weights(particles(weights.grid, 5))
    images["cam2"] = np.where(images["cam2"] > 0, 0, 1).astype(np.float32)
    images["cam2"][weights(np.ones(weights.grid.shape))["cam2"] > 0] = 0
    with pytest.raises(ValueError, match=r"images\['cam2'\]: expected light where the volume is seen"):
        plain_steps.reconstruct(weights, images)
