"""What runs in a worker process: pairs, one at a time, with weights that all processes of a machine share.

The parent leaves a task in a folder; a worker opens it once and keeps it for the pairs that follow. Nothing but the
names of that folder and of a pair is sent to a worker, and nothing but a `Result` comes back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import pickle
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import writing
from lfpiv.results.folder import Folder
from lfpiv.runs import memory
from lfpiv.runs.pair import WRITES, Outcome, PairWork
from lfpiv.version import __version__
from lfpiv_kernels import runtime

log = logging.getLogger(__name__)

REPORT_EVERY_S = 0.5
"""A worker tells how far it is at most this often [s]."""

_TASK, _WEIGHTS = "task.pickle", "weights"


@dataclass(frozen=True, kw_only=True)
class Task:
    """What a worker needs to know of a run; everything larger it finds in the run's folder."""

    version: str
    experiment: Experiment
    out: Path
    calibration_hash: str
    keep_volumes: bool
    vectors: bool
    weights: str | None
    """Hash of the weights' content; None where none are needed."""
    device: str
    threads: int | None
    """CPU threads of each worker; None for those its cluster gave it."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came of a pair in a worker."""

    outcome: Outcome | None
    """None where the worker could not even try; `fatal` says why."""
    fatal: str = ""
    storage: bool = False
    """Whether that is because results cannot be written."""
    records: tuple[tuple[str, int, str], ...] = ()
    """What was logged: logger, level, text."""
    peak_mib: float = 0.0


def share(work: PairWork, device: str, threads: int | None) -> Path:
    """Write what the workers need into the run's folder, weights included; return the folder to hand to `work_on`.

    Raises
    ------
    StorageError
        If there is no room for it.
    """
    from lfpiv.weights.storage import save_weights

    shared = work.folder.shared.absolute() / secrets.token_hex(8)
    with writing(shared):
        shared.mkdir(parents=True)
        need = 0 if work.weights is None else work.weights.memory_bytes
        free = shutil.disk_usage(shared).free
        if need > free:
            raise StorageError(
                f"{shared}: workers share the weights as files of {need / memory.GIB:.1f} GiB, "
                f"{free / memory.GIB:.1f} GiB are free there. Make room, or use one worker."
            )
    task = Task(
        version=__version__,
        experiment=_absolute(work.experiment),
        out=work.folder.path.absolute(),
        calibration_hash=work.calibration_hash,
        keep_volumes=work.keep_volumes,
        vectors=work.vectors,
        weights=None if work.weights is None else save_weights(work.weights, shared / _WEIGHTS),
        device=device,
        threads=threads,
    )
    with writing(shared / _TASK):
        (shared / _TASK).write_bytes(pickle.dumps(task))
    return shared


def _absolute(experiment: Experiment) -> Experiment:
    """Return the same experiment for processes that run in another folder."""
    cameras = tuple(
        dataclasses.replace(
            camera,
            white_path=camera.white_path.absolute(),
            dark_path=None if camera.dark_path is None else camera.dark_path.absolute(),
        )
        for camera in experiment.cameras
    )
    return dataclasses.replace(experiment, path=experiment.path.absolute(), cameras=cameras)


# --- in the worker

_busy = threading.Lock()  # kernels and their scratch memory serve one pair at a time
_opened: dict[Path, PairWork] = {}
_stopped: set[Path] = set()


class _Stopped(BaseException):
    """The run was given up; no Exception, so that nobody takes it for a pair's failure."""


def work_on(shared: Path, pair: int, report: Callable[[int, float], None], threads: Callable[[], int]) -> Result:
    """Do one pair of the task in the folder `shared`.

    Parameters
    ----------
    shared : Path
        From `share`.
    pair : int
        Number of the pair.
    report : callable
        Called as ``report(pair, fraction)`` now and then.
    threads : callable
        Returns the CPU threads this worker may use where the task does not say.
    """
    with _busy, _caught() as records:
        try:
            work = _open(shared, threads)
            outcome = work.do(pair, _now_and_then(shared, pair, report))
        except _Stopped:
            return Result(outcome=None, fatal="stopped")
        except (StorageError, InputError) as error:
            return Result(outcome=None, fatal=str(error), storage=isinstance(error, StorageError))
        return Result(outcome=outcome, records=tuple(records), peak_mib=memory.peak_mib())


def release(shared: Path) -> None:
    """Forget a task, and give up the pair of it that is being worked on."""
    _stopped.add(shared)
    _opened.pop(shared, None)


def _open(shared: Path, threads: Callable[[], int]) -> PairWork:
    if shared in _opened:
        return _opened[shared]
    from lfpiv.calibration.cameras import load_calibration
    from lfpiv.weights.storage import open_weights

    where = f"{shared}, worker on {socket.gethostname()}"
    try:
        task: Task = pickle.loads((shared / _TASK).read_bytes())
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
    folder, weights = Folder(task.out), None
    if task.weights is not None:
        cameras = load_calibration(folder.calibration).cameras
        weights = open_weights(shared / _WEIGHTS, cameras, task.weights)
    _opened.clear()  # of an earlier run
    _opened[shared] = PairWork(
        experiment=task.experiment,
        folder=folder,
        calibration_hash=task.calibration_hash,
        weights=weights,
        keep_volumes=task.keep_volumes,
        vectors=task.vectors,
    )
    return _opened[shared]


def _now_and_then(shared: Path, pair: int, report: Callable[[int, float], None]) -> Callable[[float], None]:
    last = -REPORT_EVERY_S

    def progress(fraction: float) -> None:
        nonlocal last
        if shared in _stopped:
            raise _Stopped
        if time.monotonic() - last >= REPORT_EVERY_S or fraction == WRITES:
            last = time.monotonic()
            if not (shared / _TASK).exists():  # its run is dead, and the next one has swept it away
                raise _Stopped
            report(pair, fraction)

    return progress


@contextlib.contextmanager
def _caught() -> Iterator[list[tuple[str, int, str]]]:
    """Collect what this package logs while a pair is worked on: the parent logs it in its own process."""
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
