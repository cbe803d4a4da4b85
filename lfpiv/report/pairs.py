"""Write the report's section on all pairs: valid share, uncertainty and mean velocity of each, from the summary."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import SupportsFloat

import numpy as np

from lfpiv.experiment.recording import Recording
from lfpiv.prompt import count
from lfpiv.quantities import Scale, scale_of, significant
from lfpiv.report import markup
from lfpiv.report.fields import evenly
from lfpiv.report.markup import number, percent
from lfpiv.report.summary import Failure, PairFigures
from lfpiv.report.svg import SERIES, new_panel, spread_ticks, style, to_svg

MOST_ROWS = 100
"""Largest number of rows of the table and of points of a line. More pairs are merged into groups of neighbours."""
WORST = 20
"""Number of pairs with the lowest valid share in the table of the worst pairs."""


@dataclass(frozen=True, kw_only=True)
class Groups:
    """Figures of groups of neighbouring pairs, in arrays with one value per group."""

    first: np.ndarray
    """Number of the first pair."""
    last: np.ndarray
    """Number of the last pair."""
    pairs: np.ndarray
    """Count of finished pairs."""
    mean: dict[str, np.ndarray]
    """Figure -> mean over the pairs of the group, nan where no pair has it."""
    low: dict[str, np.ndarray]
    """Figure -> lowest value of the group."""
    high: dict[str, np.ndarray]
    """Figure -> highest value of the group."""


KEYS = ("valid", "uncertainty", "peak_ratio", "u", "v", "w", "sd_u", "sd_v", "sd_w")
"""Figures of a pair: valid share, and over its valid vectors the medians of uncertainty [voxel] and peak ratio and the
mean and standard deviation of the velocity [m/s]."""


def group(pairs: Sequence[PairFigures]) -> Groups:
    """Merge pairs, sorted by number, into at most `MOST_ROWS` groups of neighbours."""
    numbers = np.array([pair.number for pair in pairs])
    values = np.array([_values(pair) for pair in pairs], float)
    edges = np.unique(np.linspace(0, len(pairs), min(MOST_ROWS, len(pairs)) + 1).round().astype(int))
    parts = [slice(low, high) for low, high in itertools.pairwise(edges)]
    return Groups(
        first=np.array([numbers[part][0] for part in parts]),
        last=np.array([numbers[part][-1] for part in parts]),
        pairs=np.diff(edges),
        **{
            name: {key: np.array([_known(reduce, values[part, k]) for part in parts]) for k, key in enumerate(KEYS)}
            for name, reduce in (("mean", np.mean), ("low", np.min), ("high", np.max))
        },
    )


def _values(pair: PairFigures) -> list[float | None]:
    """Return the figures of a pair in the order of `KEYS`."""
    spreads = [pair.velocity_m_per_s[name] for name in "uvw"]
    moments = [*(spread.mean for spread in spreads), *(spread.sd for spread in spreads)]
    return [pair.valid_fraction, pair.uncertainty_voxel, pair.peak_ratio, *moments]


def _known(reduce: Callable[[np.ndarray], SupportsFloat], values: np.ndarray) -> float:
    """Reduce the finite values; nan where there are none."""
    values = values[np.isfinite(values)]
    return float(reduce(values)) if values.size else float("nan")


def section(
    pairs: Sequence[PairFigures],
    failures: Sequence[Failure],
    finished: int,
    recording: Recording,
) -> str:
    """Return the section on all pairs, as HTML.

    Parameters
    ----------
    pairs : sequence of PairFigures
        Finished pairs; at least one.
    failures : sequence of Failure
        Pairs without result, marked in the charts.
    finished : int
        Number of all finished pairs, of which `pairs` may be an evenly chosen part.
    recording : Recording
        What was recorded; it names results.
    """
    pairs = sorted(pairs, key=lambda pair: pair.number)
    groups = group(pairs)
    failed = [failure.pair for failure in failures]
    single, noun = bool((groups.pairs == 1).all()), recording.noun
    parts = [
        f'<h2 id="pairs">All {noun}s</h2>',
        markup.paragraph(_overview(pairs, failed, finished, noun)),
    ]
    table, tracked = _table(groups, single, noun), particle_table(pairs, noun)
    if len(pairs) == 1:
        return "\n".join([*parts, table, tracked])
    shown = [_line(groups, ("valid",), "valid vectors [%]", failed, noun, factor=100.0, bottom=0)]
    shown.append(_line(groups, ("uncertainty",), "median uncertainty [voxel]", failed, noun, bottom=0))
    scale = _velocity_scale(groups)
    shown.append(_line(groups, ("u", "v", "w"), f"mean velocity [{scale.unit}]", failed, noun, factor=scale.factor))
    caption = f"Each {noun}'s figures over its valid vectors."
    if not single:
        caption = (
            f"Each {noun}'s figures over its valid vectors; {groups.pairs.max()} neighbouring {noun}s are merged: "
            "lines are their mean, bands reach from the lowest to the highest."
        )
    if failed:
        caption += f" Marks on the lower edge: failed {noun}s."
    parts.append(markup.figure(shown, caption, table + (_worst(pairs, noun) if not single else "")))
    return "\n".join([*parts, tracked])


def _overview(pairs: Sequence[PairFigures], failed: Sequence[int], finished: int, noun: str) -> str:
    """Count the pairs and state their mean and lowest valid share."""
    shares = np.array([pair.valid_fraction for pair in pairs])
    text = f"{count(finished, noun)} finished"
    text += f", of which {len(pairs):,}, evenly chosen, are shown here" if len(pairs) < finished else ""
    text += f", {count(len(failed), noun)} failed" if failed else ""
    if len(pairs) == 1:
        return f"{text}: statistics over {noun}s need two or more."
    worst = int(shares.argmin())
    return (
        f"{text}. Valid vectors: {percent(float(shares.mean()), 1)} in the mean over {noun}s, "
        f"{percent(float(shares.min()), 1)} in the worst, {noun} {pairs[worst].number}."
    )


def _line(
    groups: Groups,
    keys: Sequence[str],
    label: str,
    failed: Sequence[int],
    noun: str,
    *,
    factor: float = 1.0,
    bottom: float | None = None,
) -> str:
    """Plot figures over the pairs, as mean and range of each group; mark the failed pairs on the lower edge."""
    figure, axes = new_panel()
    middle = (groups.first + groups.last) / 2
    few = len(middle) <= 30
    for k, key in enumerate(keys):
        if not (groups.pairs == 1).all():
            low, high = factor * groups.low[key], factor * groups.high[key]
            axes.fill_between(middle, low, high, color=SERIES[k], alpha=0.25, linewidth=0)
        name = key if len(keys) > 1 else None
        axes.plot(middle, factor * groups.mean[key], "o-" if few else "-", color=SERIES[k], lw=1.3, ms=3, label=name)
    if bottom is not None:
        axes.set_ylim(bottom, 1.05 * axes.get_ylim()[1] if keys != ("valid",) else 102)
    if failed:
        from_below = axes.get_xaxis_transform()
        marked = evenly(failed, MOST_ROWS)
        axes.plot(marked, [0.02] * len(marked), "x", color=SERIES[1], ms=6, transform=from_below)
    style(axes, title=label, xlabel=noun, legend=len(keys) > 1)
    spread_ticks(axes)
    axes.xaxis.get_major_locator().set_params(integer=True)
    means = ", ".join(f"{key} {np.nanmean(factor * groups.mean[key]):.4g}" for key in keys if not _empty(groups, key))
    return to_svg(figure, f"{label} over the {noun}s; mean: {means or 'none known'}.")


def _empty(groups: Groups, key: str) -> bool:
    return bool(np.isnan(groups.mean[key]).all())


def _table(groups: Groups, single: bool, noun: str) -> str:
    scale = _velocity_scale(groups)
    titles = [noun, "valid", *(f"{name} [{scale.unit}]" for name in "uvw"), "uncertainty [voxel]", "peak ratio"]
    rows = []
    for k in range(len(groups.pairs)):
        first, last = groups.first[k], groups.last[k]
        name = f"{first}" if groups.pairs[k] == 1 else f"{first} to {last} ({groups.pairs[k]})"
        valid = percent(groups.mean["valid"][k], 1)
        if not single:
            valid += f" (lowest {percent(groups.low['valid'][k], 1)})"
        spread = [_spread(scale.factor * groups.mean[c][k], scale.factor * groups.mean[f"sd_{c}"][k]) for c in "uvw"]
        ratio = number(groups.mean["peak_ratio"][k], 2)
        rows.append([name, valid, *spread, number(groups.mean["uncertainty"][k], 3), ratio])
    caption = "Mean ± standard deviation over the valid vectors, medians of uncertainty and peak ratio"
    return markup.table(titles, rows, caption=caption) + markup.paragraph(f"{caption}.", "quiet")


def particle_table(pairs: Sequence[PairFigures], noun: str) -> str:
    """Tabulate the tracked particles, of many pairs those of an even choice; nothing without tracking."""
    tracked = [pair.number for pair in pairs if pair.particles is not None]
    chosen = set(evenly(tracked, WORST))
    rows = [
        [
            str(pair.number),
            " and ".join(f"{count:,}" for count in found.found),
            f"{found.linked:,}",
            f"{found.valid_links:,}",
            number(float(np.mean(found.per_microlens)), 3),
            number(float(np.mean(found.sigma_voxel)), 2),
        ]
        for pair in pairs
        if pair.number in chosen and (found := pair.particles) is not None
    ]
    if not rows:
        return ""
    titles = [noun, "found", "linked", "valid", "per microlens", "size, σ [voxel]"]
    text = "Particles found in each frame, and those followed from one to the next. The folder particles has them."
    return (
        "<h3>Tracked particles</h3>"
        + markup.paragraph(text)
        + markup.table(titles, rows, caption=f"Tracked particles by {noun}")
    )


def _velocity_scale(groups: Groups) -> Scale:
    """Return the unit in which the velocities of all groups are handy numbers."""
    parts = [np.abs(groups.mean[name]) + groups.mean[f"sd_{name}"] for name in "uvw"]
    return scale_of(_known(np.max, np.concatenate(parts)), "m/s")


def _spread(mean: float, sd: float) -> str:
    """Write a mean and a standard deviation, with as many decimals as show two digits of the latter."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{significant(mean)} ± {significant(sd)}"
    decimals = int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))
    return f"{number(mean, decimals)} ± {number(sd, decimals)}"


def _worst(pairs: Sequence[PairFigures], noun: str) -> str:
    """Tabulate the pairs with the lowest valid share."""
    lowest = sorted(pairs, key=lambda pair: pair.valid_fraction)[:WORST]
    rows = [[str(pair.number), percent(pair.valid_fraction, 1), pair.verdict] for pair in lowest]
    caption = f"The {len(rows)} {noun}s with the lowest valid share"
    return markup.paragraph(f"{caption}:") + markup.table([noun, "valid", "verdict"], rows, caption=caption, words=True)
