"""Draw a vector field in space as a still panel."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lfpiv.quantities import significant
from lfpiv.report.flow import Quantity
from lfpiv.report.slice_panels import arrow_scale
from lfpiv.report.svg import INK, TEXT_POINT, WIDTH_INCH, style, to_svg

MOST_IN_SPACE = 500
"""Largest number of arrows of the view in space."""


def in_space(fields: xr.Dataset, kinds: dict[str, Quantity]) -> str:
    """Draw the valid vectors of a field from `flow.shown` in space, coloured by speed."""
    step = 1
    while np.prod([-(-fields.sizes[axis] // step) for axis in "zyx"]) > MOST_IN_SPACE:
        step += 1
    thin = fields.isel({axis: slice(min(step // 2, fields.sizes[axis] - 1), None, step) for axis in "zyx"})
    z, y, x = np.meshgrid(*(thin[axis].values for axis in "zyx"), indexing="ij")
    velocity = np.stack([thin[name].values for name in "uvw"], axis=-1)
    speed = thin["speed"].values
    good = thin["valid"].values & np.isfinite(speed)
    figure = Figure(figsize=(WIDTH_INCH, 3.8))
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    axes: Any = figure.add_axes((0.02, 0.25, 0.84, 0.75), projection="3d")  # matplotlib has no types for 3D axes
    axes.patch.set_alpha(0)
    longest = float(speed[good].max(initial=0.0))
    apart = step * min((_spacing(fields[axis].values) for axis in "zyx" if fields.sizes[axis] > 1), default=1.0)
    scale = arrow_scale(longest, apart)
    norm = Normalize(0, longest or 1.0)
    shade = ScalarMappable(norm, "viridis")
    if good.any():
        colours = shade.to_rgba(speed[good])
        start, steps = (np.stack([x, y, z], axis=-1)[good], velocity[good] * scale)
        axes.quiver(*start.T, *steps.T, colors=colours, linewidth=1.0, arrow_length_ratio=0.35, pivot="middle")
    spans = [max(float(np.ptp(fields[axis].values)), apart) for axis in "xyz"]
    axes.set_box_aspect(spans)
    for axis, name in zip((axes.xaxis, axes.yaxis, axes.zaxis), "xyz", strict=True):
        axis.set_pane_color((0, 0, 0, 0))
        axis.line.set_color(INK)
        axis.set_label_text(f"{name} [mm]", color=INK, fontsize=TEXT_POINT)
        axis.set_tick_params(colors=INK, labelsize=8)
    axes.grid(False)
    axes.locator_params(nbins=4)
    bar = figure.colorbar(shade, cax=figure.add_axes((0.2, 0.14, 0.5, 0.025)), orientation="horizontal")
    style(bar.ax, xlabel=kinds["speed"].title)
    bar.outline.set(color=INK, linewidth=0.6)
    fastest = f"{significant(longest)} {kinds['speed'].unit}"
    return to_svg(figure, f"The vectors in space from obliquely above; the fastest has {fastest}.")


def _spacing(positions: np.ndarray) -> float:
    """Return the spacing of positions; 1 for a single one."""
    return float(np.median(np.diff(positions))) if positions.size > 1 else 1.0
