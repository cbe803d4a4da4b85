"""Write the report's section on the vectors: slices with a slider, a view in space, histograms of displacements.

The scripts in ``static`` draw the interactive views. Still panels drawn here replace them without scripts and in print.
"""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from lfpiv.geometry.names import COMPONENTS
from lfpiv.report import markup
from lfpiv.report.fields import Survey, embed, survey
from lfpiv.report.markup import number, percent, significant
from lfpiv.report.naming import PAIRS, Naming
from lfpiv.report.svg import (
    INK,
    SERIES,
    TEXT_POINT,
    WIDTH_INCH,
    arrows,
    cell_edges,
    colour_bar,
    new_panel,
    spread_ticks,
    style,
    to_svg,
)

MOST_SLICES = 6
"""Largest number of slices of a vector field."""
MOST_ARROWS = 24
"""Largest number of arrows along an axis of a slice; more are thinned out."""
MOST_IN_SPACE = 500
"""Largest number of arrows of the view in space."""
ARROW_TINTS = ("#101418", "#9aa0a6")
"""Colours of measured and of replaced vectors in a slice."""
MASKED_FILL, MASKED_LINE = "#d5d8db", "#9aa0a6"
"""Colours of masked cells in a slice and of their hatching."""

_DEPTH_TITLES = (
    "z [mm]",
    "vectors",
    "valid",
    "mean u [m/s]",
    "mean v [m/s]",
    "mean w [m/s]",
    "rms speed [m/s]",
    "largest [m/s]",
)


def section(vectors: Mapping[int, pathlib.Path], naming: Naming = PAIRS) -> str:
    """Return the section on the vectors, as HTML, with the data of its views.

    Parameters
    ----------
    vectors : dict
        Pair -> file of its vectors.
    naming : Naming
        Names of results.
    """
    if not vectors:
        return '<h2 id="vectors">Vectors</h2>' + markup.paragraph(f"No {naming.noun} is finished yet.")
    found = survey(vectors, naming)
    pair, first = next(iter(found.shown.items()))
    data, thinning = embed(found, naming)
    parts = [
        '<h2 id="vectors">Vectors</h2>',
        markup.paragraph(_overview(found, len(vectors), thinning, first, naming.noun)),
    ]
    name = naming.result(pair)
    parts += [_slice_view(name, first), _space_view(name, first), _displacements(name, first), data]
    return "\n".join(parts)


def _overview(found: Survey, pairs: int, thinning: int, first: xr.Dataset, noun: str) -> str:
    """State how many vectors a pair has, and which of them the page holds."""
    nz, ny, nx = first["u"].shape
    text = f"{nx} × {ny} × {nz} vectors (x, y, z) per {noun}."
    if len(found.shown) < pairs:
        text += (
            f" The page holds {len(found.shown)} of {pairs:,} {noun}s, evenly chosen; all are in the folder vectors."
        )
    if found.mean is not None and found.read < pairs:
        text += f" Mean and fluctuation are those of {found.read} evenly chosen {noun}s."
    if thinning > 1:
        text += f" Along x and y the views show every {thinning}th vector; the files hold all."
    return text


def _slice_view(name: str, first: xr.Dataset) -> str:
    """Return the view with a slider, its still panels, and a table by depth."""
    still = markup.figure(
        [*slices(first), *slices(first, normal="y", most=1)],
        f"{name.capitalize()}: velocity at several depths, and in the middle from the side. Arrows show the components "
        "in the slice, colour the one across it; pale arrows were replaced after validation; hatched cells are masked.",
    )
    rows = depth_rows(first)
    table = markup.table(_DEPTH_TITLES, rows, caption="Valid vectors by depth")
    title = f'By depth: <span id="depth-field">{name}</span>'
    return f"""<h3>Slices</h3>
<div class="view" id="slices">
<div class="live">
<div class="controls">
<label>Field <select id="slice-field"></select></label>
<label>Colour <select id="slice-colour"></select></label>
<label>Across <select id="slice-axis"><option>z</option><option>y</option><option>x</option></select></label>
<label class="long"><span>Slice <output id="slice-place" for="slice-slider"></output></span>
<input type="range" id="slice-slider" min="0" max="0" step="1" value="0"></label>
</div>
<canvas id="slice-canvas" tabindex="0" role="img" aria-describedby="slice-reading"></canvas>
<p id="slice-reading" class="reading" aria-live="polite"></p>
<p class="caption">Arrows show the velocity in the slice, colour the quantity chosen; pale arrows were replaced after
validation; hatched cells are masked. Point at a vector, or move over them with the arrow keys, to read it.</p>
</div>
<div class="still">{still}</div>
<details><summary>{title}</summary><div id="depth-table">{table}</div></details>
</div>"""


