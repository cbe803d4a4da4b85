"""Likely flow: the power of the true one, told from errors by several pairs."""

import numpy as np
import xarray as xr

from lfpiv.damping.likely_flow import LikelyFlow
from lfpiv.velocity.damping_estimate import Simulated

SLOPE, NOISE = 0.8, 0.15


def waves(phase=1.0, shape=(6, 7, 8)):
    z, y, x = (np.arange(count) - count / 2 for count in shape)
    wave = np.sin(0.35 * z[:, None, None] + 0.3 * y[:, None] + 0.4 * x + phase)
    return np.stack([wave, 2 * wave, 1 + 0.5 * wave], -1)


def measured(flow, rng):
    mean = flow.mean((0, 1, 2))
    return mean + SLOPE * (flow - mean) + NOISE * rng.standard_normal(flow.shape)


def simulated(flow, rng):
    found = measured(flow, rng)
    names = {f"displacement_{axis}": (("z", "y", "x"), found[..., k]) for k, axis in enumerate("zyx")}
    return Simulated(vectors=xr.Dataset(names), imposed=flow)


def gradient(field):
    return np.sqrt(sum(np.diff(field, axis=axis).var() for axis in range(3)))


def likely(fields, rng, pair=0):
    """Flow after a pilot and two simulated pairs."""
    flow = LikelyFlow(fields)
    done = []
    for _ in range(3):
        done.append(simulated(flow(pair, done), rng))
    return flow(pair, done[1:])


def test_without_simulated_pairs_it_is_the_measured_field():
    fields = [measured(waves(phase), np.random.default_rng(0)) for phase in (0.0, 1.0)]
    assert np.allclose(LikelyFlow(fields)(1, []), fields[1])


def test_a_single_pair_gives_the_power_of_the_true_flow():
    rng = np.random.default_rng(3)
    true = waves()
    found = likely([measured(true, rng)], rng)
    assert np.allclose(found.std((0, 1, 2)), true.std((0, 1, 2)), rtol=0.05)


def test_many_pairs_tell_a_steady_flow_from_errors():
    rng = np.random.default_rng(4)
    true = waves()
    fields = [measured(true, rng) for _ in range(12)]
    one, all_of_them = likely(fields[:1], rng), likely(fields, rng)
    raw = fields[0] - fields[0].mean((0, 1, 2))
    for found, most in ((one, 0.8), (all_of_them, 0.5)):
        away = (found - found.mean((0, 1, 2))) - (true - true.mean((0, 1, 2)))
        assert away.std() < most * (raw / SLOPE - (true - true.mean((0, 1, 2)))).std()
    assert np.allclose(all_of_them.std((0, 1, 2)), true.std((0, 1, 2)), rtol=0.05)
    assert abs(gradient(all_of_them) / gradient(true) - 1) < 0.05 < gradient(fields[0] / SLOPE) / gradient(true) - 1


def test_flows_that_differ_from_pair_to_pair_keep_their_power():
    rng = np.random.default_rng(5)
    phases = rng.uniform(0, 2 * np.pi, 12)
    fields = [measured(waves(phase), rng) for phase in phases]
    found = [likely(fields, rng, pair) for pair in range(12)]
    true = [waves(phase) for phase in phases]
    power = [np.mean([one.var((0, 1, 2)) for one in flows], axis=0) for flows in (found, true)]
    assert np.allclose(power[0], power[1], rtol=0.15)
    for one, exact in zip(found, true, strict=True):
        assert np.corrcoef(one[..., 1].ravel(), exact[..., 1].ravel())[0, 1] > 0.97


def test_errors_alone_make_hardly_any_flow():
    rng = np.random.default_rng(6)
    still = np.zeros((6, 7, 8, 3))
    found = likely([measured(still, rng) for _ in range(12)], rng)
    assert found.std() < 0.5 * NOISE


def test_a_shell_without_any_power_leaves_the_flow_finite():
    """The shell of the mean holds nothing else in few windows, and the mean of fluctuations may be exactly zero."""
    rng = np.random.default_rng(7)
    flow = waves(shape=(1, 3, 4))
    flow[..., 0] = np.tile([1.0, -1.0], (1, 3, 2))  # sums to zero to the bit
    pairs = [Simulated(vectors=simulated(flow, rng).vectors, imposed=flow)]
    pairs[0].vectors["displacement_z"].values[:] = flow[..., 0]
    assert np.isfinite(LikelyFlow([flow])(0, pairs)).all()
