"""Draw the board of each camera, as recorded and rectified, with arrows along x and y."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import ndimage

from lfpiv.files import replacing, writing

WIDTH_INCH, ROW_INCH, DPI = 9.0, 4.4, 110
"""Width of the picture and height of a camera's row [inch], and pixels per inch."""
BRIGHT_PERCENTILE = 99.5
"""Percentile of the image that is drawn white."""
X_COLOUR, Y_COLOUR = "#ff5a4f", "#4fc3ff"
"""Colours of the arrows."""
QUESTION = (
    "Compare each picture with the real board, seen from the cameras: does x point where you count it as growing, "
    "and y up? Letters or a corner of the board must look as they do there."
)
LINE_LETTERS = 92
"""Letters in a line of the text above the picture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """One plane of the board as a camera shows it."""

    camera: str
    plane: int
    z_mm: float
    stated_flip: str | None
    """The camera's key ``image_flip``."""
    recorded: np.ndarray
    """Image as it is recorded, shape (rows, columns) [counts]."""
    pitch_px: float
    """Distance of the microimages [pixel]."""
    arrows_px: np.ndarray
    """Middle of the board, tips of the x and the y arrow (column, row) in the recorded image, shape (3, 2) [pixel]."""
    light: np.ndarray
    """Image rectified to the plane of the board, shape (y, x); NaN where nothing is seen."""
    corner_mm: np.ndarray
    """Centre (x, y) of the first element of `light` [mm]."""
    bin_mm: float
    """Distance between the elements of `light` [mm]."""
    reach_mm: float
    """Length of the arrows [mm]."""


def draw(views: Sequence[BoardView], said: str, path: Path) -> None:
    """Draw the views and write them as PNG, below the text `said` (the axes, or a contradiction) and `QUESTION`."""
    sentence = f"{said[0].upper()}{said[1:].rstrip('.')}."
    text = textwrap.wrap(f"{sentence} {QUESTION}", LINE_LETTERS)
    head = 0.35 + 0.2 * len(text)
    figure = Figure(figsize=(WIDTH_INCH, head + ROW_INCH * len(views)), layout="constrained")
    FigureCanvasAgg(figure)
    heights = [head, *(ROW_INCH for _ in views)]
    top, *rows = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    top.text(0.02, 0.5, "\n".join(text), va="center", fontsize=10)
    for row, view in zip(rows, views, strict=True):
        recorded, rectified = row.subplots(1, 2)
        _draw_recorded(recorded, view)
        _draw_rectified(rectified, view)
    with writing(path), replacing(path) as scratch:
        figure.savefig(scratch, format="png", dpi=DPI)


def _draw_recorded(axes: Axes, view: BoardView) -> None:
    smooth = ndimage.gaussian_filter(view.recorded.astype(np.float32), view.pitch_px / 2)
    axes.imshow(smooth, cmap="gray", vmax=float(np.percentile(smooth, BRIGHT_PERCENTILE)), interpolation="bilinear")
    flip = "image_flip is absent" if view.stated_flip is None else f'image_flip = "{view.stated_flip}"'
    axes.set_title(f"{view.camera}: as recorded, plane {view.plane}\n{flip}", fontsize=10)
    axes.set_axis_off()
    middle, *tips = view.arrows_px
    _arrows(axes, middle, tips)


def _draw_rectified(axes: Axes, view: BoardView) -> None:
    low = view.corner_mm - view.bin_mm / 2  # outer edge of the first element
    high = low + view.bin_mm * np.array(view.light.shape[::-1])
    top = float(np.nanpercentile(view.light, BRIGHT_PERCENTILE))
    axes.set_facecolor("#444444")
    axes.imshow(view.light, cmap="gray", vmax=top, extent=(low[0], high[0], low[1], high[1]), origin="lower")
    axes.set_title(f"{view.camera}: on the board at z = {view.z_mm:g} mm", fontsize=10)
    axes.set_xlabel("x [mm]", fontsize=9)
    axes.set_ylabel("y [mm]", fontsize=9)
    axes.tick_params(labelsize=8)
    _arrows(axes, np.zeros(2), [np.array([view.reach_mm, 0.0]), np.array([0.0, view.reach_mm])])


def _arrows(axes: Axes, middle: np.ndarray, tips: Sequence[np.ndarray]) -> None:
    """Draw the arrows along x and y with their names."""
    for name, colour, tip in zip("xy", (X_COLOUR, Y_COLOUR), tips, strict=True):
        shape = {"arrowstyle": "-|>", "color": colour, "lw": 2.2, "mutation_scale": 16}
        axes.annotate("", xy=tuple(tip), xytext=tuple(middle), arrowprops=shape)
        x, y = middle + 1.15 * (tip - middle)
        axes.text(x, y, name, color=colour, fontsize=13, weight="bold", ha="center", va="center")
