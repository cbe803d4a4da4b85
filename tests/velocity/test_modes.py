"""Modes of vector fields, their shells and coherences."""

import numpy as np
import pytest

from lfpiv.velocity.modes import coherences, field_of, modes_of, shells_of, weighted

SHAPE = (5, 6, 7)


@pytest.fixture
def field():
    return np.random.default_rng(0).standard_normal((*SHAPE, 3))


def test_modes_hold_the_fluctuations_and_their_power(field):
    modes = modes_of(field)
    fluctuations = field - field.mean((0, 1, 2))
    assert np.allclose(field_of(modes), fluctuations)
    assert np.allclose((modes**2).sum((0, 1, 2)), (fluctuations**2).sum((0, 1, 2)))


def test_weights_of_shells_leave_long_waves_and_take_short_ones(field):
    shells = shells_of(SHAPE)
    one = field[..., 0]
    assert shells[0, 0, 0] == 0 and shells[-1, -1, -1] == shells.max()
    assert np.allclose(weighted(one, [1.0]), one - one.mean())  # shells beyond the last weight have that weight
    modes = modes_of(weighted(one, [1.0] * 4 + [0.0]))
    assert np.allclose(modes[shells >= 4], 0) and np.allclose(modes[shells < 4], modes_of(one)[shells < 4])


def test_the_coherence_of_a_signal_with_noise_is_its_share_of_the_power():
    rng = np.random.default_rng(1)
    exact = [rng.standard_normal(SHAPE) for _ in range(60)]
    found = coherences([(one, 0.7 * one + 0.7 * rng.standard_normal(SHAPE)) for one in exact])
    assert np.allclose(found[2:-1], 0.5, atol=0.08)
    assert np.allclose(coherences([(one, 3 * one) for one in exact])[2:], 1.0)
