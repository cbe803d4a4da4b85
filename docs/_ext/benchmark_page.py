"""Tables and plots of the page on the benchmark: cases, figures of merit, and stored rows of methods.

The functions need no Sphinx; `setup` registers ``{benchmark-cases}``, ``{benchmark-figures}``, ``{benchmark-sources}``,
``{benchmark-rows}`` and ``{benchmark-plot}``. `perf/accuracy/benchmark_table.py` writes the rows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from panels import add_directive
from tables import markdown_table

from lfpiv.benchmark import figures
from lfpiv.benchmark.listing import rows as case_rows
from lfpiv.report import svg

FIGURES = Path(__file__).resolve().parents[1] / "figures" / "benchmark.json"
STYLES = {
    "lfpiv": ("this software", svg.SERIES[0], "-"),
    "paper": ("10 plain iterations", svg.SERIES[1], "-"),
    "mlos": ("first guess (MLOS)", svg.SERIES[4], "-"),
    "refocused": ("refocused stacks", svg.SERIES[3], "-"),
    "openpiv": ("OpenPIV on slices", svg.SERIES[2], "-"),
    "truth": ("true particles", svg.INK, ":"),
}
"""Name, colour and line of each method, in the order of tables."""
SHOWN = (
    ("completeness", "complete [%]", 100.0, 0),
    ("error", "mean error [voxel]", 1.0, 3),
    ("error_at_80", "in 80 %", 1.0, 3),
    ("error_point", "at points", 1.0, 3),
    ("slope", "slopes", 1.0, 2),
    ("outliers", "outliers [%]", 100.0, 1),
    ("within_two", "2 sigma [%]", 100.0, 0),
    ("quality", "Q", 1.0, 3),
    ("ghosts", "ghosts", 1.0, 2),
    ("seconds", "CPU [s]", 1.0, 0),
)
"""Figure, title, factor and decimals of the columns of the table of methods."""

LEAST_TIMED = 2
"""Least number of pairs whose time is shown: the first one compiles kernels."""

Rows = Sequence[Mapping[str, Any]]


def stored_rows() -> list[dict[str, Any]]:
    """Return the rows of methods, in the order of cases and of methods."""
    cases = [row["case"] for row in case_rows()]
    rows: list[dict[str, Any]] = json.loads(FIGURES.read_text("utf-8"))["rows"]
    return sorted(rows, key=lambda row: (cases.index(row["case"]), list(STYLES).index(row["method"])))


def cases_markdown() -> str:
    """Return the table of cases."""
    lines = []
    for row in case_rows():
        count = next(f"{row[name]} {name}" for name in ("pairs", "instants") if name in row).replace(
            "1 pairs", "1 pair"
        )
        voxels = "\u00a0×\u00a0".join(map(str, row["voxels"]))
        seeding = f"{row['per_microlens']:g}"
        lines.append((f"`{row['case']}`", str(row["cameras"]), seeding, row["flow"], count, voxels, row["purpose"]))
    return markdown_table(("case", "cameras", "per microlens", "flow", "images", "voxels", "what it is for"), lines)


def figures_markdown() -> str:
    """Return the table of figures of merit, with numbers of their sources."""
    numbers = {key: number for number, key in enumerate(figures.SOURCES, 1)}
    lines = []
    for figure in figures.all_figures():
        source = f" [{numbers[figure.source]}]" if figure.source else ""
        axes = " x, y, z" if figure.axes else ""
        keys = ", ".join(f"`{key}`" for key in figures.keys_of(figure)[:1]) + (", ..." if figure.axes else "")
        lines.append((figure.title + axes, keys, figure.unit, figure.text + source))
    return markdown_table(("figure", "key", "unit", "definition"), lines)


def sources_markdown() -> str:
    """Return the sources as a list with the numbers of `figures_markdown`."""
    return "\n".join(f"{number}. {text}" for number, text in enumerate(figures.SOURCES.values(), 1))


def rows_markdown(rows: Rows) -> str:
    """Return the table of methods on cases."""
    lines: list[tuple[str, ...]] = []
    for row, before in zip(rows, [None, *rows[:-1]], strict=True):
        cells = [_cell(row["figures"], key, factor, digits) for key, _, factor, digits in SHOWN]
        if row["pairs"] < LEAST_TIMED:
            cells[-1] = "–"
        new = before is None or before["case"] != row["case"]
        case = f"`{row['case']}`, {row['pairs']} pairs".replace(" 1 pairs", " 1 pair") if new else ""
        lines.append((case, STYLES[row["method"]][0], *cells))
    return markdown_table(("case", "method", *(title for _, title, _, _ in SHOWN)), lines)


def _cell(stored: Mapping[str, Any], key: str, factor: float, digits: int) -> str:
    """Return a figure, and its standard error where it is that of errors."""
    if key == "slope":
        return " ".join(_cell(stored, f"slope_{axis}", factor, digits) or "–" for axis in "xyz")
    found = stored.get(key)
    if found is None or found["value"] is None:
        return "–"
    text = f"{factor * found['value']:.{digits}f}"
    if key == "error" and found["standard_error"] is not None:
        text += f"\u00a0±\u00a0{factor * found['standard_error']:.{digits}f}"
    return text


def panels(rows: Rows) -> str:
    """Return a legend, and a plot of each case: the error that is not exceeded in a part of the measurable region."""
    cases = list(dict.fromkeys(row["case"] for row in rows))
    return _legend() + "".join(_panel(case, [row for row in rows if row["case"] == case]) for case in cases)


def _legend() -> str:
    figure, axes = svg.new_panel(2.8)
    for label, colour, line in STYLES.values():
        axes.plot([], [], color=colour, ls=line, lw=1.6, label=label)
    axes.axis("off")
    axes.legend(loc="center", fontsize=svg.TEXT_POINT, labelcolor=svg.INK, frameon=False, handlelength=2.6)
    return svg.to_svg(figure, "Legend")


def _panel(case: str, rows: Rows) -> str:
    figure, axes = svg.new_panel(2.8)
    for row in rows:
        _, colour, line = STYLES[row["method"]]
        part = [100 * value for value in row["curve"]["part"]]
        error = [float("nan") if value is None else value for value in row["curve"]["error"]]
        axes.plot(part, error, color=colour, ls=line, lw=1.6)
    axes.set_yscale("log")
    axes.set_ylim(0.01, 10)
    axes.set_yticks((0.01, 0.1, 1.0, 10.0), ("0.01", "0.1", "1", "10"))
    axes.tick_params(which="minor", colors=svg.INK)
    axes.set_xlim(0, 100)
    svg.style(axes, title=case, xlabel="part of the region [%]", ylabel="error [voxel]")
    return svg.to_svg(figure, f"Error not exceeded in a part of the measurable region, case {case}, by each method")


def setup(app):
    """Register the directives."""
    from sphinx.util.docutils import SphinxDirective

    texts = {
        "cases": cases_markdown,
        "figures": figures_markdown,
        "sources": sources_markdown,
        "rows": lambda: rows_markdown(stored_rows()),
    }

    def table(text: Any) -> type[SphinxDirective]:
        class Table(SphinxDirective):
            """Table in Markdown."""

            def run(self):
                self.env.note_dependency(str(FIGURES))
                return self.parse_text_to_nodes(text())

        return Table

    for name, text in texts.items():
        app.add_directive(f"benchmark-{name}", table(text))
    return add_directive(app, "benchmark-plot", lambda _: panels(stored_rows()), ("curves",), (FIGURES,))
