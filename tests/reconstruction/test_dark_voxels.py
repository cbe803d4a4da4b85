"""Dark voxels that are left out of a good first guess: the faintest ones, with their share of the light, for good."""

import numpy as np
import pytest

from lfpiv.reconstruction.dark_voxels import DARK, leave_out, without_dark
from lfpiv.reconstruction.momentum import Momentum
from lfpiv_kernels.reconstruction.sums import brightest_share
from lfpiv_kernels.transfer import to_device, to_host

TOLERANCE_STEP = 1e-5  # float32 against float64, relative


def test_a_guess_without_dark_voxels_keeps_the_brightest_and_its_light():
    guess = np.random.default_rng(2).lognormal(0, 3, (6, 8, 10)).astype(np.float32)
    given = guess.copy()
    found = without_dark(guess)
    np.testing.assert_array_equal(guess, given)
    dark = found == 0
    below = np.cumsum(np.sort(guess[dark]), dtype=np.float64)[-1] / guess.sum(dtype=np.float64)
    with_next = below + guess[~dark].min() / guess.sum(dtype=np.float64)
    assert guess[dark].max() < guess[~dark].min() and below <= DARK <= with_next
    assert found.sum(dtype=np.float64) == pytest.approx(guess.sum(dtype=np.float64), rel=TOLERANCE_STEP)
    assert np.ptp(found[~dark] / guess[~dark]) < TOLERANCE_STEP
    nothing = np.zeros_like(guess)
    assert np.array_equal(without_dark(nothing), nothing)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3])
def test_the_faintest_hold_at_most_their_share_of_the_light(share):
    light = np.random.default_rng(1).lognormal(0, 3, 1000).astype(np.float32)
    least = to_host(brightest_share(to_device(light), share))[0]
    faintest = light[light < least].sum(dtype=np.float64) / light.sum(dtype=np.float64)
    with_next = light[light <= least].sum(dtype=np.float64) / light.sum(dtype=np.float64)
    assert faintest <= share <= with_next


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
    assert not to_host(momentum.previous)[out].any(), "not lifted by the momentum"
