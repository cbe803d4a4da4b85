"""Build ``summary.json``, the machine-readable figures of a run, and read that of an earlier invocation.

`build` takes the calibration, the figures of all results in the folder and the `Invocation`. It returns the content of
the file, with equal warnings about several pairs merged into one.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv import files, version
from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.records import RecordError, digest, read_object, read_text, validate
from lfpiv.results import particles
from lfpiv.results.folder import Folder
from lfpiv.results.stored_damping import StoredDamping
from lfpiv.runs import guard, refinement
from lfpiv.runs.guard import Guard
from lfpiv.runs.invocation import Calibrated, Invocation
from lfpiv.runs.moved_cameras import SelfCalibrationFigures
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.runs.refinement import Refinement
from lfpiv.runs.result_warnings import copied_warnings, pair_warnings, rig_warnings
from lfpiv.velocity import vector_grid
from lfpiv.warn import Gathering, Warning, from_list

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.geometry.grid import Grid
    from lfpiv_kernels.runtime import Device

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1

CORRECTION_RAYS = 4000
"""Number of rays for the network's part in the mapping."""

SETTINGS = ("smart", "correlation", "bootstrap", "tracking", "self_calibration", "network", "compute")
"""Tables of the experiment file that the summary states, where the run has them."""

MOST_LISTED = 10_000
"""Largest number of pairs with an entry in the summary, and that a warning names. ``pairs.jsonl`` lists more."""


@dataclass(frozen=True, kw_only=True)
class Contents:
    """Results in the folder of a run."""

    vectors: Mapping[int, PairFigures]
    """Pair -> figures of its vectors."""
    selected: range
    """Pairs selected for this invocation."""
    volumes: Gathering
    """Warnings about the images of pairs that have volumes and no vectors."""
    background: Mapping[str, Any] = field(default_factory=dict)
    """Camera -> figures of the light that stands still in its images."""
    background_warnings: tuple[Warning, ...] = ()
    """Warnings about light that stands still and is not subtracted."""
    guard: Guard | None = None
    """Light beyond the volume and guard layers; None if they were not measured."""
    damping: StoredDamping | None = None
    """Damping by ghosts; None if it was not measured."""
    refinement: Refinement | None = None
    """Size of the particles and refinement; None if it was not measured."""
    copies: Mapping[int, int] = field(default_factory=dict)
    """Pairs with an image of another pair, each with that one."""


