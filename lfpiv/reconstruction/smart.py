"""SMART's iteration (Eq. 5): propose a step, compare its projections with the images, accept or reject it.

With the volume E, the weights w, the images I, the noise floor b and the projections P = sum w E, SMART lowers the
misfit f(E) = sum_i (P + b) log((P + b) / (I + b)) - P + I. Each iteration back-projects log((I + b) / (P + b)) to the
exponent of a step (`lfpiv.reconstruction.steps`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.steps import Step
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.update import Comparison


@dataclass(frozen=True)
class Misfit:
    """Difference of a volume's projections from the images."""

    squares: float
    """Sum of (I - P)^2 [counts^2]."""
    divergence: float
    """f [counts]."""

    def __add__(self, other: Misfit) -> Misfit:
        return Misfit(self.squares + other.squares, self.divergence + other.divergence)


@dataclass(frozen=True, kw_only=True)
class CameraEquation:
    """One camera's equation I = gain * W E; arrays are float32, shape (pixel,)."""

    image: np.ndarray
    """Counts >= 0, zero where `gain` is zero and where no voxel lights a pixel."""
    gain: np.ndarray
    """Counts that a pixel records per unit of light."""
    floor: float
    """Noise floor b [counts]."""
    projector: Projector
    """The weights W."""


class ImageEquations:
    """The equations of all cameras. Volumes are flat, in stored order, float32.

    Each projector holds the light of one volume at a time. So `compare` and `back_project` are called inside `locked`.
    """

    def __init__(self, cameras: Sequence[CameraEquation]):
        self.cameras = tuple(cameras)
        self._comparisons = [Comparison(one.projector, one.image, one.gain, one.floor) for one in self.cameras]

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Exclude other threads from the projectors."""
        with contextlib.ExitStack() as locks:
            for camera in self.cameras:
                locks.enter_context(camera.projector.reserved())
            yield

    def compare(self, volume: np.ndarray) -> Misfit:
        """Project a volume and compare it with the images. The projectors then hold gain * log((I + b) / (P + b))."""
        misfit = Misfit(0.0, 0.0)
        for comparison in self._comparisons:
            misfit += Misfit(*comparison.compare(volume))
        return misfit

    def back_project(self, volume: np.ndarray) -> np.ndarray:
        """Back-project the logarithms that `compare` left: sum_i w log((I + b) / (P + b)); 0 where `volume` is 0."""
        exponent = np.zeros_like(volume)
        for camera in self.cameras:
            camera.projector.gather(exponent, active=volume)
        return exponent

    def hold(self, volume: np.ndarray) -> None:
        """Add the projections of a volume to those of each volume that is compared from now on, until `release`."""
        for comparison in self._comparisons:
            comparison.hold(volume)

    def release(self) -> None:
        """Forget the volumes that are held."""
        for comparison in self._comparisons:
            comparison.release()

    def compare_subset(self, camera: int, lenses: int, volume: np.ndarray) -> Misfit:
        """Do as `compare` for the rays of one camera through some lenses only, see ``projector.ALL``."""
        return Misfit(*self._comparisons[camera].compare(volume, lenses))

    def back_project_subset(self, camera: int, lenses: int, volume: np.ndarray) -> np.ndarray:
        """Do as `back_project` for the rays of one camera through some lenses only."""
        exponent = np.zeros_like(volume)
        self.cameras[camera].projector.gather(exponent, active=volume, lenses=lenses)
        return exponent


@dataclass(frozen=True)
class State:
    """State of the iteration."""

    coefficients: np.ndarray
    """Coefficients c of the sieve, E = G c, shape (voxel,), float32. Zeros stay zero."""
    momentum: Momentum | None
    """None iterates without momentum."""
    steps: tuple[Step, ...]
    """Steps, the fastest first. The last one is SMART's own."""

    def proposals(self, exponent: np.ndarray, smooth: Callable[[np.ndarray], np.ndarray]) -> Iterator[State]:
        """Propose the next states, the fastest first: with momentum, without it, and by the steps that remain.

        A state without momentum's extrapolation starts the momentum anew. Steps that were passed over are given up.
        """
        for number, step in enumerate(self.steps):
            stepped = smooth(step(self.coefficients, exponent))
            if self.momentum is None:
                yield State(stepped, None, self.steps[number:])
                continue
            if number == 0:
                yield State(*self.momentum.extrapolate(stepped), self.steps)
                if self.momentum.exponent == 0:  # nothing was extrapolated
                    continue
            yield State(stepped, Momentum(stepped), self.steps[number:])


def iterate(
    equations: ImageEquations,
    state: State,
    sieve: Sieve,
    *,
    iterations: int,
    smooth: Callable[[np.ndarray], np.ndarray] = lambda volume: volume,
) -> Iterator[tuple[np.ndarray, Misfit]]:
    """Iterate SMART; yield the first volume and the one after each iteration, with their misfits.

    An iteration takes the first of its proposals by which the misfit does not rise, or else the last one. `smooth` is
    applied to the coefficients after each step but those of the last iteration.
    """
    volume = sieve(state.coefficients)
    misfit = equations.compare(volume)
    for left in reversed(range(iterations)):
        yield volume, misfit
        exponent = equations.back_project(volume)
        for proposal in state.proposals(exponent, smooth if left else _unchanged):
            volume = sieve(proposal.coefficients)
            proposed = equations.compare(volume)
            if not proposed.divergence > misfit.divergence:
                break
        state, misfit = proposal, proposed
    yield volume, misfit


def _unchanged(volume: np.ndarray) -> np.ndarray:
    return volume
