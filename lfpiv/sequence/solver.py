"""`SequenceSolver`: SMART along a time series, where each frame learns from those before and after it.

Images of two cameras hardly distinguish particles from ghosts: SMART keeps what its first guess holds. Particles move
with the flow, and a ghost moves with the flow only where all particles on its lines of sight move alike. So the volume
of the frame before, moved by the flow, is a better first guess than one from the images alone, and needs fewer
iterations. This is the sequential form of motion tracking enhancement [1]_, [2]_.

The guess is the product of powers M^p F^(1 - p) of the moved volume M and the guess F from the images, with the
exponent p = `PERSISTENCE` where the flow is known, and 0 elsewhere. SMART multiplies its first guess, so what the
images do not determine is forgotten by the factor p in each frame. Particles that enter through a face come from F.

So the volumes go forward in time. Afterwards each is corrected by the volumes on both sides of it
(`lfpiv.sequence.fixed_lag`), which changes no other one.

.. [1] M. Novara, K. J. Batenburg, F. Scarano, "Motion tracking-enhanced MART for tomographic PIV", Meas. Sci. Technol.
   21 (2010) 035401, doi:10.1088/0957-0233/21/3/035401.
.. [2] K. P. Lynch, F. Scarano, "An efficient and accurate approach to MTE-MART for time-resolved tomographic PIV", Exp.
   Fluids 56 (2015) 66, doi:10.1007/s00348-015-1934-6.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.reconstruction.frame import PreparedFrame
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.sieve import coefficients
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.sequence.fixed_lag import ROUGHEST, agreed_guess, mean_flow, roughness
from lfpiv.sequence.flow import measure_flow
from lfpiv.sequence.motion_field import LEAST_VALID, MotionField
from lfpiv.settings.processing import Correlation
from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import deform

PERSISTENCE = 0.9
"""Exponent of the moved volume in the first guess."""
FLOW_MEMORY = 0.7
"""Weight of the flow known before in the flow that moves the next frame."""
FIRST_SHARE = 0.35
"""Iterations of a frame that starts from its images, as a share of the iterations of a frame by itself."""
ITERATION_SHARE = 0.2
"""Iterations of a predicted frame over iterations of an independent frame."""
SHARE_SUBSETS = 4
"""Number of subsets up to which `ITERATION_SHARE` holds. With more subsets, fewer iterations make as many steps."""
DIMMEST = 0.05
"""Least light of the moved volume in the first guess, as a share of the guess's mean."""
FAINTEST = 1e-6
"""Least light of a voxel in the first guess, as a share of the brightest one. SMART can raise it; it cannot raise 0."""

CORRECTING_TIME = 2.0
"""Nesterov's time at which the momentum begins in a correction: its few steps are longer than plain ones."""
TRIES = 2
"""Successive frames whose flow is too rough to be followed after which no flow of a segment is looked at any more."""
LEAST_AGREEMENT = 0.9
"""Largest misfit of a prediction, as a share of the misfit of particles in other places."""

MeasureFlow = Callable[[xr.DataArray, xr.DataArray, Mapping[str, Any], xr.Dataset | None], xr.Dataset]
"""Takes two successive volumes, settings of `correlate` and the flow known before; returns the flow between them."""


class StartedFrom(enum.Enum):
    """From what a frame started; the text says why."""

    FIRST = "the flow is not known yet"
    PREDICTED = "started from the instant before, moved by the flow"
    UNRESOLVED = "the flow varies too much from vector to vector to move particles by it: reconstructed by itself"
    MISSED = "the instant before, moved by the flow, fits the images no better than particles in other places"


