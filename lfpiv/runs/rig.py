"""Steps that a run does once for all pairs: calibration, self-calibration, weights and the work that pairs share.

Each step reuses the result in the output folder if it still fits the experiment.
"""

from __future__ import annotations

import functools
import io
import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv import files, hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import MIB, writing
from lfpiv.records import RecordError, validate
from lfpiv.results import datasets, provenance, stamps
from lfpiv.runs import background, belonging, guard, memory, moved_cameras, refinement
from lfpiv.runs.frame_light import sampled_light
from lfpiv.runs.invocation import Calibrated, WeightsFigures
from lfpiv.runs.moved_cameras import SelfCalibrationFigures
from lfpiv.runs.pair import PairWork
from lfpiv.warn import Code, Warning, collected, warn

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.progress import StepProgress
    from lfpiv.runs.run import Run
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """Calibrations of a run that know what stands still in the images."""

    board: Calibration
    """From the board."""
    calibration: Calibration
    """Corrected for movements of the cameras, if the experiment demands it."""
    self_calibration: SelfCalibrationFigures | None
    """None without self-calibration."""


def load_calibration(run: Run) -> Calibrated:
    """Load the calibration in the folder; raise InputError if there is none that fits the experiment."""
    from lfpiv.calibration.camera import load_calibration

    path = run.folder.calibration
    try:
        fits = run.calibration_stamp.fits(provenance.require_marks(path))
    except FileNotFoundError:
        fits = False
    except DamagedFile as error:
        raise DamagedFile(path, error.reason, "Run `lfpiv calibrate` or `lfpiv run`, which make it again") from None
    if not fits:
        raise InputError(
            f"{path}: expected the calibration of this experiment, found none that fits. "
            "Run `lfpiv calibrate` or `lfpiv run` first."
        )
    calibration = load_calibration(path)
    _require_cameras(calibration, run.experiment, path)
    try:
        seconds = validate(float, datasets.read_attributes(path).get("seconds"))
    except RecordError as error:
        raise DamagedFile(path, f"seconds: {error}", "Calibrate again") from None
    log.info("calibration: finished before with the same settings, kept")
    return Calibrated(calibration=calibration, seconds=seconds, reused=True)


def _require_cameras(calibration: Calibration, experiment: Experiment, path: Path) -> None:
    """Refuse a stored calibration whose cameras have other names or optics than those of the experiment."""
    stated = {camera.name: camera.optics for camera in experiment.cameras}
    found = {name: camera.optics for name, camera in calibration.cameras.items()}
    if found != stated:
        raise DamagedFile(path, "its cameras are not those of the experiment", "Calibrate again")


def with_standing_light(run: Run, calibration: Calibration) -> Calibration:
    """Return a calibration with the standing light in the folder, if the results of the run depend on one."""
    if run.background is None:
        return calibration
    return background.load(run.folder.background, calibration).seen_by(calibration)


def calibrate(run: Run) -> Calibrated:
    """Calibrate the cameras and write the calibration, unless the folder holds one that fits the experiment.

    What was measured of each camera is kept until the calibration is written, in case it is interrupted.
    """
    from lfpiv.calibration.cameras import calibrate_or_continue

    marks, kept = provenance.read_marks(run.folder.calibration), _Kept(run)
    if run.calibration_stamp.fits(marks):
        try:
            found = load_calibration(run)
            kept.remove()
            return found
        except DamagedFile as error:
            provenance.reject(run.folder.calibration, error.reason)
    elif marks is not None:
        log.info("%s changed: calibration made again", ", ".join(run.calibration_stamp.changes(marks)))
    start = time.perf_counter()
    calibration = calibrate_or_continue(run.experiment, kept, run.step("calibration"))
    seconds = time.perf_counter() - start
    _write(calibration, run.folder.calibration, {**run.calibration_stamp.attributes, "seconds": seconds})
    kept.remove()
    return Calibrated(calibration=calibration, seconds=seconds, reused=False)


