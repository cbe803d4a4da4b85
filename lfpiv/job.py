"""One invocation on one experiment and one output folder: what is done once for all pairs, its clock, its warnings."""

from __future__ import annotations

import contextlib
import io
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv import dataset, memory, stamp, summary
from lfpiv.errors import InputError
from lfpiv.experiment import Experiment, check_pairs, read_experiment
from lfpiv.folder import Folder, make_writable, writing
from lfpiv.pair import Outcome, PairWork
from lfpiv_kernels import runtime

if TYPE_CHECKING:
    from lfpiv.calibration import Calibration
    from lfpiv.weights import Weights

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]
"""Called as ``progress(step, fraction)``, fraction from 0 to 1."""

NAMED = 5
"""Pairs that a message names one by one."""


@contextlib.contextmanager
def open_job(
    experiment: Experiment | str | Path,
    out: str | Path,
    device: str | None,
    progress: Progress | None,
    pairs: tuple[int, int | None] | None = None,
    *,
    writes_results: bool = True,
) -> Iterator[Job]:
    """Check everything, start the device, collect the warnings; leave no empty folder behind on failure.

    Jobs that write results hold the folder for themselves; `writes_results` is False for one that only reports.
    """
    start = time.perf_counter()
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    folder = Folder(Path(out))
    numbers = _select(experiment, pairs)
    memory.require(memory.least_bytes(experiment), experiment, "volumes of")
    made = make_writable(folder.path)
    collector = _WarningCollector(level=logging.WARNING)
    loggers = [logging.getLogger(name) for name in ("lfpiv", "lfpiv_kernels")]
    for logger in loggers:
        logger.addHandler(collector)
    try:
        with contextlib.ExitStack() as stack:
            if writes_results:
                stack.enter_context(folder.held())
                folder.sweep()
                stack.callback(folder.sweep)
            try:
                running = runtime.start(device or experiment.compute.device, threads=experiment.compute.threads)
            except (RuntimeError, ValueError) as error:
                raise InputError(str(error)) from None
            stack.enter_context(threadpool_limits(running.threads))
            request = device or experiment.compute.device
            yield Job(experiment, folder, numbers, progress, request, running, collector.texts, start)
    finally:
        for logger in loggers:
            logger.removeHandler(collector)
        for path in made:
            with contextlib.suppress(OSError):  # not empty: the run got somewhere
                path.rmdir()


def _select(experiment: Experiment, pairs: tuple[int, int | None] | None) -> range:
    first, after = (0, None) if pairs is None else pairs
    after = experiment.pairs if after is None else after
    if not 0 <= first < after <= experiment.pairs:
        raise InputError(
            f"pairs: expected A:B with 0 <= A < B <= {experiment.pairs}, the pairs of the experiment, "
            f"found {first}:{after}."
        )
    return range(first, after)


class _WarningCollector(logging.Handler):
    """Keeps the text of each warning once.

    What vectors and motion passes say of a pair the summary words pair by pair; errors are those of pairs that failed.
    """

    PAIRWISE = ("lfpiv.vectors", "lfpiv.motion")

    def __init__(self, level: int):
        super().__init__(level)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno == logging.WARNING and text not in self.texts and record.name not in self.PAIRWISE:
            self.texts.append(text)


