"""Score results of any program on a data set with known truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv import metrics
from lfpiv.benchmark import figures
from lfpiv.benchmark.measured import MeasuredField
from lfpiv.benchmark.readers import ReadOptions, read_result
from lfpiv.benchmark.sample import PairErrors, Sample, divergence, in_time, missing_pair, pair_errors
from lfpiv.benchmark.truth import PARTICLES, Truth, open_truth
from lfpiv.benchmark.volumes import score_volumes
from lfpiv.errors import InputError
from lfpiv.experiment.pair_range import pair_range
from lfpiv.files import plain
from lfpiv.metrics import Estimate
from lfpiv.progress import StepProgress
from lfpiv.version import SOURCE

CURVE = np.linspace(0.02, 1.0, 50)
"""Parts of the measurable region at which the error curve is stored."""
PER_PAIR = ("completeness", "error", "median", "error_point", "outliers")
"""Figures that are stated of every pair or instant."""
NORMAL_95 = 1.96
"""Half width of an interval of 95 % in standard errors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """Score of one result; see `score_result`."""

    label: str
    """Name of the result."""
    kind: str
    """"vectors" or "particles"."""
    figures: Mapping[str, Estimate]
    """Figures by key, see `lfpiv.benchmark.figures`. Parts are ratios. NaN where a figure cannot be stated."""
    instants: tuple[Mapping[str, float], ...]
    """The figures of `PER_PAIR` of each pair or instant, with its `number`."""
    curve: metrics.ErrorCurve
    """Errors over the part of the measurable region."""
    sample: Sample
    """The vectors beside the truth."""
    window_mm: tuple[float, float, float] | None
    """Window over which the truth is averaged [mm]; None: values at points."""
    notes: tuple[str, ...]
    """What was assumed."""

    def to_dict(self) -> dict[str, Any]:
        """Return the score as values of JSON."""
        estimates = {
            key: {
                "value": found.value,
                "standard_error": found.standard_error,
                "low": found.low,
                "high": found.high,
            }
            for key, found in self.figures.items()
        }
        return {
            "label": self.label,
            "kind": self.kind,
            "window_mm": self.window_mm,
            "notes": list(self.notes),
            "figures": estimates,
            self.sample.truth.noun + "s": [dict(one) for one in self.instants],
            "error_over_completeness": {
                "part": CURVE.tolist(),
                "error_voxel": [self.curve.bound_at(part) for part in CURVE],
                "mean_error_voxel": [self.curve.mean_at(part) for part in CURVE],
            },
        }


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """What is scored, and how."""

    reading: ReadOptions = field(default_factory=ReadOptions)
    pairs: tuple[int, int | None] | None = None
    """Pairs or instants A to B - 1. Default: all; a missing one counts as not measured."""
    outlier_voxel: float = figures.OUTLIER_VOXEL
    """Length of the error above which a vector is an outlier [voxel]."""
    volumes: Path | None = None
    """Volumes of the reconstruction, a file or a folder."""
    resamples: int = metrics.RESAMPLES
    """Draws of the bootstrap."""


def score_results(
    truth: Truth | str | Path,
    results: Sequence[str | Path],
    options: ScoreOptions | None = None,
    *,
    labels: Sequence[str] = (),
    progress: StepProgress | None = None,
) -> list[Score]:
    """Score results of any program on one data set.

    Parameters
    ----------
    truth : Truth, str or Path
        Truth from `open_truth`, or the folder of the data set.
    results : sequence of str or Path
        Files or folders that `lfpiv.benchmark.readers.read_result` reads, one for each method.
    options : ScoreOptions, optional
        What is scored, and how.
    labels : sequence of str, optional
        Names of the results. Default: those of the files.
    progress : callable, optional
        Called with the finished fraction.

    Raises
    ------
    InputError
        If the truth or a result cannot be read, or nothing of it lies in the volume.
    """
    truth = truth if isinstance(truth, Truth) else open_truth(truth)
    options = options or ScoreOptions()
    if labels and len(labels) != len(results):
        raise InputError(f"--label: expected one for each of the {len(results)} results, found {len(labels)}.")
    if not (np.isfinite(options.outlier_voxel) and options.outlier_voxel > 0):
        raise InputError(f"--outlier: expected a length above 0 voxel, found {options.outlier_voxel}.")
    scores = []
    for number, path in enumerate(results):
        label = labels[number] if labels else Path(path).stem
        fields = read_result(path, truth, options.reading)
        scores.append(score_fields(truth, fields, options, label=label, source=str(path)))
        if progress is not None:
            progress((number + 1) / len(results))
    if len(scores) > 1 and options.volumes is not None:
        raise InputError("--volumes: expected with one result, found several. Score each one with its own volumes.")
    return scores