@dataclass(frozen=True)
class _Kept:
    """What a calibration measured of each camera, in files of its own until all are calibrated."""

    run: Run

    def load(self, name: str) -> CalibratedCamera | None:
        """Return a camera that was kept; None if there is none that fits the experiment."""
        from lfpiv.calibration.camera import load_calibration

        path = self.run.folder.camera(name)
        marks = provenance.read_marks(path)
        if marks is None or not stamps.of_camera(self.run.experiment, name).fits(marks):
            return None
        try:
            camera = load_calibration(path).cameras.get(name)
        except DamagedFile as error:
            provenance.reject(path, error.reason)
            return None
        return camera if camera is not None and camera.optics == self.run.experiment.camera(name).optics else None

    def keep(self, camera: CalibratedCamera) -> None:
        """Write a camera."""
        from lfpiv.calibration.camera import Calibration

        stamp = stamps.of_camera(self.run.experiment, camera.name)
        _write(Calibration({camera.name: camera}), self.run.folder.camera(camera.name), stamp.attributes)

    def remove(self) -> None:
        """Remove the files."""
        for camera in self.run.experiment.cameras:
            with writing(path := self.run.folder.camera(camera.name)):
                path.unlink(missing_ok=True)


def self_calibrate(run: Run, calibration: Calibration) -> tuple[Calibration, SelfCalibrationFigures | None]:
    """Correct the calibration by particle images. Return it unchanged, and no figures, without self-calibration."""
    from lfpiv.calibration.camera import load_calibration

    stamp = stamps.of_self_calibration(run.experiment, run.calibration_stamp.hash, run.background)
    if stamp is None:
        return calibration, None
    path = run.folder.self_calibration
    marks = provenance.read_marks(path)
    if marks is not None and marks.figures is not None and stamp.fits(marks):
        try:
            corrected, figures = load_calibration(path), SelfCalibrationFigures.from_json(marks.figures)
            _require_cameras(corrected, run.experiment, path)
            log.info("self-calibration: finished before with the same settings, kept")
            return _with_standing(corrected, calibration), figures
        except (DamagedFile, RecordError) as error:
            provenance.reject(path, error.reason if isinstance(error, DamagedFile) else str(error))
    corrected, figures = moved_cameras.correct(run.experiment, calibration, run.step("self-calibration"))
    _write(corrected, path, {**stamp.attributes, "figures": json.dumps(figures.to_json())})
    return corrected, figures


def prepare(run: Run, board: Calibration) -> tuple[Run, Prepared]:
    """Make what all pairs depend on beside the settings: subtracted light, corrected cameras, guard layers, voxels.

    `board` is the calibration from the board. Return also the run whose results depend on them.
    """
    standing = background.prepare(run, board)
    run = replace(run, background=standing.content)
    board = standing.seen_by(board)
    calibration, self_calibration = self_calibrate(run, board)
    given = run.experiment, run.folder, run.calibration_stamp.hash, standing.content, calibration
    light = functools.cache(functools.partial(sampled_light, run.experiment, calibration.cameras))
    run = replace(run, guard=guard.keep_or_measure(*given, light))
    run = replace(run, refinement=refinement.keep_or_measure(*given, light, run.guard_layers))
    return run, Prepared(board=board, calibration=calibration, self_calibration=self_calibration)


def log_vector_grid(experiment: Experiment) -> None:
    """Log how many vectors a run will measure along each axis, and warnings if they are too few."""
    from lfpiv.velocity import vector_grid

    grid, correlation = experiment.grid, experiment.correlation
    log.info("%s", vector_grid.sentence(correlation, grid.shape, grid.voxel_mm))
    for warning in vector_grid.warnings(correlation, grid.shape):
        log.warning("%s", warning.sentence)


