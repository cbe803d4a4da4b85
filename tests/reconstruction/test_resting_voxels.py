"""Resting voxels: which ones rest and when, that their light counts, that they do not change, and what is reached."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import ndimage
from support.noisy_blobs import noisy_blobs

import lfpiv
from lfpiv.reconstruction import resting_voxels, solver, steps
from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.particle_size import ParticleSizer
from lfpiv.reconstruction.resting_voxels import RestingVoxels, leave_out, without_dark
from lfpiv.reconstruction.sieve import TRUNCATE, Sieve
from lfpiv.reconstruction.smart import CameraEquation, ImageEquations
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import EVEN, ODD
from lfpiv_kernels.reconstruction.sums import brightest_share
from lfpiv_kernels.transfer import to_device, to_host

TOLERANCE_MISFIT = 1e-5  # float32 sums of the same terms in another order, relative
TOLERANCE_STEP = 1e-5  # float32 against float64, relative
NEVER = 10**6


@pytest.fixture(autouse=True)
def small_volumes_rest_too(monkeypatch):
    """Let voxels of the small volumes of these tests rest."""
    monkeypatch.setattr(resting_voxels, "FEWEST_VOXELS", 0)


@pytest.fixture(scope="module")
def recorded():
    """Weights of a small volume, and noisy images of blobs in it."""
    weights, _, images = noisy_blobs(40)
    return weights, images


@pytest.fixture(scope="module")
def equations(recorded):
    weights, images = recorded
    cameras = []
    for name, camera in weights.cameras.items():
        projector, gain = weights.projector(name), np.ones(camera.gain.size, np.float32)
        image = np.zeros_like(gain)
        seen = projector.map.pixel
        image[seen] = np.maximum(images[name].ravel()[seen], 0)
        cameras.append(CameraEquation(image=image, gain=gain, floor=5.0, projector=projector))
    return ImageEquations(cameras)


def test_a_guess_without_dark_voxels_keeps_the_brightest_and_its_light():
    guess = np.random.default_rng(2).lognormal(0, 3, (6, 8, 10)).astype(np.float32)
    given = guess.copy()
    found = without_dark(guess)
    np.testing.assert_array_equal(guess, given)
    dark = found == 0
    below = np.cumsum(np.sort(guess[dark]), dtype=np.float64)[-1] / guess.sum(dtype=np.float64)
    with_next = below + guess[~dark].min() / guess.sum(dtype=np.float64)
    assert guess[dark].max() < guess[~dark].min() and below <= resting_voxels.DARK <= with_next
    assert found.sum(dtype=np.float64) == pytest.approx(guess.sum(dtype=np.float64), rel=TOLERANCE_STEP)
    assert np.ptp(found[~dark] / guess[~dark]) < TOLERANCE_STEP
    nothing = np.zeros_like(guess)
    assert np.array_equal(without_dark(nothing), nothing)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3])
def test_the_faintest_that_rest_hold_at_most_their_share_of_the_light(share):
    light = np.random.default_rng(1).lognormal(0, 3, 1000).astype(np.float32)
    least = to_host(brightest_share(to_device(light), share))[0]
    resting = light[light < least].sum(dtype=np.float64) / light.sum(dtype=np.float64)
    with_next = light[light <= least].sum(dtype=np.float64) / light.sum(dtype=np.float64)
    assert resting <= share <= with_next


def test_voxels_rest_in_cycles_and_more_of_them_in_each_epoch(equations):
    rng = np.random.default_rng(2)
    volume = rng.lognormal(0, 3, equations.cameras[0].projector.blocks.scale.size).astype(np.float32)
    epochs = range(resting_voxels.ALL + 2 * (resting_voxels.CYCLE + 1))
    with equations.locked():
        resting = RestingVoxels(equations)
        active = [resting.active_in(epoch, to_device(volume)) for epoch in epochs]
        active = [None if one is None else to_host(one) for one in active]
        resting.wake()
    every = [number for number, one in enumerate(active) if one is None]
    assert every == [0, 1, resting_voxels.ALL + resting_voxels.CYCLE, len(epochs) - 1]
    cycle = active[resting_voxels.ALL : resting_voxels.ALL + resting_voxels.CYCLE]
    assert all((after <= before).all() and after.sum() < before.sum() for before, after in pairwise(cycle))
    bright = volume * cycle[0]
    assert bright.sum(dtype=float) == pytest.approx((1 - resting_voxels.LIGHT) * volume.sum(dtype=float), rel=2e-3)


def test_no_voxel_of_a_small_volume_rests(equations, monkeypatch):
    volume = np.random.default_rng(2).lognormal(0, 3, 1000).astype(np.float32)
    monkeypatch.setattr(resting_voxels, "FEWEST_VOXELS", volume.size + 1)
    resting = RestingVoxels(equations)
    assert [resting.active_in(epoch, to_device(volume)) for epoch in range(12)] == [None] * 12


def test_light_at_rest_counts_until_it_is_released(equations):
    volume = np.random.default_rng(3).uniform(0, 2e4, equations.cameras[0].projector.blocks.scale.size)
    bright = np.where(volume > 1e4, volume, 0).astype(np.float32)
    parts = volume.astype(np.float32), bright, (volume - bright).astype(np.float32)
    every, bright, dark = (to_device(part) for part in parts)
    with equations.locked():
        whole, back = equations.compare(every), to_host(equations.back_project(bright)).copy()
        equations.hold(dark)
        held, from_held = equations.compare(bright), to_host(equations.back_project(bright))
        halves = [_of_half(equations, half, bright) for half in (EVEN, ODD)]
        equations.release()
        released = equations.compare(bright)
        expected = [_of_half(equations, half, every) for half in (EVEN, ODD)]
    assert held.divergence == pytest.approx(whole.divergence, rel=TOLERANCE_MISFIT)
    assert halves == pytest.approx(expected, rel=TOLERANCE_MISFIT)
    np.testing.assert_allclose(from_held, back, atol=1e-4 * np.abs(back).max())
    assert abs(released.divergence - whole.divergence) > 0.01 * whole.divergence


def _of_half(equations, half, volume):
    """The misfit of one camera's half."""
    equations.begin()
    equations.compare_part(0, half, volume)
    return equations.measured().divergence