def score_fields(
    truth: Truth, fields: Sequence[MeasuredField], options: ScoreOptions, *, label: str, source: str
) -> Score:
    """Score the vectors of one result; see `score_results`. `source` names it in messages."""
    numbers = chosen_numbers(truth, options.pairs)
    by_number = {one.number: one for one in fields if one.number in numbers}
    if not by_number:
        raise InputError(f"{source}: expected vectors of the {truth.noun}s that are scored, found none.")
    pairs = [pair_errors(by_number[one], truth) if one in by_number else missing_pair(one) for one in numbers]
    sample = Sample(pairs, truth, options.outlier_voxel)
    if not sample.scored.any():
        raise InputError(
            f"{source}: expected vectors in the measurable region, found none of {_found(pairs)}. Are x, y and z "
            "in the data set's axes and in the unit that is stated?"
        )
    first = next(iter(by_number.values()))
    found = metrics.block_bootstrap(sample.statistics, sample.block, resamples=options.resamples)
    found["completeness"] = _mean_of([one.completeness for one in pairs])
    found["divergence"] = _mean_of([divergence(one, truth) for one in pairs if one.scored.any()])
    found |= {key: _exact(value) for key, value in {**in_time(pairs), **_costs(fields)}.items()}
    if first.is_particles:
        found |= _particle_figures(truth, by_number, numbers)
    if options.volumes is not None:
        found |= {key: _mean_of(values) for key, values in score_volumes(options.volumes, truth).items()}
    return Score(
        label=label,
        kind="particles" if first.is_particles else "vectors",
        figures=found,
        instants=tuple(_of_pair(one, truth, options.outlier_voxel) for one in pairs),
        curve=sample.curve(),
        sample=sample,
        window_mm=first.window_mm,
        notes=_notes(pairs, first, truth),
    )


def _costs(fields: Sequence[MeasuredField]) -> dict[str, float]:
    """Return the median time of a pair and the largest memory; NaN where no file states them."""
    seconds = [one.seconds for one in fields if one.seconds is not None]
    memory = [one.memory_mib for one in fields if one.memory_mib is not None]
    return {"seconds": float(np.median(seconds)) if seconds else np.nan, "memory": max(memory, default=np.nan)}


def chosen_numbers(truth: Truth, pairs: tuple[int, int | None] | None) -> tuple[int, ...]:
    """Return the numbers of the pairs or instants that are scored; raise InputError if there are none."""
    first, last = pair_range(pairs)
    chosen = tuple(one for one in truth.numbers if one >= first and (last is None or one < last))
    if not chosen:
        raise InputError(
            f"--pairs: expected {truth.noun}s of the data set, {truth.numbers[0]} to {truth.numbers[-1]}, found none "
            "of them."
        )
    return chosen


def report(truth: Truth, scores: Sequence[Score]) -> dict[str, Any]:
    """Return scores as values of JSON, with the data set and the region that they belong to."""
    scene = truth.scene
    return {
        "case": scene.name,
        "benchmark": truth.about.get("benchmark"),
        "truth_sha256": truth.about.get("truth_sha256"),
        "source": SOURCE,
        "voxel_mm": truth.voxel_mm,
        "dt_s": scene.dt_s,
        "peak_voxel": truth.peak_mm / truth.voxel_mm,
        "reference_window_mm": truth.reference_window_mm,
        "results": [plain(one.to_dict()) for one in scores],
    }


