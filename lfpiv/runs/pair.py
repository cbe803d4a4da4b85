"""The work on one image pair: images to volumes to vectors, and files of both.

`PairWork.do` takes the number of a pair and returns its `Outcome`. Volumes that are in the output folder and still fit
are read instead of reconstructed.
"""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv import warn
from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.settings import Correlation
from lfpiv.geometry.grid import Grid, Layers
from lfpiv.geometry.volume import VIEWS
from lfpiv.lightfield import image_checks
from lfpiv.progress import StepProgress, part_of
from lfpiv.reconstruction.motion import Motion, PairSolver, unshared_quality
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import FrameRecord, PairFiles, PairVolumes
from lfpiv.runs import pair_figures
from lfpiv.runs.frame_light import FrameLight, pair_light
from lfpiv.runs.guard import with_guard
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.warn import FirstOfEachCode

if TYPE_CHECKING:
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

RECONSTRUCTED = 0.9
"""Finished fraction of a pair when its volumes are reconstructed, for progress bars."""

CORRELATED = 0.99
"""Finished fraction of a pair when only its vectors remain to be written."""

NO_PARTICLES = "no particles in the images: none of the vectors counts"
"""Verdict on the vectors of a pair if the images of one frame show only noise."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of the work on a pair."""

    pair: int
    reason: str = ""
    """Why the pair failed; empty if it is finished."""
    peak_memory_mib: float = 0.0
    """Largest memory that the worker process held so far; 0 for pairs done in the process of the run."""


@dataclass(frozen=True, kw_only=True)
class PairWork:
    """The work on each pair of an experiment, with all its inputs."""

    experiment: Experiment
    folder: Folder
    calibration_hash: str
    guard: Layers
    """Layers of voxels that the grid of the weights has beyond the grid of the experiment; cut away afterwards."""
    weights: Weights | None
    """None if all volumes are in the folder."""
    darks: Mapping[str, np.ndarray | None]
    """Dark image of every camera [counts]; empty if all volumes are in the folder."""
    keep_volumes: bool
    """Write the volumes."""
    background: str | None = None
    """Hash of the light that is subtracted from the images; None if there is none."""
    vectors: bool = True
    """Correlate the volumes and write the vectors."""
    log_first: FirstOfEachCode = field(default_factory=lambda: FirstOfEachCode(log))

    def do(self, pair: int, progress: StepProgress) -> Outcome:
        """Work on one pair. An error ends this pair only and is returned as its outcome.

        Raises
        ------
        StorageError
            If a result cannot be written; then no other pair could be written either.
        """
        try:
            # sums of BLAS depend on its number of threads; the numbers must not depend on the number of workers
            with threadpool_limits(1):
                self._do(pair, progress)
        except StorageError:
            raise
        except MemoryError:
            return Outcome(pair=pair, reason="out of memory: use fewer workers, larger voxels or a smaller volume")
        except ValueError as error:
            return Outcome(pair=pair, reason=" ".join(str(error).split()))
        except Exception as error:  # an error in one pair must not end the others
            log.debug("pair %d: %s", pair, traceback.format_exc())
            return Outcome(pair=pair, reason=f"unexpected {type(error).__name__}: {' '.join(str(error).split())}")
        progress(1.0)
        return Outcome(pair=pair)

    @cached_property
    def solver(self) -> PairSolver:
        """SMART for this rig, made once for all pairs.

        The motion passes use default windows, so that other windows in `[correlation]` do not change the volumes.
        """
        assert self.weights is not None
        smart, farthest = self.experiment.smart, self.experiment.correlation.max_displacement_voxel
        return PairSolver(
            self.weights,
            SmartSettings(**smart.of_one_frame()),
            motion_passes=smart.motion_passes,
            correlation=Correlation(max_displacement_voxel=farthest).model_dump(),
            mask=with_guard(self.experiment, self.guard).solid,
        )

    def _do(self, pair: int, progress: StepProgress) -> None:
        files = PairFiles.of(
            self.experiment,
            self.calibration_hash,
            self.folder,
            pair,
            background=self.background,
            guard=self.guard,
        )
        volumes = files.read_volumes()
        if volumes is None:
            volumes = self._reconstruct(files, part_of(progress, 0.0, RECONSTRUCTED))
            if self.keep_volumes:
                files.write_volumes(volumes)
        if self.vectors:
            progress(RECONSTRUCTED)
            self._correlate(files, volumes, progress)

    def _reconstruct(self, files: PairFiles, progress: StepProgress) -> PairVolumes:
        if self.weights is None:
            raise InputError(
                f"{files.volumes[0]}: expected the two volumes of pair {files.pair} made with the present "
                "settings, found none. Run `lfpiv reconstruct` first."
            )
        light = pair_light(self.experiment, self.weights.cameras, self.darks, files.pair)
        self.log_first(warning.of_pair(files.pair) for frame in light for warning in frame.warnings)
        start = time.perf_counter()
        guarded = _reconstruct_frames(self.solver, light, files.pair, progress)
        grid, padded = self.experiment.grid, self.weights.grid
        volumes = _without_guard(guarded[0], grid, padded), _without_guard(guarded[1], grid, padded)
        seconds = (time.perf_counter() - start) / 2
        first, second = (
            FrameRecord(
                frame=frame.frame,
                structure=frame.structure,
                warnings=frame.warnings,
                seconds=seconds + frame.seconds,
            )
            for frame in light
        )
        return PairVolumes(volumes=volumes, records=(first, second))

    def _correlate(self, files: PairFiles, volumes: PairVolumes, progress: StepProgress) -> None:
        experiment, start = self.experiment, time.perf_counter()
        vectors = correlate(*volumes.volumes, dt_s=experiment.dt_s, **experiment.correlation.model_dump())
        vectors = _without_unmeasured(_with_motion(vectors, volumes), volumes)
        vectors.attrs["warnings"] = warn.to_text(volumes.warnings)
        vectors.attrs["reconstruction_s"] = sum(record.seconds for record in volumes.records)
        vectors.attrs["correlation_s"] = time.perf_counter() - start
        condensed = volumes.condensed()
        figures = pair_figures.measure(vectors, condensed, volumes.warnings)
        if figures.lost_unseeded > 0:
            self.log_first([figures.unseeded_warning(files.pair)])
        progress(CORRELATED)
        attributes = {
            "experiment": experiment.name,
            "smart": experiment.smart.model_dump(),
            "correlation": experiment.correlation.model_dump(),
            "figures": figures.to_json(),
        }
        files.write_vectors(vectors, condensed, attributes)
        log.info("pair %d: %.0f %% of the vectors valid", files.pair, 100 * figures.valid_fraction)