@dataclass(frozen=True, kw_only=True)
class EarlierSummary:
    """Parts of an earlier invocation's summary that the present one reuses."""

    weights: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the weights as stored; empty if there were none."""
    weights_s: float = 0.0
    refusals: tuple[Warning, ...] = ()
    """Why vectors are not valid, see `belonging.check`."""
    settled: int = 0
    """Pairs that were finished when pairs that stand out were last looked for; see `odd_pairs.settle`."""
    failed: Mapping[int, str] = field(default_factory=dict)
    """Pair -> why it failed."""
    peak_memory_mib: float | None = None


@dataclass(frozen=True, kw_only=True)
class _Failure:
    """A pair that failed, as the summary stores it."""

    pair: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class _Weights:
    """Figures of the weights, as the summary stores them."""

    method: str = ""
    memory_mib: float = 0.0
    form: dict[str, str] = field(default_factory=dict)
    cuts: dict[str, list[int]] = field(default_factory=dict)
    profiles_check_l2: dict[str, list[float | None]] = field(default_factory=dict)
    count_check_l2: list[float] = field(default_factory=list)
    disparity_pair: int | None = None
    disparity_voxel: float | None = None
    self_calibration: SelfCalibrationFigures | None = None


@dataclass(frozen=True, kw_only=True)
class _Stored:
    """Entries of the summary that a later invocation reads."""

    weights: dict[str, Any] = field(default_factory=dict)
    timings_s: dict[str, float | None] = field(default_factory=dict)
    failed: list[_Failure] = field(default_factory=list)
    peak_memory_mib: float | None = None
    pairs_settled: int = 0


def read(path: Path) -> EarlierSummary:
    """Read an earlier summary; an empty one if the file is missing, damaged or of another schema."""
    try:
        found = read_object(read_text(path))
        if found.get("digest") != digest(found):
            raise RecordError("its entries are not those that were written: the digest differs")
        if found.get("schema_version") != SCHEMA_VERSION:
            raise RecordError(
                f"expected schema version {SCHEMA_VERSION}, found {str(found.get('schema_version'))[:40]}"
            )
        known = validate(_Stored, found)
        validate(_Weights, known.weights)
        from_list(known.weights.get("warnings", []))
        refusals = from_list(known.weights.get("refusals", []))
    except FileNotFoundError:
        return EarlierSummary()
    except RecordError as error:
        log.warning("%s: damaged or of another version, written anew: %s", path, error)
        return EarlierSummary()
    return EarlierSummary(
        weights=known.weights,
        weights_s=known.timings_s.get("weights") or 0.0,
        refusals=refusals,
        settled=known.pairs_settled,
        failed={failure.pair: failure.reason for failure in known.failed},
        peak_memory_mib=known.peak_memory_mib,
    )


def build(
    experiment: Experiment,
    device: Device,
    calibrated: Calibrated,
    contents: Contents,
    done: Invocation,
    earlier: EarlierSummary,
    folder: Folder,
) -> dict[str, Any]:
    """Build the content of ``summary.json`` without ``timings_s.total``, ``peak_memory_mib`` and the digest.

    ``timings_s`` is the time that the results took, also those of earlier invocations. ``warnings`` are
    sentences for people. ``warning_records`` are the same warnings, in the same order, with code and figures. Of more
    than `MOST_LISTED` finished pairs that many are in ``pairs``, evenly chosen. This writes the file ``pairs.jsonl``
    with all of them.
    """
    reports = {name: _report(camera, experiment.grid) for name, camera in calibrated.calibration.cameras.items()}
    weights = done.weights.to_json() if done.weights else dict(earlier.weights)
    pairs = _survey(contents, folder)
    warnings = _warnings(experiment, calibrated, contents, done, weights, pairs.warnings)
    failed = _failures(experiment, contents, done, earlier)
    return {
        "schema_version": SCHEMA_VERSION,
        **_settings(experiment),
        "device": device.figures(),
        "workers": asdict(done.workers) if done.workers else {},
        "versions": version.versions(),
        "timings_s": {
            "calibration": calibrated.seconds,
            "network_training": sum(float(report.get("training_s", 0.0)) for report in reports.values()),
            "weights": done.weights.seconds if done.weights else earlier.weights_s,
            "reconstruction": pairs.totals["reconstruction_s"],
            "correlation": pairs.totals["correlation_s"],
            "bootstrap": contents.damping.seconds if contents.damping else 0.0,
        },
        "calibration": reports,
        "board": {} if calibrated.calibration.board is None else calibrated.calibration.board.to_json(),
        "weights": weights,
        "background": dict(contents.background),
        "guard": _guard(experiment, contents.guard),
        "damping": None if contents.damping is None else contents.damping.to_json(),
        "refinement": _refinement(experiment, contents.refinement),
        "pairs_finished": pairs.count,
        "pairs_settled": earlier.settled if done.settled is None else done.settled,
        "pairs_file": folder.pairs.name if pairs.count > MOST_LISTED else None,
        "pairs": pairs.listed,
        "pairs_failed": len(failed) + max(done.tried.failures - len(done.tried.failed), 0),
        "failed": failed,
        "without_vectors": list(pairs.empty),
        "valid_fraction": pairs.mean("valid_fraction"),
        "finite_fraction": pairs.mean("finite_fraction"),
        "warnings": list(warnings),
        "warning_records": [_record(warning) for warning in warnings.values()],
        "reused": list(done.reused),
    }


@dataclass(frozen=True, kw_only=True)
class _Survey:
    """What the summary states of all finished pairs."""

    count: int
    listed: list[dict[str, Any]]
    """Entries of the pairs, of at most `MOST_LISTED`."""
    totals: Mapping[str, float]
    """Figure -> its sum over all pairs."""
    empty: Sequence[int]
    """Selected pairs without a single valid vector, at most `MOST_LISTED`."""
    warnings: Sequence[Warning]

    def mean(self, name: str) -> float | None:
        """Return the mean of a figure over all pairs; None without pairs."""
        return self.totals[name] / self.count if self.count else None


def _survey(contents: Contents, folder: Folder) -> _Survey:
    """Go through the figures of all finished pairs once. If they are too many for the summary, write them to a file."""
    total, images, vectors = len(contents.vectors), Gathering(), Gathering()
    tracked = folder.particles(0).parent.is_dir()
    totals, listed = dict.fromkeys(_SUMMED, 0.0), []
    empty: list[int] = []
    with _lines(folder.pairs if total > MOST_LISTED else None) as write:
        for place, (pair, figures) in enumerate(contents.vectors.items()):
            entry = {"pair": pair, "file": folder.vectors(pair).name, **figures.to_json()}
            entry |= particles.figures(folder.particles(pair)) if tracked else {}
            write(entry)
            if total <= MOST_LISTED or place in (0, total - 1) or _is_sampled(place, total):
                listed.append(entry)
            if pair in contents.selected and not figures.valid_fraction > 0 and len(empty) < MOST_LISTED:
                empty.append(pair)
            images.add(warning.of_pair(pair) for warning in figures.warnings)
            vectors.add(pair_warnings(pair, figures))
            for name in totals:
                totals[name] += getattr(figures, name)
    if total <= MOST_LISTED:
        folder.pairs.unlink(missing_ok=True)
    images.join(contents.volumes)
    warnings = [*images.merged(), *vectors.merged()]
    return _Survey(count=total, listed=listed, totals=totals, empty=empty, warnings=warnings)


def _is_sampled(place: int, total: int) -> bool:
    """Return whether an item is among `MOST_LISTED` - 2 evenly chosen ones between the first and the last."""
    most = MOST_LISTED - 1
    return place * most // total != (place - 1) * most // total


_SUMMED = ("reconstruction_s", "correlation_s", "valid_fraction", "finite_fraction")


@contextlib.contextmanager
def _lines(path: Path | None) -> Iterator[Callable[[Any], object]]:
    """Yield a function that writes values as lines of JSON into a file, which appears when all are written."""
    if path is None:
        yield lambda value: None
        return
    with files.replacing(path) as scratch, scratch.open("w", encoding="utf-8") as file:
        yield lambda value: file.write(json.dumps(files.plain(value), allow_nan=False) + "\n")


def _record(warning: Warning) -> dict[str, Any]:
    """Return the form of a warning in the summary; it names the first `MOST_LISTED` pairs and counts all."""
    stored = warning.to_json()
    for name in ("pairs", "instants"):
        if (count := len(stored.get(name, ()))) > MOST_LISTED:
            stored |= {name: stored[name][:MOST_LISTED], f"{name}_count": count}
    return stored


def _settings(experiment: Experiment) -> dict[str, Any]:
    return {
        "experiment": {
            "name": experiment.name,
            "file": str(experiment.path),
            "dt_s": experiment.dt_s,
            "pairs": experiment.pairs,
            "volume_shape": list(experiment.grid.shape),
            "voxel_mm": experiment.grid.voxel_mm,
            **experiment.recording.stated,
        },
        "settings": {name: table.model_dump() for name in SETTINGS if (table := getattr(experiment, name)) is not None},
    }


def _warnings(
    experiment: Experiment,
    calibrated: Calibrated,
    contents: Contents,
    done: Invocation,
    weights: Mapping[str, Any],
    of_pairs: Sequence[Warning],
) -> dict[str, Warning]:
    """Collect all warnings by their sentences, each once."""
    found = [
        *rig_warnings(calibrated.calibration, experiment),
        *vector_grid.warnings(experiment.correlation, experiment.grid.shape),
        *guard.warnings(experiment, contents.guard),
        *refinement.warnings(experiment, contents.refinement),
        *map(Warning.from_json, weights.get("warnings", ())),
        *map(Warning.from_json, () if contents.vectors else weights.get("refusals", ())),
        *contents.background_warnings,
        *of_pairs,
        *copied_warnings(contents.copies, series=experiment.recording.is_series),
        *done.warnings,
    ]
    by_sentence: dict[str, Warning] = {}
    for warning in map(experiment.recording.by_result, found):
        by_sentence.setdefault(warning.sentence, warning)
    return by_sentence


def _guard(experiment: Experiment, found: Guard | None) -> dict[str, Any]:
    """Return the guard layers (x, y, z; low and high) [mm] and the light beyond the volume."""
    used = guard.layers(experiment, found)
    thickness = [[round(count * experiment.grid.voxel_mm, 6) for count in pair] for pair in reversed(used)]
    light = {} if found is None else found.to_json()
    return {"thickness_mm": thickness, "pairs": list(light.get("pairs", ())), "faces": list(light.get("faces", ()))}


def _refinement(experiment: Experiment, found: Refinement | None) -> dict[str, Any]:
    """Return the reconstructed voxels and the size of the particles [voxel of the experiment]."""
    factor = refinement.factor(experiment, found)
    return {
        "factor": factor,
        "voxel_mm": experiment.grid.voxel_mm / factor,
        "particle_size_voxel": None if found is None else found.size_voxel,
        "pairs": [] if found is None else list(found.pairs),
    }


def _failures(
    experiment: Experiment, contents: Contents, done: Invocation, earlier: EarlierSummary
) -> list[dict[str, Any]]:
    """List the pairs that failed; those of earlier invocations are marked unless they were tried or finished since."""
    entries: list[dict[str, Any]] = [{"pair": pair, "reason": reason} for pair, reason in done.tried.failed.items()]
    entries += [
        {"pair": pair, "reason": reason, "earlier": True}
        for pair, reason in earlier.failed.items()
        if pair in experiment.numbers and pair not in done.tried and pair not in contents.vectors
    ]
    return sorted(entries, key=lambda entry: entry["pair"])


def _report(camera: CalibratedCamera, grid: Grid) -> dict[str, Any]:
    """Return the numbers and short texts of a camera's calibration; its arrays stay in the calibration file."""
    report = ({} if camera.report is None else camera.report.to_json()) | {
        "warnings": [warning.sentence for warning in camera.warnings],
        "network_correction_pitch": network_correction(camera, grid),
    }
    return {key: files.plain(value) for key, value in report.items() if not isinstance(value, np.ndarray)}


def network_correction(camera: CalibratedCamera, grid: Grid) -> float | None:
    """Return the root mean square of the network's correction to the thin lens over a volume [microlens pitch].

    Uses rays through the whole pupil from random voxels. None without a thin lens, where the network is the mapping.
    """
    if camera.network is None or camera.baseline is None:
        return None
    rng = np.random.default_rng(0)
    points = np.stack([rng.choice(grid.axis_mm(axis), CORRECTION_RAYS) for axis in (2, 1, 0)], axis=1)
    pupil = random_on_pupil(camera.optics.pupil_radius_mm, CORRECTION_RAYS, rng)
    correction = camera.network(np.hstack([points, pupil]))
    return float(np.sqrt((correction**2).sum(1).mean()) / camera.lattice.pitch_mm)
