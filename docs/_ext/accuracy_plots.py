"""Plots of the page on accuracy, drawn from stored figures in the colours of the page, light or dark.

`draw` needs no Sphinx; `setup` registers the directives ``{accuracy-plot} NAME`` and ``{lens-table}``. The figures are
written by `perf/accuracy`: `headlines.py`, `method_comparison.py`, `resolution.py` and `lenses.py`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from panels import add_directive
from side_by_side import FIGURES as METHODS

from lfpiv.report import svg

FIGURES = METHODS.with_name("accuracy.json")
RESOLUTION = METHODS.with_name("resolution.json")
LENSES = METHODS.with_name("lenses.json")
NAMES = {
    "thin": "thin lens",
    "double_gauss": "Double Gauss, f/4",
    "cooke_triplet": "Cooke triplet, f/4",
    "tessar": "Tessar, f/4.5",
    "heliar": "Heliar, f/4.5",
}
"""Main lenses of `perf/accuracy/lenses.py`, in the order of the table."""
OURS, TRUTH, BEFORE, PAPER = svg.SERIES[0], svg.INK, svg.SERIES[2], svg.SERIES[1]
AXIS_COLOURS = dict(zip("xyz", svg.SERIES, strict=False))
HEIGHT_INCH = 2.7

Rows = Sequence[Mapping[str, Any]]


def stored_figures() -> dict[str, Any]:
    """Return the figures of all files."""
    figures: dict[str, Any] = json.loads(FIGURES.read_text("utf-8"))
    response = json.loads(RESOLUTION.read_text("utf-8"))["response"]
    return figures | {"methods": json.loads(METHODS.read_text("utf-8"))["seeding"], "response": response}


def draw(name: str, stored: Mapping[str, Any]) -> str:
    """Return one of `PLOTS` as SVG."""
    figure, axes = svg.new_panel(HEIGHT_INCH)
    alt = PLOTS[name](axes, stored)
    return svg.to_svg(figure, alt)


def _line(axes: Axes, x: Sequence[float], rows: Sequence[Sequence[float]], colour: str, label: str, style: str = "-"):
    """Draw means with their standard errors."""
    mean, spread = ([row[part] or 0.0 for row in rows] for part in (0, 1))
    axes.errorbar(x, mean, spread, color=colour, ls=style, lw=1.6, marker="o", ms=3.5, elinewidth=1, label=label)


def _method(stored: Mapping[str, Any], way: str, figure: str) -> tuple[list[float], list[Sequence[float]]]:
    rows = [row for row in stored["methods"] if row["way"] == way and row["cameras"] == 2]
    return [row["ppm"] for row in rows], [row["figures"][figure] for row in rows]


def _finish(axes: Axes, title: str, xlabel: str, ylabel: str, *, log_x: Sequence[float] = (), legend: bool = True):
    if log_x:
        axes.set_xscale("log")
        axes.set_xticks(log_x, [f"{value:g}" for value in log_x])
        axes.set_xticks([], minor=True)
    axes.set_ylim(0, None)
    svg.style(axes, title=title, xlabel=xlabel, ylabel=ylabel, legend=legend)


def error_against_seeding(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the errors of this software, of the paper's iterations and of the true particles."""
    styles = {
        "paper": ("the paper's 10 iterations", PAPER, "-"),
        "ours": ("this software", OURS, "-"),
        "truth": ("true particles", TRUTH, ":"),
    }
    for way, (label, colour, style) in styles.items():
        seedings, values = _method(stored, way, "error")
        _line(axes, seedings, values, colour, label, style)
    _finish(axes, "error against seeding", "particles per microlens", "mean error [voxel]", log_x=seedings)
    return "Mean error of the displacement against seeding"


