"""`SmartSolver`: SMART for one rig. Made once, it reconstructs the volume of every instant from its images."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import xarray as xr

from lfpiv.geometry.volume import checked_mask
from lfpiv.reconstruction.first_guess import checked_guess, multiplicative_guess
from lfpiv.reconstruction.intensity_cap import CAP, POINT_CAP
from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.ordered_subsets import WHOLE_PASSES, Partition, Subset, iterate_epochs, step_sizes, subsets_of
from lfpiv.reconstruction.particle_size import UNLIKE, ParticleSizer
from lfpiv.reconstruction.recording import Recording, checked_images, record
from lfpiv.reconstruction.resting_voxels import RestingVoxels
from lfpiv.reconstruction.result import Reconstruction, SmartStop
from lfpiv.reconstruction.settings import AUTO, SmartSettings
from lfpiv.reconstruction.sieve import Sieve, Smoothing
from lfpiv.reconstruction.smart import CameraEquation, ImageEquations, Misfit, State, iterate
from lfpiv.reconstruction.steps import SharpenedStep, SmartStep, Step
from lfpiv.weights.operator import Weights
from lfpiv_kernels.reconstruction.projector import ALL, EVEN, ODD

log = logging.getLogger(__name__)

LEAST_COLUMN_SUM = 1e-6
"""Least sum of the weights of a voxel that some camera sees, as a share of the largest one."""
FEW_CAMERAS = 2
"""Number of cameras up to which "auto" cuts the rays of each camera into two subsets."""
LEAST_ALONE = 0.8
"""Least share of a camera's pixels that see lenses of one half only."""
DIVERGENCE = 1.5
"""Rise of the misfit over its first value that counts as divergence. Smoothing may raise it a little."""


@dataclass
class _History:
    """Misfits of an iteration so far, and whether it should stop."""

    settings: SmartSettings
    iterations: int
    squares: list[float] = field(default_factory=list)
    divergence: list[float] = field(default_factory=list)
    subsets: list[int] = field(default_factory=list)
    """Number of subsets of each iteration over subsets. These come first. Their misfits are sums over the subsets'
    pixels, so not quite exact."""

    def append(self, misfit: Misfit) -> None:
        self.squares.append(misfit.squares)
        self.divergence.append(misfit.divergence)

    @property
    def epochs(self) -> int:
        """Number of iterations over subsets."""
        return len(self.subsets)

    @property
    def early_stop(self) -> SmartStop | None:
        """Reason to stop before the last iteration; None to go on."""
        count, misfit, tolerance = len(self.divergence) - 1, self.divergence, self.settings.tolerance
        if count > 0 and not misfit[-1] <= DIVERGENCE * misfit[0]:  # true for NaN
            return SmartStop.DIVERGED
        whole = self.epochs < count  # both misfits are those of all rays
        if tolerance > 0 and whole and count < self.iterations and misfit[-2] - misfit[-1] < tolerance * misfit[-2]:
            return SmartStop.CONVERGED
        return None

    @property
    def settled(self) -> bool:
        """Whether the last epoch hardly lowered the misfit of the same subsets, or made it no number."""
        if self.settings.tolerance == 0 or self.epochs < 2 or self.subsets[-1] != self.subsets[-2]:
            return False
        before, after = self.divergence[-2:]
        return not before - after >= self.subsets[-1] * self.settings.tolerance * before