@dataclass(frozen=True, kw_only=True, eq=False)
class PreviousFrame:
    """What is known at a frame, for the next one."""

    volume: np.ndarray
    """Volume on the grid of the reconstruction, shape (z, y, x), float32."""
    measured: xr.DataArray
    """Volume on the grid of the experiment, in which the flow is measured."""
    earlier: xr.DataArray | None = None
    """The same of the frame before; None where the particles cannot be followed from it."""
    flow: xr.Dataset | None = None
    """Displacement from one frame to the next as known at the frame before; None if it is not known."""
    unresolved: int = 0
    """Number of the last frames, one after the other, whose flow was too rough to be followed."""

    @property
    def given_up(self) -> bool:
        """Whether all following frames are reconstructed by themselves."""
        return self.unresolved >= TRIES


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceResult:
    """One frame of a sequence, from its images and the frames before it."""

    prepared: PreparedFrame | None
    """The images; None once they are not needed any more."""
    found: Reconstruction
    started_from: StartedFrom
    flow: xr.Dataset | None = None
    """Displacement from one frame to the next, as it was known before this frame."""
    vectors: xr.Dataset | None = None
    """Displacement between the two frames before this one; None if it was not measured."""
    misfit_ratio: float = math.nan
    """Misfit of a prediction that missed over that of particles in other places; NaN for other starts."""

    def as_previous(self, measured: xr.DataArray, last: PreviousFrame | None) -> PreviousFrame:
        """Return what the next frame starts from. `measured` is this volume on the grid of the experiment.

        Particles are not followed from the frame before if the prediction missed. The flow stays known: one dark
        image does not change it.
        """
        earlier = None if last is None or self.started_from is StartedFrom.MISSED else last.measured
        known = 0 if last is None else last.unresolved
        unresolved = known + 1 if self.started_from is StartedFrom.UNRESOLVED else 0
        volume = self.found.volume
        return PreviousFrame(volume=volume, measured=measured, earlier=earlier, flow=self.flow, unresolved=unresolved)


