"""The steps of one experiment in order: calibrate, weights, reconstruct, correlate, report; resumable in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lfpiv.errors import InputError
from lfpiv.experiment import Experiment
from lfpiv.job import Progress, open_job


def run(
    experiment: Experiment | str | Path,
    out: str | Path,
    *,
    pairs: tuple[int, int | None] | None = None,
    device: str | None = None,
    keep_volumes: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Do the whole job: raw images to vectors, summary and report.

    What is finished in `out` and still fits the experiment is kept: the calibration, and the pairs.

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
    progress : callable, optional
        Called as ``progress(step, fraction)``.

    Returns
    -------
    dict
        The content of ``summary.json``.

    Raises
    ------
    InputError
        If something the user can mend is wrong: files, keys, memory, the output folder, the device.
    """
    with open_job(experiment, out, device, progress, pairs) as job:
        numbers = job.numbers
        todo = [pair for pair in numbers if not job.is_finished(pair, keep_volumes)]
        if todo:
            job.plan_memory()
        calibration = job.calibrate()
        for pair in numbers:
            if pair not in todo:
                job.note_reused(f"vectors of pair {pair}")
        if todo:
            weights = None
            for done, pair in enumerate(todo):
                job.begin_pair(done, len(todo))
                volumes = job.stored_volumes(pair)
                if volumes is None:
                    weights = weights or job.build_weights(calibration)
                    volumes = job.reconstruct(calibration, weights, pair, keep=keep_volumes)
                job.correlate(pair, volumes)
            job.progress("image pairs", 1.0)
        return job.finish(numbers, report=True)


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
        return job.finish(job.finished_pairs(), report=False)


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
        numbers = job.numbers
        job.plan_memory()
        calibration = job.calibrate()
        weights = None
        for done, pair in enumerate(numbers):
            job.begin_pair(done, len(numbers))
            if job.stored_volumes(pair) is not None:
                job.note_reused(f"volumes of pair {pair}")
                continue
            weights = weights or job.build_weights(calibration)
            job.reconstruct(calibration, weights, pair, keep=True)
        job.progress("image pairs", 1.0)
        return job.finish(job.finished_pairs(), report=False)


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
        If the calibration, or the volumes of a pair, are missing or belong to other settings.
    """
    with open_job(experiment, out, device, progress, pairs) as job:
        job.load_calibration()
        numbers = job.numbers
        for done, pair in enumerate(numbers):
            job.begin_pair(done, len(numbers))
            if job.is_finished(pair, keep_volumes=False):
                job.note_reused(f"vectors of pair {pair}")
                continue
            volumes = job.stored_volumes(pair)
            if volumes is None:
                raise InputError(
                    f"{job.folder.volume(pair, 0)}: expected the two volumes of pair {pair} made with the present "
                    "settings, found none. Run `lfpiv reconstruct` first."
                )
            job.correlate(pair, volumes)
        job.progress("image pairs", 1.0)
        return job.finish(job.finished_pairs(), report=False)


def report(experiment: Experiment | str | Path, out: str | Path) -> dict[str, Any]:
    """Write summary and report anew from what a folder holds. Returns the summary.

    Raises
    ------
    InputError
        If the folder holds no calibration that fits the experiment.
    """
    with open_job(experiment, out, None, None) as job:
        job.load_calibration()
        return job.finish(job.finished_pairs(), report=True)
