"""Plots and a table of methods side by side, drawn from stored figures in the colours of the page, light or dark.

`panels` and `table` need no Sphinx; `setup` registers the directive ``{side-by-side}``. The figures are those that
`perf/accuracy/method_comparison.py` wrote.
"""

from __future__ import annotations

import html
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
    ("refocused", 1): ("refocused, one camera", svg.SERIES[3], "--"),
    ("truth", 2): ("true particles", svg.INK, ":"),
}
"""Name, colour and line of each method and number of cameras, in the order of the legend."""
TABLE_PPM = 0.5
"""Seeding of the table [particles per microlens]."""
ERROR_TICKS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Marks of the logarithmic axis of errors [voxel]."""


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
    figure, axes = svg.new_panel(2.9)
    seedings = sorted({row["ppm"] for row in rows})
    for (way, cameras), (_, colour, line) in STYLES.items():
        known = [row for row in rows if row["way"] == way and row["cameras"] == cameras]
        known = [row for row in known if row["figures"][key][0] is not None]
        if key == "q" and way == "truth":
            continue
        value, error = ([row["figures"][key][part] or 0.0 for row in known] for part in (0, 1))
        width = 2.0 if way == "ours" else 1.3
        axes.errorbar(
            [row["ppm"] for row in known],
            value,
            error,
            color=colour,
            ls=line,
            lw=width,
            marker="o",
            ms=3,
            elinewidth=1,
            zorder=3 if way == "ours" else 2,
        )
    svg.style(axes, title=f"{label} against seeding", xlabel="particles per microlens", ylabel=label)
    axes.set_xscale("log")
    axes.set_xticks(seedings, [f"{ppm:g}" for ppm in seedings])
    axes.set_xticks([], minor=True)
    if key == "q":
        axes.set_ylim(0, 1)
    else:
        axes.set_yscale("log")
        axes.set_yticks(ERROR_TICKS, [f"{tick:g}" for tick in ERROR_TICKS])
        axes.set_yticks([], minor=True)
    return svg.to_svg(figure, f"{label} of each method against particles per microlens; the table below has numbers")


def _legend() -> str:
    figure, axes = svg.new_panel(2.3)
    for name, colour, line in STYLES.values():
        axes.plot(
            [], [], color=colour, ls=line, lw=2.0 if name.startswith("this") else 1.3, marker="o", ms=3, label=name
        )
    axes.axis("off")
    axes.legend(loc="center", fontsize=svg.TEXT_POINT, labelcolor=svg.INK, frameon=False, handlelength=2.6)
    return svg.to_svg(figure, "Legend")


def _time(rows: Sequence[Mapping[str, Any]]) -> str:
    figure, axes = svg.new_panel(2.6)
    names = [way for way, cameras in STYLES if cameras == 2 and way in {row["way"] for row in rows}]
    passes = {row["way"]: row["passes"] for row in rows}
    place = range(len(names))
    error = [passes[way][1] or 0.0 for way in names]
    values = [passes[way][0] for way in names]
    axes.barh(place, values, xerr=error, height=0.6, color=[STYLES[way, 2][1] for way in names], ecolor=svg.INK)
    for at, value, beyond in zip(place, values, error, strict=True):
        spot = {"xytext": (4, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(f"{value:.1f}", (value + beyond, at), color=svg.INK, fontsize=svg.SMALL_POINT, **spot)
    svg.style(axes, title="time of a frame", xlabel="times a pass over all rays")
    axes.set_yticks(place, [STYLES[way, 2][0] for way in names])
    axes.invert_yaxis()
    axes.set_xlim(0, 1.35 * max(values))
    return svg.to_svg(figure, "Time of a frame by each method in passes over all rays; the table has the numbers")


def table(stored: Mapping[str, Any], ppm: float = TABLE_PPM) -> str:
    """Return the figures at one seeding as an HTML table: means, and standard errors after a plus-minus sign."""
    rows = {(row["way"], row["cameras"]): row for row in stored["seeding"] if row["ppm"] == ppm}
    passes = {row["way"]: row["passes"][0] for row in stored["time"]}
    heads = ("method", "error", "more than ours", "slopes x, y, z", "valid", "2 sigma", "Q", "ghosts", "time")
    lines = []
    for key, (name, _, _) in STYLES.items():
        figures = rows[key]["figures"]
        own = key == ("ours", 2)
        slopes = ",\u00a0".join(_number(figures[f"slope_{axis}"][0], 2) for axis in "xyz")
        cells = (
            name,
            _with_error(figures["error"]),
            "" if own else _with_error(rows[key]["beyond_ours"]["error"]),
            slopes,
            _percent(figures["valid"][0]),
            _percent(figures["within"][0]),
            _with_error(figures["q"]),
            _number(figures["ghosts"][0], 2),
            _number(passes.get(key[0]), 1) if key[1] == 2 else "",
        )
        lines.append("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>")
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    return (
        '<div class="table-wrapper"><table class="docutils"><thead><tr>'
        f"{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f}\u00a0%"


def _with_error(value: Sequence[float | None]) -> str:
    mean, error = value
    return _number(mean, 3) + ("" if error is None or mean is None else f"\u00a0±\u00a0{error:.3f}")


def setup(app):
    """Register the directive."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class SideBySide(SphinxDirective):
        """The plots."""

        def run(self):
            self.env.note_dependency(str(FIGURES))
            stored = json.loads(FIGURES.read_text("utf-8"))
            return [nodes.raw("", panels(stored) + table(stored), format="html")]

    app.add_directive("side-by-side", SideBySide)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
