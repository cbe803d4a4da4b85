"""Panels of the calibration: microimages and their lattice, the board's dots, errors of the mapping."""

from __future__ import annotations

import cv2
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import PathPatch, Polygon, Rectangle

from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import LensLattice, Optics, float_pair
from lfpiv.report.dot_map import DotMap, rms_by
from lfpiv.report.lens_map import LensMap, lattice_px
from lfpiv.report.svg import INK, SERIES, arrows, colour_bar, new_panel, spread_ticks, style, to_svg

CROP_LENSES = 7
"""Microimages along the edge of a crop of the white image."""
PHOTO_WIDTH = 640
"""Most pixels along an edge of a photograph: twice what a panel shows."""
BINS = 50
"""Bins of a histogram of errors."""


def lens_residuals(found: LensMap, shape: tuple[int, int]) -> str:
    """Map of the distances of microimages from their lattice over the sensor; arrows are the mean of each cell."""
    rows, columns = shape
    figure, (axes,) = new_panel(2.5 if columns >= rows else 3.4)
    extent = (-0.5, columns - 0.5, rows - 0.5, -0.5)
    shown = axes.imshow(found.rms_px, cmap="viridis", extent=extent, interpolation="none", vmin=0)
    longest = float(np.nanmax(np.hypot(*np.moveaxis(found.mean_px, -1, 0)), initial=0.0))
    cell = columns / len(found.column_px)
    if longest > 0:
        start = np.stack(np.meshgrid(found.column_px, found.row_px), axis=-1).reshape(-1, 2)
        step = found.mean_px.reshape(-1, 2) * (cell / longest)
        axes.add_patch(PathPatch(arrows(start - step / 2, step, 0.35 * cell), edgecolor="#ffffff", fill=False, lw=1.1))
    axes.set(xlim=extent[:2], ylim=extent[2:])
    title = f"off the lattice; longest mean {longest:.3f} px"
    style(axes, title=title, xlabel="column [px]", ylabel="row [px]")
    spread_ticks(axes)
    colour_bar(figure, shown, axes, "rms [px]")
    return to_svg(
        figure, f"Map over the sensor: microimages lie {found.total_rms_px:.3f} px rms off the lattice; {title}."
    )


def white_crop(white: np.ndarray, optics: Optics, lattice: LensLattice, corner: tuple[int, int], title: str) -> str:
    """Part of the white image from (row, column) on, with the fitted centres of the microimages."""
    size = crop_edge(white.shape, optics)
    row, column = corner
    crop = white[row : row + size, column : column + size]
    figure, (axes,) = new_panel(3.1)
    extent = (column - 0.5, column + size - 0.5, row + size - 0.5, row - 0.5)
    top = max(float(np.percentile(crop, 99.5)), 1e-9)
    axes.imshow(crop, cmap="gray", extent=extent, vmin=0, vmax=top, interpolation="none")
    centres = _centres_inside(optics, lattice, extent)
    axes.plot(*centres.T, "+", color="#ff8a3c", markersize=8, markeredgewidth=1.3)
    axes.set(xlim=extent[:2], ylim=extent[2:])
    style(axes, title=title, xlabel="column [px]", ylabel="row [px]")
    spread_ticks(axes)
    return to_svg(figure, f"White image, {title}: each microimage with the fitted centre marked.")


def crop_edge(shape: tuple[int, int], optics: Optics) -> int:
    """Edge of a crop of the white image [pixel]."""
    return int(min(*shape, np.ceil(CROP_LENSES * optics.microimage_pitch_px)))