class SequenceSolver:
    """SMART along a time series with fixed weights and settings.

    Parameters
    ----------
    smart : SmartSolver
        Solver of each frame. One that starts from the frame before has `ITERATION_SHARE` of its iterations.
    correlation : mapping, optional
        Settings of `correlate`, which measures the flow; default: those of an experiment without such a table. Windows
        that are None are taken from `lfpiv.sequence.flow`.
    measure : callable, optional
        Replaces `lfpiv.sequence.flow.measure_flow`, for a caller that knows the flow.
    """

    def __init__(
        self,
        smart: SmartSolver,
        correlation: Mapping[str, Any] | None = None,
        measure: MeasureFlow = measure_flow,
    ):
        self.smart = smart
        self.correlation = Correlation().model_dump() if correlation is None else dict(correlation)
        self._measure = measure

    def solve(
        self,
        images: Mapping[str, np.ndarray],
        previous: PreviousFrame | None,
        *,
        floor: float | Mapping[str, float] | None = None,
        mask: np.ndarray | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> SequenceResult:
        """Reconstruct a frame from its images and the one before; arguments as of `SmartSolver.solve`.

        `previous` is what is known at the frame before; None reconstructs the frame from its images alone.

        Raises
        ------
        ValueError
            If `SmartSolver.solve` or `correlate` refuse their arguments.
        """
        given_up = previous is not None and previous.given_up
        known = None if given_up else previous
        prepared, (flow, vectors) = runtime.side_by_side(
            lambda: self.smart.prepare(images, floor=floor, mask=mask), lambda: self._flow(known)
        )

        def solved(
            started_from: StartedFrom, share: float, first: np.ndarray | None = None, ratio: float = math.nan
        ) -> SequenceResult:
            if share == 1:
                found = prepared.solve(progress=progress)
            else:
                count = math.ceil(share * self.smart.settings.iterations)
                if first is None:
                    found = prepared.solve(iterations=count, whole_passes=0, brief=True, progress=progress)
                else:
                    found = self._continued(prepared, first, count, progress)
            return SequenceResult(
                prepared=prepared,
                found=found,
                started_from=started_from,
                flow=flow,
                vectors=vectors,
                misfit_ratio=ratio,
            )

        if given_up:
            return solved(StartedFrom.UNRESOLVED, 1)
        if previous is None or flow is None:
            return solved(StartedFrom.FIRST, FIRST_SHARE)
        if roughness(flow) > ROUGHEST:
            return solved(StartedFrom.UNRESOLVED, 1)
        plain = prepared.guess()
        guess = predicted_guess(previous.volume, plain, flow)
        misfit = prepared.sampled_misfit(guess)
        if not misfit < prepared.sampled_misfit():
            exchanged = predicted_guess(_exchanged(previous.volume), plain, flow)
            chance = prepared.sampled_misfit(exchanged)
            if not misfit < LEAST_AGREEMENT * chance:
                return solved(StartedFrom.MISSED, FIRST_SHARE, ratio=misfit / chance if chance > 0 else 1.0)
        return solved(StartedFrom.PREDICTED, ITERATION_SHARE, guess)

    def correct(
        self, trail: Sequence[SequenceResult], at: int, progress: Callable[[float], None] | None = None
    ) -> Reconstruction:
        """Reconstruct one frame again from those before and after it.

        Parameters
        ----------
        trail : sequence of SequenceResult
            Successive frames that show the same particles, at most `lfpiv.experiment.segments.REACH` on each side.
        at : int
            Index of the frame in `trail`.
        progress : callable, optional
            Called with the finished fraction.

        Returns
        -------
        Reconstruction
            If the flow between the frames is not known well enough, the one by `SmartSolver.solve`, from its images.
        """
        own = trail[at]
        assert own.prepared is not None
        alone = own.found if own.started_from is StartedFrom.UNRESOLVED else None
        flows = [one.vectors for one in trail[2:] if one.vectors is not None]
        if not flows and trail[-1].flow is not None:
            flows = [trail[-1].flow]
        flow = mean_flow(flows) if flows else None
        others = {} if flow is None else _within_reach(trail, at, roughness(flow))
        if flow is None or not others:
            return own.prepared.with_unlike_light(alone or own.prepared.solve(progress=progress))
        guess = agreed_guess(own.found, others, flow)
        partition = own.prepared.normalisation.correcting
        after = own.prepared.refine(guess, [partition], epochs=1, time=CORRECTING_TIME, progress=progress)
        return own.prepared.with_unlike_light(own.found.continued_by(after))

    def _continued(
        self, prepared: PreparedFrame, guess: np.ndarray, count: int, progress: Callable[[float], None] | None
    ) -> Reconstruction:
        """Reconstruct a frame from a guess by the one before, in `count` iterations or by as many steps of subsets.

        Its last misfit is NaN.
        """
        normal = prepared.normalisation
        if not normal.followed:
            return prepared.solve(iterations=count, first=guess, brief=True, progress=progress)
        count, time = max(round(count * min(1, SHARE_SUBSETS / len(self.smart.subsets))), 1), normal.following_time
        return prepared.refine(guess, normal.followed, epochs=count, time=time, brief=True, progress=progress)

    def _flow(self, previous: PreviousFrame | None) -> tuple[xr.Dataset | None, xr.Dataset | None]:
        """Return the displacement by which the next frame is predicted, and the last one measured, if known."""
        if previous is None:
            return None, None
        if previous.earlier is None:
            return previous.flow, None
        found = self._measure(previous.earlier, previous.measured, self.correlation, previous.flow)
        if found.attrs["valid_fraction"] < LEAST_VALID * found.attrs["measurable_fraction"]:
            return previous.flow, None
        if previous.flow is None:
            return found, found
        mean = {}
        for name in (f"displacement_{axis}" for axis in "zyx"):
            values = FLOW_MEMORY * previous.flow[name].values + (1 - FLOW_MEMORY) * found[name].values
            mean[name] = (AXES, values, found[name].attrs)
        return found.assign(mean), found


def predicted_guess(volume: np.ndarray, plain: Reconstruction, flow: xr.Dataset) -> np.ndarray:
    """Return the first guess of a frame from the volume of the frame before.

    Parameters
    ----------
    volume : ndarray, shape (z, y, x), float32
        Volume of the frame before.
    plain : Reconstruction
        First guess of the frame from its images alone.
    flow : Dataset
        From `correlate`: displacement from one frame to the next [voxel of the vectors' volumes].

    Returns
    -------
    ndarray, shape (z, y, x), float32
        With the light of the guess from the images; zero where that is zero.
    """
    own, light = plain.volume, float(plain.volume.sum(dtype=np.float64))
    motion = MotionField(plain.grid.axes_mm, flow)
    moved, inside = motion.carried(deform.spline_coefficients(volume), -1)
    np.maximum(moved, 0, out=moved)
    total = float(moved.sum(dtype=np.float64))
    if not (light > 0 and total > 0):
        return own
    moved = coefficients(moved, plain.sieve_voxel)
    exponent = np.float32(PERSISTENCE) * motion.trust * np.where(inside > 0.5, inside, 0)
    moved = np.maximum(moved * np.float32(light / total), np.float32(DIMMEST * own.mean(dtype=np.float64)))
    guess: np.ndarray = np.where(own > 0, moved**exponent * np.maximum(own, FAINTEST * own.max()) ** (1 - exponent), 0)
    guess *= np.float32(light / guess.sum(dtype=np.float64))
    return guess


def _within_reach(trail: Sequence[SequenceResult], at: int, rough: float) -> dict[int, Reconstruction]:
    """Return other frames from which particles are moved to one, by the number of steps to it."""
    steps = {number: at - number for number in range(len(trail)) if number != at}
    return {step: trail[number].found for number, step in steps.items() if abs(step) * rough <= ROUGHEST}


def _exchanged(volume: np.ndarray) -> np.ndarray:
    """Return a volume (z, y, x) with its quarters exchanged along y and x: the same particles in other places."""
    return np.roll(volume, (volume.shape[1] // 2, volume.shape[2] // 2), (1, 2))
