"""Write the report's section on the flow: slices, profiles, space, vorticity, uncertainty and displacements.

The scripts in ``static`` draw the interactive views. Still panels replace them without scripts and in print.
"""

from __future__ import annotations

import pathlib
from collections.abc import Mapping

import numpy as np
import xarray as xr

from lfpiv.experiment.recording import Recording
from lfpiv.geometry.names import COMPONENTS
from lfpiv.prompt import count
from lfpiv.quantities import Scale
from lfpiv.report import flow, markup
from lfpiv.report.fields import Survey, embed, survey
from lfpiv.report.flow import Quantity, View, masked_of
from lfpiv.report.line_panels import (
    displacement_histogram,
    profile_panel,
    uncertainty_histogram,
    uncertainty_over_depth,
)
from lfpiv.report.markup import number, percent, significant
from lfpiv.report.slice_panels import depth_slices, slice_panel
from lfpiv.report.space_panel import in_space
from lfpiv.report.summary import DampingFigures


def section(vectors: Mapping[int, pathlib.Path], recording: Recording, damping: DampingFigures | None) -> str:
    """Return the section on the flow, as HTML, with the data of its views.

    Parameters
    ----------
    vectors : dict
        Pair -> file of its vectors.
    recording : Recording
        What was recorded; it names results.
    damping : DampingFigures or None
        Damping by ghosts; None if it was not measured.
    """
    if not vectors:
        return '<h2 id="vectors">Flow</h2>' + markup.paragraph(f"No {recording.noun} is finished yet.")
    found = survey(vectors, recording)
    pair, first = next(iter(found.shown.items()))
    scale, view, kinds = flow.velocity_scale(first), flow.best_view(first), flow.describe(first)
    data, thinning = embed(found, view, recording)
    fields = flow.shown(first, kinds)
    name = recording.name_of(pair)
    parts = [
        '<h2 id="vectors">Flow</h2>',
        markup.paragraph(_overview(found, len(vectors), thinning, first, recording.noun)),
        _slice_view(name, first, fields, kinds, view, scale),
        _space_view(name, fields, kinds),
        *_figures(name, first, fields, kinds, view),
        damping_table(damping),
        data,
    ]
    return "\n".join(part for part in parts if part)


def _figures(
    name: str, first: xr.Dataset, fields: xr.Dataset, kinds: dict[str, Quantity], view: View
) -> tuple[str, ...]:
    """Return the still figures of a field; a sentence where no vector is valid."""
    if not first["valid"].values.any():
        return (markup.paragraph(f"No vector of {name} is valid, so there is no more to draw."),)
    return (
        _vorticity(name, fields, kinds, view),
        _uncertainty(name, first, fields, kinds, view),
        _displacements(name, first),
    )


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


def _slice_view(
    name: str, first: xr.Dataset, fields: xr.Dataset, kinds: dict[str, Quantity], view: View, scale: Scale
) -> str:
    """Return the slice with its slider and its profiles, their still panels, and a table by depth."""
    place, label = view.place[view.normal], kinds[view.quantity].label
    profile, numbers = profile_panel(fields, kinds, view, flow.voxel_velocity(first) * scale.factor)
    still = markup.figure(
        [slice_panel(fields, kinds, view.normal, place, view.quantity, "arrows"), profile],
        f"{name.capitalize()}: {label} and the velocity in the slice with most vorticity (in the middle where none "
        "stands out), and the velocity along a line through it "
        "(bands: ± 2 standard deviations). White arrows and open marks were replaced after validation; hatched cells "
        "are masked.",
        numbers,
        title="Numbers of the line",
    ) + markup.figure(
        depth_slices(fields, kinds, "z", "w"), f"{name.capitalize()}: velocity at several depths; colour is w."
    )
    table = markup.table(_depth_titles(scale.unit), depth_rows(first, scale), caption="Valid vectors by depth")
    title = f'By depth: <span id="depth-field">{name}</span>'
    return f"""<div class="view" id="slices">
<div class="live">
<div class="controls">
<label>Field <select id="slice-field"></select></label>
<label>Colour <select id="slice-colour"></select></label>
<label>Across <select id="slice-axis"><option>z</option><option>y</option><option>x</option></select></label>
<label>Over it <select id="slice-overlay"><option>arrows</option><option>streamlines</option><option>nothing</option>
</select></label>
<label>Profile along <select id="slice-along"></select></label>
<label class="tick"><input type="checkbox" id="slice-smooth" checked> smooth</label>
<label class="long"><span>Slice <output id="slice-place" for="slice-slider"></output></span>
<input type="range" id="slice-slider" min="0" max="0" step="1" value="0"></label>
</div>
<div class="beside">
<div><canvas id="slice-canvas" tabindex="0" role="img" aria-describedby="slice-reading"></canvas></div>
<div><canvas id="profile-canvas" role="img" aria-describedby="profile-reading"></canvas>
<p id="profile-reading" class="caption"></p>
<p id="slice-reading" class="reading" aria-live="polite"></p></div>
</div>
<p class="caption">It opens at the slice that holds most vorticity, or in the middle where none stands out. Colours show
the quantity chosen, interpolated between the vectors if smooth; white arrows were replaced after validation; hatched
cells are masked. Point at a vector, or move over them with the arrow keys, to read it; a click or Enter puts the dashed
line of the profile through it.</p>
</div>
<div class="still">{still}</div>
<details><summary>{title}</summary><div id="depth-table">{table}</div></details>
</div>"""


