"""The report's section on all pairs: valid share, uncertainty and mean velocity over them, from the summary alone."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, SupportsFloat

import numpy as np

from lfpiv.report import markup
from lfpiv.report.fields import evenly
from lfpiv.report.markup import number, percent
from lfpiv.report.svg import SERIES, new_panel, spread_ticks, style, to_svg

MOST_ROWS = 100
"""Rows of the table over the pairs and points of its lines: more pairs are put together, neighbours with neighbours."""
WORST = 20
"""Pairs with the lowest valid share that are named."""


@dataclass(frozen=True, kw_only=True)
class Groups:
    """Pairs put together in the order of their numbers; arrays with one value per group."""

    first: np.ndarray
    """Number of the first pair."""
    last: np.ndarray
    """Number of the last pair."""
    pairs: np.ndarray
    """Finished pairs in it."""
    mean: dict[str, np.ndarray]
    """Key -> mean over its pairs, nan where none is known."""
    low: dict[str, np.ndarray]
    """Key -> lowest of its pairs."""
    high: dict[str, np.ndarray]
    """Key -> highest of its pairs."""


KEYS = ("valid", "uncertainty", "peak_ratio", "u", "v", "w", "sd_u", "sd_v", "sd_w")
"""What is known of a pair: valid share, medians of uncertainty [voxel] and peak ratio, mean and standard deviation of
the velocity over its valid vectors [m/s]."""


def group(items: Sequence[Mapping[str, Any]], most: int = MOST_ROWS) -> Groups:
    """Put the pairs of a summary together in at most so many groups of neighbours."""
    numbers = np.array([item["pair"] for item in items])
    values = np.array([_values(item) for item in items], float)
    edges = np.unique(np.linspace(0, len(items), min(most, len(items)) + 1).round().astype(int))
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


def _values(item: Mapping[str, Any]) -> list[float | None]:
    velocity = item["velocity_m_per_s"]
    spread = [velocity[name][kind] for kind in ("mean", "sd") for name in "uvw"]
    return [item["valid_fraction"], item["uncertainty_voxel"], item["peak_ratio"], *spread]


def _known(reduce: Callable[[np.ndarray], SupportsFloat], values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(reduce(values)) if values.size else float("nan")


def section(summary: Mapping[str, Any]) -> str:
    """Write the section on all pairs."""
    items = sorted(summary["pairs"], key=lambda item: item["pair"])
    groups = group(items)
    failed = [int(entry["pair"]) for entry in summary.get("failed", ())]
    single = bool((groups.pairs == 1).all())
    parts = ['<h2 id="pairs">All pairs</h2>', markup.paragraph(_said(items, failed))]
    table = _table(groups, single)
    if len(items) == 1:
        return "\n".join([*parts, table])
    shown = [_line(groups, ("valid",), "valid vectors [%]", failed, factor=100.0, bottom=0)]
    shown.append(_line(groups, ("uncertainty",), "median uncertainty [voxel]", failed, bottom=0))
    shown.append(_line(groups, ("u", "v", "w"), "mean velocity [m/s]", failed))
    caption = "Each pair's figures over its valid vectors."
    if not single:
        caption = (
            f"Each pair's figures over its valid vectors; {groups.pairs.max()} neighbouring pairs are put together: "
            "lines are their mean, bands reach from the lowest to the highest. summary.json holds every pair."
        )
    if failed:
        caption += " Marks on the lower edge: failed pairs."
    parts.append(markup.figure(shown, caption, table + (_worst(items) if not single else "")))
    return "\n".join(parts)


def _said(items: Sequence[Mapping[str, Any]], failed: Sequence[int]) -> str:
    """Put the pairs' own figures into a sentence or two."""
    shares = np.array([item["valid_fraction"] for item in items])
    text = f"{markup.count(len(items), 'pair')} finished"
    text += f", {markup.count(len(failed), 'pair')} failed" if failed else ""
    if len(items) == 1:
        return f"{text}: statistics over pairs need two or more."
    worst = int(shares.argmin())
    return (
        f"{text}. Valid vectors: {percent(float(shares.mean()), 1)} in the mean over pairs, "
        f"{percent(float(shares.min()), 1)} in the worst, pair {items[worst]['pair']}."
    )


def _line(
    groups: Groups,
    keys: Sequence[str],
    label: str,
    failed: Sequence[int],
    *,
    factor: float = 1.0,
    bottom: float | None = None,
) -> str:
    figure, (axes,) = new_panel()
    middle = (groups.first + groups.last) / 2
    few = len(middle) <= 30
    for k, key in enumerate(keys):
        if not (groups.pairs == 1).all():
            low, high = factor * groups.low[key], factor * groups.high[key]
            axes.fill_between(middle, low, high, color=SERIES[k], alpha=0.25, linewidth=0)
        name = key if len(keys) > 1 else None
        axes.plot(middle, factor * groups.mean[key], "o-" if few else "-", color=SERIES[k], lw=1.3, ms=3, label=name)
    if bottom is not None:
        axes.set_ylim(bottom, 1.05 * axes.get_ylim()[1] if factor == 1 else 102)
    if failed:
        from_below = axes.get_xaxis_transform()
        marked = evenly(failed, MOST_ROWS)
        axes.plot(marked, [0.02] * len(marked), "x", color=SERIES[1], ms=6, transform=from_below)
    style(axes, title=label, xlabel="pair", legend=len(keys) > 1)
    spread_ticks(axes)
    axes.xaxis.get_major_locator().set_params(integer=True)
    means = ", ".join(f"{key} {np.nanmean(factor * groups.mean[key]):.4g}" for key in keys if not _empty(groups, key))
    return to_svg(figure, f"{label} over the pairs; mean: {means or 'none known'}.")


def _empty(groups: Groups, key: str) -> bool:
    return bool(np.isnan(groups.mean[key]).all())


def _table(groups: Groups, single: bool) -> str:
    titles = ["pair", "valid", "u [m/s]", "v [m/s]", "w [m/s]", "uncertainty [voxel]", "peak ratio"]
    rows = []
    for k in range(len(groups.pairs)):
        first, last = groups.first[k], groups.last[k]
        name = f"{first}" if groups.pairs[k] == 1 else f"{first} to {last} ({groups.pairs[k]})"
        valid = percent(groups.mean["valid"][k], 1)
        if not single:
            valid += f" (lowest {percent(groups.low['valid'][k], 1)})"
        spread = [f"{number(groups.mean[c][k], 4)} ± {number(groups.mean[f'sd_{c}'][k], 4)}" for c in "uvw"]
        ratio = number(groups.mean["peak_ratio"][k], 2)
        rows.append([name, valid, *spread, number(groups.mean["uncertainty"][k], 3), ratio])
    caption = "Mean ± standard deviation over the valid vectors, medians of uncertainty and peak ratio"
    return markup.table(titles, rows, caption=caption) + markup.paragraph(f"{caption}.", "quiet")


def _worst(items: Sequence[Mapping[str, Any]]) -> str:
    lowest = sorted(items, key=lambda item: item["valid_fraction"])[:WORST]
    rows = [[str(item["pair"]), percent(item["valid_fraction"], 1), str(item["verdict"])] for item in lowest]
    caption = f"The {len(rows)} pairs with the lowest valid share"
    return markup.paragraph(f"{caption}:") + markup.table(
        ["pair", "valid", "verdict"], rows, caption=caption, words=True
    )