@pytest.mark.parametrize("sharpened", [True, False])
def test_steps_leave_resting_voxels_and_blur_over_the_others(sharpened):
    rng, shape = np.random.default_rng(4), (6, 7, 8)
    coefficients = rng.uniform(1, 2, 336).astype(np.float32)
    active = (rng.random(336) > 0.4).astype(np.float32)
    size, exponent = rng.uniform(0.2, 0.4, 336).astype(np.float32), active * rng.normal(size=336).astype(np.float32)
    sieve = Sieve(0.9, shape)
    on_device = to_device(size)
    step = (steps.SharpenedStep if sharpened else steps.SmartStep)(on_device, sieve)
    following, _ = step(to_device(coefficients), to_device(exponent), over=step.over(to_device(active)))
    following = to_host(following)
    np.testing.assert_array_equal(following[active == 0], coefficients[active == 0])
    logarithm = (size * exponent).astype(float)
    if sharpened:
        options = {"sigma": steps.SHARPENED_VOXEL, "mode": "nearest", "truncate": TRUNCATE}
        both = (one.reshape(shape) for one in (logarithm, active.astype(float)))
        sums = [ndimage.gaussian_filter(one, **options).ravel() for one in both]
        mean = sums[0] / np.maximum(sums[1], steps.LEAST_ACTIVE)
        options["sigma"] = steps.BAND * sieve.sigma_voxel
        logarithm = ndimage.gaussian_filter(logarithm.reshape(shape), **options).ravel()
        logarithm = logarithm + steps.SHARPENING * (logarithm - mean)
    else:
        logarithm = size * sieve(exponent)
    expected = np.where(active > 0, coefficients * np.exp(logarithm), coefficients)
    np.testing.assert_allclose(following, expected, rtol=TOLERANCE_STEP)


def test_momentum_forgets_voxels_that_stop():
    before, after = np.array([1.0, 1.0, 2.0], np.float32), np.array([2.0, 2.0, 2.0], np.float32)
    moving = Momentum(to_device(before), time=5.0)
    moving.forget(to_device(after), to_device(np.array([1.0, 0.0, 1.0], np.float32)))
    ahead = to_host(moving.extrapolate(to_device(after.copy()))[0])
    assert ahead[0] > 2 and ahead[1:].tolist() == [2, 2]


def test_voxels_that_are_left_out_stay_dark():
    rng = np.random.default_rng(6)
    given, before = (rng.lognormal(0, 2, 400).astype(np.float32) for _ in range(2))
    values, momentum = to_device(given.copy()), Momentum(to_device(before.copy()), time=5.0)
    leave_out(values, momentum, 0.1)
    left = to_host(values).copy()
    out = left == 0
    np.testing.assert_array_equal(left[~out], given[~out])
    assert given[out].sum() <= 0.1 * given.sum() < given[out].sum() + given[~out].min()
    assert given[out].max() < given[~out].min()
    assert (to_host(momentum.extrapolate(values)[0])[out] == 0).all(), "not lifted by the momentum"


def test_volumes_are_as_good_with_fewer_voxels_visited(recorded, monkeypatch):
    weights, images = recorded
    settings = {"iterations": 14, "subsets": "auto", "sieve_voxel": 0.6}
    visited = []  # voxels
    gather = type(weights.projector("cam1")).gather

    def counted(self, out, active=None, ray_set=ALL):
        visited.append(out.size if active is None else np.count_nonzero(active.numpy()))
        return gather(self, out, active, ray_set)

    monkeypatch.setattr(type(weights.projector("cam1")), "gather", counted)
    rested = lfpiv.reconstruct(weights, images, **settings)
    some = sum(visited)
    visited.clear()
    monkeypatch.setattr(resting_voxels, "ALL", NEVER)
    whole = lfpiv.reconstruct(weights, images, **settings)
    assert some < 0.85 * sum(visited)
    assert rested.attrs["misfit"][-1] < 1.02 * whole.attrs["misfit"][-1]
    assert np.corrcoef(rested.values.ravel(), whole.values.ravel())[0, 1] > 0.99


def test_solvers_of_the_same_weights_share_the_estimator_of_sizes(recorded, monkeypatch):
    weights, images = recorded
    monkeypatch.setattr(weights, "derived", {})
    made = []
    monkeypatch.setattr(solver, "ParticleSizer", lambda weights: made.append(weights) or ParticleSizer(weights))
    for _ in range(2):
        lfpiv.reconstruct(weights, images, 1, sieve_voxel="auto")
    assert len(made) == 1
