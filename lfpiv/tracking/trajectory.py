"""Position, velocity and acceleration along tracks: a filter that predicts a particle, and the fit to its whole track.

The acceleration of a particle is a stationary random process whose correlation decays exponentially, as of Singer [1]_.
All tracks share its strength and memory. Positions are measured with known standard errors. With this model the Kalman
filter gives the best prediction from the past, and the smoother of Rauch, Tung and Striebel [2]_ the best estimate from
the whole track: a Wiener filter that knows about ends, gaps, and unequal errors. `fit_motion` fits strength, memory,
and a factor on the standard errors to the measured tracks by their likelihood.

Lengths are in voxels and times in instants. The axes are independent of each other.

.. [1] R. A. Singer, "Estimating optimal tracking filter performance for manned maneuvering targets", IEEE Trans.
   Aerosp. Electron. Syst. AES-6 (1970) 473-483, doi:10.1109/TAES.1970.310128.
.. [2] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA J. 3 (1965)
   1445-1450, doi:10.2514/3.3166.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.linalg import expm
from scipy.optimize import minimize

FIRST_ACCELERATION = 0.5
"""Standard deviation of the acceleration before tracks show it [voxel/instant^2]."""
FIRST_MEMORY = 5.0
"""Memory of the acceleration before tracks show it [instant]."""
ACCELERATIONS, MEMORIES, FACTORS = (1e-4, 2.0), (1.0, 30.0), (1.0, 10.0)
"""Limits of the three figures that are fitted. The factor is at least 1: most positions may be better than stated, but
particles that overlap are not."""
DIFFUSE_SPEED = 10.0
"""Standard deviation of a velocity that is not known [voxel/instant]."""
TELLING_TRACKS, TELLING_POSITIONS = 300, 40
"""Largest number of tracks that callers give to `fit_motion`, and of measured positions of each track that it takes."""
TELLING_LENGTH = 4
"""Least number of positions of a track that tells the motion."""
LEAST_TELLING = 5
"""Least number of such tracks."""
TAILS = 8.0
"""Degrees of freedom of Student's distribution of innovations. Its tails allow for positions of other particles."""
FIT_STEPS = 120
"""Largest number of steps of the fit of the motion along an axis."""
FIRST_RATIO = 1.6
"""Ratio between the first guess of a figure and the other value that the fit tries first."""


