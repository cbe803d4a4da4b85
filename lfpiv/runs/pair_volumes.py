"""Volumes of frames: reconstruct their images and return them on the voxels of the experiment.

The grid of the weights has guard layers and perhaps finer voxels than the experiment. `Reconstructor` makes the
solvers for that grid once. It samples each volume on the voxels that are written.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.recording import Frame
from lfpiv.geometry.grid import Grid, Layers
from lfpiv.geometry.resampling import volume_on
from lfpiv.geometry.volume import VIEWS
from lfpiv.joint.pair import Estimate, PairSolver
from lfpiv.progress import StepProgress
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.results.pair_files import FrameRecord, FrameVolume, PairVolumes
from lfpiv.runs.frame_light import FrameLight
from lfpiv.sequence.solver import PreviousFrame, SequenceResult, SequenceSolver, StartedFrom
from lfpiv.settings.processing import Correlation
from lfpiv.warn import Code, Warning

if TYPE_CHECKING:
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceFrame:
    """A frame that was reconstructed from its images and from the frames before it."""

    light: FrameLight
    """Its images, with a warning more if the particles were not where they were predicted."""
    result: SequenceResult
    seconds: float
    """Time of the reconstruction [s]."""

    def finished(self) -> SequenceFrame:
        """Return it without its images: its volume still corrects others."""
        return replace(self, light=replace(self.light, images={}), result=replace(self.result, prepared=None))


@dataclass(frozen=True, kw_only=True)
class Reconstructor:
    """Reconstruction of the images of a run, whose solvers are made once."""

    experiment: Experiment
    weights: Weights
    guard: Layers
    """Layers of voxels that the grid of the weights has beyond the grid of the experiment; cut away afterwards."""
    refinement: float
    """Edge of a voxel of the experiment over that of the weights, which volumes are sampled from."""

    @cached_property
    def solver(self) -> PairSolver:
        """SMART for this rig, made once for all pairs.

        The joint fit starts from default windows, so that other windows in `[correlation]` do not change the volumes.
        """
        self.weights.volume = self.experiment.grid
        smart, farthest = self.experiment.smart, self.experiment.correlation.max_displacement_voxel
        return PairSolver(
            self.weights,
            SmartSettings(**smart.of_one_frame(self.refinement)),
            estimate=self.experiment.estimate,
            correlation=Correlation(max_displacement_voxel=farthest).model_dump(),
        )

    def solid(self, frame: Frame) -> np.ndarray | None:
        """Return the flags of the reconstructed voxels without fluid in a frame, shape (z, y, x); None without a mask.

        Raises
        ------
        InputError
            If the frame's mask cannot be used.
        """
        return self.experiment.solid(frame, self.weights.grid)

    def with_intensity_cap(self, cap: float) -> Reconstructor:
        """Return the same reconstruction whose limit of the counts does not depend on the images."""
        smart = self.experiment.smart.model_copy(update={"intensity_cap": cap})
        return replace(self, experiment=replace(self.experiment, smart=smart))

    @cached_property
    def sequence(self) -> SequenceSolver:
        """SMART along a series, made once."""
        farthest = self.experiment.correlation.max_displacement_voxel
        correlation = Correlation(max_displacement_voxel=farthest).model_dump()
        return SequenceSolver(self.solver.smart, correlation)

    def pair(self, light: Sequence[FrameLight], progress: StepProgress) -> tuple[FrameVolume, FrameVolume]:
        """Reconstruct both frames of a pair together; raise InputError if their images cannot be reconstructed."""
        start = time.perf_counter()
        solver = self.solver
        try:
            masks = [self.solid(frame.frame) for frame in light]
            floors = [frame.noise for frame in light]
            result = solver.solve([frame.images for frame in light], floors, progress, masks=masks)
        except ValueError as error:
            raise InputError(f"pair {light[0].frame.fields['pair']}: {error}") from error
        volumes = [_without_views(volume) for volume in result.to_dataarrays(self.experiment.grid)]
        seconds = (time.perf_counter() - start) / 2
        first, second = (self._record(volume, frame, seconds) for volume, frame in zip(volumes, light, strict=True))
        return first, second

    def frame(self, light: FrameLight, progress: StepProgress) -> FrameVolume:
        """Reconstruct one frame from its images alone; raise as `pair`."""
        label, start = light.frame.label, time.perf_counter()
        try:
            mask = self.solid(light.frame)
            prepared = self.solver.smart.prepare(light.images, floor=light.noise, mask=mask)
            found = prepared.with_unlike_light(prepared.solve(progress=progress))
        except ValueError as error:
            raise InputError(f"{label}: {error}") from error
        seconds = time.perf_counter() - start
        level = logging.INFO if self.experiment.recording.is_series else logging.DEBUG
        log.log(level, "%s: reconstructed in %.1f s", label, seconds)
        volume = found.to_dataarray().assign_attrs(estimate=Estimate.ALONE.value)
        return self._frame(volume, light, seconds)

    def follow(
        self, light: FrameLight, previous: PreviousFrame | None, progress: StepProgress
    ) -> tuple[SequenceFrame, PreviousFrame]:
        """Reconstruct a frame of a series from its predecessor, and return it with what its successor needs.

        Raises
        ------
        InputError
            As `pair`.
        """
        number, start = light.frame.number, time.perf_counter()
        try:
            mask = self.solid(light.frame)
            result = self.sequence.solve(light.images, previous, floor=light.noise, mask=mask, progress=progress)
        except ValueError as error:
            raise InputError(f"{light.frame.label}: {error}") from error
        if result.started_from is StartedFrom.MISSED:
            missed = Warning(code=Code.NOT_FOLLOWED, figures={"ratio": result.misfit_ratio}, instants=(number,))
            light = replace(light, warnings=(*light.warnings, missed))
        measured = _as_written(result.found.to_dataarray(), self.experiment.grid)
        seconds = time.perf_counter() - start
        log.info("%s: %s, in %.1f s", light.frame.label, result.started_from.value, seconds)
        return SequenceFrame(light=light, result=result, seconds=seconds), result.as_previous(measured, previous)

    def correct(self, trail: Sequence[SequenceFrame], at: int, progress: StepProgress) -> FrameVolume:
        """Reconstruct one of successive frames again from those before and after it; raise as `pair`."""
        own, start = trail[at], time.perf_counter()
        label = own.light.frame.label
        try:
            found = self.sequence.correct([one.result for one in trail], at, progress)
        except ValueError as error:
            raise InputError(f"{label}: {error}") from error
        seconds = own.seconds + time.perf_counter() - start
        log.info("%s: reconstructed in %.1f s with %d instants beside it", label, seconds, len(trail) - 1)
        return self._frame(found.to_dataarray(), own.light, seconds)

    def volumes(
        self, images: Sequence[Mapping[str, np.ndarray]], noise: Sequence[Mapping[str, float]], frames: Sequence[Frame]
    ) -> tuple[xr.DataArray, xr.DataArray]:
        """Return the volumes of two sets of images, reconstructed as some frames of the experiment, with their masks.

        Raises
        ------
        ValueError
            If the images cannot be reconstructed.
        """
        masks = [self.solid(frame) for frame in frames]
        both = self.solver.solve(images, noise, masks=masks).to_dataarrays(self.experiment.grid)
        return _without_views(both[0]), _without_views(both[1])

    def _frame(self, found: xr.DataArray, light: FrameLight, seconds: float) -> FrameVolume:
        """Return a volume on the voxels of the experiment, with its record."""
        return self._record(_as_written(found, self.experiment.grid), light, seconds)

    def _record(self, volume: xr.DataArray, light: FrameLight, seconds: float) -> FrameVolume:
        """Return a written volume with its record."""
        record = FrameRecord(structure=light.structure, warnings=light.warnings, seconds=seconds + light.seconds)
        return FrameVolume(volume=volume, record=record)


def reconstruction_s(experiment: Experiment, pair: int, volumes: PairVolumes) -> float:
    """Return the time that the volumes of a pair took [s].

    In a series the second instant counts, and the first one only if it is the second of no other pair: the sum over
    all pairs then counts each instant once.
    """
    first, second = (record.seconds for record in volumes.records)
    step = experiment.recording.shared_step
    return second if step is not None and pair - step in experiment.numbers else first + second


def _as_written(volume: xr.DataArray, grid: Grid) -> xr.DataArray:
    """Return a reconstructed volume on the voxels that are written, ``views`` only if some are seen by one camera."""
    return _without_views(volume_on(volume, grid))


def _without_views(volume: xr.DataArray) -> xr.DataArray:
    """Return a volume with ``views`` only if some voxels are seen by one camera."""
    if VIEWS in volume.coords and volume.coords[VIEWS].values.min() >= 2:
        volume = volume.drop_vars(VIEWS)
    return volume
