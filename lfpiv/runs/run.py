"""One invocation on one experiment and one output folder: its checks, the pairs to do, its summary and report.

`open_run` checks everything, starts the device and yields a frozen `Run`. `Run.finish` writes summary and report from
the results of all steps.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from lfpiv import files
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment, check_pairs, read_experiment
from lfpiv.files import writing
from lfpiv.geometry.grid import Layers
from lfpiv.progress import Progress, StepProgress, ignore_progress
from lfpiv.results import finished, provenance
from lfpiv.results.folder import Folder, make_writable
from lfpiv.results.pair_files import PairFiles
from lfpiv.results.provenance import Stamp
from lfpiv.runs import guard, memory, pair_figures, summary
from lfpiv.runs.guard import Guard
from lfpiv.runs.invocation import Calibrated, Invocation, Workers
from lfpiv.runs.pair import Outcome
from lfpiv.runs.summary import Contents, EarlierSummary
from lfpiv.warn import NAMED_PAIRS, Warning, collected, name_pairs
from lfpiv_kernels import runtime

log = logging.getLogger(__name__)


@contextlib.contextmanager
def open_run(
    experiment: Experiment | str | Path,
    out: str | Path,
    device: str | None,
    progress: Progress | None,
    pairs: tuple[int, int | None] | None = None,
    *,
    writes_results: bool = True,
) -> Iterator[Run]:
    """Check everything, start the device and collect warnings. Remove the output folder if it stays empty.

    A run that writes results locks the folder; `writes_results` is False for a run that only reports.
    """
    start_s = time.perf_counter()
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    folder = Folder(Path(out), experiment.series)
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
            request = device or experiment.compute.device
            try:
                running = runtime.start(request, threads=experiment.compute.threads)
            except (RuntimeError, ValueError) as error:
                raise InputError(str(error)) from None
            stack.enter_context(threadpool_limits(running.threads))
            yield Run(
                experiment=experiment,
                folder=folder,
                numbers=numbers,
                progress=progress or ignore_progress,
                device_request=request,
                device=running,
                warnings=warnings,
                start_s=start_s,
                calibration_stamp=provenance.of_calibration(experiment),
                earlier=summary.read(folder.summary),
                background=provenance.background_content(folder.background),
                guard=None if (measured := guard.read(folder)) is None else measured[0],
            )
    finally:
        for path in made:
            with contextlib.suppress(OSError):  # not empty
                path.rmdir()


def _select(experiment: Experiment, pairs: tuple[int, int | None] | None) -> range:
    known = experiment.numbers
    first, after = (None, None) if pairs is None else pairs
    first, after = first or known.start, known.stop if after is None else after
    if not known.start <= first < after <= known.stop:
        raise InputError(
            f"pairs: expected A:B with {known.start} <= A < B <= {known.stop}, the pairs of the experiment, "
            f"found {first}:{after}."
        )
    return range(first, after)


@dataclass(frozen=True)
class Todo:
    """Unfinished pairs of an invocation, and the results that it reuses."""

    pairs: list[int]
    reused: tuple[str, ...]
    """Results of earlier invocations, named for the summary."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One invocation on one experiment and one output folder."""

    experiment: Experiment
    folder: Folder
    numbers: range
    """Pairs selected for this invocation."""
    progress: Progress
    device_request: str
    """Device requested by the user; workers of a cluster choose their own by it."""
    device: runtime.Device
    warnings: Sequence[Warning]
    """Warnings of this invocation so far; grows while `open_run` collects them."""
    start_s: float
    calibration_stamp: Stamp
    earlier: EarlierSummary
    background: str | None = None
    """Hash of the light that is subtracted from the images; None if there is none."""
    guard: Guard | None = None
    """Light beyond the volume and the guard layers that it demands; None before it was measured."""

    def step(self, name: str) -> StepProgress:
        """Return the progress of one step of the run."""
        return lambda fraction: self.progress(name, fraction)

    @property
    def guard_layers(self) -> Layers:
        """Guard layers of the volumes; none if they are yet to be measured."""
        return guard.layers(self.experiment, self.guard if self.experiment.guard_mm == "auto" else None)

    def has_light_of(self, other: Run) -> bool:
        """Return whether the volumes of both runs have the same subtracted light and the same guard layers."""
        return self.background == other.background and self.guard_layers == other.guard_layers

    @property
    def guarded_experiment(self) -> Experiment:
        """The experiment with the grid that is reconstructed."""
        return guard.with_guard(self.experiment, self.guard_layers)

    def files(self, pair: int) -> PairFiles:
        """Return the files of a pair with the stamps that they must have."""
        return PairFiles.of(
            self.experiment,
            self.calibration_stamp.hash,
            self.folder,
            pair,
            background=self.background,
            guard=self.guard_layers,
        )

    def has_volumes(self, pair: int) -> bool:
        """Return whether both volumes of a pair are in the folder and fit."""
        return self.files(pair).fitting_volumes() is not None

    def unfinished(self, *, vectors: bool = True, volumes: bool = False, quiet: bool = False) -> Todo:
        """Find the selected pairs whose vectors or volumes are missing or do not fit; log changes unless `quiet`."""
        changed: dict[str, list[int]] = {}
        for pair in self.numbers:
            changes = self.files(pair).outdated(vectors=vectors, volumes=volumes)
            if changes is not None:
                changed.setdefault(", ".join(changes), []).append(pair)
        todo = sorted(pair for pairs in changed.values() for pair in pairs)
        finished = sorted({*self.numbers}.difference(todo))
        if finished and not quiet:
            text = "%d of %d %ss: finished before with the same settings, kept"
            log.info(text, len(finished), len(self.numbers), self.experiment.noun)
        for reason, pairs in changed.items():
            if reason and not quiet:
                log.info("%s changed: %s made again", reason, name_pairs(pairs, self.experiment.noun))
        kind = "vectors" if vectors else "volumes"
        return Todo(todo, tuple(f"{kind} of {self.experiment.name_of(pair)}" for pair in finished))

    def check_images(self, todo: Sequence[int]) -> tuple[list[int], list[Outcome]]:
        """Log pairs whose images cannot be used; return the pairs to do, and outcomes if none can be done.

        If some pairs can be done, all are tried, and the others fail when their turn comes.

        Raises
        ------
        InputError
            If the first pair cannot be used and no finished pair shows that the experiment file is right.
        """
        bad = dict(check_pairs(self.experiment, [pair for pair in todo if not self.has_volumes(pair)]))
        if bad and todo[0] in bad and not any(map(self._is_finished, self.experiment.numbers)):
            noun = self.experiment.noun
            others = f" To do the {noun}s after it, use --pairs {todo[0] + 1}:." if len(bad) < len(todo) else ""
            raise InputError(bad[todo[0]] + others)
        if len(bad) == len(todo):
            return [], [self.record(Outcome(pair=pair, reason=reason)) for pair, reason in bad.items()]
        for reason in list(bad.values())[:NAMED_PAIRS]:
            log.error("%s The other %ss will be done.", reason, self.experiment.noun)
        if len(bad) > NAMED_PAIRS:
            names = name_pairs(list(bad), self.experiment.noun)
            log.error("%d %ss have images that cannot be used: %s", len(bad), self.experiment.noun, names)
        return list(todo), []

    def _is_finished(self, pair: int) -> bool:
        found = self.files(pair)
        return found.fitting_vectors() is not None or found.fitting_volumes() is not None

    def require_whole(self) -> None:
        """Verify the results that a report shows, where they cannot be made again.

        Raises
        ------
        InputError
            If a file is damaged, or is another one's copy.
        """
        finished.require([self.folder.background, *map(self.folder.vectors, self.experiment.numbers)])

    def record(self, outcome: Outcome) -> Outcome:
        """Log the failure of a pair, rename its results from earlier images, and return the outcome."""
        if outcome.died and self.files(outcome.pair).fitting_vectors() is not None:
            return replace(outcome, reason="")  # its worker died after it
        if outcome.reason:
            log.error("%s failed and is left out: %s", self.experiment.name_of(outcome.pair), outcome.reason)
            for path, aside in self.files(outcome.pair).retire_outdated():
                log.warning("%s: made of other images than there are now; renamed %s", path, aside.name)
        return outcome

    def finish(self, calibrated: Calibrated, done: Invocation, *, report: bool) -> dict[str, Any]:
        """Write summary.json about all results in the folder, and optionally report.html; return the summary."""
        contents = self._contents()
        reused = (*(("calibration",) if calibrated.reused else ()), *done.reused)
        done = replace(
            done,
            reused=reused,
            warnings=tuple(self.warnings),
            workers=done.workers or Workers(count=1, threads=self.device.threads),
        )
        result = summary.build(self.experiment, self.device, calibrated, contents, done, self.earlier)
        result |= self._usage(done, result["timings_s"])
        if report:
            from lfpiv.report import write_report

            start = time.perf_counter()
            vectors = {pair: self.folder.vectors(pair) for pair in contents.vectors}
            with writing(self.folder.report):
                write_report(self.experiment, calibrated.calibration, result, vectors, self.folder.report)
            result |= self._usage(done, result["timings_s"] | {"report": time.perf_counter() - start})
        with writing(self.folder.summary):
            files.write_json(result, self.folder.summary)
        return result

    def _contents(self) -> Contents:
        """Read the figures of all finished pairs of the experiment, from the attributes of their files."""
        vectors, volumes = {}, {}
        for pair in self.experiment.numbers:
            found = self.files(pair)
            if (marks := found.fitting_vectors()) is not None:
                vectors[pair] = pair_figures.read_figures(found.vectors, marks)
            elif (both := found.fitting_volumes()) is not None:
                volumes[pair] = both[0].warnings + both[1].warnings
        light, warnings = provenance.background_figures(self.folder.background)
        return Contents(
            vectors=vectors,
            volumes=volumes,
            background=light,
            background_warnings=warnings,
            guard=self.guard,
        )

    def _usage(self, done: Invocation, timings_s: dict[str, float]) -> dict[str, Any]:
        """Return the time and the peak memory so far, in the form of the summary."""
        earlier = self.earlier.peak_memory_mib if done.reused else None
        workers = done.workers.peak_memory_mib if done.workers else None
        total_s = time.perf_counter() - self.start_s
        return {
            "timings_s": timings_s | {"total": total_s},
            "peak_memory_mib": max(memory.peak_mib(), earlier or 0.0, workers or 0.0),
        }
