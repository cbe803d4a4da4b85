"""Plots of what particle tracking finds against seeding: the figures of `perf/accuracy/particle_tracking.py`.

`panels` needs no Sphinx; `setup` registers the directive ``{tracking-limits}``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lfpiv.report import svg

FIGURES = Path(__file__).resolve().parents[1] / "figures" / "particle_tracking.json"
NAMES = {1: "one camera", 2: "two cameras", 3: "three cameras"}
LINES, MARKERS = {"clean": "-", "real": "--"}, {"clean": "o", "real": "x"}
SHOWN = (
    ("found", "found, share of the true ones", False),
    ("false", "false, share of the found ones", False),
    ("position", "error of the position [voxel]", True),
    ("moved_z", "error of the depth displacement [voxel]", True),
)
"""Figures, their labels, and whether their axis is logarithmic."""


def panels(stored: Mapping[str, Any]) -> str:
    """Return the plots as HTML, means over the seeds."""
    drawn = [_panel(stored["rows"], *one) for one in SHOWN]
    return f'<div class="side-by-side">{"".join(drawn)}</div>'


def _panel(rows: Sequence[Mapping[str, Any]], key: str, label: str, logarithmic: bool) -> str:
    figure, axes = svg.new_panel(2.9)
    for number, (cameras, name) in enumerate(NAMES.items()):
        for condition, line in LINES.items():
            values = _means(rows, key, cameras, condition)
            if not values:
                continue
            text = name if condition == "clean" else None
            axes.plot(
                *zip(*values, strict=True),
                color=svg.SERIES[number],
                ls=line,
                marker=MARKERS[condition],
                ms=4,
                label=text,
            )
    seedings = sorted({row["ppm"] for row in rows})
    svg.style(axes, title=label, xlabel="particles per microlens", ylabel="", legend=key == "found")
    axes.set_xscale("log")
    axes.set_xticks(seedings, [f"{ppm:g}" for ppm in seedings])
    axes.set_xticks([], minor=True)
    if logarithmic:
        axes.set_yscale("log")
        axes.set_yticks([], minor=True)
        axes.set_yticks((0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0), ("0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1"))
    else:
        axes.set_ylim(0, 1)
    return svg.to_svg(figure, f"{label} against particles per microlens; the notebook has the numbers")


def _means(rows: Sequence[Mapping[str, Any]], key: str, cameras: int, condition: str) -> list[tuple[float, float]]:
    """Return seedings and means over the seeds."""
    found: dict[float, list[float]] = {}
    for row in rows:
        value = row["figures"][key]
        if row["cameras"] == cameras and row["condition"] == condition and value is not None:
            found.setdefault(row["ppm"], []).append(value)
    return [(ppm, sum(values) / len(values)) for ppm, values in sorted(found.items())]


def setup(app):
    """Register the directive."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class TrackingLimits(SphinxDirective):
        """The plots."""

        def run(self):
            self.env.note_dependency(str(FIGURES))
            return [nodes.raw("", panels(json.loads(FIGURES.read_text("utf-8"))), format="html")]

    app.add_directive("tracking-limits", TrackingLimits)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
