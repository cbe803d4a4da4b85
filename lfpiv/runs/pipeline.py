"""The steps of one experiment in order: calibrate, weights, reconstruct, correlate, report; resumable in its folder."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.runs import worker_plan
from lfpiv.runs.pair import Outcome
from lfpiv.runs.run import Job, Progress, open_job

if TYPE_CHECKING:
    from lfpiv.calibration.cameras import Calibration


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
    """Do the whole job: raw images to vectors, summary and report.

    What is finished in `out` and still fits the experiment is kept: the calibration, and the pairs. A pair that cannot
    be done is left out and listed under ``failed``; the others are done.

    Parameters
    ----------
    experiment : Experiment or path
        The experiment, or its file.
    out : path
        Output folder; made where it is missing.
    pairs : (int, int), optional
        First pair and the one after the last, None for the end; default: all.
    device : {"auto", "cpu", "cuda"}, optional
        Default: ``compute.device`` of the experiment.
    keep_volumes : bool
        Write the volumes too.
    workers : int, optional
        Processes of this machine that work on pairs side by side, each with its share of the cores; default: one per
        GPU on CUDA, this process alone otherwise. More than one need the extra ``distributed``, and a script that asks
        for them calls this below ``if __name__ == "__main__":``.
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
        If something the user can mend is wrong: files, keys, memory, the output folder, the device, the workers.
    StorageError
        If results cannot be written, for want of space or rights.
    """
    if scheduler is not None and workers is not None:
        raise InputError("--workers, --scheduler: expected one of them: a cluster has workers of its own.")
    with open_job(experiment, out, device, progress, pairs) as job:
        todo = job.unfinished(volumes=keep_volumes)
        todo, planned = _plan(job, todo, workers, scheduler)
        calibration = job.calibrate()
        if todo:
            _do(job, _outcomes(job, calibration, todo, planned, scheduler, keep_volumes))
        return job.finish(report=True)


def calibrate(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Calibrate the cameras into ``calibration.h5``; the first step of `run`. Returns the summary."""
    with open_job(experiment, out, device, progress) as job:
        job.calibrate()
        return job.finish(report=False)


def reconstruct(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    pairs: tuple[int, int | None] | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Reconstruct the volumes of some pairs into ``volumes/``; calibrates first where need be. Returns the summary."""
    with open_job(experiment, out, device, progress, pairs) as job:
        todo = job.unfinished(vectors=False, volumes=True)
        todo, _ = _plan(job, todo, 1, None)
        calibration = job.calibrate()
        if todo:
            weights = job.build_weights(job.self_calibrate(calibration), todo)
            work = job.work(weights, keep_volumes=True, vectors=False)
            _do(job, worker_plan.alone(work, todo, job.step("image pairs")))
        return job.finish(report=False)


def correlate(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    pairs: tuple[int, int | None] | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Correlate the volumes in ``volumes/`` into ``vectors/``. Returns the summary.

    Raises
    ------
    InputError
        If the calibration, or the volumes of all pairs, are missing or belong to other settings.
    """
    with open_job(experiment, out, device, progress, pairs) as job:
        job.load_calibration()
        todo = job.unfinished()
        if todo:
            if not any(job.has_volumes(pair) for pair in todo):
                raise InputError(
                    f"{job.folder.volume(todo[0], 0)}: expected the two volumes of pair {todo[0]} made with the "
                    "present settings, found none. Run `lfpiv reconstruct` first."
                )
            work = job.work(None, keep_volumes=False)
            _do(job, worker_plan.alone(work, todo, job.step("image pairs")))
        return job.finish(report=False)


def report(experiment: Experiment | str | Path, out: str | Path) -> dict[str, Any]:
    """Write summary and report anew from what a folder holds, also while a run goes on. Returns the summary.

    Raises
    ------
    InputError
        If the folder holds no calibration that fits the experiment.
    """
    with open_job(experiment, out, None, None, writes_results=False) as job:
        job.load_calibration()
        return job.finish(report=True)


def _plan(
    job: Job, todo: list[int], workers: int | None, scheduler: str | None
) -> tuple[list[int], worker_plan.Plan | None]:
    """Check images, memory and workers before any work; return the pairs worth it, and None where a cluster does it."""
    from lfpiv.runs import memory

    gpus = worker_plan.visible_gpus() if job.device.kind == "cuda" else ()
    planned = worker_plan.plan(len(todo), workers, job.device, gpus)
    if todo:
        todo = job.check_images(todo)
    if todo:
        weights = memory.weights_bytes(job.experiment) if not all(map(job.has_volumes, todo)) else 0
        if workers is None:
            planned = worker_plan.lowered(worker_plan.unasked(planned, job.device), job.experiment, weights, job.device)
        worker_plan.require_memory(job.experiment, weights, 1 if scheduler else planned.workers)
    if scheduler:
        return todo, None
    if planned.workers > 1:
        from lfpiv.runs import local_workers

        local_workers.warm_up(planned.kind)
    return todo, planned


def _outcomes(
    job: Job,
    calibration: Calibration,
    todo: Sequence[int],
    planned: worker_plan.Plan | None,
    scheduler: str | None,
    keep_volumes: bool,
) -> Generator[Outcome, None, None]:
    """Do the pairs here or in several processes; the weights are built once, for all of them."""
    weights = None
    if not all(map(job.has_volumes, todo)):
        weights = job.build_weights(job.self_calibrate(calibration), todo)
    work = job.work(weights, keep_volumes=keep_volumes)
    if planned is not None and weights is not None:
        planned = worker_plan.lowered(planned, job.experiment, weights.memory_bytes, job.device)
    if planned is not None and planned.workers == 1:
        yield from worker_plan.alone(work, todo, job.step("image pairs"))
        return
    from lfpiv.runs import dispatch, worker

    if planned is None:
        shared = worker.share(work, job.device_request, job.experiment.compute.threads)
        job.workers_report |= {"count": None, "threads": job.experiment.compute.threads}
    else:
        shared = worker.share(work, job.device.kind, planned.threads)
        job.workers_report |= {"count": planned.workers, "threads": planned.threads}
    del work, weights  # the workers have them in their files; there must be room for both

    def peak(mib: float) -> None:
        job.workers_report["peak_memory_mib"] = mib

    yield from dispatch.together(shared, todo, planned, scheduler, job.step("image pairs"), peak)


def _do(job: Job, outcomes: Generator[Outcome, None, None]) -> None:
    with contextlib.closing(outcomes):  # no worker outlives an interruption
        for outcome in outcomes:
            job.note(outcome)
    job.progress("image pairs", 1.0)