def weights_of(run: Run, calibration: Calibration, progress: StepProgress | None = None) -> Weights:
    """Build the weights of the voxels that a run reconstructs, with the sums that all pairs and workers share."""
    from lfpiv.weights.operator import build_weights

    compute, finest = run.experiment.compute, run.reconstructed_experiment
    weights = build_weights(
        calibration,
        finest.grid,
        compute.weights,
        form=compute.weights_form,
        particle_voxel=run.particle_voxel,
        rays=compute.count_rays,
        limit_bytes=memory.left_for_weights(finest),
        progress=progress,
    )
    weights.volume = run.experiment.grid
    _ = weights.camera_sums
    return weights


def build_weights(run: Run, prepared: Prepared, pending: Sequence[int]) -> tuple[Weights, WeightsFigures]:
    """Build the weights and check the cameras by the first pairs of `pending`."""
    from lfpiv.calibration.coverage import require_seen, warn_outside
    from lfpiv.weights.checks import compare_with_count

    experiment, compute = run.experiment, run.experiment.compute
    calibration, self_calibration = prepared.calibration, prepared.self_calibration
    require_seen(experiment.path, calibration, experiment.grid)
    warn_outside(calibration, experiment.grid)
    if len(calibration.cameras) == 1 and not experiment.by_links:
        log.warning("%s", Warning(code=Code.ONE_CAMERA).sentence)
    for warning in guard.warnings(experiment, run.guard) + refinement.warnings(experiment, run.refinement):
        log.warning("%s", warning.sentence)
    start = time.perf_counter()
    with collected() as warnings:
        for warning in self_calibration.warnings if self_calibration else ():
            warn(log, warning)
        weights = weights_of(run, calibration, run.step("weights"))
        seconds = time.perf_counter() - start
        counted = compare_with_count(weights)
        agreement = belonging.check(experiment, weights, pending)
    errors = [error for camera in counted.values() for error in camera]
    if errors:  # a camera may see none of the voxels that were drawn
        share = 100 * np.mean(errors)
        log.info("weights differ from counted rays by %.1f %% (mean of %d voxels)", share, len(errors))
    return weights, WeightsFigures(
        method=compute.weights,
        memory_mib=weights.memory_bytes / MIB,
        seconds=seconds,
        warnings=tuple(warnings),
        agreement=agreement,
        forms=weights.forms,
        cuts=weights.cuts,
        profile_errors=weights.profile_errors,
        count_errors=counted,
        self_calibration=self_calibration,
    )


def pair_work(
    run: Run,
    weights: Weights | None,
    *,
    keep_volumes: bool,
    vectors: bool = True,
    calibration: Calibration | None = None,
    figures: WeightsFigures | None = None,
) -> PairWork:
    """Return the work on pairs, whose cameras `calibration` gives if there are no weights.

    Without `figures` of the weights, the refusals are those of an earlier invocation.
    """
    cameras = {} if calibration is None else calibration.cameras
    if weights is not None:
        cameras = weights.cameras
    return PairWork(
        experiment=run.experiment,
        folder=run.folder,
        inputs=run.inputs,
        weights=weights,
        cameras=cameras,
        keep_volumes=keep_volumes,
        vectors=vectors,
        refusals=run.earlier.refusals if figures is None else figures.agreement.refusals,
    )


def _with_standing(corrected: Calibration, calibration: Calibration) -> Calibration:
    """Return a stored calibration with the standing light of another one's cameras."""
    cameras = {
        name: camera if (standing := calibration.cameras[name].standing) is None else camera.with_standing(standing)
        for name, camera in corrected.cameras.items()
    }
    return replace(corrected, cameras=cameras)


def _write(calibration: Calibration, path: Path, attributes: Mapping[str, Any]) -> None:
    import h5py

    content = io.BytesIO()  # see `files.write_bytes` for why not straight to disk
    calibration.save(content)
    with h5py.File(content, "a") as opened:
        opened.attrs.update({**attributes, datasets.FILE: path.name})
    hdf5.seal(content)  # last: attributes are sealed too
    with writing(path):
        files.write_bytes(content.getbuffer(), path)
