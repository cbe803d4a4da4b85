"""Small charts as SVG, drawn as the panels of the report are: lines and steps over one axis, in colours of the page."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lfpiv.report import svg


def chart(lines: Mapping[str, tuple[np.ndarray, np.ndarray]], x_title: str, y_title: str) -> str:
    """Return lines by name, each of x and y, as SVG. Gaps are NaN."""
    panel, axes = svg.new_panel(2.2)
    for (name, (x, y)), colour in zip(lines.items(), svg.SERIES, strict=False):
        axes.plot(x, y, color=colour, linewidth=1.2, label=name)
    svg.style(axes, xlabel=x_title, ylabel=y_title, legend=len(lines) > 1)
    svg.spread_ticks(axes)
    return svg.to_svg(panel, f"{y_title} over {x_title}")


def histogram(values: np.ndarray, bins: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the steps of a histogram: x and y."""
    count, edges = np.histogram(values[np.isfinite(values)], bins)
    return np.repeat(edges, 2)[1:-1], np.repeat(count, 2)
