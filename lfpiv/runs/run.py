"""One invocation on one experiment and one output folder: its checks, the pairs to do, its summary and report.

`open_run` checks everything, starts the device and yields a frozen `Run`. `Run.finish` writes summary and report from
the results of all steps.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from lfpiv.errors import DamagedFile, InputError
from lfpiv.experiment import recorded_times
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.experiment.pair_range import pair_range
from lfpiv.files import writing
from lfpiv.geometry.grid import Layers
from lfpiv.progress import Progress, StepProgress, ignore_progress
from lfpiv.results import provenance, stamps, summary_file
from lfpiv.results.folder import Folder, VectorFiles, make_writable
from lfpiv.results.pair_files import PairFiles
from lfpiv.results.provenance import Stamp
from lfpiv.results.stamps import Inputs
from lfpiv.results.track_files import track_figures
from lfpiv.runs import bootstrap, guard, memory, odd_pairs, pair_figures, refinement, summary
from lfpiv.runs.finished_pairs import FinishedPairs
from lfpiv.runs.guard import Guard
from lfpiv.runs.invocation import Calibrated, Invocation, Tried, Workers
from lfpiv.runs.other_scales import other_scales
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_outcome import Outcome
from lfpiv.runs.pending_pairs import PendingPairs
from lfpiv.runs.refinement import Refinement
from lfpiv.runs.repeated_images import repeated_images
from lfpiv.runs.reversed_pairs import reversed_pairs, still
from lfpiv.runs.summary import Contents, EarlierSummary
from lfpiv.runs.unlike_pulses import unlike_pulses
from lfpiv.warn import Gathering, Warning, collected, warn
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
    folder = Folder(Path(out), experiment.recording)
    numbers = _select(experiment, pairs)
    memory.require(memory.worker_bytes(experiment), experiment, "volumes of")
    made = make_writable(folder.path)
    try:
        with contextlib.ExitStack() as stack:
            warnings = stack.enter_context(collected())
            stack.enter_context(provenance.rejected_once())
            for warning in recorded_times.contradictions(experiment):
                warn(log, warning)
            if writes_results:
                stack.enter_context(folder.held())
                folder.sweep()
                stack.callback(folder.sweep)
            request = device or experiment.compute.device
            try:
                running = runtime.start(request, threads=experiment.compute.threads)
            except (RuntimeError, ValueError) as error:
                raise InputError(str(error)) from None
            # sums of BLAS depend on its number of threads; operations on small matrices are slower with several
            stack.enter_context(threadpool_limits(1))
            yield Run(
                experiment=experiment,
                folder=folder,
                numbers=numbers,
                progress=progress or ignore_progress,
                device_request=request,
                device=running,
                warnings=warnings,
                start_s=start_s,
                calibration_stamp=stamps.of_calibration(experiment),
                earlier=summary.read(folder.summary),
                finished=FinishedPairs(experiment.numbers, folder.path),
                background=provenance.background_content(folder.background),
                guard=None if (measured := guard.read(folder)) is None else measured[0],
                refinement=None if (sized := refinement.read(folder)) is None else sized[0],
            )
    finally:
        for path in made:
            with contextlib.suppress(OSError):  # not empty
                path.rmdir()


def _select(experiment: Experiment, pairs: tuple[int, int | None] | None) -> range:
    known = experiment.numbers
    start, stop = pair_range(pairs)
    first, after = start or known.start, known.stop if stop is None else stop
    if not known.start <= first < after <= known.stop:
        numbers = "instants that have a partner" if experiment.recording.is_series else "pairs of the experiment"
        raise InputError(
            f"pairs: expected A:B with {known.start} <= A < B <= {known.stop}, the {numbers}, "
            f"found {start}:{'' if stop is None else stop}."
        )
    return range(first, after)


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
    finished: FinishedPairs
    """Figures of the finished pairs that this invocation met so far."""
    background: str | None = None
    """Hash of the light that is subtracted from the images; None if there is none."""
    guard: Guard | None = None
    """Light beyond the volume and the guard layers that it demands; None before it was measured."""
    refinement: Refinement | None = None
    """Size of the particles and the refinement that it demands; None before it was measured."""

    def step(self, name: str) -> StepProgress:
        """Return the progress of one step of the run."""
        return lambda fraction: self.progress(name, fraction)

    @property
    def guard_layers(self) -> Layers:
        """Guard layers of the volumes; the least ones if they are yet to be measured."""
        return guard.layers(self.experiment, self.guard if self.experiment.guard_mm == "auto" else None)

    @property
    def refinement_factor(self) -> float:
        """Edge of a voxel over the edge of a reconstructed voxel; 1 if it is yet to be measured."""
        return refinement.factor(self.experiment, self.refinement)

    @property
    def particle_voxel(self) -> float:
        """Standard deviation of the particles [reconstructed voxel]; 0 for points, and where it was not measured."""
        size = None if self.refinement is None else self.refinement.size_voxel
        return (size or 0.0) * self.refinement_factor

    def has_light_of(self, other: Run) -> bool:
        """Return whether the volumes of both runs have the same subtracted light and the same reconstructed grid."""
        return self.inputs == other.inputs

    @property
    def inputs(self) -> Inputs:
        """What the volumes of all pairs depend on."""
        return Inputs(self.calibration_stamp.hash, self.background, self.guard_layers, self.refinement_factor)

    @property
    def reconstructed_experiment(self) -> Experiment:
        """The experiment with the grid that is reconstructed: with guard layers, of smaller voxels."""
        return refinement.refined(guard.with_guard(self.experiment, self.guard_layers), self.refinement_factor)

    def files(self, pair: int) -> PairFiles:
        """Return the files of a pair with the stamps that they must have."""
        return PairFiles.for_pair(self.experiment, self.inputs, self.folder, pair)

    def damping_stamp(self, pairs: Sequence[int]) -> Stamp:
        """Return the stamp of the damping by ghosts that was measured with some pairs."""
        first = next(iter(pairs), self.numbers[0])
        return stamps.of_bootstrap(self.experiment, self.files(first).stamp, pairs)

    def tracks_stamp(self, pairs: Sequence[int]) -> Stamp:
        """Return the stamp of the tracks that the linked particles of some pairs begin."""
        particles = self.files(next(iter(pairs))).particles_stamp
        assert particles is not None
        return stamps.of_tracks(self.experiment, particles, pairs)

    def pairs_with_particles(self) -> list[int]:
        """Return all pairs of the experiment whose linked particles are finished and fit."""
        files = (self.files(pair) for pair in self.experiment.numbers)
        return [one.pair for one in files if one.has_particles()]

    def pairs_with_vectors(self) -> list[int]:
        """Return the selected pairs whose vectors are finished and fit."""
        there = self.folder.stored(self.numbers, vectors=True, volumes=False)
        stored = (pair for pair, one in zip(self.numbers, there, strict=True) if one)
        return [pair for pair in stored if self.files(pair).fitting_vectors() is not None]

    def has_volumes(self, pair: int) -> bool:
        """Return whether both volumes of a pair are in the folder and fit."""
        return self.files(pair).fitting_volumes() is not None

    def unfinished(
        self, *, vectors: bool = True, volumes: bool = False, particles: bool = True, quiet: bool = False
    ) -> PendingPairs:
        """Find the selected pairs whose results are missing or do not fit; log changes unless `quiet`."""
        self.finished.clear()

        def changes(pair: int) -> list[str] | None:
            found = self.files(pair)
            changed = found.outdated(vectors=vectors, volumes=volumes, particles=particles)
            if changed is None:
                self._keep(found)
            return changed

        stored = self.folder.stored(self.numbers, vectors=vectors, volumes=volumes)
        step = 1 if self.experiment.in_sequence else self.experiment.recording.shared_step or 1
        pending = PendingPairs(
            self.numbers, stored, changes, self.step("stored results"), step=step, noun=self.experiment.noun
        )
        pending.quiet = quiet
        return pending

    def _keep(self, found: PairFiles) -> None:
        """Keep the figures of a pair's vectors for the summary, if they fit."""
        if (marks := found.fitting_vectors()) is not None:
            self.finished.add(found.pair, pair_figures.read_figures(found.vectors, marks), marks.images)

    def has_some_volumes(self) -> bool:
        """Return whether a selected pair has both volumes and they fit."""
        stored = self.folder.stored(self.numbers, vectors=False, volumes=True)
        return any(self.has_volumes(pair) for pair, there in zip(self.numbers, stored, strict=True) if there)

    def need_weights(self, pending: PendingPairs) -> bool:
        """Return whether a pair to do has no volumes that fit, or particles are to be found in its images."""
        if self.experiment.tracking is not None and pending.ahead():
            return True
        if not all(map(self.has_volumes, pending.ahead())):
            return True
        if pending.whole:
            return False
        stored = self.folder.stored(self.numbers, vectors=False, volumes=True)
        return not all(stored) or not all(map(self.has_volumes, self.numbers))

    def require_whole(self) -> None:
        """Verify the results that a report shows, where they cannot be made again.

        Raises
        ------
        InputError
            If a file is damaged, or is another one's copy.
        """
        numbers = self.experiment.numbers
        stored = self.folder.stored(numbers, vectors=True, volumes=False)
        vectors = (self.folder.vectors(pair) for pair, there in zip(numbers, stored, strict=True) if there)
        for path in itertools.chain([self.folder.background], vectors):
            try:
                provenance.require_marks(path)
            except FileNotFoundError:
                continue
            except DamagedFile as error:
                raise DamagedFile(path, error.reason, "Run `lfpiv run`, which makes it again") from None

    def record(self, outcome: Outcome, tried: Tried) -> None:
        """Keep the outcome of a pair and its figures. Log a failure, and rename the results from earlier images."""
        files = self.files(outcome.pair)
        if not outcome.reason or outcome.died:
            self._keep(files)
        if outcome.died and outcome.pair in self.finished:
            outcome = replace(outcome, reason="")  # its worker died after it
        tried.add(outcome)
        if outcome.reason:
            log.error("%s failed and is left out: %s", self.experiment.name_of(outcome.pair), outcome.reason)
            for path, aside in files.retire_outdated():
                log.warning("%s: made of other images than there are now; renamed %s", path, aside.name)

    def finish(self, calibrated: Calibrated, done: Invocation, *, report: bool) -> dict[str, Any]:
        """Write summary.json about all results in the folder, and optionally report.html; return the summary."""
        self.folder.require_kept()
        contents = self._contents()
        reused = (*(("calibration",) if calibrated.reused else ()), *done.reused)
        done = replace(
            done,
            reused=reused,
            warnings=(*self.warnings, *self._unlike_pairs(contents)),
            workers=done.workers or Workers(count=1, threads=self.device.threads),
        )
        with writing(self.folder.pairs):
            result = summary.build(self.experiment, self.device, calibrated, contents, done, self.earlier, self.folder)
        result |= {"tracks": self._tracks()} | self._usage(done, result["timings_s"])
        if report:
            from lfpiv.report.page import write_report

            start = time.perf_counter()
            vectors = VectorFiles(self.folder, contents.vectors)
            with writing(self.folder.report):
                write_report(self.experiment, calibrated.calibration, result, vectors, self.folder.report)
            result |= self._usage(done, result["timings_s"] | {"report": time.perf_counter() - start})
        return summary_file.write(result, self.folder.summary)

    def settle(self, make_work: Callable[[], PairWork]) -> None:
        """Refuse finished pairs whose images do not belong together; `make_work` returns the work with its weights."""
        for pair in odd_pairs.settle(self.finished, self.files, make_work):
            self._keep(self.files(pair))

    def _unlike_pairs(self, contents: Contents) -> list[Warning]:
        """Log and return the warnings about pairs unlike the others, pairs at rest, and cameras with unlike pulses."""
        found = [*reversed_pairs(contents.vectors), *still(contents.vectors), *other_scales(contents.vectors)]
        found += unlike_pulses(contents.vectors)
        for warning in found:
            log.warning("%s", warning.sentence)
        return found

    def _contents(self) -> Contents:
        """Read the figures of all finished pairs of the experiment, from the attributes of their files."""
        numbers, volumes = self.experiment.numbers, Gathering()
        with_vectors = self.folder.stored(numbers, vectors=True, volumes=False)
        with_volumes = self.folder.stored(numbers, vectors=False, volumes=True)
        for pair, one, both in zip(numbers, with_vectors, with_volumes, strict=True):
            if not (one or both) or pair in self.finished:
                continue
            found = self.files(pair)
            self._keep(found)
            if pair not in self.finished and (frames := found.fitting_volumes()) is not None:
                volumes.add(warning.of_pair(pair) for frame in frames for warning in frame.warnings)
        light, warnings = provenance.background_figures(self.folder.background)
        copies = self.finished.copies()
        return Contents(
            vectors=self.finished,
            selected=self.numbers,
            volumes=volumes,
            background=light,
            background_warnings=warnings,
            guard=self.guard,
            damping=bootstrap.stored(self.experiment, self.folder, self.damping_stamp),
            refinement=self.refinement,
            copies={**repeated_images(self.finished, self.experiment, copies), **copies},
        )

    def _tracks(self) -> dict[str, Any] | None:
        """Return the figures of the tracks; None if there are none that fit."""
        if self.experiment.tracking is None or not self.folder.tracks.is_file():
            return None
        pairs, marks = self.pairs_with_particles(), provenance.read_marks(self.folder.tracks)
        fits = bool(pairs) and marks is not None and self.tracks_stamp(pairs).fits(marks)
        return track_figures(self.folder.tracks) if fits else None

    def _usage(self, done: Invocation, timings_s: dict[str, float]) -> dict[str, Any]:
        """Return the time and the peak memory so far, in the form of the summary."""
        earlier = self.earlier.peak_memory_mib if done.reused else None
        workers = done.workers.peak_memory_mib if done.workers else None
        total_s = time.perf_counter() - self.start_s
        return {
            "timings_s": timings_s | {"total": total_s},
            "peak_memory_mib": max(memory.peak_mib(), earlier or 0.0, workers or 0.0),
        }
