"""Page of scores: table of figures, errors over completeness, error maps, measured against true displacements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from lfpiv import files
from lfpiv.benchmark import figures
from lfpiv.benchmark.figures import Figure, all_figures, keys_of
from lfpiv.benchmark.score import Score
from lfpiv.benchmark.truth import Truth
from lfpiv.metrics import Estimate
from lfpiv.quantities import UNKNOWN, significant
from lfpiv.report import markup, svg
from lfpiv.version import SOURCE

POINTS = 1500
"""Most points of a panel of measured against true displacements."""
MOST_INSTANTS = 40
"""Most pairs or instants in the table of single ones."""
_ERROR_DIGITS = 2
NO_SPREAD = 1e-4
"""Standard error, relative to its value, up to which it is rounding and not shown."""
MOST_PLACES = 6
"""Most decimal places of a figure."""


def rows(scores: Sequence[Score]) -> Iterator[tuple[str, list[str]]]:
    """Yield the title, with the unit, and the cells of each figure that is known of any of the results."""
    for figure in all_figures():
        for key in keys_of(figure):
            estimates = [one.figures.get(key) for one in scores]
            if any(one is not None and np.isfinite(one.value) for one in estimates):
                axis = f" {key[-1]}" if figure.axes else ""
                unit = "" if figure.unit == "1" else f" [{figure.unit}]"
                yield f"{figure.title}{axis}{unit}", [cell(figure, one) for one in estimates]


def cell(figure: Figure, estimate: Estimate | None) -> str:
    """Return a figure as text with its standard error, rounded to two digits of that error."""
    if estimate is None or not np.isfinite(estimate.value):
        return UNKNOWN
    factor = 100.0 if figure.unit == "%" else 1.0
    value, spread = factor * estimate.value, factor * estimate.standard_error
    if not (np.isfinite(spread) and spread > NO_SPREAD * abs(value)):
        return significant(value, 4)
    places = min(max(0, _ERROR_DIGITS - 1 - int(np.floor(np.log10(spread)))), MOST_PLACES)
    return f"{round(value, places) + 0.0:.{places}f} ± {spread:.{places}f}".replace("-", "−")


def write_page(truth: Truth, scores: Sequence[Score], path: Path) -> None:
    """Write the scores of results on one data set as one HTML file that needs no other.

    Parameters
    ----------
    scores : sequence of Score
        Scores of results on this data set.
    path : Path
        The file; an existing one is replaced.
    """
    labels = [one.label for one in scores]
    table = markup.table(
        ["", *labels],
        ([title, *(text.replace(" ± ", "\u00a0±\u00a0") for text in cells)] for title, cells in rows(scores)),
        caption="figures of merit of each result",
    )
    body = [
        f"<h1>{markup.escape(truth.scene.name)}: {markup.escape(', '.join(labels))}</h1>",
        markup.paragraph(
            f"Largest displacement {truth.peak_mm / truth.voxel_mm:.2f} voxel of {truth.voxel_mm:g} mm. After ± stands "
            "the standard error: of a bootstrap over blocks of vectors, or of the mean over pairs or instants.",
            "quiet",
        ),
        "".join(markup.paragraph(f"{text[:1].upper()}{text[1:]}.", "quiet") for text in noted(scores)),
        table,
        "<h2>Errors over completeness</h2>",
        markup.figure(
            [completeness_panel(scores)],
            "Error that is not exceeded in a part of the measurable region. A line ends where no vectors are left.",
        ),
        "<h2>Where errors are</h2>",
        markup.figure(
            [map_panel(one, _top(scores)) for one in scores],
            "Length of the error in the middle of the depth, first pair, same colours. Crosses: no valid vector.",
        ),
        "<h2>Measured and true displacements</h2>",
        markup.figure(
            [response_panel(one, axis) for one in scores for axis in range(3)],
            f"Kept vectors in the measurable region, at most {POINTS:,}; dotted: equal.",
        ),
        _instants(truth, scores),
        "<h2>Definitions</h2>",
        markup.facts((figure.title, figure.text) for figure in all_figures()),
        "<h2>Sources</h2>",
        "".join(markup.paragraph(text) for text in figures.SOURCES.values()),
        markup.paragraph(f"Scored by {SOURCE}.", "quiet"),
    ]
    files.write_text(markup.page(f"{truth.scene.name}: scores", body), path)


def completeness_panel(scores: Sequence[Score]) -> str:
    """Draw the errors of all results over the part of the measurable region."""
    figure, axes = svg.new_panel(3.0)
    for number, one in enumerate(scores):
        if len(one.curve.part):
            axes.plot(
                100 * one.curve.part,
                one.curve.bound,
                color=svg.SERIES[number % len(svg.SERIES)],
                lw=1.6,
                label=one.label,
            )
    axes.set_xlim(0, 100)
    positive = np.concatenate([one.curve.bound[one.curve.bound > 0] for one in scores])
    if len(positive):
        axes.set_yscale("log")
        axes.tick_params(which="minor", colors=svg.INK)
        axes.set_ylim(max(np.percentile(positive, 1), 1e-4), 1.3 * positive.max())
    svg.style(axes, xlabel="part of the region [%]", ylabel="error [voxel]", legend=len(scores) > 1)
    return svg.to_svg(figure, "Error not exceeded in a part of the measurable region; the table has the numbers")


def noted(scores: Sequence[Score]) -> Iterator[str]:
    """Yield what was assumed, with the names of the results unless it is the same for all."""
    for note in dict.fromkeys(note for one in scores for note in one.notes):
        labels = [one.label for one in scores if note in one.notes]
        yield note if len(labels) == len(scores) else f"{', '.join(labels)}: {note}"


def _top(scores: Sequence[Score]) -> float:
    """Return the error at the end of the colours of maps: few vectors of any result exceed it [voxel]."""
    lengths = np.concatenate([one.sample.length[one.sample.scored] for one in scores])
    return float(np.percentile(lengths, 98)) or 1.0


def map_panel(score: Score, top: float) -> str:
    """Draw the errors of the first pair's vectors in the middle of the depth, colours up to `top` [voxel]."""
    pair, truth = next(one for one in score.sample.pairs if len(one.kept)), score.sample.truth
    x, y, z = pair.positions_mm.T
    depths = np.unique(np.round(z, 6))
    middle = depths[np.abs(depths - truth.scene.volume.centre_mm[2]).argmin()]
    reach = truth.reference_window_mm[2] / 4 if score.kind == "particles" else 0.01 * truth.voxel_mm
    near = np.abs(z - middle) <= reach
    length = np.linalg.norm(pair.error, axis=1)
    good, bad = near & pair.kept, near & ~pair.kept
    figure, axes = svg.new_panel(3.7)
    shown = axes.scatter(x[good], y[good], c=length[good], cmap="viridis", vmin=0, vmax=top, marker="s", s=_side(good))
    axes.scatter(x[bad], y[bad], color=svg.INK, marker="x", s=9, lw=0.7)
    axes.set_aspect("equal")
    svg.colour_bar(figure, shown, axes, "error [voxel]", location="bottom")
    svg.style(axes, title=f"{score.label}, z = {middle:.2f} mm", xlabel="x [mm]", ylabel="y [mm]")
    return svg.to_svg(figure, f"Map of the error of {score.label} at z = {middle:.2f} mm")


