"""SMART's iteration (Eq. 5): propose a step, compare its projections with the images, accept or reject it.

With the volume E, the weights w, the images I, the noise floor b and the projections P = sum w E, SMART lowers the
misfit f(E) = sum_i (P + b) log((P + b) / (I + b)) - P + I. Each iteration back-projects log((I + b) / (P + b)) to the
exponent of a step (`lfpiv.reconstruction.steps`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.steps import Step
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.update import Comparison
from lfpiv_kernels.reconstruction.voxels import darken
from lfpiv_kernels.replay import Replay
from lfpiv_kernels.transfer import DeviceArray, clear, zeros


@dataclass(frozen=True)
class Misfit:
    """Difference of a volume's projections from the images."""

    squares: float
    """Sum of (I - P)^2 [counts^2]."""
    divergence: float
    """f [counts]."""


@dataclass(frozen=True, kw_only=True)
class CameraEquation:
    """One camera's equation I = gain * W E."""

    image: np.ndarray
    """Counts >= 0, shape (pixel,), float32; zero where `gain` is zero and where no voxel lights a pixel."""
    gain: np.ndarray | DeviceArray
    """Counts that a pixel records per unit of light, shape (pixel,), float32; or on the device, of lit pixels only."""
    floor: float
    """Noise floor b [counts]."""
    projector: RayProjector
    """The weights W."""


class ImageEquations:
    """The equations of all cameras, on the device. Volumes are flat, in stored order, float32.

    Each projector holds the light of one volume at a time. So comparisons and `back_project` are called inside
    `locked`. The sums of a misfit stay on the device until `measured` reads them.
    """

    def __init__(self, cameras: Sequence[CameraEquation]):
        self.cameras = tuple(cameras)
        self.comparisons = [Comparison(one.projector, one.image, one.gain, one.floor) for one in self.cameras]
        """The images beside the projections, on the device."""
        self._totals = Totals(2)
        self._replay = Replay()

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Exclude other threads from the projectors."""
        with contextlib.ExitStack() as locks:
            for camera in self.cameras:
                locks.enter_context(camera.projector.reserved())
            yield

    def compare(self, volume: DeviceArray) -> Misfit:
        """Project a volume and compare it with the images. The projectors then hold gain * log((I + b) / (P + b))."""
        self.begin()
        for comparison in self.comparisons:
            comparison.compare(volume, self._totals)
        return self.measured()

    def back_project(self, volume: DeviceArray) -> DeviceArray:
        """Back-project the logarithms that `compare` left: sum_i w log((I + b) / (P + b)); 0 where `volume` is 0."""
        exponent = zeros(volume.size)
        for camera in self.cameras:
            camera.projector.gather(exponent, active=volume)
        darken(exponent, volume)
        return exponent

    def begin(self) -> None:
        """Begin to sum the misfits of `compare_part` anew."""
        self._totals.clear()

    def compare_part(self, camera: int, ray_set: int, volume: DeviceArray) -> None:
        """Do as `compare` for one set of the rays of one camera. The misfit is added to those since `begin`."""
        self.comparisons[camera].compare(volume, self._totals, ray_set)

    def exponent_of(self, parts: Sequence[tuple[int, int]], volume: DeviceArray) -> DeviceArray:
        """Compare a volume with sets of rays, each given by its camera and number, and back-project the logarithms.

        The misfits are added to those since `begin`. The exponent is 0 where `volume` is 0. The next call may
        overwrite it.
        """
        return self._replay(tuple(parts), partial(self._find_exponent, parts), volume)

    def _find_exponent(self, parts: Sequence[tuple[int, int]], volume: DeviceArray, exponent: DeviceArray) -> None:
        """Write what `exponent_of` returns."""
        clear(exponent)
        for camera, ray_set in parts:
            self.compare_part(camera, ray_set, volume)
            self.cameras[camera].projector.gather(exponent, active=volume, ray_set=ray_set)
        darken(exponent, volume)

    def measured(self) -> Misfit:
        """Return the misfit that was summed since `begin`."""
        return Misfit(*self._totals.read())


@dataclass(frozen=True)
class State:
    """State of the iteration."""

    coefficients: DeviceArray
    """Coefficients c of the sieve, E = G c, shape (voxel,), float32, on the device. Zeros stay zero."""
    momentum: Momentum | None
    """None iterates without momentum."""
    steps: tuple[Step, ...]
    """Steps, the fastest first. The last one is SMART's own."""

    def proposals(self, exponent: DeviceArray) -> Iterator[State]:
        """Propose the next states, the fastest first: with momentum, without it, and by the steps that remain.

        A state without momentum's extrapolation starts the momentum anew. Steps that were passed over are given up.
        """
        for number, step in enumerate(self.steps):
            momentum = self.momentum if number == 0 else None
            stepped, after = step(self.coefficients, exponent, momentum)
            if self.momentum is None:
                yield State(stepped, None, self.steps[number:])
                continue
            if momentum is not None and after is not None:
                yield State(stepped, after, self.steps)
                if momentum.exponent == 0:  # nothing was extrapolated
                    continue
                stepped = after.previous
            yield State(stepped, Momentum(stepped), self.steps[number:])


def iterate(
    equations: ImageEquations, state: State, sieve: Sieve, *, iterations: int
) -> Iterator[tuple[DeviceArray, Misfit]]:
    """Iterate SMART; yield the first volume and the one after each iteration, with their misfits.

    An iteration takes the first of its proposals by which the misfit does not rise, or else the last one.
    """
    volume = sieve(state.coefficients)
    misfit = equations.compare(volume)
    for _ in range(iterations):
        yield volume, misfit
        exponent = equations.back_project(volume)
        for proposal in state.proposals(exponent):
            volume = sieve(proposal.coefficients)
            proposed = equations.compare(volume)
            if not proposed.divergence > misfit.divergence:
                break
        state, misfit = proposal, proposed
    yield volume, misfit
