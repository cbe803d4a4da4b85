"""Pictures of a run as PNG bytes: drawn on a transparent ground in tones that read on light and dark pages."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lfpiv.rig import LensLattice, Optics

INK = "#808890"
"""Axes and text: half-way between a light and a dark page."""
COLOURS = ("#2f81d6", "#e0762a", "#2ca36b", "#c2478f", "#8a6fd1", "#9a8d2a")
"""Lines and marks, told apart also by the colour-blind."""
DPI = 150

MOST_SLICES = 6
"""Depths shown of a vector volume."""
MOST_ARROWS = 40
"""Arrows along an axis; more are thinned out."""
KEY_INCH = 0.28
"""Height of the line with the arrows' scale [inch]."""


def lens_centres(white: np.ndarray, optics: Optics, lattice: LensLattice, across: int = 7) -> bytes:
    """Crops of the white image, middle and two opposite corners, with the fitted microimage centres.

    Parameters
    ----------
    white : ndarray, shape (rows, columns)
        White image [counts].
    optics : Optics
        Nominal optics.
    lattice : LensLattice
        Fitted lattice [mm].
    across : int
        Microimages along a crop's edge.
    """
    rows, columns = white.shape
    size = int(min(rows, columns, np.ceil(across * optics.microimage_pitch_px)))
    corners = {
        "top left corner": (0, 0),
        "middle": ((rows - size) // 2, (columns - size) // 2),
        "bottom right corner": (rows - size, columns - size),
    }
    figure = _figure(9.6, 3.5)
    for number, (title, (row, column)) in enumerate(corners.items()):
        axes = figure.add_subplot(1, 3, number + 1)
        crop = white[row : row + size, column : column + size]
        extent = (column - 0.5, column + size - 0.5, row + size - 0.5, row - 0.5)
        axes.imshow(crop, cmap="gray", extent=extent, vmin=0, vmax=np.percentile(crop, 99.5), interpolation="nearest")
        centres = _microimage_centres(optics, lattice, (row, column), size)
        axes.plot(*centres.T, "+", color=COLOURS[1], markersize=9, markeredgewidth=1.4)
        axes.set(xlim=extent[:2], ylim=extent[2:], title=title)
        axes.set(xlabel="column [px]", ylabel="row [px]" if number == 0 else "")
        _style(axes)
    return _png(figure)


def board_dots(
    images: Mapping[str, np.ndarray], outlines_px: Mapping[str, np.ndarray], measured: Mapping[str, np.ndarray]
) -> bytes:
    """Raw board images with the outline of each dot's light.

    Parameters
    ----------
    images : dict
        Title -> raw board image (rows, columns) [counts].
    outlines_px : dict
        Title -> outlines as (column, row) [pixel], shape (dot, points, 2).
    measured : dict
        Title -> which dots were measured, bool, shape (dot,); the others are dashed.
    """
    figure = _figure(9.6, 3.7)
    for number, (title, image) in enumerate(images.items()):
        axes = figure.add_subplot(1, len(images), number + 1)
        outlines = outlines_px[title]
        low, high = np.percentile(image, [1, 99.9])
        axes.imshow(np.clip((image - low) / max(high - low, 1e-9), 0, 1) ** 0.5, cmap="gray", interpolation="auto")
        for outline, good in zip(outlines, measured[title], strict=True):
            closed = np.vstack([outline, outline[:1]])
            axes.plot(*closed.T, "-" if good else "--", color=COLOURS[1] if good else COLOURS[0], linewidth=0.8)
        if len(outlines):
            middle, reach = outlines.reshape(-1, 2), 0.06
            low_xy, high_xy = middle.min(0), middle.max(0)
            margin = reach * (high_xy - low_xy).max()
            limits = np.clip([low_xy - margin, high_xy + margin], 0, np.array(image.shape)[::-1] - 1)
            axes.set(xlim=limits[:, 0], ylim=limits[::-1, 1])
        axes.set(title=title, xlabel="column [px]", ylabel="row [px]" if number == 0 else "")
        _style(axes)
    return _png(figure)


def error_histogram(errors_pitch: Mapping[str, np.ndarray]) -> bytes:
    """Histogram of each camera's mapping errors on held-out dots [microlens pitch]."""
    figure = _figure(7.2, 3.0)
    axes = figure.add_subplot()
    largest = max(float(np.percentile(errors, 99.5)) for errors in errors_pitch.values())
    bins = np.linspace(0, largest, 60)
    for (name, errors), colour in zip(errors_pitch.items(), _cycle(len(errors_pitch)), strict=True):
        label = f"{name}: mean {errors.mean():.4f}, 95 % below {np.percentile(errors, 95):.4f}"
        axes.hist(errors, bins, density=True, histtype="stepfilled", color=colour, alpha=0.25)
        axes.hist(errors, bins, density=True, histtype="step", color=colour, linewidth=1.4, label=label)
    axes.set(xlabel="distance between mapping and label [microlens pitch]", ylabel="density", xlim=(0, largest))
    _style(axes, legend=True)
    return _png(figure)


def training_history(histories: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> bytes:
    """Training and validation error over the epochs: camera -> (training, validation) [microlens pitch]."""
    figure = _figure(7.2, 2.8)
    axes = figure.add_subplot()
    for (name, (training, validation)), colour in zip(histories.items(), _cycle(len(histories)), strict=True):
        axes.semilogy(training, color=colour, linewidth=1.4, label=f"{name}, training")
        axes.semilogy(validation, color=colour, linewidth=1.4, linestyle="--", label=f"{name}, validation")
    axes.set(xlabel="epoch", ylabel="rms error [pitch]")
    _style(axes, legend=True)
    return _png(figure)


def residual_history(reconstructions: Mapping[str, xr.Dataset]) -> bytes:
    """Image residual over the SMART iterations: label of a pair -> its reconstruction dataset."""
    figure = _figure(7.2, 2.8)
    axes = figure.add_subplot()
    few = len(reconstructions) <= 3
    for (label, dataset), colour in zip(reconstructions.items(), _cycle(len(reconstructions)), strict=True):
        for frame, row, line in zip(dataset["frame"].values, dataset["residual"].values, ("-", "--"), strict=False):
            name = f"{label}, frame {frame}" if few else None
            axes.plot(np.arange(len(row)), row, line, color=colour, linewidth=1.4, label=name)
    axes.set(xlabel="iteration", ylabel="||image - projection|| / ||image||", ylim=(0, None))
    _style(axes, legend=few)
    return _png(figure)


def projections(reconstruction: xr.Dataset, frame: int = 0) -> bytes:
    """Maximum projections of a volume along its three axes, to one scale."""
    x, y, z = (reconstruction[name].values for name in "xyz")
    along_z, along_y, along_x = (reconstruction[f"projection_{name}"].values[frame] for name in "zyx")
    width, height, depth = (max(float(np.ptp(axis)), 1e-9) for axis in (x, y, z))
    scale = 4.6 / max(width, height)
    figure = _figure((width + depth) * scale + 2.2, (height + depth) * scale + 1.1, layout="compressed")
    grid = figure.add_gridspec(2, 2, width_ratios=(width, depth), height_ratios=(depth, height))
    top = float(np.percentile(along_z, 99.7)) or 1.0
    panels = (
        (grid[1, 0], along_z, (x, y), ("x [mm]", "y [mm]")),
        (grid[0, 0], along_y, (x, z), ("", "z [mm]")),
        (grid[1, 1], along_x.T, (z, y), ("z [mm]", "")),
    )
    for place, values, (across, up), (xlabel, ylabel) in panels:
        axes = figure.add_subplot(place)
        image = axes.imshow(
            values, cmap="magma", norm=Normalize(0, top), extent=_extent(across, up), origin="lower", aspect="equal"
        )
        axes.set(xlabel=xlabel, ylabel=ylabel)
        _style(axes)
    bar = figure.colorbar(image, ax=figure.axes, shrink=0.6, location="right")
    _style_bar(bar, "largest intensity along the line of sight [counts]")
    return _png(figure)


def vector_slices(vectors: xr.Dataset, normal: str = "z", most: int = MOST_SLICES) -> bytes:
    """Slices of a vector volume: arrows with their scale for components in the slice, colour for the one across it.

    Parameters
    ----------
    vectors : Dataset
        Dims z, y, x; replaced vectors (not ``valid``) are drawn pale.
    normal : {"z", "y"}
        Axis across the slices.
    most : int
        Largest number of slices, spread evenly; one is taken from the middle.
    """
    across, up = ("x", "y") if normal == "z" else ("x", "z")
    component = {"x": "u", "y": "v", "z": "w"}
    count = vectors.sizes[normal]
    places = [count // 2] if most == 1 else np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    columns = min(3, len(places))
    rows = -(-len(places) // columns)
    apart = {axis: _spacing(vectors[axis].values) for axis in "xyz" if vectors.sizes[axis] > 1}
    apart = {axis: apart.get(axis, min(apart.values(), default=1.0)) for axis in "xyz"}  # a single layer has no spacing
    spans = [float(np.ptp(vectors[axis].values)) + apart[axis] for axis in (across, up)]
    height = 3.2 * rows * float(np.clip(spans[1] / spans[0], 0.4, 1.6)) + 0.6 + KEY_INCH
    figure = _figure(3.3 * columns + 1.2, height, layout="compressed")
    good = vectors["valid"].values & np.isfinite(vectors["u"].values)
    through = np.abs(vectors[component[normal]].values[good])
    inside = np.hypot(vectors[component[across]].values, vectors[component[up]].values)[good]
    limit, longest = (float(np.percentile(values, 99)) if values.size else 1.0 for values in (through, inside))
    norm = Normalize(-(limit or 1.0), limit or 1.0)
    step = max(-(-max(vectors.sizes[across], vectors.sizes[up]) // MOST_ARROWS), 1)
    scale = (longest or 1.0) / (1.3 * step * min(apart[axis] for axis in (across, up)))
    for number, place in enumerate(places):
        axes = figure.add_subplot(rows, columns, number + 1)
        slab = vectors.isel({normal: int(place)}).transpose(up, across)
        edges = (_edges(slab[axis].values, apart[axis]) for axis in (across, up))
        colour = axes.pcolormesh(*edges, slab[component[normal]].values, cmap="RdBu_r", norm=norm, alpha=0.85)
        thin = slab.isel({across: slice(None, None, step), up: slice(None, None, step)})
        for shown, tint in ((thin["valid"].values, "#101418"), (~thin["valid"].values, "#9aa0a6")):
            arrows = [np.where(shown, thin[component[axis]].values, np.nan) for axis in (across, up)]
            quiver = axes.quiver(
                thin[across].values,
                thin[up].values,
                *arrows,
                angles="xy",
                scale_units="xy",
                scale=scale,
                width=0.006,
                color=tint,
            )
        axes.set(aspect="equal", title=f"{normal} = {float(slab[normal]):.2f} mm")
        axes.set(xlabel=f"{across} [mm]", ylabel=f"{up} [mm]" if number % columns == 0 else "")
        _style(axes)
    _style_bar(figure.colorbar(colour, ax=figure.axes, shrink=0.7), f"{component[normal]} [m/s]")
    _arrow_scale(figure, quiver, longest, f"along {across} and {up}")
    return _png(figure)


def displacement_histograms(vectors: xr.Dataset) -> bytes:
    """Histograms of the valid displacements [voxel]; peaks at whole numbers would betray peak locking."""
    figure = _figure(9.0, 2.5)
    valid = vectors["valid"].values
    for number, axis in enumerate("xyz"):
        axes = figure.add_subplot(1, 3, number + 1)
        values = vectors[f"displacement_{axis}"].values[valid]
        values = values[np.isfinite(values)]
        axes.hist(values, int(np.clip(np.sqrt(values.size), 8, 60)), color=COLOURS[number], alpha=0.8)
        axes.set(xlabel=f"displacement {axis} [voxel]", ylabel="vectors" if number == 0 else "")
        _style(axes)
    return _png(figure)


def _microimage_centres(optics: Optics, lattice: LensLattice, corner: tuple[int, int], size: int) -> np.ndarray:
    """Centres (column, row) [pixel] of the microimages in a square crop, X_c = s_l (1 + f_m/s_i)."""
    widening = 1 + optics.sensor_per_pupil
    row, column = corner
    frame = np.array([[column, row], [column + size, row], [column, row + size], [column + size, row + size]]) - 0.5
    index = lattice.nearest(optics.sensor_mm(frame) / widening)
    low, high = index.min(0) - 1, index.max(0) + 1
    lenses = np.stack(np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1], axis=-1).reshape(-1, 2)
    centres = optics.sensor_px(lattice.centres_mm(lenses) * widening)
    inside = ((centres >= frame[0]) & (centres <= frame[3])).all(1)
    return centres[inside]


def _extent(across: np.ndarray, up: np.ndarray) -> tuple[float, float, float, float]:
    """Edges of the outermost voxels."""
    edges = []
    for axis in (across, up):
        half = (axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5
        edges += [axis[0] - half, axis[-1] + half]
    return tuple(edges)


def _arrow_scale(figure: Figure, quiver, longest: float, where: str) -> None:
    """Put an arrow of a round speed [m/s] and what it stands for above the slices."""
    speed = _round_below(longest)
    if speed == 0:
        return
    height = figure.get_figheight()
    figure.get_layout_engine().set(rect=(0, 0, 1, 1 - KEY_INCH / height))
    figure.draw_without_rendering()  # the layout first: the key's length is fixed when it is first drawn
    figure.set_layout_engine("none")
    key = {"labelpos": "E", "coordinates": "figure", "color": INK}
    drawn = figure.axes[0].quiverkey(quiver, 0.0, 1 - KEY_INCH / 2 / height, speed, f"{speed:g} m/s {where}", **key)
    drawn.text.set(color=INK, fontsize=9)
    axes = quiver.axes
    length = speed / quiver.scale * axes.bbox.width / np.ptp(axes.get_xlim())
    drawn.X = (length + 8) / figure.bbox.width  # where its tip lies


def _round_below(value: float) -> float:
    """Largest of 1, 2, 5, 10, ... times a power of ten up to a value; 0 where there is none."""
    if not (np.isfinite(value) and value > 0):
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def _edges(positions: np.ndarray, spacing: float) -> np.ndarray:
    """Edges of evenly spaced cells around positions."""
    return np.append(positions - spacing / 2, positions[-1] + spacing / 2)


def _spacing(positions: np.ndarray) -> float:
    return float(np.median(np.diff(positions))) if positions.size > 1 else 1.0


def _cycle(count: int) -> list[str]:
    return [COLOURS[number % len(COLOURS)] for number in range(count)]


def _figure(width: float, height: float, *, layout: str = "constrained") -> Figure:
    figure = Figure(figsize=(width, height), dpi=DPI, layout=layout)
    FigureCanvasAgg(figure)
    figure.patch.set_alpha(0)
    return figure


def _style(axes, *, legend: bool = False) -> None:
    axes.patch.set_alpha(0)
    axes.title.set(color=INK, fontsize=9)
    axes.xaxis.label.set(color=INK, fontsize=9)
    axes.yaxis.label.set(color=INK, fontsize=9)
    axes.tick_params(colors=INK, labelsize=8)
    for spine in axes.spines.values():
        spine.set(color=INK, linewidth=0.6)
    if legend:
        axes.legend(fontsize=8, labelcolor=INK, frameon=False)


def _style_bar(bar, label: str) -> None:
    bar.set_label(label, color=INK, fontsize=9)
    bar.ax.tick_params(colors=INK, labelsize=8)
    bar.outline.set(color=INK, linewidth=0.6)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", transparent=True)
    return buffer.getvalue()