class SmartSolver:
    """SMART with fixed weights and settings.

    Parameters
    ----------
    weights : Weights
        The operator.
    settings : SmartSettings
        Settings of every reconstruction.
    mask : ndarray or DataArray, shape (z, y, x), optional
        Voxels without fluid, as of `lfpiv.reconstruct`.

    Raises
    ------
    ValueError
        If the mask does not fit the volume.
    """

    def __init__(self, weights: Weights, settings: SmartSettings, mask: np.ndarray | xr.DataArray | None = None):
        self.weights = weights
        self.settings = settings
        grid = weights.grid
        self.solid = None if mask is None else checked_mask(mask, [grid.axis_mm(axis) for axis in range(3)])
        """True for voxels without fluid, shape (z, y, x); None without a mask."""

    def solve(
        self,
        images: Mapping[str, np.ndarray],
        *,
        floor: float | Mapping[str, float] | None = None,
        iterations: int | None = None,
        first: np.ndarray | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Reconstruction:
        """Reconstruct one instant; arguments and exceptions as of `lfpiv.reconstruct`.

        `iterations` replaces that of the settings.
        """
        prepared = self.prepare(images, floor=floor)
        return prepared.solve(iterations=iterations, first=first, progress=progress)

    def prepare(
        self, images: Mapping[str, np.ndarray], *, floor: float | Mapping[str, float] | None = None
    ) -> PreparedInstant:
        """Measure what SMART needs to know of the images of one instant; arguments and exceptions as of `solve`."""
        settings, stored = self.settings, self.weights.stored
        images = checked_images(self.weights, images)
        sieve = Sieve(self._sieve_voxel(images), stored.shape)
        cap = self._intensity_cap(images, sieve)
        recordings = record(self.weights, images, floor=floor, floor_share=settings.floor_share, intensity_cap=cap)
        gains = (np.float32(one.camera_gain) for one in recordings.values())
        column_sum = sum(gain * own for gain, own in zip(gains, self.weights.camera_sums, strict=True))
        lit = column_sum > LEAST_COLUMN_SUM * column_sum.max()
        if self.solid is not None:
            lit &= stored.store(~self.solid) > 0
        equations = ImageEquations([self._equation(name, one) for name, one in recordings.items()])
        return PreparedInstant(self, recordings, equations, sieve, cap, column_sum, lit)

    @cached_property
    def subsets(self) -> tuple[Subset, ...]:
        """The ordered subsets to begin with; one without any.

        Raises
        ------
        ValueError
            If the rays cannot be cut into the number of subsets that the settings ask for.
        """
        cameras, wanted = len(self.weights.cameras), self.settings.subsets
        halves = all(self._can_halve(name) for name in self.weights.cameras)
        possible = sorted({1, cameras, 2 * cameras if halves else 1})
        if isinstance(wanted, str):
            few = cameras <= FEW_CAMERAS or not halves
            wanted = (possible[-1] if few else cameras) if self.settings.allows_subsets else 1
        if wanted not in possible:
            numbers = ", ".join(map(str, possible))
            raise ValueError(f"subsets: with these cameras expected one of {numbers}, got {wanted}.")
        return subsets_of(cameras, wanted == 2 * cameras) if wanted > 1 else subsets_of(1, False)

    def _can_halve(self, name: str) -> bool:
        """Return whether most of a camera's pixels see only even or only odd lenses."""
        projector = self.weights.projector(name)
        if projector.lens_sets == 1:
            return False
        even, odd, every = (len(projector.see_only(lenses)) for lenses in (EVEN, ODD, ALL))
        return min(even, odd) > 0 and even + odd >= LEAST_ALONE * every

    def _partitions(self, column_sum: np.ndarray, recordings: Mapping[str, Recording], sieve: Sieve) -> list[Partition]:
        """Return the subsets to begin with, and the whole cameras that may follow if "auto" began with halves."""
        first, cameras = self.subsets, len(self.weights.cameras)
        may_grow = self.settings.subsets == AUTO and len(first) > cameras
        in_turn = [first, subsets_of(cameras, False)] if may_grow else [first]
        return [self._partition(subsets, column_sum, recordings, sieve) for subsets in in_turn]

    def _partition(
        self, subsets: tuple[Subset, ...], column_sum: np.ndarray, recordings: Mapping[str, Recording], sieve: Sieve
    ) -> Partition:
        """Return the subsets with the step of each."""
        names = list(self.weights.cameras)
        sums = (
            np.float32(recordings[names[one.camera]].camera_gain)
            * (
                self.weights.camera_sums[one.camera]
                if one.lenses == ALL
                else self.weights.sums_of_lenses(names[one.camera], one.lenses)
            )
            for one in subsets
        )
        sizes = step_sizes(column_sum, list(sums), column_sum > LEAST_COLUMN_SUM * column_sum.max())
        mu = np.float32(self.settings.relaxation)
        if sieve.sigma_voxel > 0:
            return Partition(subsets, tuple(SharpenedStep(mu * size, sieve.shape) for size in sizes))
        return Partition(subsets, tuple(SmartStep(mu * size, sieve) for size in sizes))

    def _without_solid(self, volume: np.ndarray) -> np.ndarray:
        """Return a volume (z, y, x) without the light that the sieve spreads into the solid."""
        return volume if self.solid is None else np.where(self.solid, np.float32(0), volume)

    def _sieve_voxel(self, images: Mapping[str, np.ndarray]) -> float:
        sieve = self.settings.sieve_voxel
        return self._particle_sizer.matching_sieve(images) if isinstance(sieve, str) else sieve

    def _intensity_cap(self, images: Mapping[str, np.ndarray], sieve: Sieve) -> float:
        cap = self.settings.intensity_cap
        if not isinstance(cap, str):
            return cap
        scatter = self._particle_sizer.brightness_scatter(images, sieve.sigma_voxel)
        if scatter is not None and scatter < UNLIKE:
            return 0.0
        points = self.settings.sieve_voxel == AUTO and sieve.sigma_voxel == 0
        return POINT_CAP if points else CAP

    @property
    def _particle_sizer(self) -> ParticleSizer:
        """Return the estimator of the weights. Making it takes as long as two passes, so other solvers share it."""
        derived, key = self.weights.derived, ("particle sizer", self.weights.volume)
        if key not in derived:
            derived[key] = ParticleSizer(self.weights)
        sizer: ParticleSizer = derived[key]
        return sizer

    @cached_property
    def _views(self) -> np.ndarray | None:
        """Number of cameras that see each voxel; None for one camera, or if two see every voxel."""
        if len(self.weights.cameras) == 1:
            return None
        views = self.weights.views
        return views if views.min() < 2 else None

    def _equation(self, name: str, recording: Recording) -> CameraEquation:
        gain = self.weights.gain(name)
        if recording.camera_gain != 1:
            gain = gain * np.float32(recording.camera_gain)
        projector = self.weights.projector(name)
        return CameraEquation(image=recording.image, gain=gain, floor=recording.floor, projector=projector)

    def _steps(self, column_sum: np.ndarray, lit: np.ndarray, sieve: Sieve) -> tuple[Step, ...]:
        """Return the steps of an iteration, the fastest first. Sharpened steps come with a sieve and momentum."""

        def quotient(numerator: float, denominator: np.ndarray, where: np.ndarray) -> np.ndarray:
            result: np.ndarray = np.divide(numerator, denominator, out=np.zeros_like(column_sum), where=where)
            return result

        relaxation = self.settings.relaxation
        if self.settings.normalisation == "column":
            size, unblurred = (quotient(relaxation, total, lit) for total in (sieve(column_sum), column_sum))
        else:
            pixels = self.weights.stored.store(self.weights.affected_pixels)
            size = unblurred = quotient(relaxation / self.weights.largest, pixels, lit & (pixels > 0))
        plain = SmartStep(size, sieve)
        sharpened = self.settings.accelerate and sieve.sigma_voxel > 0
        return (SharpenedStep(unblurred, sieve.shape), plain) if sharpened else (plain,)


@dataclass(frozen=True, eq=False)
class PreparedInstant:
    """Images of one instant with all that SMART needs to know of them. Made by `SmartSolver.prepare`."""

    solver: SmartSolver
    recordings: Mapping[str, Recording]
    equations: ImageEquations
    sieve: Sieve
    intensity_cap: float
    column_sum: np.ndarray
    """Sum of the weights of each voxel, in stored order."""
    lit: np.ndarray
    """Voxels that some camera sees and that hold fluid, in stored order."""

    def solve(
        self,
        *,
        iterations: int | None = None,
        whole_passes: int = WHOLE_PASSES,
        first: np.ndarray | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Reconstruction:
        """Reconstruct the instant; arguments and exceptions as of `SmartSolver.solve`.

        `whole_passes` is the number of passes over all rays after those over subsets, at most half of all passes.
        """
        settings, stored = self.solver.settings, self.solver.weights.stored
        norm = _norm(self.equations.cameras)
        guess = self._from_images.copy() if first is None else checked_guess(first, stored) * self.lit
        if settings.active_share > 0:
            guess[guess < settings.active_share * guess.max()] = 0.0
        momentum = Momentum(guess) if settings.accelerate else None
        state = State(guess, momentum, self.solver._steps(self.column_sum, self.lit, self.sieve))
        count = settings.iterations if iterations is None else iterations
        history = _History(settings, count)
        epochs = count - min(whole_passes, -(-count // 2)) if len(self.solver.subsets) > 1 else 0
        partitions = self.solver._partitions(self.column_sum, self.recordings, self.sieve) if epochs else []
        with self.equations.locked():
            if partitions:
                state = self._solve_subsets(state, partitions, history, epochs, progress)
            volume, stop = self._solve_whole(state, history, progress)
        if stop is SmartStop.DIVERGED:
            log.warning("SMART: %s", stop.value)
        last = SmartStop.DONE if settings.tolerance == 0 else SmartStop.ITERATION_LIMIT
        return Reconstruction(
            grid=self.solver.weights.grid,
            volume=self.solver._without_solid(stored.restore(volume)),
            solid=self.solver.solid,
            views=self.solver._views,
            residual=tuple(float(np.sqrt(squares)) / norm for squares in history.squares),
            misfit=tuple(history.divergence),
            stop=stop or last,
            floor={name: one.floor for name, one in self.recordings.items()},
            camera_gain={name: one.camera_gain for name, one in self.recordings.items()},
            light_outside={name: one.light_outside for name, one in self.recordings.items()},
            sieve_voxel=self.sieve.sigma_voxel,
            intensity_cap=self.intensity_cap,
            settings=settings,
        )

    def misfit(self, first: np.ndarray) -> float:
        """Return the misfit of a first guess, shape (z, y, x) [counts]; raise ValueError as `solve`."""
        guess = checked_guess(first, self.solver.weights.stored) * self.lit
        with self.equations.locked():
            return self.equations.compare(self.sieve(guess)).divergence

    @cached_property
    def _from_images(self) -> np.ndarray:
        """First guess from the images alone, in stored order."""
        peaks = [one.peak for one in self.recordings.values()]
        return multiplicative_guess(self.equations.cameras, peaks, self.column_sum, self.lit)

    def _solve_subsets(
        self,
        state: State,
        partitions: Sequence[Partition],
        history: _History,
        epochs: int,
        progress: Callable[[float], None] | None,
    ) -> State:
        """Iterate over subsets until few iterations are left or an epoch hardly lowers the misfit."""
        history.append(self.equations.compare(self.sieve(state.coefficients)))  # exact, as all steps begin here
        resting = RestingVoxels(self.equations)
        for epoch in iterate_epochs(
            self.equations, state, self.sieve, partitions=partitions, epochs=epochs, resting=resting
        ):
            state = epoch.state
            if history.epochs:
                history.append(epoch.misfit)
            history.subsets.append(epoch.subsets)
            if progress is not None:
                progress(history.epochs / (history.iterations + 1))
            if history.settled:
                break
        resting.wake()
        return state

    def _solve_whole(
        self,
        state: State,
        history: _History,
        progress: Callable[[float], None] | None,
    ) -> tuple[np.ndarray, SmartStop | None]:
        """Iterate over all rays in the iterations that are left. Return the last volume, and why it stopped early."""
        smooth = Smoothing(self.solver.settings.smoothing_voxel, self.sieve.shape, self.lit)
        left, done = history.iterations - history.epochs, history.epochs
        states = iterate(self.equations, state, self.sieve, iterations=left, smooth=smooth)
        for number, (volume, misfit) in enumerate(states):  # noqa: B007 - the last volume is the result
            history.append(misfit)
            if progress is not None:
                progress((done + number + 1) / (history.iterations + 1))
            stop = history.early_stop
            if stop is not None:
                break
        return volume, stop


def _norm(cameras: Sequence[CameraEquation]) -> float:
    """Euclidean norm of all images [counts]."""
    images = (camera.image.ravel() for camera in cameras)
    return float(np.sqrt(sum(np.einsum("i,i", image, image, dtype=np.float64) for image in images)))
