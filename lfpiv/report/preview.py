"""Draw the preview of one pair as a picture: projections of a coarse volume, refocused planes and light levels.

It is a PNG for a look between two recordings, so it is drawn without the style of the page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure

from lfpiv.files import replacing, writing
from lfpiv.report.light_sheet import ENOUGH, find_sheet
from lfpiv.report.svg import cell_edges

PLANES = 5
"""Largest number of refocused planes of a camera."""
MOST_CAMERAS = 4
"""Largest number of cameras whose planes are drawn."""
WIDTH_INCH, DPI = 13.0, 100
"""Width of the picture [inch] and its pixels per inch."""
BRIGHT_PERCENTILE = 99.7
"""Percentile of the voxels at which the colours of a projection or a plane end."""
CLEAR, WEAK = 0.2, 0.05
"""Particles are clear above the first value of the structure, and hardly rise above the noise below the second."""
SEVERAL_PERCENT = 0.02
"""Share of saturated pixels, of the bright ones, that is too much."""
GOOD = "clear"
"""Verdict on a level that is as it should be."""
GOOD_COLOUR, BAD_COLOUR = "#1a7f45", "#b3261e"

_TITLES = ("camera", "frame", "dark", "noise", "typical peak", "lit lenses", "saturated", "particles")


@dataclass(frozen=True, kw_only=True)
class Level:
    """Light of one camera in one frame."""

    camera: str
    frame: str
    dark: float
    """Level of the background, dark image included [counts]."""
    noise: float
    """Standard deviation of the background [counts]."""
    peak: float
    """Median over the lit microimages of the brightest pixel [counts]; 0 without lit ones."""
    lit: float
    """Share of the microimages that light falls into."""
    saturated: float
    """Saturated pixels over bright ones."""
    structure: float
    """Correlation of near pixels under one microlens: about 0 for noise, 0.2 and more for clear particles."""

    @property
    def verdict(self) -> str:
        """Words about the particles in the image; `GOOD` if nothing is wrong."""
        if self.structure < WEAK:
            return "hardly any"
        if self.saturated > SEVERAL_PERCENT:
            return "saturated"
        return GOOD if self.structure >= CLEAR else "weak"

    def to_json(self) -> dict[str, Any]:
        """Return the figures and the verdict."""
        return asdict(self) | {"verdict": self.verdict}


@dataclass(frozen=True, kw_only=True)
class Preview:
    """What the picture shows of one pair or instant."""

    title: str
    volumes: Mapping[str, xr.DataArray]
    """Frame -> coarse volume, shape (z, y, x), with coordinates [mm]."""
    refocused: Mapping[str, xr.DataArray]
    """Camera -> mean light of the first frame on the pixels of each voxel, shape (z, y, x) [counts]."""
    counts: Mapping[str, np.ndarray]
    """Camera -> first image without background, shape (rows, columns) [counts]."""
    levels: Sequence[Level]


def draw(shown: Preview, path: Path) -> None:
    """Draw a preview and write it as PNG."""
    cameras = list(shown.refocused)[:MOST_CAMERAS]
    heights = [3.6, *(2.5 for _ in cameras), max(2.6, 0.9 + 0.3 * len(shown.levels))]
    figure = Figure(figsize=(WIDTH_INCH, sum(heights) + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(shown.title, fontsize=13)
    rows = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    _draw_volume(rows[0], shown.volumes)
    for row, name in zip(rows[1:-1], cameras, strict=True):
        _draw_planes(row, name, shown.refocused[name])
    _draw_levels(rows[-1], shown)
    with writing(path), replacing(path) as scratch:
        figure.savefig(scratch, format="png", dpi=DPI)


def _draw_volume(row: SubFigure, volumes: Mapping[str, xr.DataArray]) -> None:
    """Draw the brightest voxel along each axis, and the mean brightness over the depth."""
    frame, first = next(iter(volumes.items()))
    row.suptitle(f"coarse volume, {frame}: brightest voxel along each axis", fontsize=10)
    axes = row.subplots(1, 4)
    for one, along, across, up in zip(axes, "zyx", "xxz", "yzy", strict=False):
        values = first.max(along).transpose(up, across)
        _show(one, values, "magma", across, up)
        one.set_title(f"along {along}", fontsize=9)
    for name, volume in volumes.items():
        axes[3].plot(volume["z"], volume.mean(("y", "x")), label=name)
    profile = first.mean(("y", "x")).values
    sheet = find_sheet(first["z"].values, profile) if profile.size > 1 else None
    title = "mean brightness over the depth"
    if sheet is not None:
        axes[3].axvspan(sheet.low_mm, sheet.high_mm, color="#2f81d7", alpha=0.15)
        enough = "good" if sheet.ratio >= ENOUGH else "too little"
        title = f"light sheet {sheet.low_mm:.2g} to {sheet.high_mm:.2g} mm,\n{sheet.ratio:.1f} x the ghosts: {enough}"
    axes[3].set_title(title, fontsize=9)
    axes[3].set_xlabel("z [mm]", fontsize=8)
    axes[3].set_ylim(bottom=0)
    axes[3].tick_params(labelsize=8)
    axes[3].legend(fontsize=8, frameon=False)


def _draw_planes(row: SubFigure, name: str, stack: xr.DataArray) -> None:
    """Draw planes through the refocused images of a camera, with one colour scale."""
    row.suptitle(f"{name}: refocused at these depths; particles are sharp at their own depth", fontsize=10)
    count = stack.sizes["z"]
    places = np.unique(np.linspace(0, count - 1, min(PLANES, count)).round().astype(int))
    top = float(np.percentile(stack.values, BRIGHT_PERCENTILE)) or 1.0
    for one, place in zip(row.subplots(1, PLANES), places, strict=False):
        plane = stack.isel(z=int(place))
        _show(one, plane.transpose("y", "x"), "gray", "x", "y", top)
        one.set_title(f"z = {float(plane['z']):.2f} mm", fontsize=9)


def _show(axes: Axes, values: xr.DataArray, colours: str, across: str, up: str, top: float | None = None) -> None:
    """Show a plane of voxels on its axes [mm]."""
    edges = [cell_edges(values[axis].values) for axis in (across, up)]
    top = top or float(np.percentile(values.values, BRIGHT_PERCENTILE)) or 1.0
    extent = (*edges[0], *edges[1])
    axes.imshow(values.values, cmap=colours, vmin=0, vmax=top, extent=extent, origin="lower")
    axes.set_xlabel(f"{across} [mm]", fontsize=8)
    axes.set_ylabel(f"{up} [mm]", fontsize=8)
    axes.tick_params(labelsize=8)


def _draw_levels(row: SubFigure, shown: Preview) -> None:
    """Draw the counts of the pixels of each camera, and a table of the light levels."""
    counts, table = row.subplots(1, 2, width_ratios=(1, 2.4))
    highest = max(float(image.max()) for image in shown.counts.values())
    bins = np.linspace(0, max(highest, 1.0), 80)
    for name, image in shown.counts.items():
        counts.stairs(np.histogram(image, bins)[0], bins, label=name)
    counts.set_yscale("log")
    counts.set_title("pixels of the first frame by their counts above the background", fontsize=9)
    counts.set_xlabel("counts", fontsize=8)
    counts.tick_params(labelsize=8)
    counts.legend(fontsize=8, frameon=False)
    table.axis("off")
    drawn = table.table([_cells(level) for level in shown.levels], colLabels=_TITLES, loc="upper center")
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    drawn.scale(1, 1.5)
    for (line, column), cell in drawn.get_celld().items():
        cell.set_edgecolor("#cccccc")
        if line and column == len(_TITLES) - 1:
            cell.get_text().set_color(GOOD_COLOUR if shown.levels[line - 1].verdict == GOOD else BAD_COLOUR)


def _cells(level: Level) -> list[str]:
    figures = (f"{level.dark:.1f}", f"{level.noise:.1f}", f"{level.peak:.0f}", f"{100 * level.lit:.0f} %")
    return [level.camera, level.frame, *figures, f"{100 * level.saturated:.1f} %", level.verdict]