class Job:
    """One invocation: the steps done once, the pairs to do, and what came of them."""

    def __init__(
        self,
        experiment: Experiment,
        folder: Folder,
        numbers: range,
        progress: Progress | None,
        device_request: str,
        device: runtime.Device,
        warnings: list[str],
        start: float,
    ):
        self.experiment = experiment
        self.folder = folder
        self.numbers = numbers
        """Pairs selected for this invocation."""
        self.progress: Progress = progress or (lambda step, fraction: None)
        self.device_request = device_request
        """What was asked for: a cluster's machines have devices of their own."""
        self.device = device
        self.warnings = warnings
        self.reused: list[str] = []
        self.start = start
        self.seconds: dict[str, float] = {}
        self.failed: dict[int, str] = {}
        """Pair -> why this invocation has no result of it."""
        self.weights_report: dict[str, Any] = {}
        self.workers_report: dict[str, Any] = {"count": 1, "threads": device.threads, "peak_memory_mib": None}
        self.calibration: Calibration | None = None
        self.calibration_stamp = stamp.of_calibration(experiment)
        self.previous = summary.read(folder.summary)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block that ends well to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def step(self, name: str) -> Callable[[float], None]:
        """Progress of a step as a function of its fraction."""
        return lambda fraction: self.progress(name, fraction)

    # --- what is there, what is to do

    def unfinished(self, *, vectors: bool = True, volumes: bool = False) -> list[int]:
        """Pairs of this invocation whose vectors or volumes are not there or do not fit; logs what is kept and why."""
        todo, changed = [], dict[str, list[int]]()
        for pair in self.numbers:
            wanted = [(self.folder.vectors(pair), stamp.of_vectors)] if vectors else []
            wanted += [(self.folder.volume(pair, frame), stamp.of_volumes) for frame in (0, 1)] if volumes else []
            for path, mark in wanted:
                found = stamp.marks(path)
                why = None if found is None else mark(self.experiment, self.calibration_stamp.hash, pair).changes(found)
                if why != []:
                    todo.append(pair)
                    changed.setdefault(", ".join(why or ()), []).append(pair)
                    break
            else:
                self.reused.append(f"{'vectors' if vectors else 'volumes'} of pair {pair}")
        if len(todo) < len(self.numbers):
            log.info(
                "%d of %d pairs: finished before with the same settings, kept",
                len(self.numbers) - len(todo),
                len(self.numbers),
            )
        for reason, pairs in changed.items():
            if reason:
                log.info("%s changed: %s made anew", reason, _listed(pairs))
        return todo

    def check_images(self, todo: Sequence[int]) -> None:
        """Warn of pairs whose images cannot be used; they are tried and left out when their turn comes.

        Raises
        ------
        InputError
            If the first one's images cannot be used: they show whether the experiment file is right.
        """
        bad = dict(check_pairs(self.experiment, todo))
        if bad and todo[0] in bad:
            others = f" To do the pairs after it, use --pairs {todo[0] + 1}:." if len(bad) < len(todo) else ""
            raise InputError(bad[todo[0]] + others)
        for reason in list(bad.values())[:NAMED]:
            log.error("%s The other pairs will be done.", reason)
        if len(bad) > NAMED:
            log.error("%d pairs have images that cannot be used: %s", len(bad), _listed(list(bad)))

    def has_volumes(self, pair: int) -> bool:
        """Whether both volumes of a pair are in the folder and fit."""
        wanted = stamp.of_volumes(self.experiment, self.calibration_stamp.hash, pair)
        found = [stamp.marks(self.folder.volume(pair, frame)) for frame in (0, 1)]
        return all(marks is not None and not wanted.changes(marks) for marks in found)

    # --- steps done once

    def load_calibration(self) -> Calibration:
        """Load the calibration in the folder; InputError where there is none that fits the experiment."""
        from lfpiv.calibration import load_calibration

        path = self.folder.calibration
        found = stamp.marks(path)
        if found is None or self.calibration_stamp.changes(found):
            raise InputError(
                f"{path}: expected the calibration of this experiment, found none that fits. "
                "Run `lfpiv calibrate` or `lfpiv run` first."
            )
        log.info("calibration: finished before with the same settings, kept")
        self.reused.insert(0, "calibration")
        self.calibration = load_calibration(path)
        return self.calibration

    def calibrate(self) -> Calibration:
        """Keep the calibration in the folder where it fits the experiment, make it otherwise."""
        path = self.folder.calibration
        found = stamp.marks(path)
        changes = None if found is None else self.calibration_stamp.changes(found)
        if changes == []:
            return self.load_calibration()
        if changes:
            log.info("%s changed: calibration made anew", ", ".join(changes))
        from lfpiv.calibration import calibrate as calibrate_cameras

        with self.timed("calibration"):
            self.calibration = calibrate_cameras(self.experiment, progress=self.step("calibration"))
        content = io.BytesIO()  # not straight to disk: see `dataset.write_bytes`
        self.calibration.save(content)  # type: ignore[arg-type]  # HDF5 takes files too
        _mark(content, **self.calibration_stamp.attributes, seconds=self.seconds["calibration"])
        with writing(path):
            dataset.write_bytes(content.getbuffer(), path)
        return self.calibration

    def build_weights(self, calibration: Calibration) -> Weights:
        """Build the weights of the grid."""
        from lfpiv.calibration import warn_outside
        from lfpiv.exposure import pair_warnings
        from lfpiv.view import require_seen
        from lfpiv.weights import build_weights, compare_with_count

        method = self.experiment.compute.weights
        require_seen(self.experiment.path, calibration, self.experiment.grid)
        warn_outside(calibration, self.experiment.grid)
        for text in pair_warnings(self.experiment, calibration, self.numbers[0]):
            log.warning("%s", text)
        if len(calibration.cameras) == 1:
            log.warning(
                "one camera hardly sees depth: w and displacement_z are not to be trusted, nor is their validation"
            )
        with self.timed("weights"):
            weights = build_weights(
                calibration,
                self.experiment.grid,
                method,
                form=self.experiment.compute.weights_form,
                limit_bytes=memory.left_for_weights(self.experiment),
                progress=self.step("weights"),
            )
        self.weights_report = {"method": method, "memory_mib": weights.memory_bytes / memory.MIB}
        if method == "footprint":
            self.weights_report["form"] = dict(weights.forms)
            self.weights_report["profiles_check_l2"] = {
                name: [round(error, 4) for error in errors] for name, errors in weights.profile_errors.items()
            }
            errors = [error for camera in compare_with_count(weights).values() for error in camera]
            self.weights_report["count_check_l2"] = [round(error, 4) for error in errors]
            if errors:  # of the few voxels drawn some camera may see none
                share = 100 * np.mean(errors)
                log.info("weights differ from counted rays by %.1f %% (mean of %d voxels)", share, len(errors))
        return weights

    # --- the pairs

    def work(self, weights: Weights | None, *, keep_volumes: bool, vectors: bool = True) -> PairWork:
        """Put together what is to be done with each pair."""
        return PairWork(
            experiment=self.experiment,
            folder=self.folder,
            calibration_hash=self.calibration_stamp.hash,
            weights=weights,
            keep_volumes=keep_volumes,
            vectors=vectors,
        )

    def note(self, outcome: Outcome) -> None:
        """Keep what came of a pair."""
        if outcome.reason:
            self.failed[outcome.pair] = outcome.reason
            log.error("pair %d failed and is left out: %s", outcome.pair, outcome.reason)

    def finish(self, *, report: bool) -> dict[str, Any]:
        """Write summary.json of all that the folder holds, and report.html where asked; return the summary."""
        if self.calibration is None:
            raise InputError(f"{self.folder.calibration}: expected a calibration, found none. Run `lfpiv calibrate`.")
        vectors, pairs = {}, []
        for pair in range(self.experiment.pairs):
            path = self.folder.vectors(pair)
            found = stamp.marks(path)
            if found is not None and not stamp.of_vectors(self.experiment, self.calibration_stamp.hash, pair).changes(
                found
            ):
                vectors[pair] = path
                pairs.append(summary.pair_entry(pair, path, found))
        earlier = {entry["pair"]: entry["reason"] for entry in self.previous.get("failed", ())}
        result = summary.build(
            experiment=self.experiment,
            calibration=self.calibration,
            calibration_path=self.folder.calibration,
            pairs=pairs,
            failed={pair: reason for pair, reason in {**earlier, **self.failed}.items() if pair not in vectors},
            previous=self.previous,
            weights_s=self.seconds.get("weights"),
            weights=self.weights_report,
            workers=self.workers_report,
            device=self.device,
            warnings=self.warnings,
            reused=self.reused,
        )
        self._stop_clock(result)
        if report:
            from lfpiv.report import write_report

            with self.timed("report"), writing(self.folder.report):
                write_report(self.experiment, self.calibration, result, vectors, self.folder.report)
            result["timings_s"]["report"] = self.seconds["report"]
            self._stop_clock(result)
        with writing(self.folder.summary):
            dataset.write_json(result, self.folder.summary)
        return result

    def _stop_clock(self, result: dict[str, Any]) -> None:
        """Put the time and the peak memory so far into a summary."""
        result["timings_s"]["total"] = time.perf_counter() - self.start
        earlier = self.previous.get("peak_memory_mib") if self.reused else None
        peaks = (memory.peak_mib(), earlier, self.workers_report["peak_memory_mib"])
        result["peak_memory_mib"] = max(peak or 0.0 for peak in peaks)


def _listed(pairs: Sequence[int]) -> str:
    """Name some pairs, and say how many there are where they are many."""
    names = ", ".join(map(str, pairs[:NAMED]))
    return f"pair{'s' if len(pairs) > 1 else ''} {names}" + (
        f" and {len(pairs) - NAMED} more" if len(pairs) > NAMED else ""
    )


def _mark(file: io.BytesIO, **attributes: Any) -> None:
    import h5py

    with h5py.File(file, "a") as opened:
        opened.attrs.update(attributes)
