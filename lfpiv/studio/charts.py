"""Small charts as SVG: lines and steps over one axis, in the colours of the page."""

from __future__ import annotations

import html
from collections.abc import Mapping

import numpy as np

from lfpiv.quantities import significant

WIDTH, HEIGHT = 300, 170
LEFT, RIGHT, TOP, BOTTOM = 46, 8, 20, 34
COLOURS = ("#2f81d7", "#d9822b", "#2a9d5c", "#a259c9", "#c0392b")


def chart(lines: Mapping[str, tuple[np.ndarray, np.ndarray]], x_title: str, y_title: str) -> str:
    """Return lines by name, each of x and y, as SVG. Gaps are NaN."""
    known = {name: (np.asarray(x, float), np.asarray(y, float)) for name, (x, y) in lines.items() if len(x)}
    every = [np.concatenate([pair[axis] for pair in known.values()]) if known else np.zeros(1) for axis in (0, 1)]
    ends = [_ends(values) for values in every]

    def at(value: float, axis: int) -> float:
        share = (value - ends[axis][0]) / (ends[axis][1] - ends[axis][0])
        return LEFT + share * (WIDTH - LEFT - RIGHT) if axis == 0 else HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" class="lf-chart" role="img" aria-label="{html.escape(y_title)}">']
    for axis in (0, 1):
        for value in np.linspace(*ends[axis], 4):
            place, text = at(value, axis), html.escape(significant(float(value)))
            if axis == 0:
                parts.append(f'<text x="{place:.1f}" y="{HEIGHT - BOTTOM + 13}" text-anchor="middle">{text}</text>')
            else:
                parts.append(
                    f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{place:.1f}" y2="{place:.1f}"/>'
                    f'<text x="{LEFT - 4}" y="{place + 3:.1f}" text-anchor="end">{text}</text>'
                )
    for number, (name, (x, y)) in enumerate(known.items()):
        colour = COLOURS[number % len(COLOURS)]
        good = np.isfinite(x) & np.isfinite(y)
        for part in np.split(np.arange(len(x)), np.flatnonzero(~good)):
            places = " ".join(f"{at(x[i], 0):.1f},{at(y[i], 1):.1f}" for i in part if good[i])
            parts.append(f'<polyline points="{places}" stroke="{colour}"/>' if places else "")
        if len(known) > 1:
            parts.append(f'<text x="{LEFT + 4 + 62 * number}" y="10" style="fill:{colour}">{html.escape(name)}</text>')
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 6}" text-anchor="middle">{html.escape(x_title)}</text>')
    anchor = "" if len(known) > 1 else f'<text x="2" y="11">{html.escape(y_title)}</text>'
    return "".join(parts) + anchor + "</svg>"


def histogram(values: np.ndarray, bins: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the steps of a histogram: x and y."""
    values = values[np.isfinite(values)]
    if not values.size:
        return np.zeros(0), np.zeros(0)
    count, edges = np.histogram(values, bins)
    return np.repeat(edges, 2)[1:-1], np.repeat(count, 2)


def _ends(values: np.ndarray) -> tuple[float, float]:
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)