def _side(good: np.ndarray) -> float:
    """Return the area of a marker [square point], so that markers of a square lattice nearly touch."""
    return float(np.clip((135 / max(np.sqrt(good.sum()), 1.0)) ** 2, 4, 300))


def response_panel(score: Score, axis: int) -> str:
    """Draw one component of the measured displacements against the true one."""
    figure, axes = svg.new_panel(2.8)
    sample = score.sample
    chosen = np.flatnonzero(sample.scored)
    chosen = chosen[:: max(1, -(-len(chosen) // POINTS))]
    true, measured = sample.true[chosen, axis], sample.measured[chosen, axis]
    axes.plot(true, measured, ".", color=svg.SERIES[axis], ms=2.5, alpha=0.6)
    _diagonal(axes, true, measured)
    slope = score.figures[f"slope_{'xyz'[axis]}"].value
    title = f"{score.label}, {'xyz'[axis]}" + (f": slope {slope:.3f}" if np.isfinite(slope) else "")
    svg.style(axes, title=title, xlabel="true [voxel]", ylabel="measured [voxel]")
    return svg.to_svg(figure, f"Measured against true displacement along {'xyz'[axis]}, {score.label}")


def _diagonal(axes: Axes, true: np.ndarray, measured: np.ndarray) -> None:
    """Draw the line of equal values over the range of the truth, and cut off what is far from it."""
    low, high = (float(true.min()), float(true.max())) if len(true) else (0.0, 1.0)
    pad = 0.15 * (high - low) + 0.1
    axes.plot([low - pad, high + pad], [low - pad, high + pad], ls=":", lw=1, color=svg.INK)
    axes.set_xlim(low - pad, high + pad)
    spread = 0.5 * (high - low) + 0.5
    axes.set_ylim(max(low - spread, float(measured.min(initial=0)) - pad), min(high + spread, measured.max() + pad))


def _instants(truth: Truth, scores: Sequence[Score]) -> str:
    """Return the table of single pairs or instants, where there are several."""
    numbers = [one["number"] for one in scores[0].instants]
    if len(numbers) < 2:
        return ""
    titles = [truth.noun]
    for one in scores:
        titles += [f"{one.label}: completeness [%]", "mean error [voxel]", "outliers [%]"]
    lines = []
    for place, number in enumerate(numbers[:MOST_INSTANTS]):
        line = [f"{number:.0f}"]
        for one in scores:
            values = one.instants[place]
            line += [significant(100 * values["completeness"]), significant(values["error"])]
            line.append(significant(100 * values["outliers"]))
        lines.append(line)
    shown = f"{truth.noun}s".capitalize()
    return f"<h2>{shown}</h2>" + markup.table(titles, lines, caption=f"figures of each {truth.noun}")
