"""`PreparedFrame`: the images of one frame and all that SMART needs to reconstruct it, perhaps several times."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lfpiv.reconstruction.first_guess import checked_guess, multiplicative_guess
from lfpiv.reconstruction.history import History
from lfpiv.reconstruction.image_preparation import PreparedImage
from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.normalisation import LensSubsets, RowSubsets
from lfpiv.reconstruction.ordered_subsets import Epoch, Partition, Subset, iterate_epochs, whole_subset
from lfpiv.reconstruction.result import Reconstruction, SmartStop
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.smart import ImageEquations, Misfit, State, iterate
from lfpiv.reconstruction.unlike_light import unlike_light
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.voxels import multiply
from lfpiv_kernels.transfer import DeviceArray, duplicate, to_device, to_host

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """Images of one frame with all that SMART needs to know of them. Made by `SmartSolver.prepare`."""

    stored: StoredGrid
    settings: SmartSettings
    images: Mapping[str, PreparedImage]
    normalisation: LensSubsets | RowSubsets
    intensity_cap: float
    solid: np.ndarray | None
    """True for voxels without fluid, shape (z, y, x); None without a mask."""
    views: np.ndarray | None
    """Number of cameras that see each voxel, for the result; None if two see every voxel."""
    equations: ImageEquations

    def solve(
        self,
        *,
        iterations: int | None = None,
        whole_passes: int | None = None,
        first: np.ndarray | None = None,
        brief: bool = False,
        progress: Callable[[float], None] | None = None,
    ) -> Reconstruction:
        """Reconstruct the frame; arguments and exceptions as of `SmartSolver.solve`.

        `whole_passes` is the number of passes over all rays after those over subsets; default: that of the subsets. A
        `brief` reconstruction over subsets leaves out what nobody reads: the projection before the first epoch, whose
        misfit is then the sum over the subsets, and after the last epoch, whose misfit is then NaN.
        """
        settings, normalisation = self.settings, self.normalisation
        state = self._start(duplicate(self._from_images) if first is None else self._given(first))
        count = settings.iterations if iterations is None else iterations
        history = History(settings, count)
        epochs, whole_passes = normalisation.passes(count, whole_passes)
        partitions = normalisation.partitions if epochs else ()
        sieve, rose = normalisation.sieve, False
        with self.equations.locked():
            if partitions:
                if not brief:  # exact, as all steps begin here
                    history.append(self.equations.compare(sieve(state.coefficients)))
                made = iterate_epochs(self.equations, state, sieve, partitions=partitions, epochs=epochs)
                state, rose = _run_epochs(made, state, history, progress)
            left = count - history.epochs
            enough = normalisation.suffice and left > whole_passes and not rose
            if enough:
                left = whole_passes
            if brief and left == 0:
                volume, stop = sieve(state.coefficients), None
                history.append(Misfit(math.nan, math.nan))
            else:
                volume, stop = self._solve_whole(state, history, left, progress)
        last = SmartStop.ENOUGH if enough else SmartStop.DONE if settings.tolerance == 0 else SmartStop.ITERATION_LIMIT
        return self._reconstruction(volume, history, stop or last)

    def refine(
        self,
        first: np.ndarray,
        partitions: Sequence[Partition],
        *,
        epochs: int,
        time: float = 1.0,
        brief: bool = False,
        progress: Callable[[float], None] | None = None,
    ) -> Reconstruction:
        """Reconstruct the frame from a first guess that shows already where particles are, by subsets of the rays.

        No pass over all rays follows. Misfits are those of the subsets before each step, scaled to the light of all
        rays. After the last step it is that of `RowSubsets.sample`, scaled likewise. Without a sieve voxels
        that become dark are left out.

        Parameters
        ----------
        first : ndarray, shape (z, y, x), float32
            First guess.
        partitions : sequence of Partition
            As of `iterate_epochs`. All have the same rays.
        epochs : int
            Largest number of epochs.
        time : float
            As of `iterate_epochs`.
        brief : bool
            Leave out the misfit after the last step, which is then NaN.
        progress : callable, optional
            Called with the finished fraction.

        Raises
        ------
        ValueError
            As `solve`.
        """
        state, sieve = self._start(self._given(first)), self.normalisation.sieve
        history = History(self.settings, epochs)
        with self.equations.locked():
            made = iterate_epochs(self.equations, state, sieve, partitions=partitions, epochs=epochs, time=time)
            state, _ = _run_epochs(made, state, history, progress)
            history.scale(*self._part_of_light(partitions[0].subsets))
            volume = sieve(state.coefficients)
            history.append(Misfit(math.nan, math.nan) if brief else self._sampled(volume))
        stop = SmartStop.DONE if brief else history.early_stop or SmartStop.DONE
        return self._reconstruction(volume, history, stop)

    def _start(self, guess: DeviceArray) -> State:
        """Return the state from which SMART iterates. Overwrites the guess."""
        return State(guess, Momentum(guess) if self.settings.accelerate else None, self.normalisation.steps)

    def _reconstruction(self, volume: DeviceArray, history: History, stop: SmartStop) -> Reconstruction:
        """Return what SMART found, and log a divergence."""
        if stop is SmartStop.DIVERGED:
            log.warning("SMART: %s", stop.value)
        return Reconstruction(
            grid=self.stored.grid,
            volume=self._restored(volume),
            solid=self.solid,
            views=self.views,
            residual=tuple(float(np.sqrt(squares)) / self._norm for squares in history.squares),
            misfit=tuple(history.divergence),
            stop=stop,
            floor={name: one.floor for name, one in self.images.items()},
            camera_gain={name: one.camera_gain for name, one in self.images.items()},
            light_outside={name: one.light_outside for name, one in self.images.items()},
            light={name: float(one.image.sum(dtype=np.float64)) for name, one in self.images.items()},
            sieve_voxel=self.normalisation.sieve.sigma_voxel,
            intensity_cap=self.intensity_cap,
            settings=self.settings,
        )

    def guess(self) -> Reconstruction:
        """Return a first guess from the images alone, without iterations.

        It takes the rays of `RowSubsets.part`, and so less time than the guess that `solve` starts from.
        """
        history = History(self.settings, 0)
        history.append(Misfit(math.nan, math.nan))
        return self._reconstruction(self.normalisation.sieve(self._from_part), history, SmartStop.DONE)

    def sampled_misfit(self, first: np.ndarray | None = None) -> float:
        """Return the misfit of a first guess (z, y, x) in a part of the rays [counts]; raise ValueError as `solve`.

        It is scaled to the light of all rays. The part is `RowSubsets.sample`, or all. Default: that of `guess`.
        """
        guess = self._from_part if first is None else self._given(first)
        with self.equations.locked():
            return self._sampled(self.normalisation.sieve(guess)).divergence

    def _sampled(self, volume: DeviceArray) -> Misfit:
        """Return the misfit of a volume in a part of the rays, scaled to the light of all rays."""
        sample = self.normalisation.sample
        if not sample:
            return self.equations.compare(volume)
        self.equations.begin()
        for subset in sample:
            for camera, ray_set in subset.parts:
                self.equations.compare_part(camera, ray_set, volume)
        found, (squares, light) = self.equations.measured(), self._sampled_part
        return Misfit(found.squares / squares, found.divergence / light)

    @cached_property
    def _sampled_part(self) -> tuple[float, float]:
        """`_part_of_light` of `RowSubsets.sample`."""
        return self._part_of_light(self.normalisation.sample)

    def _part_of_light(self, subsets: Sequence[Subset]) -> tuple[float, float]:
        """Return the rays' part of the images' sum of squared counts, and of the sum of the counts; 1 without light."""
        seen = [
            self.equations.comparisons[camera].counts_of(ray_set) for one in subsets for camera, ray_set in one.parts
        ]
        squares = sum(float(np.einsum("i,i", counts, counts, dtype=np.float64)) for counts in seen)
        light = sum(float(counts.sum(dtype=np.float64)) for counts in seen)
        return (squares / self._norm**2, light / self._light) if light > 0 else (1.0, 1.0)

    def exponents(self, stored: np.ndarray) -> tuple[list[np.ndarray], Misfit]:
        """Compare a volume (voxel,) with the images: back-projected logarithms of each camera, and the misfit of all.

        Volume and logarithms are in stored order.
        """
        with self.equations.locked():
            self.equations.begin()
            on_device = to_device(stored, float)
            rays = whole_subset(len(self.images)).parts
            exponents = [to_host(self.equations.exponent_of((one,), on_device)).copy() for one in rays]
            return exponents, self.equations.measured()

    def unlike_light(self, exponents: Sequence[np.ndarray], stored: np.ndarray) -> float:
        """Return how much the cameras ask for unlike light, from `exponents` of a volume (voxel,)."""
        return unlike_light(exponents, self.normalisation.camera_sums, stored)

    def with_unlike_light(self, found: Reconstruction) -> Reconstruction:
        """Return a reconstruction of the frame with how much the cameras ask for unlike light."""
        if len(self.images) == 1:
            return replace(found, unlike=0.0)
        stored = self.stored.store(found.volume)
        return replace(found, unlike=self.unlike_light(self.exponents(stored)[0], stored))

    def _given(self, first: np.ndarray) -> DeviceArray:
        """Return the caller's first guess, shape (z, y, x), on the device, without light that no camera sees."""
        return multiply(to_device(checked_guess(first, self.stored), float), self.normalisation.lit)

    def _restored(self, volume: DeviceArray) -> np.ndarray:
        """Return a volume (z, y, x) of the host without the light that the sieve spreads into the solid."""
        restored = self.stored.restore(to_host(volume))
        return restored if self.solid is None else np.where(self.solid, np.float32(0), restored)

    @cached_property
    def _from_images(self) -> DeviceArray:
        """First guess from the images alone, in stored order, on the device."""
        return self._guessed()

    @cached_property
    def _from_part(self) -> DeviceArray:
        """First guess by the rays of `RowSubsets.part`, in stored order, on the device."""
        part = self.normalisation.part
        return self._from_images if part is None else self._guessed(*part)

    def _guessed(self, subset: Subset | None = None, sums: DeviceArray | None = None) -> DeviceArray:
        """Return `multiplicative_guess` of the images by all rays, or by a subset with its sums of weights."""
        peaks, normal = [one.peak for one in self.images.values()], self.normalisation
        return multiplicative_guess(
            self.equations.comparisons, peaks, normal.column_sum, normal.lit, normal.shown, subset=subset, sums=sums
        )

    @cached_property
    def _norm(self) -> float:
        """Euclidean norm of all images [counts]."""
        images = (one.image for one in self.images.values())
        return float(np.sqrt(sum(np.einsum("i,i", image, image, dtype=np.float64) for image in images)))

    @cached_property
    def _light(self) -> float:
        """Sum of the counts of all images."""
        return sum(float(one.image.sum(dtype=np.float64)) for one in self.images.values())

    def _solve_whole(
        self,
        state: State,
        history: History,
        left: int,
        progress: Callable[[float], None] | None,
    ) -> tuple[DeviceArray, SmartStop | None]:
        """Iterate over all rays `left` times. Return the last volume, and why it stopped early."""
        done = history.epochs
        states = iterate(self.equations, state, self.normalisation.sieve, iterations=left)
        for number, (volume, misfit) in enumerate(states):  # noqa: B007 - the last volume is the result
            history.append(misfit)
            if progress is not None:
                progress((done + number + 1) / (history.iterations + 1))
            stop = history.early_stop
            if stop is not None:
                break
        return volume, stop


def _run_epochs(
    epochs: Iterable[Epoch], state: State, history: History, progress: Callable[[float], None] | None
) -> tuple[State, bool]:
    """Iterate until an epoch hardly lowers the misfit. Return the state, and whether the misfit of the last one rose.

    The history has the misfit before the first epoch already, or gets the sum over its subsets in place of it.
    """
    rose = False
    for epoch in epochs:
        state, rose = epoch.state, epoch.rose
        if len(history.divergence) == history.epochs:
            history.append(epoch.misfit)
        history.subsets.append(epoch.subsets)
        if progress is not None:
            progress(history.epochs / (history.iterations + 1))
        if history.settled and not epoch.undone:
            break
    return state, rose