def depth_rows(vectors: xr.Dataset) -> list[list[str]]:
    """Return rows of figures of the valid vectors at each depth; masked ones are left out.

    ``slices.js`` writes the same for other fields.
    """
    rows = []
    for k, depth in enumerate(vectors["z"].values):
        slab = vectors.isel(z=k)
        velocity = np.stack([slab[name].values for name in "uvw"]).astype(float)
        good = slab["valid"].values & np.isfinite(velocity).all(0)
        fluid = ~masked_of(slab)
        velocity = velocity[:, good]
        speed = np.linalg.norm(velocity, axis=0)
        known = good.any()
        means = [significant(float(part.mean())) if known else markup.NONE for part in velocity]
        ends = (float(np.sqrt((speed**2).mean())), float(speed.max())) if known else (None, None)
        share = percent(float(good[fluid].mean()), 1) if fluid.any() else markup.NONE
        counts = [number(float(depth), 3), str(int(fluid.sum())), share]
        rows.append([*counts, *means, *map(significant, ends)])
    return rows


def _space_view(name: str, first: xr.Dataset) -> str:
    """Return the view in space and its still panel."""
    still = markup.figure(
        [in_space(first)], f"{name.capitalize()}: the valid vectors, coloured by speed, seen from obliquely above."
    )
    return f"""<h3>In space</h3>
<div class="view" id="space">
<p class="note" id="space-note" role="status"></p>
<div class="live">
<div class="controls">
<label>Field <select id="space-field"></select></label>
<label>Surface <select id="space-quantity"></select></label>
<label class="long"><span>at <output id="space-value" for="space-level"></output></span>
<input type="range" id="space-level" min="5" max="95" step="1" value="50"></label>
<label class="tick"><input type="checkbox" id="space-arrows" checked> arrows</label>
</div>
<div id="space-scene" class="scene" tabindex="0" role="application"
 aria-label="Vectors in space. Arrow keys turn the view, plus and minus zoom, 0 puts it back."></div>
<p class="caption">Valid vectors as cones, coloured by speed, and a surface of equal value. Drag to turn, wheel or pinch
to zoom once the view is chosen by a click, a tap or the Tab key; arrow keys turn it, + and − zoom, 0 puts it back.</p>
</div>
<div class="still">{still}</div>
</div>"""


def _displacements(name: str, first: xr.Dataset) -> str:
    """Draw and tabulate histograms of the displacements."""
    shown, tables = [], []
    for axis in "xyz":
        panel, counts, edges = displacement_histogram(first, axis)
        shown.append(panel)
        rows = [
            [f"{number(low, 3)} to {number(high, 3)}", str(count)]
            for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
        ]
        tables.append(
            markup.table([f"displacement {axis} [voxel]", "vectors"], rows, caption=f"Displacements along {axis}")
        )
    return "<h3>Displacements</h3>" + markup.figure(
        shown,
        f"{name.capitalize()}: displacements of the valid vectors. Peaks at whole numbers would be peak locking.",
        f'<div class="side-by-side">{"".join(tables)}</div>',
    )