def _depth_titles(unit: str) -> list[str]:
    means = [f"mean {name} [{unit}]" for name in "uvw"]
    return ["z [mm]", "vectors", "valid", *means, f"rms speed [{unit}]", f"largest [{unit}]"]


def depth_rows(vectors: xr.Dataset, scale: Scale) -> list[list[str]]:
    """Return rows of figures of the valid vectors at each depth; masked ones are left out.

    ``slices.js`` writes the same for other fields.
    """
    rows = []
    for k, depth in enumerate(vectors["z"].values):
        slab = vectors.isel(z=k)
        velocity = scale.factor * np.stack([slab[name].values for name in "uvw"]).astype(float)
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


def _space_view(name: str, fields: xr.Dataset, kinds: dict[str, Quantity]) -> str:
    """Return the view in space and its still panel."""
    still = markup.figure(
        [in_space(fields, kinds)],
        f"{name.capitalize()}: the valid vectors, coloured by speed, seen from obliquely above.",
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
<label class="tick"><input type="checkbox" id="space-lines"> streamlines</label>
</div>
<div id="space-scene" class="scene" tabindex="0" role="application"
 aria-label="Vectors in space. Arrow keys turn the view, plus and minus zoom, 0 puts it back."></div>
<p class="caption">Valid vectors as arrows, coloured by speed, and a surface of equal value, interpolated between the
vectors. Drag to turn, wheel or pinch to zoom once the view is chosen by a click, a tap or the Tab key; arrow keys turn
it, + and − zoom, 0 puts it back.</p>
</div>
<div class="still">{still}</div>
</div>"""


def _vorticity(name: str, fields: xr.Dataset, kinds: dict[str, Quantity], view: View) -> str:
    """Draw streamlines in three slices, and the components of the vorticity where there are any in the best one."""
    order = [view.normal, *(axis for axis in "zyx" if axis != view.normal)]
    panels = [slice_panel(fields, kinds, axis, view.place[axis], "speed", "streamlines") for axis in order]
    text = f"{name.capitalize()}: speed in the slice with most vorticity and in those across it, with the "
    text += "streamlines of the velocity in each slice."
    parts = ["<h3>Streamlines</h3>", markup.figure(panels, text), "<h3>Vorticity</h3>"]
    curl = [f"vorticity_{axis}" for axis in "xyz" if f"vorticity_{axis}" in fields]
    if not curl:
        return "".join([*parts, markup.paragraph("There are too few vectors along one axis for vorticity.")])
    place = view.place[view.normal]
    panels = [slice_panel(fields, kinds, view.normal, place, quantity, "none") for quantity in curl]
    text = (
        f"{name.capitalize()}: components of the vorticity in this slice, differences of neighbours, one-sided at "
        "the border."
    )
    return "".join([*parts, markup.figure(panels, text)])


def _uncertainty(name: str, first: xr.Dataset, fields: xr.Dataset, kinds: dict[str, Quantity], view: View) -> str:
    """Draw the uncertainty in the best slice, over the depth and as a histogram; nothing where it is not known."""
    if "uncertainty" not in first:
        return ""
    known = first["uncertainty"].values[first["valid"].values]
    known = known[np.isfinite(known)]
    if not known.size:
        return ""
    panels = [
        slice_panel(fields, kinds, view.normal, view.place[view.normal], "uncertainty", "none"),
        uncertainty_over_depth(first),
        uncertainty_histogram(known),
    ]
    text = (
        f"{name.capitalize()}: standard deviation of each component of a displacement, as stated with the vectors. The "
        "last bar holds all larger ones."
    )
    return "<h3>Uncertainty</h3>" + markup.figure(panels, text)


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


def damping_table(damping: DampingFigures | None) -> str:
    """Tabulate the damping by ghosts; nothing where it was not measured."""
    if damping is None or not damping.axes:
        return ""
    rows = [
        [
            f"{COMPONENTS[axis]}, along {axis}",
            f"{number(found.slope, 3)} ± {number(found.slope_error, 3)}",
            f"{number(found.offset, 3)} ± {number(found.offset_error, 3)}",
            number(found.raw_error, 3),
            number(found.unbiased_error, 3),
            "taken off" if found.applied else "not taken off",
        ]
        for axis, found in sorted(damping.axes.items())
    ]
    text = (
        "Slope of measured on true fluctuations, their offset, and the expected root mean square errors of raw vectors "
        "and of those without damping, from "
        f"{count(damping.simulated, 'simulated pair')}. This page shows the raw vectors; open_results has both."
    )
    titles = [
        "component",
        "slope",
        "offset [voxel]",
        "raw error [voxel]",
        "unbiased error [voxel]",
        "by open_results",
    ]
    return (
        "<h3>Damping by ghosts</h3>"
        + markup.table(titles, rows, caption="Damping by ghosts of each component")
        + markup.paragraph(text, "quiet")
    )
