"""One invocation on one experiment and one output folder: what is done once for all pairs, its clock, its warnings."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv import files
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment, check_pairs, read_experiment
from lfpiv.files import writing
from lfpiv.results import provenance
from lfpiv.results.folder import Folder, make_writable, retire
from lfpiv.runs import memory, summary
from lfpiv.runs.pair import Outcome, PairWork
from lfpiv.warn import NAMED_PAIRS, Code, Warning, collected, name_pairs
from lfpiv_kernels import runtime

if TYPE_CHECKING:
    from lfpiv.calibration.cameras import Calibration
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]
"""Called as ``progress(step, fraction)``, fraction from 0 to 1."""


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
    """Check everything, start the device, keep the warnings; leave no empty folder behind on failure.

    Jobs that write results hold the folder for themselves; `writes_results` is False for one that only reports.
    """
    start = time.perf_counter()
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    folder = Folder(Path(out))
    numbers = _select(experiment, pairs)
    memory.require(memory.least_bytes(experiment), experiment, "volumes of")
    made = make_writable(folder.path)
    try:
        with contextlib.ExitStack() as stack:
            warnings = stack.enter_context(collected())
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
            yield Job(experiment, folder, numbers, progress, request, running, warnings, start)
    finally:
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
        warnings: list[Warning],
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
        self.tried: set[int] = set()
        self.weights_report: dict[str, Any] = {}
        self.workers_report: dict[str, Any] = {"count": 1, "threads": device.threads, "peak_memory_mib": None}
        self.calibration: Calibration | None = None
        self.calibration_stamp = provenance.of_calibration(experiment)
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
            wanted = [(self.folder.vectors(pair), provenance.of_vectors)] if vectors else []
            wanted += [(self.folder.volume(pair, frame), provenance.of_volumes) for frame in (0, 1)] if volumes else []
            for path, mark in wanted:
                found = provenance.marks(path)
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
                log.info("%s changed: %s made anew", reason, name_pairs(pairs))
        return todo

    def check_images(self, todo: Sequence[int]) -> list[int]:
        """Warn of pairs whose images cannot be used, and return those that are worth any work.

        They are tried and left out when their turn comes; where all are such, none is worth it, and all have failed.

        Raises
        ------
        InputError
            If the first one's images cannot be used and no finished pair shows that the experiment file is right.
        """
        bad = dict(check_pairs(self.experiment, [pair for pair in todo if not self.has_volumes(pair)]))
        if bad and todo[0] in bad and not any(map(self.is_finished, range(self.experiment.pairs))):
            others = f" To do the pairs after it, use --pairs {todo[0] + 1}:." if len(bad) < len(todo) else ""
            raise InputError(bad[todo[0]] + others)
        if len(bad) == len(todo):
            for pair, reason in bad.items():
                self.note(Outcome(pair=pair, reason=reason))
            return []
        for reason in list(bad.values())[:NAMED_PAIRS]:
            log.error("%s The other pairs will be done.", reason)
        if len(bad) > NAMED_PAIRS:
            log.error("%d pairs have images that cannot be used: %s", len(bad), name_pairs(list(bad)))
        return list(todo)

    def is_finished(self, pair: int) -> bool:
        """Whether vectors or both volumes of a pair are in the folder and fit."""
        found = provenance.marks(self.folder.vectors(pair))
        wanted = provenance.of_vectors(self.experiment, self.calibration_stamp.hash, pair)
        return (found is not None and not wanted.changes(found)) or self.has_volumes(pair)

    def has_volumes(self, pair: int) -> bool:
        """Whether both volumes of a pair are in the folder and fit."""
        wanted = provenance.of_volumes(self.experiment, self.calibration_stamp.hash, pair)
        found = [provenance.marks(self.folder.volume(pair, frame)) for frame in (0, 1)]
        return all(marks is not None and not wanted.changes(marks) for marks in found)

    # --- steps done once

    def load_calibration(self) -> Calibration:
        """Load the calibration in the folder; InputError where there is none that fits the experiment."""
        from lfpiv.calibration.cameras import load_calibration

        path = self.folder.calibration
        found = provenance.marks(path)
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
        found = provenance.marks(path)
        changes = None if found is None else self.calibration_stamp.changes(found)
        if changes == []:
            return self.load_calibration()
        if changes:
            log.info("%s changed: calibration made anew", ", ".join(changes))
        from lfpiv.calibration.cameras import calibrate as calibrate_cameras

        with self.timed("calibration"):
            self.calibration = calibrate_cameras(self.experiment, progress=self.step("calibration"))
        attributes = {**self.calibration_stamp.attributes, "seconds": self.seconds["calibration"]}
        _write_calibration(self.calibration, path, **attributes)
        return self.calibration

    def self_calibrate(self, calibration: Calibration) -> Calibration:
        """Correct the calibration by the particles where the experiment asks for it; what is in the folder is kept."""
        mark = provenance.of_self_calibration(self.experiment, self.calibration_stamp.hash)
        if mark is None:
            return calibration
        from lfpiv.calibration.camera import load_calibration
        from lfpiv.runs import moved_cameras

        path = self.folder.self_calibration
        found = provenance.marks(path)
        if found is not None and not mark.changes(found):
            log.info("self-calibration: finished before with the same settings, kept")
            self.weights_report["self_calibration"] = json.loads(found["figures"])
            return load_calibration(path)
        try:
            with self.timed("self_calibration"):
                corrected, self.weights_report["self_calibration"] = moved_cameras.correct(
                    self.experiment, calibration, self.step("self-calibration")
                )
        except ValueError as error:
            raise InputError(f"{self.experiment.path}: self_calibration.pairs: {error}") from None
        figures = self.weights_report["self_calibration"]
        _write_calibration(corrected.calibration, path, **mark.attributes, figures=json.dumps(figures))
        return corrected.calibration

    def build_weights(self, calibration: Calibration, todo: Sequence[int]) -> Weights:
        """Build the weights of the grid, for some pairs of which the first tells whether cameras moved."""
        from lfpiv.calibration.coverage import require_seen, warn_outside
        from lfpiv.runs import moved_cameras
        from lfpiv.weights.operator import build_weights, compare_with_count

        method = self.experiment.compute.weights
        require_seen(self.experiment.path, calibration, self.experiment.grid)
        warn_outside(calibration, self.experiment.grid)
        if len(calibration.cameras) == 1:
            log.warning("%s", Warning(code=Code.ONE_CAMERA).sentence)
        with collected() as warnings:
            with self.timed("weights"):
                weights = build_weights(
                    calibration,
                    self.experiment.grid,
                    method,
                    form=self.experiment.compute.weights_form,
                    limit_bytes=memory.left_for_weights(self.experiment),
                    progress=self.step("weights"),
                )
                _ = weights.camera_sums  # made once for all pairs and workers
            counted = compare_with_count(weights) if method == "footprint" else {}
            disparity = moved_cameras.check(self.experiment, weights, todo)
        memory_mib = weights.memory_bytes / memory.MIB
        self.weights_report |= {
            "method": method,
            "memory_mib": memory_mib,
            "warnings": [one.to_json() for one in warnings],
            **disparity,
        }
        if method == "footprint":
            self.weights_report |= {"form": dict(weights.forms), "cuts": dict(weights.cuts)}
            self.weights_report["profiles_check_l2"] = {
                name: [round(error, 4) for error in errors] for name, errors in weights.profile_errors.items()
            }
            errors = [error for camera in counted.values() for error in camera]
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
        """Keep what came of a pair; where it failed, put results aside that were made of other images of it."""
        pair = outcome.pair
        self.tried.add(pair)
        if not outcome.reason:
            return
        self.failed[pair] = outcome.reason
        log.error("pair %d failed and is left out: %s", pair, outcome.reason)
        made = [(self.folder.vectors(pair), provenance.of_vectors)]
        made += [(self.folder.volume(pair, frame), provenance.of_volumes) for frame in (0, 1)]
        for path, mark in made:
            found = provenance.marks(path)
            wanted = mark(self.experiment, self.calibration_stamp.hash, pair)
            if found is None or "images" not in wanted.changes(found):
                continue
            with writing(path):
                aside = retire(path)
            log.warning("%s: made of other images than there are now; renamed %s", path, aside.name)

    def finish(self, *, report: bool) -> dict[str, Any]:
        """Write summary.json of all that the folder holds, and report.html where asked; return the summary."""
        if self.calibration is None:
            raise InputError(f"{self.folder.calibration}: expected a calibration, found none. Run `lfpiv calibrate`.")
        vectors, pairs, reconstructed = {}, [], []
        for pair in range(self.experiment.pairs):
            path = self.folder.vectors(pair)
            found = provenance.marks(path)
            if found is not None and not provenance.of_vectors(
                self.experiment, self.calibration_stamp.hash, pair
            ).changes(found):
                vectors[pair] = path
                pairs.append(summary.pair_entry(pair, path, found))
            elif self.has_volumes(pair):
                marks = [provenance.marks(self.folder.volume(pair, frame)) for frame in (0, 1)]
                reconstructed.append(summary.volumes_entry(pair, filter(None, marks)))
        earlier = {entry["pair"]: entry["reason"] for entry in self.previous.get("failed", ())}
        done = {*self.tried, *vectors}
        result = summary.build(
            experiment=self.experiment,
            calibration=self.calibration,
            calibration_path=self.folder.calibration,
            pairs=pairs,
            reconstructed=reconstructed,
            failed=self.failed,
            failed_earlier={
                pair: reason for pair, reason in earlier.items() if pair < self.experiment.pairs and pair not in done
            },
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
            files.write_json(result, self.folder.summary)
        return result

    def _stop_clock(self, result: dict[str, Any]) -> None:
        """Put the time and the peak memory so far into a summary."""
        result["timings_s"]["total"] = time.perf_counter() - self.start
        earlier = self.previous.get("peak_memory_mib") if self.reused else None
        peaks = (memory.peak_mib(), earlier, self.workers_report["peak_memory_mib"])
        result["peak_memory_mib"] = max(peak or 0.0 for peak in peaks)


def _write_calibration(calibration: Calibration, path: Path, **attributes: Any) -> None:
    """Write a calibration and what its file is marked with, whole or not at all."""
    import h5py

    content = io.BytesIO()  # not straight to disk: see `dataset.write_bytes`
    calibration.save(content)  # type: ignore[arg-type]  # HDF5 takes files too
    with h5py.File(content, "a") as opened:
        opened.attrs.update(attributes)
    with writing(path):
        files.write_bytes(content.getbuffer(), path)
