"""The steps of one experiment in order: calibrate, weights, reconstruct, correlate, report.

Each function opens a run on an output folder, does the unfinished work, and returns the content of summary.json.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from operator import length_hint
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.progress import Progress
from lfpiv.runs import (
    bootstrap,
    device_memory,
    dispatch,
    local_workers,
    memory,
    rig,
    task,
    tracks,
    unchanged,
    usable_images,
    worker_plan,
)
from lfpiv.runs.invocation import Invocation, Tried, WeightsFigures, Workers
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_outcome import Outcome
from lfpiv.runs.pair_vectors import REFUSED
from lfpiv.runs.pending_pairs import PendingPairs
from lfpiv.runs.rig import Prepared
from lfpiv.runs.run import Run, open_run
from lfpiv.runs.worker_plan import Plan
from lfpiv_kernels import runtime

if TYPE_CHECKING:
    from lfpiv.weights.operator import Weights

TRACKS = "tracks"
"""Name of the step that makes tracks over a time series, for progress."""
SIMULATED = "simulated pairs"
"""The same for pairs that are simulated."""


def run(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    pairs: tuple[int, int | None] | None = None,
    device: str | None = None,
    keep_volumes: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Do all steps: raw images to vectors, summary and report.

    Finished results in `out` that still fit the experiment are not made again. A pair that fails is left out and listed
    under ``failed``.

    Parameters
    ----------
    experiment : Experiment or path
        The experiment, or its file.
    out : path
        Output folder; made if it is missing.
    pairs : (int, int), optional
        First pair and the one after the last, None for the end; default: all.
    device : {"auto", "cpu", "cuda"}, optional
        Default: ``compute.device`` of the experiment.
    keep_volumes : bool
        Write the volumes too.
    workers : int, optional
        Number of processes of this machine that work on pairs in parallel and share its cores; default: one per GPU on
        CUDA, this process only otherwise. More than one need the extra ``distributed``, and a script must call this
        function below ``if __name__ == "__main__":``.
    scheduler : str, optional
        Address of a Dask scheduler whose workers do the pairs; they must see `out` and the images under the same paths.
    progress : callable, optional
        Called as ``progress(step, fraction)``.

    Returns
    -------
    dict
        The content of ``summary.json``.

    Raises
    ------
    InputError
        If files, keys, memory, output folder, device or workers are not as expected; the message says what to change.
    StorageError
        If results cannot be written because space or rights are missing.
    """
    if scheduler is not None and workers is not None:
        raise InputError("--workers, --scheduler: expected one of them: a cluster has workers of its own.")
    with open_run(experiment, out, device, progress, pairs) as current:
        read = unchanged.look_at(current.experiment)
        checked = _check(current, current.unfinished(volumes=keep_volumes), workers, scheduler)
        if checked.failed is None and checked.pending.ahead():
            rig.log_vector_grid(current.experiment)
        calibrated = rig.calibrate(current)
        before, (current, prepared) = current, rig.prepare(current, calibrated.calibration)
        if not current.has_light_of(before):
            pending = current.unfinished(volumes=keep_volumes, quiet=True)
            checked = _check(current, pending, workers, scheduler)
        calibrated = replace(calibrated, calibration=prepared.board)
        done, weights = _process(current, prepared, checked, keep_volumes)
        done = _after_all(current, done, _Lazily(current, prepared, weights))
        summary = current.finish(calibrated, _with_reused(current, done, checked.pending, "vectors"), report=True)
        if not isinstance(experiment, Experiment):
            command: dict[str, Any] = {"experiment": str(experiment), "pairs": pairs, "device": device}
            command |= {"keep_volumes": keep_volumes, "workers": workers, "scheduler": scheduler}
            unchanged.record(command, current.folder, current.experiment, read, summary)
        return summary


