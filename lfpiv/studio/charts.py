"""What people call the fields of results, and charts of them as SVG, drawn as the panels of the report are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lfpiv.report import svg

LABELS = {
    "speed": ("speed", "m/s"), "u": ("u", "m/s"), "v": ("v", "m/s"), "w": ("w", "m/s"),
    "vorticity_magnitude": ("vorticity", "1/s"), "vorticity_x": ("vorticity x", "1/s"),
    "vorticity_y": ("vorticity y", "1/s"), "vorticity_z": ("vorticity z", "1/s"), "q_criterion": ("Q", "1/s²"),
    "divergence": ("divergence", "1/s"), "pressure": ("pressure", "Pa"), "uncertainty": ("uncertainty", "voxel"),
    "peak_ratio": ("peak ratio", ""), "correlation": ("correlation", ""), "valid": ("valid", ""),
}  # fmt: skip
"""Fields in the order of the lists, what people call them, and their units. Others follow by their names."""


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


def title_of(name: str, unit: str = "") -> str:
    """Return what people call a field, with its unit."""
    text, unit = LABELS.get(name, (name.replace("_", " "), "" if unit == "1" else unit.replace("^2", "²")))
    return f"{text} [{unit}]" if unit else text
