"""Plots of methods side by side, drawn from stored figures in the colours of the page, light or dark.

`panels` needs no Sphinx; `setup` registers the directive ``{side-by-side}``. `perf/accuracy/method_comparison.py` writes
the figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lfpiv.report import svg

FIGURES = Path(__file__).resolve().parents[1] / "figures" / "method_comparison.json"
STYLES = {
    ("ours", 2): ("this software", svg.SERIES[0], "-"),
    ("today", 2): ("40 iterations (b2f8238)", svg.SERIES[2], "-"),
    ("paper", 2): ("10 plain iterations", svg.SERIES[1], "-"),
    ("printed", 2): ("the same, Eq. 5 as printed", svg.SERIES[1], ":"),
    ("mlos", 2): ("first guess (MLOS)", svg.SERIES[4], "-"),
    ("refocused", 2): ("refocused stacks", svg.SERIES[3], "-"),
    ("ours", 1): ("this software, one camera", svg.SERIES[0], "--"),
    ("refocused", 1): ("refocused, one camera", svg.SERIES[3], "--"),
    ("truth", 2): ("true particles", svg.INK, ":"),
}
"""Name, colour and line of each method and number of cameras, in the order of the legend."""
LARGEST_ERROR = 2.2
"""Upper end of the axis of errors [voxel]."""


def panels(stored: Mapping[str, Any]) -> str:
    """Return the plots as HTML: error and Q against seeding, a legend, and time."""
    drawn = [
        _against_seeding(stored["seeding"], "error", "mean error [voxel]"),
        _against_seeding(stored["seeding"], "q", "Q"),
        _legend(),
        _time(stored["time"]),
    ]
    return f'<div class="side-by-side">{"".join(drawn)}</div>'


def _against_seeding(rows: Sequence[Mapping[str, Any]], key: str, label: str) -> str:
    figure, (axes,) = svg.new_panel(2.9)
    seedings = sorted({row["ppm"] for row in rows})
    for (way, cameras), (_, colour, line) in STYLES.items():
        known = [row for row in rows if row["way"] == way and row["cameras"] == cameras]
        known = [row for row in known if row["figures"][key][0] is not None]
        if key == "q" and way == "truth":
            continue
        value, error = ([row["figures"][key][part] or 0.0 for row in known] for part in (0, 1))
        width = 2.0 if way == "ours" else 1.3
        axes.errorbar(
            [row["ppm"] for row in known], value, error, color=colour, ls=line, lw=width, marker="o", ms=3, elinewidth=1
        )
    svg.style(axes, title=f"{label} against seeding", xlabel="particles per microlens", ylabel=label)
    axes.set_xscale("log")
    axes.set_xticks(seedings, [f"{ppm:g}" for ppm in seedings])
    axes.set_xticks([], minor=True)
    axes.set_ylim(0, 1 if key == "q" else LARGEST_ERROR)
    return svg.to_svg(figure, f"{label} of each method against particles per microlens; the table has the numbers")


def _legend() -> str:
    figure, (axes,) = svg.new_panel(2.6)
    for name, colour, line in STYLES.values():
        axes.plot(
            [], [], color=colour, ls=line, lw=2.0 if name.startswith("this") else 1.3, marker="o", ms=3, label=name
        )
    axes.axis("off")
    axes.legend(loc="center", fontsize=svg.TEXT_POINT, labelcolor=svg.INK, frameon=False, handlelength=2.6)
    return svg.to_svg(figure, "Legend")


def _time(rows: Sequence[Mapping[str, Any]]) -> str:
    figure, (axes,) = svg.new_panel(2.6)
    names = [way for way, cameras in STYLES if cameras == 2 and way in {row["way"] for row in rows}]
    passes = {row["way"]: row["passes"] for row in rows}
    place = range(len(names))
    error = [passes[way][1] or 0.0 for way in names]
    values = [passes[way][0] for way in names]
    axes.barh(place, values, xerr=error, height=0.6, color=[STYLES[way, 2][1] for way in names], ecolor=svg.INK)
    for at, value in zip(place, values, strict=True):
        axes.annotate(
            f"{value:.1f}", (value, at), (4, 0), textcoords="offset points", va="center", color=svg.INK,
            fontsize=svg.SMALL_POINT,
        )  # fmt: skip
    svg.style(axes, title="time of a frame", xlabel="times a pass over all rays")
    axes.set_yticks(place, [STYLES[way, 2][0] for way in names])
    axes.invert_yaxis()
    axes.margins(x=0.15)
    return svg.to_svg(figure, "Time of a frame by each method in passes over all rays; the table has the numbers")


def setup(app):
    """Register the directive."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class SideBySide(SphinxDirective):
        """The plots."""

        def run(self):
            self.env.note_dependency(str(FIGURES))
            return [nodes.raw("", panels(json.loads(FIGURES.read_text("utf-8"))), format="html")]

    app.add_directive("side-by-side", SideBySide)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