def calibrate(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Calibrate the cameras into ``calibration.h5``; the first step of `run`. Return the summary."""
    with open_run(experiment, out, device, progress) as current:
        return current.finish(rig.calibrate(current), Invocation(), report=False)


def reconstruct(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    pairs: tuple[int, int | None] | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Reconstruct the volumes of some pairs into ``volumes/``; calibrate first if necessary. Return the summary."""
    with open_run(experiment, out, device, progress, pairs) as current:
        checked = _check(current, current.unfinished(vectors=False, volumes=True), 1, None)
        calibrated = rig.calibrate(current)
        before, (current, prepared) = current, rig.prepare(current, calibrated.calibration)
        if not current.has_light_of(before):
            checked = _check(current, current.unfinished(vectors=False, volumes=True, quiet=True), 1, None)
        done = Invocation(tried=checked.failed or Tried(current.numbers))
        if checked.failed is None and (first := checked.pending.ahead()):
            weights, figures = rig.build_weights(current, prepared, first)
            work = rig.pair_work(current, weights, keep_volumes=True, vectors=False, figures=figures)
            done = Invocation(tried=_sequential(current, work, checked.pending), weights=figures)
        return current.finish(calibrated, _with_reused(current, done, checked.pending, "volumes"), report=False)


def correlate(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    pairs: tuple[int, int | None] | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Correlate the volumes in ``volumes/`` into ``vectors/``. Return the summary.

    Raises
    ------
    InputError
        If the calibration, or the volumes of all pairs, are missing or belong to other settings.
    """
    with open_run(experiment, out, device, progress, pairs) as current:
        calibrated = rig.load_calibration(current)
        pending = current.unfinished(particles=False)
        if (known := pending.ahead()) and current.experiment.by_links:
            raise InputError(
                f"{current.experiment.path}: tracking.vectors takes the vectors from linked particles, which are found "
                'in the images, not in volumes. Use `lfpiv run`, or set tracking.vectors = "correlation".'
            )
        if known and not current.has_some_volumes():
            first = known[0]
            raise InputError(
                f"{current.folder.volume(first, 0)}: expected the two volumes of {current.experiment.name_of(first)} "
                "made with the present settings, found none. Run `lfpiv reconstruct` first."
            )
        if known:
            rig.log_vector_grid(current.experiment)
        calibration = rig.with_standing_light(current, calibrated.calibration)
        work = rig.pair_work(current, None, keep_volumes=False, calibration=calibration)
        done = Invocation(tried=_sequential(current, work, pending))
        return current.finish(calibrated, _with_reused(current, done, pending, "vectors"), report=False)


def report(experiment: Experiment | str | Path, out: str | Path) -> dict[str, Any]:
    """Write summary and report again from the results in a folder, also during a run on it. Return the summary.

    Raises
    ------
    InputError
        If the folder holds no calibration that fits the experiment, or a file in it is damaged.
    """
    with open_run(experiment, out, None, None, writes_results=False) as current:
        calibrated = rig.load_calibration(current)
        current.require_whole()
        calibrated = replace(calibrated, calibration=rig.with_standing_light(current, calibrated.calibration))
        return current.finish(calibrated, Invocation(), report=True)


@dataclass(frozen=True, kw_only=True)
class _Checked:
    """Pairs to do, after all checks."""

    pending: PendingPairs
    failed: Tried | None
    """Outcomes of all pairs if none can be done; None otherwise."""
    workers: Plan | str
    """Processes of this machine, or the address of a Dask scheduler."""


def _check(current: Run, pending: PendingPairs, workers: int | None, scheduler: str | None) -> _Checked:
    """Check images, memory and workers before any work, and start to preload worker processes."""
    gpus = worker_plan.visible_gpus() if current.device.kind == "cuda" else ()
    some = bool(pending.ahead())
    planned = worker_plan.plan(length_hint(pending), workers, current.device, gpus)
    failed = usable_images.check_images(current, pending) if some else None
    if some and failed is None:
        finest = current.reconstructed_experiment
        needed = memory.weights_bytes(finest, current.particle_voxel) if current.need_weights(pending) else 0
        if workers is None:
            planned = worker_plan.fit_installation(planned, current.device)
            planned = worker_plan.fit_memory(planned, finest, needed, current.device)
        if not scheduler and runtime.free_bytes() is not None:
            need = device_memory.estimate_need(finest, weights=needed > 0)
            sharing = -(-planned.workers // max(len(gpus), 1))
            device_memory.require(finest, need, current.device, sharing=sharing)
        worker_plan.require_memory(finest, needed, 1 if scheduler else planned.workers)
        if planned.workers > 1 and not scheduler:
            local_workers.start_preloading(planned.kind)
    return _Checked(pending=pending, failed=failed, workers=scheduler or planned)


_Weights = Callable[[], "Weights | None"]
"""Returns the weights that pairs were reconstructed with; None if they were not built."""


def _process(current: Run, prepared: Prepared, checked: _Checked, keep_volumes: bool) -> tuple[Invocation, _Weights]:
    """Do the pairs in this process or in several; the weights are built once for all of them."""
    pending, workers = checked.pending, checked.workers
    if checked.failed is not None:
        return Invocation(tried=checked.failed), lambda: None
    if not pending.ahead():
        return Invocation(tried=Tried(current.numbers)), lambda: None
    weights: Weights | None = None
    figures: WeightsFigures | None = None
    if current.need_weights(pending):
        weights, figures = rig.build_weights(current, prepared, pending.ahead())
        if isinstance(workers, Plan):
            finest = current.reconstructed_experiment
            workers = worker_plan.fit_memory(workers, finest, weights.memory_bytes, current.device)
    work = rig.pair_work(current, weights, keep_volumes=keep_volumes, calibration=prepared.calibration, figures=figures)
    if isinstance(workers, Plan) and workers.workers == 1:
        return Invocation(tried=_sequential(current, work, pending), weights=figures), _known(weights)
    if isinstance(workers, Plan):
        used = Workers(count=workers.workers, threads=workers.threads)
    else:
        used = Workers(count=None, threads=current.experiment.compute.threads)
    device = current.device.kind if isinstance(workers, Plan) else current.device_request
    shared = task.write_task(work, device, used.threads)
    del work, weights  # the workers map them from files; the memory may not have room for both
    tried = _collect(
        current,
        dispatch.parallel(
            shared, current.experiment, pending, workers, current.step(current.experiment.recording.work)
        ),
    )
    used = replace(used, peak_memory_mib=tried.peak_memory_mib or None)
    done = Invocation(tried=tried, weights=figures, workers=used)
    return done, lambda: task.open_weights_of(shared, prepared.calibration.cameras)


def _known(weights: Weights | None) -> _Weights:
    return lambda: weights


def _after_all(current: Run, done: Invocation, lazy: _Lazily) -> Invocation:
    """Do what follows the pairs; return the invocation, with the weights if they were built for it.

    Refuse pairs whose images do not belong together. Make the tracks of a time series. Measure the damping by ghosts.
    """
    count, folder = len(current.finished), current.folder
    if done.weights is not None or count > current.earlier.settled:  # an earlier run may have ended before it settled
        current.settle(lazy.work)
        done = replace(done, settled=count)
    pairs = current.pairs_with_particles() if current.experiment.recording.is_series else []
    pairs = [pair for pair in pairs if not (figures := current.finished.get(pair)) or figures.verdict not in REFUSED]
    tracks.keep_or_make(current.experiment, folder, current.tracks_stamp, pairs, lazy.work, current.step(TRACKS))
    stamp, finished = current.damping_stamp, current.pairs_with_vectors
    bootstrap.keep_or_measure(current.experiment, folder, stamp, finished, lazy.work, current.step(SIMULATED))
    return done if lazy.built is None else replace(done, weights=lazy.built)


@dataclass
class _Lazily:
    """Work on pairs after all of them are done; weights are built only if it needs them and nobody has."""

    current: Run
    prepared: Prepared
    weights: _Weights
    built: WeightsFigures | None = None

    def work(self) -> PairWork:
        """Return the work on pairs, with weights."""
        known = self.weights()
        if known is None:
            known, self.built = rig.build_weights(self.current, self.prepared, list(self.current.numbers[:1]))
            self.weights = _known(known)
        return rig.pair_work(self.current, known, keep_volumes=False, calibration=self.prepared.calibration)


def _with_reused(current: Run, done: Invocation, pending: PendingPairs, kind: str) -> Invocation:
    """Return the results of an invocation with the names of the pairs that were finished before."""
    first, count = pending.finished
    names = tuple(f"{kind} of {current.experiment.name_of(pair)}" for pair in sorted(first))
    more = (f"{kind} of {count - len(first)} more {current.experiment.noun}s",) if count > len(first) else ()
    return replace(done, reused=names + more)


def _sequential(current: Run, work: PairWork, pending: PendingPairs) -> Tried:
    if not pending.ahead():
        return Tried(current.numbers)
    return _collect(current, dispatch.sequential(work, pending, current.step(current.experiment.recording.work)))


def _collect(current: Run, outcomes: Generator[Outcome, None, None]) -> Tried:
    """Record the outcomes of all pairs as they arrive."""
    tried = Tried(current.numbers)
    with contextlib.closing(outcomes):  # ends the workers if the run is interrupted
        for outcome in outcomes:
            current.folder.require_kept()
            current.record(outcome, tried)
    current.progress(current.experiment.recording.work, 1.0)
    return tried