@dataclass(frozen=True)
class Motion:
    """How particles move, for each axis (x, y, z), or for the only axis of a fit."""

    acceleration: tuple[float, ...] = (FIRST_ACCELERATION,) * 3
    """Standard deviation of the acceleration [voxel/instant^2]."""
    memory: tuple[float, ...] = (FIRST_MEMORY,) * 3
    """Time after which the acceleration's correlation is 1/e [instant]."""
    factor: tuple[float, ...] = (1.0,) * 3
    """Errors of positions over their stated standard errors."""

    def steps(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return transition matrices and added covariances, shape (track, axis, 3, 3), over times (track,)."""
        different, which = np.unique(times, return_inverse=True)
        found = [_step(self, float(time)) for time in different]
        moved, added = (np.stack([one[part] for one in found]) for part in (0, 1))
        return moved[which], added[which]


@lru_cache(maxsize=1024)
def _step(motion: Motion, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return transition and added covariance (axis, 3, 3) over a time by the matrix exponential of Van Loan (1978).

    The exponential of [[-F, Q], [0, F^T]] t is [[., G], [0, T^T]]: T is the transition, and T G the added covariance.
    """
    axes = len(motion.memory)
    rate, density = np.zeros((axes, 3, 3)), np.zeros((axes, 3, 3))
    rate[:, 0, 1] = rate[:, 1, 2] = 1
    rate[:, 2, 2] = -1 / np.array(motion.memory)
    density[:, 2, 2] = 2 * np.square(motion.acceleration) / motion.memory
    both = np.zeros((axes, 6, 6))
    both[:, :3, :3], both[:, :3, 3:], both[:, 3:, 3:] = -rate, density, rate.swapaxes(1, 2)
    found = expm(both * time)
    moved = found[:, 3:, 3:].swapaxes(1, 2)
    return moved, moved @ found[:, :3, 3:]


@dataclass(frozen=True)
class State:
    """Estimates of position, velocity and acceleration of tracks, each at its own time, with their covariance."""

    mean: np.ndarray
    """Position, velocity, acceleration, shape (track, axis, 3) [voxel, voxel/instant, voxel/instant^2]."""
    variance: np.ndarray
    """Covariance, shape (track, axis, 3, 3)."""

    @classmethod
    def first(
        cls,
        motion: Motion,
        position: np.ndarray,
        error: np.ndarray,
        velocity: np.ndarray | float = 0.0,
        velocity_error: np.ndarray | float = DIFFUSE_SPEED,
    ) -> State:
        """Return the state of tracks that begin at positions (track, axis) with standard errors [voxel]."""
        mean = np.zeros((*position.shape, 3))
        mean[..., 0], mean[..., 1] = position, velocity
        variance = np.zeros((*position.shape, 3, 3))
        variance[..., 0, 0] = np.square(error * motion.factor)
        variance[..., 1, 1] = np.square(velocity_error)
        variance[..., 2, 2] = np.square(motion.acceleration)
        return cls(mean, variance)

    def __getitem__(self, chosen: np.ndarray) -> State:
        return State(self.mean[chosen], self.variance[chosen])

    def joined(self, other: State) -> State:
        """Return the states of these tracks, then of other tracks."""
        return State(np.concatenate([self.mean, other.mean]), np.concatenate([self.variance, other.variance]))

    def where(self, chosen: np.ndarray, other: State) -> State:
        """Return these states, but `other` for chosen tracks, shape (track,), bool."""
        mean = np.where(chosen[:, None, None], other.mean, self.mean)
        return State(mean, np.where(chosen[:, None, None, None], other.variance, self.variance))

    def after(self, motion: Motion, times: np.ndarray) -> State:
        """Predict the states after times (track,) [instant]."""
        moved, added = motion.steps(times)
        mean = np.einsum("taij,taj->tai", moved, self.mean)
        return State(mean, moved @ self.variance @ moved.swapaxes(2, 3) + added)

    def measured(self, motion: Motion, position: np.ndarray, error: np.ndarray) -> State:
        """Return the states corrected by measured positions (track, axis) with standard errors [voxel]."""
        noise = np.square(error * motion.factor)
        gain = self.variance[..., 0] / (self.variance[..., 0, 0] + noise)[..., None]
        mean = self.mean + gain * (position - self.mean[..., 0])[..., None]
        kept = np.eye(3) - gain[..., None] * np.array([1.0, 0.0, 0.0])
        variance = kept @ self.variance @ kept.swapaxes(2, 3)  # Joseph's form stays symmetric
        return State(mean, variance + noise[..., None, None] * gain[..., :, None] * gain[..., None, :])


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Measured positions of tracks, one row a track. Shorter tracks repeat their last position, see `is_measured`."""

    time: np.ndarray
    """Shape (track, position) [instant], rising along a track until its end."""
    position: np.ndarray
    """Shape (track, position, axis) [voxel]."""
    error: np.ndarray
    """Standard errors, shape (track, position, axis) [voxel]."""
    length: np.ndarray
    """Number of positions of each track, shape (track,)."""

    @classmethod
    def from_rows(cls, track: np.ndarray, time: np.ndarray, position: np.ndarray, error: np.ndarray) -> Measured:
        """Gather rows (row,) and (row, axis) in the order of track, then time; tracks are 0, 1, ... without gaps."""
        length = np.bincount(track) if len(track) else np.zeros(0, int)
        first = np.concatenate([[0], np.cumsum(length)[:-1]]) if len(length) else length
        place = np.minimum(np.arange(length.max(initial=0)), length[:, None] - 1) + first[:, None]
        return cls(time=time[place], position=position[place], error=error[place], length=length)

    @property
    def is_measured(self) -> np.ndarray:
        """Positions that were measured, not repeated to fill a row, shape (track, position), bool."""
        return np.arange(self.time.shape[1]) < self.length[:, None]

    def __getitem__(self, chosen: np.ndarray) -> Measured:
        return Measured(
            time=self.time[chosen],
            position=self.position[chosen],
            error=self.error[chosen],
            length=self.length[chosen],
        )


def smooth(motion: Motion, measured: Measured) -> State:
    """Return position, velocity and acceleration at each measured position, from the whole track.

    Returns
    -------
    State
        Shapes (track, position, axis, 3) and (track, position, axis, 3, 3). Behind the end of a track its last state.
    """
    count = measured.time.shape[1]
    if not count:
        return State(np.zeros((*measured.time.shape, 3, 3)), np.zeros((*measured.time.shape, 3, 3, 3)))
    state = State.first(motion, measured.position[:, 0], measured.error[:, 0])
    is_measured, filtered, predicted = measured.is_measured, [state], []
    for place in range(1, count):
        ahead = state.after(motion, measured.time[:, place] - measured.time[:, place - 1])
        corrected = ahead.measured(motion, measured.position[:, place], measured.error[:, place])
        state = state.where(is_measured[:, place], corrected)
        predicted.append(ahead)
        filtered.append(state)
    smoothed = [filtered[-1]]
    for place in range(count - 1, 0, -1):
        before, ahead, later = filtered[place - 1], predicted[place - 1], smoothed[-1]
        moved, added = motion.steps(measured.time[:, place] - measured.time[:, place - 1])
        gain = before.variance @ moved.swapaxes(2, 3) @ _inverse(ahead.variance)
        mean = before.mean + np.einsum("taij,taj->tai", gain, later.mean - ahead.mean)
        kept = np.eye(3) - gain @ moved
        variance = kept @ before.variance @ kept.swapaxes(2, 3)  # Joseph's form: no difference, so none below 0
        variance += gain @ (later.variance + added) @ gain.swapaxes(2, 3)
        smoothed.append(later.where(is_measured[:, place], State(mean, variance)))
    smoothed.reverse()
    return State(np.stack([one.mean for one in smoothed], 1), np.stack([one.variance for one in smoothed], 1))


def _inverse(variance: np.ndarray) -> np.ndarray:
    """Return the inverse of covariances (..., 3, 3) by way of their correlations, whose condition is better."""
    scale = np.sqrt(np.einsum("...ii->...i", variance))
    product = scale[..., :, None] * scale[..., None, :]
    return np.linalg.pinv(variance / product, hermitian=True) / product


def unlikeliness(motion: Motion, measured: Measured) -> np.ndarray:
    """Return the negative logarithm of the likelihood of each axis, shape (axis,), but for a constant.

    Innovations over their standard deviation follow Student's distribution with `TAILS` degrees of freedom. The first
    two positions of a track tell its velocity and do not count.
    """
    state = State.first(motion, measured.position[:, 0], measured.error[:, 0])
    is_measured, total = measured.is_measured, np.zeros(measured.position.shape[2])
    for before, place in pairwise(range(measured.time.shape[1])):
        ahead = state.after(motion, measured.time[:, place] - measured.time[:, before])
        if place > 1:
            variance = ahead.variance[..., 0, 0] + np.square(measured.error[:, place] * motion.factor)
            square = np.square(measured.position[:, place] - ahead.mean[..., 0]) / variance
            cost = ((TAILS + 1) * np.log1p(square / TAILS) + np.log(variance)) / 2
            total += np.where(is_measured[:, place, None], cost, 0).sum(0)
        state = ahead.measured(motion, measured.position[:, place], measured.error[:, place])
    return total


def fit_motion(measured: Measured, start: Motion) -> Motion:
    """Return the motion that makes tracks most likely; `start` where too few of them are long enough to tell it."""
    long = np.flatnonzero(measured.length >= TELLING_LENGTH)
    if len(long) < LEAST_TELLING:
        return start
    some = measured[long]
    span = slice(int(min(some.length.max(), TELLING_POSITIONS)))
    limits = np.log([ACCELERATIONS, MEMORIES, FACTORS])
    figures = []
    for axis in range(some.position.shape[2]):
        one = Measured(
            time=some.time[:, span],
            position=some.position[:, span, axis : axis + 1],
            error=some.error[:, span, axis : axis + 1],
            length=np.minimum(some.length, span.stop),
        )

        def cost(logs: np.ndarray, one: Measured = one) -> float:
            return float(unlikeliness(_motion_of(logs), one)[0])

        first = np.log([start.acceleration[axis], start.memory[axis], start.factor[axis]])
        first = np.clip(first, *limits.T)
        # the simplex needs a second value of each figure, within the limits
        away = np.where(first + np.log(FIRST_RATIO) < limits[:, 1], 1, -1) * np.log(FIRST_RATIO)
        found = minimize(
            cost,
            first,
            method="Nelder-Mead",
            bounds=limits,
            options={
                "maxfev": FIT_STEPS,
                "xatol": 0.02,
                "fatol": 0.05,
                "initial_simplex": np.concatenate([first[None], first + np.diag(away)]),
            },
        )
        figures.append(np.exp(found.x))
    acceleration, memory, factor = (tuple(float(value) for value in values) for values in zip(*figures, strict=True))
    return Motion(acceleration, memory, factor)


def _motion_of(logs: np.ndarray) -> Motion:
    """Return the motion along one axis from the logarithms of acceleration, memory and factor."""
    acceleration, memory, factor = np.exp(logs)
    return Motion((float(acceleration),), (float(memory),), (float(factor),))