def board_photo(image: np.ndarray, outlines_px: np.ndarray, measured: np.ndarray, title: str) -> str:
    """Raw board image with the outline of each dot's light; dashed where a dot was not measured."""
    rows, columns = image.shape
    low, high = np.zeros(2), np.array([columns, rows]) - 1.0
    if len(outlines_px):
        ends = outlines_px.reshape(-1, 2).min(0), outlines_px.reshape(-1, 2).max(0)
        margin = 0.06 * (ends[1] - ends[0]).max()
        low, high = np.clip([ends[0] - margin, ends[1] + margin], 0, high)
    left, top = np.floor(low).astype(int)
    right, bottom = np.maximum(np.ceil(high).astype(int), [left + 1, top + 1])
    crop = np.asarray(image[top : bottom + 1, left : right + 1], np.float32)
    dim, bright = np.percentile(crop, [1, 99.9])
    crop = np.sqrt(np.clip((crop - dim) / max(bright - dim, 1e-9), 0, 1))
    shrink = min(PHOTO_WIDTH / max(crop.shape), 1.0)
    if shrink < 1:
        crop = cv2.resize(crop, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    figure, (axes,) = new_panel(float(np.clip(3.2 * (bottom - top) / (right - left), 1.6, 3.4)) + 0.5)
    extent = (left - 0.5, right + 0.5, bottom + 0.5, top - 0.5)
    axes.imshow(crop, cmap="gray", extent=extent, vmin=0, vmax=1, interpolation="none")
    for outline, good in zip(outlines_px, measured, strict=True):
        colour, dashes = ("#ff8a3c", "-") if good else ("#59b2ff", "--")
        axes.add_patch(Polygon(outline, closed=True, fill=False, edgecolor=colour, linestyle=dashes, linewidth=0.9))
    axes.set(xlim=extent[:2], ylim=extent[2:])
    style(axes, title=title, xlabel="column [px]", ylabel="row [px]")
    spread_ticks(axes)
    return to_svg(figure, f"Board image, {title}: {int(measured.sum())} of {len(measured)} dots measured, outlined.")


def mapping_field(dots: DotMap, board_dots: tuple[int, int], grid: Grid, *, depth: bool) -> str:
    """Error of the mapping at the dots over the field (x, y), or over x and the depth z; rms over the third axis."""
    nx, per_plane = board_dots[0], board_dots[0] * board_dots[1]
    plane, place = np.divmod(dots.number, per_plane)
    key = np.stack([plane, place % nx], axis=1) if depth else place[:, None]
    first, rms = rms_by(key, dots.error)
    up = 2 if depth else 1
    at = dots.position_mm[first][:, [0, up]]
    figure, (axes,) = new_panel(2.8)
    side = 150 / (1 + max(len(np.unique(column)) for column in at.T))
    shown = axes.scatter(
        *at.T,
        c=rms,
        s=min(side, 16) ** 2,
        marker="s",
        cmap="viridis",
        norm=Normalize(0, max(float(rms.max()), 1e-12)),
        linewidths=0,
    )
    low, high = ([grid.axis_mm(axis)[end] for axis in (2, 2 - up)] for end in (0, -1))
    corner, size = np.array(low) - grid.voxel_mm / 2, np.array(high) - np.array(low) + grid.voxel_mm
    axes.add_patch(Rectangle(float_pair(corner), *size, fill=False, edgecolor=INK, linestyle="--", linewidth=1))
    axes.margins(0.08)
    axes.autoscale_view()
    name = "yz"[depth]
    style(axes, title=f"over x and {name}", xlabel="x [mm]", ylabel=f"{name} [mm]")
    if not depth:
        axes.set_aspect("equal")
    spread_ticks(axes)
    colour_bar(figure, shown, axes, "rms error [pitch]")
    return to_svg(
        figure,
        f"Error of the mapping at the dots over x and {name}: {rms.min():.4f} to {rms.max():.4f} microlens pitch; "
        "the dashed frame is the volume.",
    )


def error_histogram(errors_pitch: np.ndarray) -> str:
    """Histogram of the errors of held-out labels [microlens pitch]."""
    figure, (axes,) = new_panel(2.8)
    largest = max(float(np.percentile(errors_pitch, 99.5)), 1e-9)
    axes.hist(errors_pitch, np.linspace(0, largest, BINS + 1), color=SERIES[0], alpha=0.8)
    mean = float(errors_pitch.mean())
    axes.axvline(mean, color=INK, linewidth=1.2, linestyle="--")
    axes.set(xlim=(0, largest))
    style(
        axes,
        title=f"held-out labels; mean {mean:.4f} (dashed)",
        xlabel="mapping to label [microlens pitch]",
        ylabel="labels",
    )
    spread_ticks(axes)
    return to_svg(figure, f"Histogram of the distance between mapping and held-out labels, mean {mean:.4f} pitch.")


def _centres_inside(optics: Optics, lattice: LensLattice, extent: tuple[float, float, float, float]) -> np.ndarray:
    """Centres (column, row) [pixel] of the microimages in a part of the sensor (left, right, bottom, top)."""
    left, right, bottom, top = extent
    origin, basis = lattice_px(optics, lattice)
    corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom]])
    index = (corners - origin) @ np.linalg.inv(basis)
    low, high = np.floor(index.min(0)).astype(int), np.ceil(index.max(0)).astype(int)
    lenses = np.moveaxis(np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1], 0, -1).reshape(-1, 2)
    centres: np.ndarray = origin + lenses @ basis
    return centres[((centres >= (left, top)) & (centres <= (right, bottom))).all(1)]
