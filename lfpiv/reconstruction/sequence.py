"""`SequenceSolver`: SMART along a time series, where each instant starts from the one before, moved by the flow.

Images of two cameras hardly distinguish particles from ghosts: SMART keeps what its first guess holds. Particles move
with the flow, and a ghost moves with the flow only where all particles on its lines of sight move alike. So the volume
of the instant before, moved by the flow, is a better first guess than one from the images alone, and needs fewer
iterations. This is the sequential form of motion tracking enhancement [1]_, [2]_.

The guess is the product of powers M^p F^(1 - p) of the moved volume M and the guess F from the images, with the
exponent p = `PERSISTENCE` where the flow is known, and 0 elsewhere. SMART multiplies its first guess, so what the
images do not determine is forgotten by the factor p in each instant. Particles that enter through a face come from F.

.. [1] M. Novara, K. J. Batenburg, F. Scarano, "Motion tracking-enhanced MART for tomographic PIV", Meas. Sci. Technol.
   21 (2010) 035401, doi:10.1088/0957-0233/21/3/035401.
.. [2] K. P. Lynch, F. Scarano, "An efficient and accurate approach to MTE-MART for time-resolved tomographic PIV", Exp.
   Fluids 56 (2015) 66, doi:10.1007/s00348-015-1934-6.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.experiment.settings import Correlation
from lfpiv.reconstruction.motion import LEAST_VALID
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.shared_light import MotionField
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.velocity.cross_correlation import correlate
from lfpiv_kernels.correlation import deform

PERSISTENCE = 0.8
"""Exponent of the moved volume in the first guess."""
FLOW_MEMORY = 0.5
"""Weight of the flow known before in the flow that moves the next instant."""
ITERATION_SHARE = 0.3
"""Iterations of an instant that starts from the one before, as a share of those of one that starts from its images."""
DIMMEST = 0.05
"""Least light of the moved volume in the first guess, as a share of the guess's mean."""
FAINTEST = 1e-6
"""Least light of a voxel in the first guess, as a share of the brightest one. SMART can raise it; it cannot raise 0."""

UNBLURRED = 5
"""Steps that undo the sieve's blur of the moved volume."""

LEAST_AGREEMENT = 0.9
"""Largest misfit of a prediction, as a share of the misfit of particles in other places."""

Correlate = Callable[[xr.DataArray, xr.DataArray, Mapping[str, Any]], xr.Dataset]
"""Takes two volumes and settings of `correlate`; returns the vectors between them."""


class Start(enum.Enum):
    """From what an instant started; the text says why."""

    FIRST = "the flow is not known yet"
    PREDICTED = "started from the instant before, moved by the flow"
    MISSED = "the instant before, moved by the flow, fits the images no better than particles in other places"


