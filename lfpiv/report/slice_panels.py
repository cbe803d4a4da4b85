"""Draw slices of a vector field as still panels: colours with arrows, streamlines, or nothing over them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import xarray as xr
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
from scipy import ndimage

from lfpiv.geometry.names import COMPONENTS
from lfpiv.quantities import significant
from lfpiv.report.flow import IN_SLICE, Quantity
from lfpiv.report.svg import arrows, cell_edges, colour_bar, image_panel, spread_ticks, style, to_svg

MOST_SLICES = 5
"""Largest number of slices of a vector field."""
MOST_ARROWS = 20
"""Largest number of arrows along an axis of a slice; more are thinned out."""
ARROW_TINTS = (("#0b0f14", "#ffffff"), ("#ffffff", "#0b0f14"))
"""Colours of measured and of replaced vectors: the line and its outline, which shows on dark and on light cells."""
MASKED_FILL, MASKED_LINE = "#d5d8db", "#9aa0a6"
"""Colours of masked cells in a slice and of their hatching."""
SAMPLES = 160
"""Number of samples along the longer edge of a slice, to which colours are interpolated."""
SHARE, SHARE_ERRORS = 99.0, 95.0
"""Percentile of a quantity's magnitude at which its colours end; of the uncertainty, which has a long tail."""

Overlay = Literal["arrows", "streamlines", "none"]


def depth_slices(fields: xr.Dataset, kinds: dict[str, Quantity], normal: str, quantity: str) -> list[str]:
    """Draw evenly spread slices of a field with arrows, the first and the last among them."""
    count = fields.sizes[normal]
    places = np.unique(np.linspace(0, count - 1, min(MOST_SLICES, count)).round().astype(int))
    return [slice_panel(fields, kinds, normal, int(place), quantity, "arrows") for place in places]


def slice_panel(
    fields: xr.Dataset,
    kinds: dict[str, Quantity],
    normal: str,
    place: int,
    quantity: str,
    overlay: Overlay,
    *,
    like: xr.Dataset | None = None,
    title: str = "",
) -> str:
    """Draw one slice of a field.

    Parameters
    ----------
    fields : Dataset
        Quantities over z, y, x from `flow.shown`. Colours and arrows of all its slices have the same scale.
    kinds : dict
        Quantity -> how it is written.
    normal : {"x", "y", "z"}
        Axis normal to the slice.
    place : int
        Index of the slice along that axis.
    quantity : str
        What the colours show.
    overlay : {"arrows", "streamlines", "none"}
        What is drawn over them.
    like : Dataset, optional
        Field whose scales of colours and arrows are used. Default: `fields`.
    title : str
        What stands before the place of the slice, in place of the scale of the arrows behind it.
    """
    across, up = IN_SLICE[normal]
    like = fields if like is None else like
    good = like["valid"].values & np.isfinite(like["u"].values)
    slab = fields.isel({normal: place}).transpose(up, across)
    edges = [cell_edges(slab[axis].values) for axis in (across, up)]
    values = _smooth(np.where(slab["masked"].values, np.nan, slab[quantity].values))
    colours = "RdBu_r" if kinds[quantity].signed else "viridis"
    ends = limits(like[quantity].values[good], kinds[quantity])
    figure, axes, shown = image_panel(values, edges, colours, Normalize(*ends))
    _hatch(axes, slab["masked"].values, edges)
    named = f"{title}, " if title else ""
    title = f"{named}{normal} = {float(slab[normal]):.2f} mm".replace("-", "−")
    in_plane = [COMPONENTS[axis] for axis in (across, up)]
    if overlay == "arrows":
        speed = np.hypot(*(like[name].values for name in in_plane))[good]
        longest = float(np.percentile(speed, 99.5)) if speed.size else 0.0
        scale = _draw_arrows(axes, slab, (across, up), longest, kinds["speed"].unit)
        title += "" if named else scale
    elif overlay == "streamlines":
        _draw_streamlines(axes, slab, (across, up))
    axes.set(xlim=edges[0], ylim=edges[1])
    style(axes, title=title, xlabel=f"{across} [mm]", ylabel=f"{up} [mm]")
    spread_ticks(axes)
    colour_bar(figure, shown, axes, kinds[quantity].title, location="bottom")
    alt = f"{named}slice at {normal} = {float(slab[normal]):.2f} mm: colour is {kinds[quantity].label}"
    over = {"arrows": f", arrows are {' and '.join(in_plane)}", "streamlines": ", with streamlines", "none": ""}
    return to_svg(figure, f"{alt[0].upper()}{alt[1:]}{over[overlay]}.")


