"""SMART: its steps, fixed point and limit, against NumPy on the explicit matrix."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize
from contract.ideal import Rig, matrix, pair_of_cameras, pixels, plain_smart

import lfpiv

STEPS = 1e-4
"""Five steps in float32 against float64, relative to the brightest voxel."""
LIMIT = 0.005
"""Relative distance of the misfit from the least one after 60 iterations."""
NOISE = 0.03
"""The same of projections. Volumes differ more: noisy images hardly tell some of them apart."""
MANY = {"maxiter": 400, "maxfun": 500}
UNCHANGED = 1e-3
"""Change of a volume that explains its images."""
DIM = 0.05
"""Difference that a dim camera leaves, whose floor weighs more against its counts; relative to the brightest voxel."""
SHAPE = (4, 6, 7)
FREE = {"sieve_voxel": 0.0, "intensity_cap": 0.0, "tolerance": 0.0}
"""Without a sieve and a limit of the counts, and without an early end."""
PLAIN = {**FREE, "accelerate": False, "subsets": 1}
FLOOR = {"floor": 0.05, "floor_share": 0.0}


def smart(rig, images, **settings):
    """Reconstruct; the one place that calls the public function."""
    return lfpiv.reconstruct(rig.weights, images, **settings)


@pytest.fixture(scope="module")
def rig():
    return Rig(pair_of_cameras(), SHAPE, {"form": "profiles"})


@pytest.fixture(scope="module")
def explicit(rig):
    return matrix(rig.weights)


def lit(explicit, images):
    """Return the rows of the matrix that have entries, and their pixels."""
    seen = np.asarray(explicit.sum(axis=1)).ravel() > 0
    return explicit[seen], pixels(images)[seen]


def test_steps_are_those_of_numpy(rig, explicit):
    images = rig.images(rig.cloud(3), noise=0.5)
    images = {name: np.clip(image, 0, None) for name, image in images.items()}
    first = np.full(SHAPE, 20.0, np.float32)
    found = smart(rig, images, iterations=5, first=first, **PLAIN, **FLOOR)
    expected, misfits = plain_smart(*lit(explicit, images), first.ravel().astype(float), 0.05, 5)
    assert np.abs(found.values.ravel() - expected).max() < STEPS * expected.max()
    np.testing.assert_allclose(found.misfit, misfits, rtol=STEPS)
    assert np.all(np.diff(misfits) < 0)


def test_volume_that_explains_its_images_stays(rig):
    known = rig.cloud(3)
    images = rig.images(known)
    for settings in (PLAIN, {**FREE, "subsets": 1}, FREE):
        found = smart(rig, images, first=known, iterations=4, **settings, **FLOOR)
        assert np.abs(found.values - known).max() < UNCHANGED * known.max()


def least_misfit(matrix, pixels, start, floor):
    """Return the least misfit of any volume, and the volume, by a method other than SMART."""

    def misfit(logarithms):
        volume = np.exp(logarithms)
        seen = matrix @ volume + floor
        ratio = np.log(seen / (pixels + floor))
        return (seen * ratio - seen + pixels + floor).sum(), (matrix.T @ ratio) * volume

    found = scipy.optimize.minimize(misfit, np.log(start), jac=True, method="L-BFGS-B", options=MANY)
    return found.fun, np.exp(found.x)


@pytest.fixture(scope="module")
def noisy(rig, explicit):
    """Return images with noise, the least misfit of any volume, and what that volume projects to."""
    images = {name: np.clip(image, 0, None) for name, image in rig.images(rig.cloud(3), noise=1.0).items()}
    least, volume = least_misfit(*lit(explicit, images), rig.cloud(3).ravel().astype(float), FLOOR["floor"])
    return images, least, explicit @ volume


@pytest.mark.parametrize("settings", [{"subsets": 1}, {}, {"subsets": 4}], ids=["whole passes", "default", "four"])
def test_iteration_ends_at_the_least_misfit(rig, explicit, noisy, settings):
    images, least, expected = noisy
    first = np.full(SHAPE, 20.0, np.float32)
    found = smart(rig, images, first=first, iterations=60, **FREE, **settings, **FLOOR)
    assert least * (1 - LIMIT) < found.misfit[-1] < least * (1 + LIMIT)
    assert np.linalg.norm(explicit @ found.values.ravel() - expected) < NOISE * np.linalg.norm(expected)


def test_misfit_falls_in_whole_passes(rig):
    images = rig.images(rig.cloud(4), noise=2.0)
    for settings in ({"accelerate": False}, {}, {"sieve_voxel": 0.8}, {"relaxation": 0.5}):
        found = smart(rig, images, subsets=1, iterations=10, tolerance=0.0, **settings)
        assert np.all(np.diff(found.misfit) < 0)


def test_more_light_makes_a_brighter_volume(rig):
    images = rig.images(rig.cloud(4), noise=1.0)
    one = smart(rig, images)
    four = smart(rig, {name: 4 * image for name, image in images.items()})
    np.testing.assert_allclose(four.values, 4 * one.values, rtol=1e-3, atol=1e-3 * four.values.max())


def test_order_of_cameras_is_nothing(rig):
    images = rig.images(rig.cloud(4), noise=1.0)
    other = Rig(rig.cameras[::-1], SHAPE, rig.options)
    one, two = smart(rig, images, subsets=1), smart(other, images, subsets=1)
    np.testing.assert_allclose(two.values, one.values, atol=1e-3 * one.values.max())


def test_a_dim_camera_is_corrected(rig):
    left, right = rig.cameras
    dim = Rig((left, dataclasses.replace(right, light=0.8**4)), SHAPE, rig.options)
    volume = rig.cloud(5)
    one, two = (smart(own, own.images(volume), subsets=1, **FREE) for own in (rig, dim))
    assert two.camera_gain == pytest.approx([1, 0.8**4])
    np.testing.assert_allclose(two.values, one.values, atol=DIM * one.values.max())


def test_solids_and_zeros_of_the_guess_stay_dark(rig):
    images = rig.images(rig.cloud(4), noise=1.0)
    mask = np.zeros(SHAPE, bool)
    mask[:, :2] = True
    found = smart(rig, images, mask=mask)
    assert not found.values[mask].any()
    assert found.values[~mask].any()
    assert np.array_equal(found.masked, mask)
    first = np.where(mask, 0, 5).astype(np.float32)
    assert not smart(rig, images, first=first, sieve_voxel=0.0).values[mask].any()


def test_particles_are_found_where_they_are():
    rig = Rig(pair_of_cameras(), options={"form": "profiles"}, particles=8)
    known = rig.blobs(6)
    found = smart(rig, rig.images(known, noise=0.5))
    likeness = (found.values * known).sum() / np.linalg.norm(found) / np.linalg.norm(known)
    assert likeness > 0.85
    assert found.residual[-1] < 0.2


def test_wrong_arguments_are_named(rig):
    images = rig.images(rig.cloud(4))
    for settings, word in [({"iterations": -1}, "iterations"), ({"relaxation": 0.0}, "relaxation")]:
        with pytest.raises(ValueError, match=word):
            smart(rig, images, **settings)
    with pytest.raises(ValueError, match="right"):
        smart(rig, {"left": images["left"]})
    images["left"][0, 0] = np.nan
    with pytest.raises(ValueError, match="left"):
        smart(rig, images)