def _reconstruct_frames(
    solver: PairSolver, light: tuple[FrameLight, FrameLight], pair: int, progress: StepProgress
) -> tuple[xr.DataArray, xr.DataArray]:
    """Reconstruct both volumes."""
    try:
        result = solver.solve([frame.images for frame in light], [frame.noise for frame in light], progress)
    except ValueError as error:
        raise InputError(f"pair {pair}: {error}") from error
    if solver.motion_passes:
        log.info("pair %d: %s", pair, result.motion.value)
    first, second = result.to_dataarrays()
    return first, second


def _without_guard(volume: xr.DataArray, grid: Grid, padded: Grid) -> xr.DataArray:
    """Cut the guard layers off a volume."""
    if padded == grid:
        return volume
    cut = volume[grid.within(padded)]
    for name in volume.coords:
        if cut.coords[name].ndim == 3:  # HDF5 and the kernels take contiguous arrays
            cut = cut.assign_coords({name: cut.coords[name].copy(data=np.ascontiguousarray(cut.coords[name].values))})
    cut = cut.copy(data=np.ascontiguousarray(cut.values))
    if VIEWS in cut.coords and cut.coords[VIEWS].values.min() >= 2:
        cut = cut.drop_vars(VIEWS)
    return cut


def _with_motion(vectors: xr.Dataset, volumes: PairVolumes) -> xr.Dataset:
    """Return vectors with the outcome of the motion passes and with a quality that does not count shared light."""
    attributes = volumes.volumes[0].attrs
    if attributes.get("motion", Motion.OFF.value) == Motion.OFF.value:
        return vectors
    shares = np.atleast_1d(attributes["motion_valid"]).tolist()
    return unshared_quality(vectors, volumes.volumes).assign_attrs(motion=attributes["motion"], motion_valid=shares)


def _without_unmeasured(vectors: xr.Dataset, volumes: PairVolumes) -> xr.Dataset:
    """Mark all vectors as not valid if fewer than two of several cameras saw particles in a frame."""
    cameras = len(volumes.records[0].structure)
    if not image_checks.unmeasured([record.warnings for record in volumes.records], cameras):
        return vectors
    valid = xr.zeros_like(vectors["valid"])  # keeps its attributes
    names = [name for name in vectors.data_vars if str(name).startswith("uncertainty")]
    changed = {"valid": valid, **{str(name): vectors[name].where(valid) for name in names}}
    seen = vectors.attrs["seen_fraction"]  # no part of the volume is blamed for it
    attributes = {"valid_fraction": 0.0, "measurable_fraction": seen, "unseeded_fraction": 0.0}
    return vectors.assign(changed).assign_attrs(verdict=NO_PARTICLES, **attributes)