def _found(pairs: Sequence[PairErrors]) -> str:
    vectors = sum(len(one.kept) for one in pairs)
    return f"{vectors} in the volume and {sum(one.outside for one in pairs)} outside"


def _of_pair(pair: PairErrors, truth: Truth, outlier_voxel: float) -> dict[str, float]:
    values = Sample([pair], truth, outlier_voxel).statistics(np.ones(len(pair.kept)))
    values["completeness"] = pair.completeness
    return {"number": pair.number} | {key: values[key] for key in PER_PAIR}


def _exact(value: float) -> Estimate:
    unknown = float("nan")
    return Estimate(value=float(value), standard_error=unknown, low=unknown, high=unknown)


def _mean_of(values: Sequence[float]) -> Estimate:
    """Return the mean over pairs, with the standard error by their scatter."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if len(known) < 2:
        return _exact(float(known[0]) if len(known) else float("nan"))
    mean, spread = float(known.mean()), float(known.std(ddof=1) / np.sqrt(len(known)))
    return Estimate(value=mean, standard_error=spread, low=mean - NORMAL_95 * spread, high=mean + NORMAL_95 * spread)


def _particle_figures(truth: Truth, fields: Mapping[int, MeasuredField], numbers: Sequence[int]) -> dict[str, Estimate]:
    """Match found particles with true ones, one to one. Found and false are counted of those in the volume."""
    rows: dict[str, list[float]] = {}
    for number in numbers:
        true, found = truth.particles(number), np.empty((0, 3))
        moved = found
        if number in fields:
            kept = fields[number].kept
            found, moved = fields[number].positions_mm[kept], fields[number].displacement_mm[kept]
        pairs = metrics.match_particles(found, true.positions_mm, figures.MATCH_VOXEL * truth.voxel_mm)
        inside = truth.inside(true.positions_mm)
        row = {"found": float(inside[pairs[:, 1]].sum() / max(inside.sum(), 1))}
        within = truth.inside(found)
        if within.any():
            row["false"] = 1 - float(within[pairs[:, 0]].sum() / within.sum())
        if len(pairs):
            away = (found[pairs[:, 0]] - true.positions_mm[pairs[:, 1]]) / truth.voxel_mm
            off = (moved[pairs[:, 0]] - true.displacement_mm[pairs[:, 1]]) / truth.voxel_mm
            row |= {f"position_{axis}": float(np.sqrt((away[:, k] ** 2).mean())) for k, axis in enumerate("xyz")}
            row["matched_error"] = float(np.linalg.norm(off, axis=1).mean())
        for key, value in row.items():
            rows.setdefault(key, []).append(value)
    return {key: _mean_of(values) for key, values in rows.items()}


def _notes(pairs: Sequence[PairErrors], first: MeasuredField, truth: Truth) -> tuple[str, ...]:
    notes = list(first.notes)
    if first.is_particles:
        notes.append("scattered vectors: taken as particles, the truth is that of the flow at their positions")
    elif first.window_mm is None:
        notes.append("no window is stated: the truth is taken at the points. State it by --window-mm")
    else:
        x, y, z = first.window_mm
        notes.append(f"the truth is averaged over windows of {x:g} x {y:g} x {z:g} mm")
    if any(one.source == PARTICLES for one in pairs):
        notes.append("the file of the flow is not at hand: the truth is the mean of the true particles in each window")
    missing = [one.number for one in pairs if not len(one.kept)]
    if missing:
        notes.append(f"{len(missing)} of {len(pairs)} {truth.noun}s have no vectors and count as not measured")
    outside = sum(one.outside for one in pairs)
    if outside:
        notes.append(f"{outside} vectors beyond the volume or in walls are not scored")
    return tuple(notes)
