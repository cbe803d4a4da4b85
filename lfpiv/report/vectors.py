"""The report's section on the vectors: slices with a slider, a view in space, displacements; stills stand in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from lfpiv.report import flow_panels, markup
from lfpiv.report.fields import Survey, embed, survey
from lfpiv.report.markup import number, percent, significant

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


def section(vectors: Mapping[int, Path]) -> str:
    """Write the section on the vectors, the data of its views included.

    Parameters
    ----------
    vectors : dict
        Pair -> file of its vectors.
    """
    if not vectors:
        return '<h2 id="vectors">Vectors</h2>' + markup.paragraph("No pair is finished yet.")
    found = survey(vectors)
    pair, first = next(iter(found.shown.items()))
    data, thinning = embed(found, {pair: f"pair {pair}" for pair in found.shown})
    parts = ['<h2 id="vectors">Vectors</h2>', markup.paragraph(_what_is_here(found, len(vectors), thinning, first))]
    parts += [_slices(pair, first), _space(pair, first), _displacements(pair, first), data]
    return "\n".join(parts)


def _what_is_here(found: Survey, pairs: int, thinning: int, first: xr.Dataset) -> str:
    nz, ny, nx = first["u"].shape
    text = f"{nx} × {ny} × {nz} vectors (x, y, z) per pair."
    if len(found.shown) < pairs:
        text += f" The page holds {len(found.shown)} of {pairs:,} pairs, evenly chosen; all are in the folder vectors."
    if found.mean is not None and found.read < pairs:
        text += f" Mean and fluctuation are those of {found.read} evenly chosen pairs."
    if thinning > 1:
        text += f" Along x and y the views show every {thinning}th vector; the files hold all."
    return text


def _slices(pair: int, first: xr.Dataset) -> str:
    still = markup.figure(
        [*flow_panels.slices(first), *flow_panels.slices(first, normal="y", most=1)],
        f"Pair {pair}: velocity at several depths, and in the middle from the side. Arrows show the components in the "
        "slice, colour the one across it; pale arrows were replaced after validation.",
    )
    rows = _depth_rows(first)
    table = markup.table(_DEPTH_TITLES, rows, caption="Valid vectors by depth")
    title = f'By depth: <span id="depth-field">pair {pair}</span>'
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
validation. Point at a vector, or move over them with the arrow keys, to read it.</p>
</div>
<div class="still">{still}</div>
<details><summary>{title}</summary><div id="depth-table">{table}</div></details>
</div>"""


def _depth_rows(vectors: xr.Dataset) -> list[list[str]]:
    """Figures of the valid vectors at each depth; the script writes the same for other fields."""
    rows = []
    for k, depth in enumerate(vectors["z"].values):
        slab = vectors.isel(z=k)
        velocity = np.stack([slab[name].values for name in "uvw"]).astype(float)
        good = slab["valid"].values & np.isfinite(velocity).all(0)
        velocity = velocity[:, good]
        speed = np.linalg.norm(velocity, axis=0)
        known = good.any()
        means = [significant(float(part.mean())) if known else markup.NONE for part in velocity]
        ends = (float(np.sqrt((speed**2).mean())), float(speed.max())) if known else (None, None)
        counts = [number(float(depth), 3), str(good.size), percent(float(good.mean()), 1)]
        rows.append([*counts, *means, *map(significant, ends)])
    return rows


def _space(pair: int, first: xr.Dataset) -> str:
    still = markup.figure(
        [flow_panels.in_space(first)], f"Pair {pair}: the valid vectors, coloured by speed, seen from obliquely above."
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


def _displacements(pair: int, first: xr.Dataset) -> str:
    shown, tables = [], []
    for axis in "xyz":
        panel, counts, edges = flow_panels.displacement_histogram(first, axis)
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
        f"Pair {pair}: displacements of the valid vectors. Peaks at whole numbers would be peak locking.",
        f'<div class="side-by-side">{"".join(tables)}</div>',
    )