@dataclass(frozen=True, kw_only=True, eq=False)
class Before:
    """What is known at an instant, for the next one."""

    volume: np.ndarray
    """Volume on the grid of the reconstruction, shape (z, y, x), float32."""
    measured: xr.DataArray
    """Volume on the grid of the experiment, in which the flow is measured."""
    earlier: xr.DataArray | None = None
    """The same of the instant before; None where the particles cannot be followed from it."""
    flow: xr.Dataset | None = None
    """Displacement from one instant to the next as known at the instant before; None if it is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solved:
    """One instant of a sequence."""

    found: Reconstruction
    start: Start
    flow: xr.Dataset | None = None
    """Displacement from one instant to the next, as it was known before this instant."""
    misfit_ratio: float = math.nan
    """Misfit of a prediction that missed over that of particles in other places; NaN for other starts."""

    def before(self, measured: xr.DataArray, last: Before | None) -> Before:
        """Return what the next instant starts from. `measured` is this volume on the grid of the experiment.

        Particles are not followed from the instant before if the prediction missed. The flow stays known: one dark
        image does not change it.
        """
        earlier = None if last is None or self.start is Start.MISSED else last.measured
        return Before(volume=self.found.volume, measured=measured, earlier=earlier, flow=self.flow)


class SequenceSolver:
    """SMART along a time series with fixed weights and settings.

    Parameters
    ----------
    smart : SmartSolver
        Solver of each instant. One that starts from the instant before has at most `ITERATION_SHARE` of its iterations.
    correlation : mapping, optional
        Settings of `correlate`, which measures the flow; default: those of an experiment without such a table.
    correlate : callable, optional
        Replaces `lfpiv.correlate`, for a caller that has the vectors already.
    """

    def __init__(
        self,
        smart: SmartSolver,
        correlation: Mapping[str, Any] | None = None,
        correlate: Correlate | None = None,
    ):
        self.smart = smart
        self.correlation = Correlation().model_dump() if correlation is None else dict(correlation)
        self._correlate = _correlate if correlate is None else correlate

    def solve(
        self,
        images: Mapping[str, np.ndarray],
        before: Before | None,
        *,
        floor: float | Mapping[str, float] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Solved:
        """Reconstruct an instant; arguments as of `SmartSolver.solve`.

        `before` is what is known at the instant before; None reconstructs the instant from its images alone.

        Raises
        ------
        ValueError
            If `SmartSolver.solve` or `correlate` refuse their arguments.
        """
        flow = None if before is None else self._flow(before)
        if before is None or flow is None:
            return Solved(found=self.smart.solve(images, floor=floor, progress=progress), start=Start.FIRST)

        def tried(first: np.ndarray | None) -> Reconstruction:
            return self.smart.solve(images, floor=floor, iterations=0, first=first)

        plain = tried(None)
        guess = predicted_guess(before.volume, plain, flow)
        misfit = tried(guess).misfit[0]
        if not misfit < plain.misfit[0]:
            chance = tried(predicted_guess(_exchanged(before.volume), plain, flow)).misfit[0]
            if not misfit < LEAST_AGREEMENT * chance:
                found = self.smart.solve(images, floor=floor, progress=progress)
                ratio = misfit / chance if chance > 0 else 1.0
                return Solved(found=found, start=Start.MISSED, flow=flow, misfit_ratio=ratio)
        count = math.ceil(ITERATION_SHARE * self.smart.settings.iterations)
        found = self.smart.solve(images, floor=floor, iterations=count, first=guess, progress=progress)
        return Solved(found=found, start=Start.PREDICTED, flow=flow)

    def _flow(self, before: Before) -> xr.Dataset | None:
        """Return the displacement by which the next instant is predicted; None if it is not known."""
        if before.earlier is None:
            return before.flow
        found = self._correlate(before.earlier, before.measured, self.correlation)
        if found.attrs["valid_fraction"] < LEAST_VALID * found.attrs["measurable_fraction"]:
            return before.flow
        if before.flow is None:
            return found
        names = [f"displacement_{axis}" for axis in "zyx"]
        mean = {name: FLOW_MEMORY * before.flow[name] + (1 - FLOW_MEMORY) * found[name] for name in names}
        return found.assign(mean)


def predicted_guess(volume: np.ndarray, plain: Reconstruction, flow: xr.Dataset) -> np.ndarray:
    """Return the first guess of an instant from the volume of the instant before.

    Parameters
    ----------
    volume : ndarray, shape (z, y, x), float32
        Volume of the instant before.
    plain : Reconstruction
        First guess of the instant from its images alone.
    flow : Dataset
        From `correlate`: displacement from one instant to the next [voxel of the vectors' volumes].

    Returns
    -------
    ndarray, shape (z, y, x), float32
        With the light of the guess from the images; zero where that is zero.
    """
    own, light = plain.volume, float(plain.volume.sum(dtype=np.float64))
    motion = MotionField(plain.to_dataarray(), flow)
    field = motion.displacement(-1)
    moved = np.maximum(motion.carried(deform.spline_coefficients(volume), field), 0)
    total = float(moved.sum(dtype=np.float64))
    if not (light > 0 and total > 0):
        return own
    moved = coefficients(moved, plain.sieve_voxel)
    inside = np.clip(motion.carried(deform.spline_coefficients(np.ones_like(volume)), field), 0, 1)
    exponent = np.float32(PERSISTENCE) * motion.trust * np.where(inside > 0.5, inside, 0)
    moved = np.maximum(moved * np.float32(light / total), np.float32(DIMMEST * own.mean(dtype=np.float64)))
    guess: np.ndarray = np.where(own > 0, moved**exponent * np.maximum(own, FAINTEST * own.max()) ** (1 - exponent), 0)
    guess *= np.float32(light / guess.sum(dtype=np.float64))
    return guess


def _exchanged(volume: np.ndarray) -> np.ndarray:
    """Return a volume (z, y, x) with its quarters exchanged along y and x: the same particles in other places."""
    return np.roll(volume, (volume.shape[1] // 2, volume.shape[2] // 2), (1, 2))


def coefficients(volume: np.ndarray, sieve_voxel: float) -> np.ndarray:
    """Return coefficients c >= 0 of a sieve G with G c near a volume (z, y, x): c <- c G (E / G c), `UNBLURRED` times.

    These are the steps of Richardson and Lucy; they keep the light. SMART takes its first guess as coefficients.
    """
    if sieve_voxel == 0:
        return volume
    nz, ny, nx = volume.shape
    sieve, flat = Sieve(sieve_voxel, (nz, ny, nx)), volume.ravel()
    found, least = flat, np.float32(FAINTEST * volume.max())
    for _ in range(UNBLURRED):
        found = found * sieve(flat / np.maximum(sieve(found), least))
    return found.reshape(volume.shape)


def _correlate(first: xr.DataArray, second: xr.DataArray, settings: Mapping[str, Any]) -> xr.Dataset:
    return correlate(first, second, dt_s=1.0, **settings)
