"""Judge the main figures of a run: good, to be looked at, or bad, each with its limits."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.checks import COMPLETE, SIGMA_NOR_PITCH
from lfpiv.experiment.experiment import Experiment
from lfpiv.quantities import quantity, significant
from lfpiv.report import markup
from lfpiv.report.markup import number, percent
from lfpiv.report.summary import Summary
from lfpiv.results.limits import CLEAR_RESIDUAL, LARGE_RESIDUAL
from lfpiv.velocity.cross_correlation import GOOD_SHARE, POOR_SHARE

UNCERTAINTY_VOXEL = (0.2, 0.5)
"""Median uncertainty of a displacement up to which it is good, and above which it is bad [voxel]."""
MAPPING_BAD = 3.0
"""Multiple of the usual error of the mapping above which it is bad."""
FEWEST_DOTS = 0.5
"""Share of the board's dots below which the calibration is bad."""


EXPLAINED = (
    "Look: the figure lies between good and bad, and vectors can be used; the part of this page on it says more. "
    "Bad: find the cause before you use the vectors."
)
"""What the verdicts mean, below tiles that are not all good."""


class Level(enum.Enum):
    """Verdict on a figure; the value is its CSS class."""

    GOOD = "good"
    LOOK = "look"
    BAD = "bad"

    @property
    def mark(self) -> str:
        """Return the symbol that stands beside the word, so that colour is not all there is."""
        return {Level.GOOD: "✓", Level.LOOK: "!", Level.BAD: "✕"}[self]


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A main figure of the run with its verdict."""

    value: str
    label: str
    level: Level
    limits: str
    """Where good ends and bad begins."""


def tiles(experiment: Experiment, summary: Summary) -> list[Tile]:
    """Return the main figures of a run, those of the results first."""
    return list(_tiles(experiment, summary))


def _tiles(experiment: Experiment, summary: Summary) -> Iterator[Tile]:
    yield _pairs(summary, experiment.noun)
    if summary.pairs_finished:
        yield _below_is_bad(
            summary.valid_fraction,
            "valid vectors",
            good=GOOD_SHARE,
            bad=POOR_SHARE,
            written=lambda share: f"{significant(100 * share)} %",
        )
        yield from _uncertainty(summary, experiment.grid.voxel_mm / 1000 / experiment.dt_s)
        yield from _residual(summary)
    cameras = summary.calibration.values()
    sigma = [camera.sigma_nor_test for camera in cameras if camera.sigma_nor_test is not None]
    if sigma:
        usual = SIGMA_NOR_PITCH.get(
            str(summary.settings.get("network", {}).get("estimator")), max(SIGMA_NOR_PITCH.values())
        )
        yield _above_is_bad(
            max(sigma),
            "error of the mapping, worst camera",
            good=usual,
            bad=MAPPING_BAD * usual,
            written=lambda error: f"{significant(error, 2)} pitch",
        )
    found, expected = sum(c.dots_found or 0 for c in cameras), sum(c.dots_expected or 0 for c in cameras)
    if expected:
        tile = _below_is_bad(
            found / expected,
            "board dots measured",
            good=COMPLETE,
            bad=FEWEST_DOTS,
            written=lambda share: percent(share),
        )
        yield Tile(value=f"{found:,} / {expected:,}", label=tile.label, level=tile.level, limits=tile.limits)


def _pairs(summary: Summary, noun: str) -> Tile:
    """Judge how many pairs are finished of those that were tried."""
    finished, failed = summary.pairs_finished, summary.pairs_failed
    level = Level.GOOD if not failed else Level.LOOK if failed < finished else Level.BAD
    done = f"{finished:,}" if not failed else f"{finished:,} of {finished + failed:,}"
    return Tile(
        value=done,
        label=f"{noun}{'' if finished + failed == 1 else 's'} finished",
        level=level if finished or failed else Level.LOOK,
        limits="good: none failed; bad: half or more failed",
    )


def _uncertainty(summary: Summary, voxel_m_per_s: float) -> Iterator[Tile]:
    """Judge the median uncertainty of a displacement, in voxels and as a velocity."""
    known = [pair.uncertainty_voxel for pair in summary.pairs if pair.uncertainty_voxel is not None]
    if not known:
        return
    value, (good, bad) = float(np.mean(known)), UNCERTAINTY_VOXEL
    yield _above_is_bad(
        value,
        f"median uncertainty: {quantity(value * voxel_m_per_s, 'm/s', 2)}",
        good=good,
        bad=bad,
        written=lambda size: f"{number(size, 2)} voxel",
    )


def _residual(summary: Summary) -> Iterator[Tile]:
    """Judge the share of the images that the volumes do not explain, of the worst volume."""
    ends = [history[-1] for pair in summary.pairs for history in pair.residual.values() if history]
    if ends:
        yield _above_is_bad(
            max(ends),
            "of the images unexplained, worst volume",
            good=CLEAR_RESIDUAL,
            bad=LARGE_RESIDUAL,
            written=lambda share: percent(share),
        )


def _below_is_bad(value: float | None, label: str, *, good: float, bad: float, written: Callable[[float], str]) -> Tile:
    """Judge a figure that should be large."""
    limits = f"good: {written(good)} or more; bad: below {written(bad)}"
    if value is None or not np.isfinite(value):
        return Tile(value=markup.NONE, label=label, level=Level.BAD, limits=limits)
    level = Level.GOOD if value >= good else Level.LOOK if value >= bad else Level.BAD
    return Tile(value=written(value), label=label, level=level, limits=limits)


def _above_is_bad(value: float, label: str, *, good: float, bad: float, written: Callable[[float], str]) -> Tile:
    """Judge a figure that should be small."""
    level = Level.GOOD if value <= good else Level.LOOK if value <= bad else Level.BAD
    limits = f"good: up to {written(good)}; bad: above {written(bad)}"
    return Tile(value=written(value), label=label, level=level, limits=limits)


def cards(found: list[Tile]) -> str:
    """Return the tiles as HTML."""
    boxes = "".join(
        f'<div class="{tile.level.value}"><dt>{markup.escape(tile.label)}</dt><dd>{markup.escape(tile.value)}</dd>'
        f'<dd class="verdict"><span aria-hidden="true">{tile.level.mark}</span> {tile.level.value}</dd>'
        f'<dd class="limits">{markup.escape(tile.limits)}</dd></div>'
        for tile in found
    )
    if all(tile.level is Level.GOOD for tile in found):
        return f'<dl class="cards">{boxes}</dl>'
    return f'<dl class="cards">{boxes}</dl>' + markup.paragraph(EXPLAINED, "quiet")