def quality_against_seeding(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw Q and the number of ghosts per particle."""
    for way, colour, name in (("ours", OURS, "this software"), ("paper", PAPER, "paper")):
        seedings, quality = _method(stored, way, "q")
        _line(axes, seedings, quality, colour, f"Q, {name}")
        _line(axes, seedings, _method(stored, way, "ghosts")[1], colour, f"ghosts, {name}", ":")
    _finish(axes, "Q, and ghosts per particle", "particles per microlens", "", log_x=seedings)
    axes.set_ylim(0, 2.0)  # the legend lies above the lines
    return "Q and ghosts per particle against seeding"


def error_against_angle(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the mean absolute error of each component against the angle of the cameras."""
    rows: Rows = stored["angle"]
    angles = [row["half_angle_deg"] for row in rows]
    for axis, colour in AXIS_COLOURS.items():
        _line(axes, angles, [row[f"error_{axis}"] for row in rows], colour, axis)
    axes.set_xticks(angles, [f"±{angle:g}" for angle in angles])
    _finish(axes, "two cameras", "angle from z [degree]", "mean |error| [voxel]")
    return "Mean absolute error along x, y and z against the angle of two cameras"


def error_against_cameras(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the mean absolute error of each component for one to four cameras."""
    rows: Rows = stored["cameras"]
    for number, (axis, colour) in enumerate(AXIS_COLOURS.items()):
        places = [row["cameras"] + 0.26 * (number - 1) for row in rows]
        mean, spread = ([row[f"error_{axis}"][part] or 0.0 for row in rows] for part in (0, 1))
        axes.bar(places, mean, 0.24, yerr=spread, color=colour, ecolor=svg.INK, label=axis)
    axes.set_xticks([row["cameras"] for row in rows])
    _finish(axes, "number of cameras", "cameras", "mean |error| [voxel]")
    return "Mean absolute error along x, y and z for one to four cameras"


def error_against_displacement(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the mean error against the largest displacement."""
    rows: Rows = stored["displacement"]
    _line(axes, [1.6 * row["speed"] for row in rows], [row["error"] for row in rows], OURS, "")
    _finish(axes, "error against displacement", "largest displacement [voxel]", "mean error [voxel]", legend=False)
    return "Mean error against the largest displacement"


def error_against_window(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the mean error against the last window."""
    rows: Rows = stored["window"]
    windows = [row["window"] for row in rows]
    _line(axes, windows, [row["ours"] for row in rows], OURS, "this software")
    _line(axes, windows, [row["truth"] for row in rows], TRUTH, "true particles", ":")
    axes.set_xticks(windows)
    _finish(axes, "error against window", "last window [voxel]", "mean error [voxel]")
    return "Mean error against the edge of the last window"


def weights_error(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the difference of weights from counted rays."""
    for angle, colour in ((0.0, svg.SERIES[0]), (45.0, svg.SERIES[1])):
        rows = [row for row in stored["weights"] if row["angle_deg"] == angle]
        percent = [[100 * (part or 0.0) for part in row["error"]] for row in rows]
        _line(axes, [row["voxel_pitch"] for row in rows], percent, colour, f"camera at {angle:g} degrees")
    _finish(axes, "weights against counted rays", "voxel [microlens pitch]", "difference [%]")
    return "Relative difference of integrated weights from counted rays against the voxel's size"


def stated_uncertainty(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the true error of vectors against their stated uncertainty."""
    rows: Rows = stored["uncertainty"]
    stated = [row["stated"] for row in rows]
    _line(axes, stated, [row["true"] for row in rows], OURS, "clean and realistic images")
    end = 1.05 * max(*stated, *(row["true"][0] for row in rows))
    axes.plot([0, end], [0, end], color=TRUTH, ls=":", lw=1.2, label="equal")
    axes.set_xlim(0, end)
    _finish(axes, "uncertainty of a component", "stated [voxel]", "true rms error [voxel]")
    return "True rms error against the stated uncertainty"


def response_across(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the response to waves of the displacement across the view."""
    return _response(axes, stored, "y", "across the view")


def response_in_depth(axes: Axes, stored: Mapping[str, Any]) -> str:
    """Draw the response to waves of the displacement in depth."""
    return _response(axes, stored, "z", "in depth")


def _response(axes: Axes, stored: Mapping[str, Any], axis: str, where: str) -> str:
    rows: Rows = stored["response"]
    waves = [row["wave"] for row in rows]
    styles = {
        "joint field": (OURS, "-"),
        "joint vectors": (svg.SERIES[2], "-"),
        "correlation": (svg.SERIES[1], "-"),
        "true particles": (TRUTH, ":"),
    }
    for way, (colour, style) in styles.items():
        _line(axes, waves, [row[way][axis] for row in rows], colour, way, style)
    axes.axhline(0.5, color=TRUTH, lw=0.6)
    _finish(axes, f"response {where}", "wavelength [voxel]", "measured / true amplitude", log_x=waves)
    axes.set_ylim(-0.2, 1.2)
    return f"Measured over true amplitude of waves of the displacement {where}, against their length"


PLOTS = {
    "seeding": error_against_seeding,
    "quality": quality_against_seeding,
    "angle": error_against_angle,
    "cameras": error_against_cameras,
    "displacement": error_against_displacement,
    "window": error_against_window,
    "weights": weights_error,
    "uncertainty": stated_uncertainty,
    "response": response_across,
    "response-depth": response_in_depth,
}
"""Plots by name."""


def lens_table() -> str:
    """Return the figures of each main lens as Markdown."""
    rows = {row["lens"]: row for row in json.loads(LENSES.read_text("utf-8"))}
    titles = (
        "lens",
        "mapping, 0.9 of the pupil",
        "whole pupil",
        "stated",
        "weights",
        "pairs",
        "correlation",
        "joint fit",
    )
    lines = [titles, tuple("---" for _ in titles)]
    for lens, row in sorted(rows.items(), key=lambda item: list(NAMES).index(item[0])):
        mapping = (f"{row['mapping'][part]:.4f}" for part in ("inner", "whole", "stated"))
        moved = ("{:.3f}\u00a0±\u00a0{:.3f}".format(*row["displacement"][way]) for way in ("correlation", "joint"))
        lines.append((NAMES[lens], *mapping, f"{100 * row['weights']:.1f} %", str(row["pairs"]), *moved))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def setup(app):
    """Register the directives."""
    from sphinx.util.docutils import SphinxDirective

    class LensTable(SphinxDirective):
        """Figures of main lenses."""

        def run(self):
            self.env.note_dependency(str(LENSES))
            return self.parse_text_to_nodes(lens_table())

    app.add_directive("lens-table", LensTable)
    return add_directive(
        app, "accuracy-plot", lambda name: draw(name, stored_figures()), PLOTS, (FIGURES, METHODS, RESOLUTION)
    )