def slices(vectors: xr.Dataset, normal: str = "z", most: int = MOST_SLICES) -> list[str]:
    """Draw slices of a vector field, one panel each: in-plane components as arrows, the normal one as colour.

    Parameters
    ----------
    vectors : Dataset
        Vectors over z, y, x. Replaced vectors (not ``valid``) are drawn pale, the cells of ``masked`` ones hatched.
    normal : {"z", "y"}
        Axis normal to the slices.
    most : int
        Largest number of slices, evenly spread. A single slice lies in the middle.
    """
    across, up = ("x", "y") if normal == "z" else ("x", "z")
    count = vectors.sizes[normal]
    places = [count // 2] if most == 1 else np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    good = vectors["valid"].values & np.isfinite(vectors["u"].values)
    through = np.abs(vectors[COMPONENTS[normal]].values[good])
    inside = np.hypot(vectors[COMPONENTS[across]].values, vectors[COMPONENTS[up]].values)[good]
    limit, longest = (float(np.percentile(values, 99)) if values.size else 0.0 for values in (through, inside))
    return [
        _slice(vectors.isel({normal: int(place)}).transpose(up, across), normal, across, up, limit or 1.0, longest)
        for place in places
    ]


def _slice(slab: xr.Dataset, normal: str, across: str, up: str, limit: float, longest: float) -> str:
    """Draw one slice. Colours end at `limit` [m/s]; the in-plane speed `longest` [m/s] scales the arrows."""
    edges = [cell_edges(slab[axis].values) for axis in (across, up)]
    spans = [high - low for low, high in edges]
    key = round_below(longest)
    figure, (axes,) = new_panel(float(np.clip(2.8 * spans[1] / spans[0], 0.5, 3.4)) + 1.35)
    through = COMPONENTS[normal]
    shown = axes.imshow(
        slab[through].values,
        cmap="RdBu_r",
        norm=Normalize(-limit, limit),
        extent=(*edges[0], *edges[1]),
        origin="lower",
        interpolation="none",
    )
    _hatch(axes, masked_of(slab), edges)
    step = max(-(-max(slab.sizes.values()) // MOST_ARROWS), 1)
    thin = slab.isel({across: slice(step // 2, None, step), up: slice(step // 2, None, step)})
    apart = step * min(spans[0] / slab.sizes[across], spans[1] / slab.sizes[up])
    length = arrow_scale(longest, apart)
    start = np.stack(np.meshgrid(thin[across].values, thin[up].values), axis=-1).reshape(-1, 2)
    velocity = np.stack([thin[COMPONENTS[axis]].values for axis in (across, up)], axis=-1).reshape(-1, 2)
    valid, known = thin["valid"].values.ravel(), np.isfinite(velocity).all(1)
    for chosen, tint in ((valid & known, ARROW_TINTS[0]), (~valid & known, ARROW_TINTS[1])):
        if chosen.any():
            path = arrows(start[chosen], velocity[chosen] * length, 0.35 * apart)
            axes.add_patch(PathPatch(path, fill=False, edgecolor=tint, linewidth=0.8))
    axes.set(xlim=edges[0], ylim=edges[1])
    place = float(slab[normal])
    title = f"{normal} = {place:.2f} mm"
    if key > 0:
        title += f"; an arrow of {key * length:.2g} mm is {key:g} m/s"
    style(axes, title=title, xlabel=f"{across} [mm]", ylabel=f"{up} [mm]")
    spread_ticks(axes)
    colour_bar(figure, shown, axes, f"{through} [m/s]", location="bottom")
    parts = f"{COMPONENTS[across]} and {COMPONENTS[up]}"
    return to_svg(figure, f"Slice at {normal} = {place:.2f} mm: arrows are {parts}, colour is {through}.")


def masked_of(vectors: xr.Dataset) -> np.ndarray:
    """Return which vectors are masked, in the shape of ``u``; files of version 0.1.0 do not have the flag."""
    if "masked" in vectors:
        return np.asarray(vectors["masked"].values, bool)
    return np.zeros(vectors["u"].shape, bool)


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
    """Return the length of an arrow per velocity [mm / (m/s)]: the longest arrow spans 1.3 times the arrow spacing."""
    return 1.3 * apart / longest if longest > 0 else 0.0


def in_space(vectors: xr.Dataset) -> str:
    """Draw the valid vectors in space, coloured by speed."""
    step = 1
    while np.prod([-(-vectors.sizes[axis] // step) for axis in "zyx"]) > MOST_IN_SPACE:
        step += 1
    thin = vectors.isel({axis: slice(min(step // 2, vectors.sizes[axis] - 1), None, step) for axis in "zyx"})
    z, y, x = np.meshgrid(*(thin[axis].values for axis in "zyx"), indexing="ij")
    velocity = np.stack([thin[name].values for name in "uvw"], axis=-1)
    speed = np.linalg.norm(velocity, axis=-1)
    good = thin["valid"].values & np.isfinite(speed)
    figure = Figure(figsize=(WIDTH_INCH, 3.4))
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    axes: Any = figure.add_axes((0.0, 0.15, 0.82, 0.85), projection="3d")  # matplotlib has no types for 3D axes
    axes.patch.set_alpha(0)
    longest = float(speed[good].max(initial=0.0))
    apart = step * min((_spacing(vectors[axis].values) for axis in "zyx" if vectors.sizes[axis] > 1), default=1.0)
    scale = arrow_scale(longest, apart)
    norm = Normalize(0, longest or 1.0)
    shade = ScalarMappable(norm, "viridis")
    if good.any():
        colours = shade.to_rgba(speed[good])
        start, steps = (np.stack([x, y, z], axis=-1)[good], velocity[good] * scale)
        axes.quiver(*start.T, *steps.T, colors=colours, linewidth=1.0, arrow_length_ratio=0.35)
    spans = [max(float(np.ptp(vectors[axis].values)), apart) for axis in "xyz"]
    axes.set_box_aspect(spans)
    for axis, name in zip((axes.xaxis, axes.yaxis, axes.zaxis), "xyz", strict=True):
        axis.set_pane_color((0, 0, 0, 0))
        axis.line.set_color(INK)
        axis.set_label_text(f"{name} [mm]", color=INK, fontsize=TEXT_POINT)
        axis.set_tick_params(colors=INK, labelsize=8)
    axes.grid(False)
    axes.locator_params(nbins=4)
    bar = figure.colorbar(shade, cax=figure.add_axes((0.2, 0.13, 0.5, 0.025)), orientation="horizontal")
    style(bar.ax, xlabel="speed [m/s]")
    bar.outline.set(color=INK, linewidth=0.6)
    return to_svg(figure, f"The vectors in space from obliquely above; the fastest has {longest:.3g} m/s.")


def displacement_histogram(vectors: xr.Dataset, axis: str) -> tuple[str, np.ndarray, np.ndarray]:
    """Draw a histogram of the valid displacements along an axis [voxel]; return the panel, counts and edges."""
    values = vectors[f"displacement_{axis}"].values[vectors["valid"].values]
    values = values[np.isfinite(values)]
    counts, edges = np.histogram(values, int(np.clip(np.sqrt(values.size), 8, 60)))
    figure, (axes,) = new_panel(2.2)
    axes.stairs(counts, edges, fill=True, color=SERIES["xyz".index(axis)], alpha=0.8)
    style(axes, title=f"along {axis}", xlabel="displacement [voxel]", ylabel="vectors")
    spread_ticks(axes)
    return to_svg(figure, f"Histogram of {values.size:,} displacements along {axis}."), counts, edges


def round_below(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that does not exceed a value; 0 for no positive value."""
    if not (np.isfinite(value) and value > 0):
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def _spacing(positions: np.ndarray) -> float:
    """Return the spacing of positions; 1 for a single one."""
    return float(np.median(np.diff(positions))) if positions.size > 1 else 1.0