def _smooth(values: np.ndarray) -> np.ma.MaskedArray:
    """Return values interpolated linearly between the vectors; cells of unknown ones are masked."""
    fine = int(np.clip(SAMPLES // max(values.shape), 1, 16))
    unknown = ~np.isfinite(values)
    if unknown.all():
        return np.ma.masked_array(values, unknown)
    nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    places = np.meshgrid(*((np.arange(n * fine) + 0.5) / fine - 0.5 for n in values.shape), indexing="ij")
    smooth = ndimage.map_coordinates(values[tuple(nearest)], places, order=1, mode="nearest")
    return np.ma.masked_array(smooth, np.repeat(np.repeat(unknown, fine, 0), fine, 1))


def limits(values: np.ndarray, kind: Quantity) -> tuple[float, float]:
    """Return the ends of the colours of a quantity."""
    values = np.abs(values[np.isfinite(values)])
    share = SHARE_ERRORS if kind.label == "uncertainty" else SHARE
    top = float(np.percentile(values, share)) if values.size else 0.0
    return (-(top or 1.0) if kind.signed else 0.0), top or 1.0


def _draw_arrows(axes: Axes, slab: xr.Dataset, names: tuple[str, str], longest: float, unit: str) -> str:
    """Draw the vectors of a slice, their middles at their places; return how long an arrow is for the title."""
    across, up = names
    sizes = [slab.sizes[axis] for axis in names]
    step = max(-(-max(sizes) // MOST_ARROWS), 1)
    thin = slab.isel({axis: slice((step - 1) // 2, None, step) for axis in names})
    ends = [cell_edges(slab[axis].values) for axis in names]
    apart = step * min((high - low) / size for (low, high), size in zip(ends, sizes, strict=True))
    length = arrow_scale(longest, apart)
    middle = np.stack(np.meshgrid(thin[across].values, thin[up].values), axis=-1).reshape(-1, 2)
    velocity = np.stack([thin[COMPONENTS[axis]].values for axis in names], axis=-1).reshape(-1, 2)
    valid, known = thin["valid"].values.ravel(), np.isfinite(velocity).all(1) & ~thin["masked"].values.ravel()
    for chosen, (ink, outline) in zip((valid & known, ~valid & known), ARROW_TINTS, strict=True):
        if chosen.any():
            step_mm = velocity[chosen] * length
            path = arrows(middle[chosen] - step_mm / 2, step_mm, 0.35 * apart)
            for tint, width in ((outline, 2.2), (ink, 0.9)):
                axes.add_patch(PathPatch(path, fill=False, edgecolor=tint, linewidth=width, capstyle="round"))
    key = round_below(longest)
    return f"; an arrow of {key * length:.2g} mm is {significant(key)} {unit}" if key > 0 else ""


def _draw_streamlines(axes: Axes, slab: xr.Dataset, names: tuple[str, str]) -> None:
    """Draw the streamlines of the velocity in a slice."""
    across, up = names
    u, v = velocity = [np.ma.masked_invalid(np.where(slab["masked"], np.nan, slab[COMPONENTS[axis]])) for axis in names]
    if min(slab.sizes.values()) < 2 or not any(np.any(part != 0) for part in velocity):
        return
    x, y = (np.linspace(float(slab[axis][0]), float(slab[axis][-1]), slab.sizes[axis]) for axis in names)
    shape = float(np.clip(slab.sizes[up] / slab.sizes[across], 0.35, 1.0))
    density = (1.1, 1.1 * shape)
    drawn = axes.streamplot(x, y, u, v, density=density, color="#0b0f14", linewidth=0.9, arrowsize=0.8)
    for patch in axes.patches:
        patch.set_in_layout(False)  # the heads of the arrows lie inside; measuring them takes long
    drawn.lines.set_path_effects([patheffects.withStroke(linewidth=2.2, foreground="#ffffff")])


def _hatch(axes: Axes, masked: np.ndarray, edges: Sequence[tuple[float, float]]) -> None:
    """Hatch the masked cells (up, across) of a slice whose outer edges are (across, up) [mm]."""
    if not masked.any():
        return
    across, up = (np.linspace(*ends, n + 1) for ends, n in zip(edges, masked.shape[::-1], strict=True))
    cells = [
        Path.unit_rectangle().transformed(
            Affine2D().scale(across[1] - across[0], up[1] - up[0]).translate(across[column], up[row])
        )
        for row, column in np.argwhere(masked)
    ]
    outline = Path.make_compound_path(*cells)
    axes.add_patch(PathPatch(outline, facecolor=MASKED_FILL, edgecolor=MASKED_LINE, hatch="////", linewidth=0))


def arrow_scale(longest: float, apart: float) -> float:
    """Return the length of an arrow per velocity [mm]: the longest arrow spans the distance of the arrows."""
    return apart / longest if longest > 0 else 0.0


def round_below(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that does not exceed a value; 0 for no positive value."""
    if not (np.isfinite(value) and value > 0):
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))
