"""Work of a worker process: one work unit of pairs at a time, with weights that all processes of a machine share.

The run writes a task into a folder (`lfpiv.runs.task`). A worker opens it once and uses it for all its pairs. It gets
the name of that folder and a work unit, and returns a `Result`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lfpiv.errors import InputError, StorageError
from lfpiv.runs import background, memory
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_outcome import CORRELATED, Outcome, PairProgress
from lfpiv.runs.task import TASK, WEIGHTS, read_task
from lfpiv.runs.work_units import WorkUnit
from lfpiv.version import __version__
from lfpiv_kernels import runtime

log = logging.getLogger(__name__)

REPORT_EVERY_S = 0.5
"""Shortest interval between two progress reports of a worker [s]."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of a work unit in a worker."""

    outcomes: tuple[Outcome, ...] | None
    """Of all its pairs; None if no pair can be done; `fatal` says why."""
    fatal: str = ""
    storage: bool = False
    """Whether the reason is that results cannot be written."""
    records: tuple[tuple[str, int, str], ...] = ()
    """Log records: logger, level, text."""


_busy = threading.Lock()  # kernels and their scratch memory can be used by one work unit at a time
_opened: dict[Path, PairWork] = {}
_stopped: set[Path] = set()


class _Stopped(BaseException):
    """The run ended. No Exception, so that it is not taken for a failure of the pair."""


def work_on(shared: Path, unit: WorkUnit, report: Callable[[float], None], threads: Callable[[], int]) -> Result:
    """Do a work unit of the task in the folder `shared`.

    Parameters
    ----------
    shared : Path
        From `task.write_task`.
    unit : WorkUnit
        Pairs to do.
    report : callable
        Called with the number of finished pairs, and parts of one, at most once in `REPORT_EVERY_S`.
    threads : callable
        Returns the CPU threads that this worker may use if the task does not say.
    """
    with _busy, _captured_logs() as records:
        try:
            work = _open(shared, threads)
            done = list(work.do(unit.pairs, _throttled(shared, report), stored=unit.stored))
        except _Stopped:
            return Result(outcomes=None, fatal="stopped")
        except (StorageError, InputError) as error:
            return Result(outcomes=None, fatal=str(error), storage=isinstance(error, StorageError))
        outcomes = (dataclasses.replace(outcome, peak_memory_mib=memory.peak_mib()) for outcome in done)
        return Result(outcomes=tuple(outcomes), records=tuple(records))


def release(shared: Path) -> None:
    """Forget a task and stop the work on its present work unit."""
    _stopped.add(shared)
    _opened.pop(shared, None)


def _open(shared: Path, threads: Callable[[], int]) -> PairWork:
    if shared in _opened:
        return _opened[shared]
    from lfpiv.calibration.camera import load_calibration
    from lfpiv.weights.storage import open_weights

    where = f"{shared}, worker on {socket.gethostname()}"
    try:
        task = read_task(shared)
    except OSError as error:
        raise InputError(
            f"{where}: expected the folder of the run ({error.strerror}). All workers must see it under the same path: "
            "choose --out on a file system that they share."
        ) from None
    if task.version != __version__:
        raise InputError(f"{where}: expected lfpiv {task.version} as the run has it, found {__version__}.")
    try:
        runtime.start(task.device, threads=task.threads or threads())
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{where}: {error}") from None
    work = task.work(shared)
    calibration = load_calibration(work.folder.calibration)
    if work.inputs.background is not None:
        calibration = background.load(work.folder.background, calibration).seen_by(calibration)
    work = dataclasses.replace(work, cameras=calibration.cameras)
    if task.weights is not None:
        work = dataclasses.replace(work, weights=open_weights(shared.parent / WEIGHTS, work.cameras, task.weights))
    _opened.clear()  # the task of an earlier run
    _opened[shared] = work
    return work


def _throttled(shared: Path, report: Callable[[float], None]) -> PairProgress:
    """Return the progress of a work unit: it reports at intervals, and stops the work if the run ended."""
    last = -REPORT_EVERY_S

    def progress(number: int, fraction: float) -> None:
        nonlocal last
        if shared in _stopped:
            raise _Stopped
        if time.monotonic() - last >= REPORT_EVERY_S or fraction == CORRELATED:
            last = time.monotonic()
            if not (shared / TASK).exists():  # the run died, and the next run removed its folder
                raise _Stopped
            report(number + fraction)

    return progress


@contextlib.contextmanager
def _captured_logs() -> Iterator[list[tuple[str, int, str]]]:
    """Collect what this package logs in a block; the process of the run logs it instead."""
    records: list[tuple[str, int, str]] = []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            records.append((record.name, record.levelno, record.getMessage()))

    handler = Collect(level=logging.INFO)
    loggers = [logging.getLogger(name) for name in ("lfpiv", "lfpiv_kernels")]
    before = [(logger.level, logger.propagate) for logger in loggers]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        logger.propagate = False
    try:
        yield records
    finally:
        for logger, (level, propagate) in zip(loggers, before, strict=True):
            logger.removeHandler(handler)
            logger.setLevel(level)
            logger.propagate = propagate
