"""Draw how the microimages of a camera fit their lattice, over the sensor and in two crops of the white image."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import PathPatch

from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.report import markup
from lfpiv.report.lens_map import LensMap, lattice_px, lens_map
from lfpiv.report.markup import number
from lfpiv.report.svg import arrows, colour_bar, new_panel, spread_ticks, style, to_svg

CROP_LENSES = 7
"""Number of microimages along the edge of a crop of the white image."""


def lens_figure(experiment: Experiment, setup: CameraSetup, camera: CalibratedCamera) -> str:
    """Draw how the microimages of a camera fit their lattice; tabulate the cells of the sensor."""
    white, optics = experiment.white(setup.name), setup.optics
    found = lens_map(white, experiment.dark(setup.name), optics, camera.lattice)
    edge = crop_edge(white.shape, optics)
    corner, name = _worst_corner(found, white.shape, edge)
    middle = tuple((n - edge) // 2 for n in white.shape)
    shown = [
        lens_residuals(found, white.shape),
        white_crop(white, optics, camera.lattice, middle, "middle of the sensor"),
        white_crop(white, optics, camera.lattice, corner, f"{name}: the worst corner"),
    ]
    rows = [
        [
            f"{row:.0f}, {column:.0f}",
            str(found.count[i, j]),
            number(found.mean_px[i, j, 0], 4),
            number(found.mean_px[i, j, 1], 4),
            number(found.rms_px[i, j], 4),
        ]
        for i, row in enumerate(found.row_px)
        for j, column in enumerate(found.column_px)
    ]
    titles = ["row, column [px]", "microimages", "mean Δcolumn [px]", "mean Δrow [px]", "rms [px]"]
    caption = (
        f"Microlens array of {setup.name}: {found.measured:,} microimages lie {found.total_rms_px:.3f} px (rms) off "
        f"the lattice; {found.left_out:,} were left out as dark or far off. Arrows are the mean of a cell, measured "
        "minus lattice: a pattern means a wrong lattice, random directions mean noise. Crosses should "
        "sit in the middle of every microimage."
    )
    table = markup.table(titles, rows, caption=f"Microimages of {setup.name} off the lattice, by cell of the sensor")
    return markup.figure(shown, caption, table)


def _worst_corner(found: LensMap, shape: tuple[int, int], edge: int) -> tuple[tuple[int, int], str]:
    """Find the corner with the largest rms distance from the lattice; return the crop's (row, column) and a name."""
    places = {
        "top left": (0, 0, 0, 0),
        "top right": (0, -1, 0, shape[1] - edge),
        "bottom left": (-1, 0, shape[0] - edge, 0),
        "bottom right": (-1, -1, shape[0] - edge, shape[1] - edge),
    }
    rms = {name: np.nan_to_num(found.rms_px[place[:2]], nan=np.inf) for name, place in places.items()}
    name = max(rms, key=rms.__getitem__)
    return places[name][2:], name


def lens_residuals(found: LensMap, shape: tuple[int, int]) -> str:
    """Draw the distance of microimages from their lattice over the sensor: rms as colour, mean as arrows."""
    rows, columns = shape
    figure, axes = new_panel(2.5 if columns >= rows else 3.4)
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
    """Draw the part of the white image that starts at `corner` (row, column), with the fitted microimage centres."""
    size = crop_edge(white.shape, optics)
    row, column = corner
    crop = white[row : row + size, column : column + size]
    figure, axes = new_panel(3.1)
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
    """Return the edge of a crop of the white image [pixel]."""
    return int(min(*shape, np.ceil(CROP_LENSES * optics.microimage_pitch_px)))


def _centres_inside(optics: Optics, lattice: LensLattice, extent: tuple[float, float, float, float]) -> np.ndarray:
    """Return the microimage centres (column, row) [pixel] in a part of the sensor (left, right, bottom, top)."""
    left, right, bottom, top = extent
    origin, basis = lattice_px(optics, lattice)
    corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom]])
    index = (corners - origin) @ np.linalg.inv(basis)
    low, high = np.floor(index.min(0)).astype(int), np.ceil(index.max(0)).astype(int)
    lenses = np.moveaxis(np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1], 0, -1).reshape(-1, 2)
    centres: np.ndarray = origin + lenses @ basis
    return centres[((centres >= (left, top)) & (centres <= (right, bottom))).all(1)]
