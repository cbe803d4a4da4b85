"""Fit along tracks against the dense solution, its standard errors against their scatter, and the fit of the motion."""

import numpy as np
import pytest

from lfpiv.tracking.trajectory import (
    DIFFUSE_SPEED,
    Measured,
    Motion,
    State,
    fit_motion,
    smooth,
    unlikeliness,
)

MOTION = Motion((0.2, 0.1, 0.3), (4.0, 2.0, 8.0), (1.0, 1.5, 2.0))
ROUNDING = 1e-7
"""Of a Kalman smoother with a diffuse beginning, relative to the dense solution."""
STEADY = 1e-3
"""Of variances where a matrix of condition 1e10 is inverted, relative."""
SIGMAS = 4.0
"""Standard errors of a mean within which it must lie, for fixed seeds."""


def simulated(count, length, motion=MOTION, error=0.05, seed=0, gaps=()):
    """Return measured tracks that the model made, and their true states (track, position, axis, 3)."""
    rng = np.random.default_rng(seed)
    times = np.setdiff1d(np.arange(length), gaps).astype(float)
    state = np.zeros((count, 3, 3))
    state[..., 0], state[..., 1] = rng.uniform(0, 30, (2, count, 3))
    state[..., 2] = rng.standard_normal((count, 3)) * motion.acceleration
    true = [state]
    for step in np.diff(times):
        moved, added = motion.steps(np.full(count, step))
        root = np.linalg.cholesky(added + 1e-15 * np.eye(3))
        state = np.einsum("taij,taj->tai", moved, state) + np.einsum(
            "taij,taj->tai", root, rng.standard_normal(state.shape)
        )
        true.append(state)
    true = np.stack(true, axis=1)
    noise = error * np.array(motion.factor) * rng.standard_normal(true.shape[:3])
    measured = Measured(
        time=np.tile(times, (count, 1)),
        position=true[..., 0] + noise,
        error=np.full(true.shape[:3], error),
        length=np.full(count, len(times)),
    )
    return measured, true


def dense(motion, measured, track, axis):
    """Return mean and covariance of all states of a track along an axis from one linear system of all positions."""
    count = int(measured.length[track])
    times, error = measured.time[track, :count], measured.error[track, :count, axis] * motion.factor[axis]
    information, right = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    information[1, 1], information[2, 2] = 1 / DIFFUSE_SPEED**2, 1 / motion.acceleration[axis] ** 2
    for place in range(count):
        information[3 * place, 3 * place] += 1 / error[place] ** 2
        right[3 * place] = measured.position[track, place, axis] / error[place] ** 2
    for place in range(1, count):
        moved, added = (one[0, axis] for one in motion.steps(times[place : place + 1] - times[place - 1 : place]))
        difference = np.concatenate([-moved, np.eye(3)], axis=1)
        span = slice(3 * place - 3, 3 * place + 3)
        information[span, span] += difference.T @ np.linalg.inv(added) @ difference
    covariance = np.linalg.inv(information)
    return (covariance @ right).reshape(count, 3), covariance


def test_the_smoother_gives_the_dense_solution_with_gaps_and_short_tracks():
    measured, _ = simulated(3, 9, gaps=(4, 5))
    measured.length[1] = 4
    found = smooth(MOTION, measured)
    for track in range(3):
        for axis in range(3):
            mean, covariance = dense(MOTION, measured, track, axis)
            for place in range(measured.length[track]):
                block = covariance[3 * place : 3 * place + 3, 3 * place : 3 * place + 3]
                assert found.mean[track, place, axis] == pytest.approx(mean[place], rel=ROUNDING, abs=ROUNDING)
                assert np.allclose(found.variance[track, place, axis], block, rtol=1e4 * ROUNDING, atol=ROUNDING)


@pytest.mark.parametrize("error", [1e-3, 0.03])
def test_standard_errors_of_particles_that_hardly_accelerate_are_those_of_the_dense_solution(error):
    """Their variances differ from those of an unknown velocity by ten orders: differences of such would be below 0."""
    steady = Motion((1e-4,) * 3, (1.0, 5.0, 30.0))
    measured, _ = simulated(20, 6, steady, error)
    found = np.einsum("tpaii->tpai", smooth(steady, measured).variance)
    for axis in range(3):
        _, covariance = dense(steady, measured, 0, axis)
        expected = np.broadcast_to(np.diag(covariance).reshape(6, 3), (20, 6, 3))
        assert found[:, :, axis] == pytest.approx(expected, rel=STEADY)


def test_standard_errors_are_the_scatter():
    measured, true = simulated(400, 8)
    found = smooth(MOTION, measured)
    normal = (found.mean - true) / np.sqrt(np.einsum("tpaii->tpai", found.variance))
    assert np.abs(np.square(normal).mean((0, 1)) - 1).max() < SIGMAS * np.sqrt(2 / 400)
    raw = np.square(measured.position - true[..., 0]).mean((0, 1))
    assert (np.square(found.mean - true)[..., 0].mean((0, 1)) < raw).all()


def test_the_filter_predicts_with_its_variance():
    measured, true = simulated(400, 7)
    state = State.first(MOTION, measured.position[:, 0], measured.error[:, 0])
    for place in range(1, 6):
        state = state.after(MOTION, np.ones(400))
        state = state.measured(MOTION, measured.position[:, place], measured.error[:, place])
    ahead = state.after(MOTION, np.ones(400))
    normal = (ahead.mean[..., 0] - true[:, 6, :, 0]) / np.sqrt(ahead.variance[..., 0, 0])
    assert np.abs(np.square(normal).mean(0) - 1).max() < SIGMAS * np.sqrt(2 / 400)


def test_two_steps_are_one_of_twice_the_time():
    moved, added = MOTION.steps(np.array([1.0, 2.0]))
    assert np.allclose(moved[0] @ moved[0], moved[1])
    assert np.allclose(moved[0] @ added[0] @ moved[0].swapaxes(1, 2) + added[0], added[1])


def test_the_motion_is_found_and_a_few_outliers_do_not_change_it():
    measured, _ = simulated(100, 10, seed=1)
    found = fit_motion(measured, Motion())
    assert unlikeliness(found, measured).sum() <= unlikeliness(MOTION, measured).sum() + 1
    assert np.allclose(found.factor, MOTION.factor, rtol=0.25) and np.allclose(
        found.acceleration, MOTION.acceleration, rtol=0.35
    )
    measured.position[:3, 6] += 3.0
    assert np.allclose(fit_motion(measured, Motion()).factor, found.factor, rtol=0.25)


def test_few_or_no_tracks_tell_no_motion():
    measured, _ = simulated(3, 8)
    assert fit_motion(measured, MOTION) is MOTION
    empty = Measured.from_rows(np.zeros(0, int), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    assert fit_motion(empty, MOTION) is MOTION and smooth(MOTION, empty).mean.size == 0
