"""Figs. 18 and 19: the board's dots reconstructed by SMART at every plane, and their lateral and depth errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.ticker import MaxNLocator
from scipy import ndimage

from lfpiv import metrics
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, store
from lfpiv.reproduce.injector import experimental_rig
from lfpiv.reproduce.rigs import Rig, reconstruct_images
from lfpiv.settings.processing import Smart

TITLE = "Figs. 18 and 19: board dots reconstructed at every plane"

PAPER_LATERAL_MM, PAPER_DEPTH_MM = 0.08, 0.25
VOXEL_SHARE = 0.6
"""Voxel edge over the dots' diameter."""
ITERATIONS = 10
"""SMART iterations, as in the paper."""
DEPTH_MM = 1.2
"""Half depth of each plane's volume [mm]. Rays of two cameras 40 degrees apart to dots 0.5 mm apart also cross 0.69 mm
before and behind the board, so the volume contains these ghosts."""
MARGIN_MM = 0.3
"""Volume beyond the outermost dots [mm]."""
OFF_CENTRE_VOXEL = 0.4
"""Volumes are placed at random by up to this much along each axis, so that dots lie anywhere in a voxel."""
OFF_CENTRE_DEPTH_MM = 0.3
"""The same along depth [mm]. The middle of a volume must not show the depth of its dots."""
GATE = 0.3
"""Largest distance along x and y of a dot from its place on the board, and half width of the window of its centroid
[spacing]."""
NEAR = 3.0
"""Half depth of the window of a dot's centroid [dot diameter]."""
STEPS = 10
"""Number of times that window is centred on its centroid."""
LEAST_SHARE = 0.2
"""Least light of a dot, as a share of the plane's median dot."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Reconstruct all planes of the board; see `lfpiv.reproduce.study` for the arguments. Both scales have 13."""
    rig = experimental_rig(work.parent / "experimental_rig", scale, seed, progress)
    planes = range(len(rig.experiment.board.planes_mm))
    return compute(rig, planes, work, seed=seed, progress=progress)


def compute(rig: Rig, planes: Sequence[int], work: Path, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Reconstruct some planes of a rig's board, except those that `work` holds already."""
    board = rig.experiment.board
    found = []
    for done, plane in enumerate(planes):
        progress(f"plane {plane}", done / len(planes))

        def reconstruct(plane: int = plane) -> dict[str, np.ndarray]:
            return {"positions_mm": reconstruct_plane(rig, plane, seed=seed)}

        arrays = store.cached_arrays(
            work / "planes" / f"plane_{plane:02d}.npz",
            {"seed": seed, "iterations": ITERATIONS, "board": board.model_dump(mode="json")},
            reconstruct,
        )
        found.append(arrays["positions_mm"])
    progress("planes", 1.0)
    positions, planes_mm = np.array(found), [board.planes_mm[plane] for plane in planes]
    error = metrics.dot_error(positions, board.spacing_mm, planes_mm)
    _draw_dots(positions, planes_mm, work / "fig18.png")
    _draw_errors(error, planes_mm, work / "fig19.png")
    return _result(positions, planes_mm, error, rig)


def _true_positions(rig: Rig, planes_mm: Sequence[float]) -> np.ndarray:
    """Return the places of the dots on the board (plane, row, column, 3) [mm]."""
    board = rig.experiment.board
    columns, rows = ((np.arange(n) - (n - 1) / 2) * board.spacing_mm for n in board.dots)
    z, y, x = np.meshgrid(planes_mm, rows, columns, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def _result(positions: np.ndarray, planes_mm: Sequence[float], error: metrics.DotError, rig: Rig) -> dict[str, Any]:
    """Return the result of the page. `positions` has the shape (plane, row, column, 3) [mm]."""
    board = rig.experiment.board
    expected = positions.shape[0] * positions.shape[1] * positions.shape[2]
    rms = np.sqrt(np.nanmean((positions - _true_positions(rig, planes_mm)) ** 2, axis=(0, 1, 2)))
    return page.result(
        {
            "lateral_mm": error.lateral_mean_mm,
            "depth_mm": error.depth_mean_mm,
            "lateral_mm_of_plane": error.lateral_mm,
            "depth_mm_of_interval": error.depth_mm,
            "planes_mm": planes_mm,
            "dots_found": error.found,
            "dots_expected": expected,
            "position_rms_mm": dict(zip("xyz", rms.tolist(), strict=True)),
        },
        comparison=[
            page.compare(
                "lateral error, Eq. 18", error.lateral_mean_mm, paper=PAPER_LATERAL_MM, at_most=0.04, unit="mm"
            ),
            page.compare("depth error, Eq. 19", error.depth_mean_mm, paper=PAPER_DEPTH_MM, at_most=0.12, unit="mm"),
            page.compare("dots found", error.found / expected, at_least=1.0),
            *(
                page.compare(f"rms error of the position along {axis}", float(value), unit="mm")
                for axis, value in zip("xyz", rms, strict=True)
            ),
        ],
        figures=[
            ("fig18.png", f"Reconstructed centres of {error.found} of {expected} dots, coloured by depth."),
            (
                "fig19.png",
                "Mean error of the spacing of neighbouring dots, and of adjacent planes' distance, by depth.",
            ),
        ],
        notes=[
            f"Each plane's images are reconstructed by {ITERATIONS} SMART iterations in a volume of "
            f"{VOXEL_SHARE * board.dot_diameter_mm:g} mm voxels, 2 x {DEPTH_MM:g} mm deep, around the stage's depth "
            f"to within {OFF_CENTRE_DEPTH_MM:g} mm. A dot is the brightest light within {GATE:g} spacings of its "
            "place on the board along x and y, at any depth; its position is the centroid of the light around it.",
            "The calibration uses the same images, as in the paper. So the figures show how well mapping, weights and "
            "SMART agree, with the noise of these images.",
            "The voxels are smaller than the dots. In the paper's voxels of 0.1 mm most of the light goes to ghosts, "
            "the crossings of the two cameras' rays between the dots.",
            "The paper states a spacing of 0.5 mm in section 5.1 and of 1 mm below Eq. 18; here it is "
            f"{board.spacing_mm:g} mm.",
        ],
    )


def reconstruct_plane(rig: Rig, plane: int, *, seed: int) -> np.ndarray:
    """Reconstruct the board at one plane and find its dots: positions (row, column, 3) [mm], NaN for missing dots."""
    board = rig.experiment.board
    voxel = VOXEL_SHARE * board.dot_diameter_mm
    rng = np.random.default_rng([seed, 19, plane])
    shift = OFF_CENTRE_VOXEL * voxel * rng.uniform(-1, 1, 3)
    shift[2] = OFF_CENTRE_DEPTH_MM * rng.uniform(-1, 1)
    across, up = ((n - 1) * board.spacing_mm + 2 * MARGIN_MM for n in board.dots)
    grid = Grid.from_extent(
        centre_mm=tuple(np.array([0.0, 0.0, board.planes_mm[plane]]) + shift),
        size_mm=(across, up, 2 * DEPTH_MM),
        voxel_mm=voxel,
    )
    images = {name: rig.experiment.board_image(name, plane) for name in rig.calibration.cameras}
    volume = reconstruct_images(rig.weights(grid, "network"), images, Smart(iterations=ITERATIONS))
    return locate_dots(volume, board.dots, board.spacing_mm, board.dot_diameter_mm)


def locate_dots(volume: xr.DataArray, dots: tuple[int, int], spacing_mm: float, diameter_mm: float) -> np.ndarray:
    """Find the dots of a board, centred at x = y = 0, in a reconstructed volume.

    Parameters
    ----------
    volume : DataArray, dims (z, y, x)
        Intensities, with coordinates [mm].
    dots : (int, int)
        Dots along x and y.
    spacing_mm, diameter_mm : float
        Distance and size of the dots [mm].

    Returns
    -------
    ndarray, shape (row, column, 3)
        Centroid (x, y, z) of each dot's light [mm]; NaN where there is none.
    """
    z, y, x = (volume[axis].values for axis in "zyx")
    values = np.asarray(volume.values, float)
    smooth = ndimage.gaussian_filter(values, diameter_mm / 2 / abs(x[1] - x[0]))
    peaks = np.where(
        smooth == ndimage.maximum_filter(smooth, 3), smooth, 0.0
    )  # only local maxima: the flank of a ghost is not a dot
    found = np.full((dots[1], dots[0], 3), np.nan)
    light = np.zeros((dots[1], dots[0]))
    half = np.array([GATE * spacing_mm, GATE * spacing_mm, NEAR * diameter_mm])
    for row, column in np.ndindex(dots[1], dots[0]):
        place = ((column - (dots[0] - 1) / 2) * spacing_mm, (row - (dots[1] - 1) / 2) * spacing_mm)
        near_x, near_y = (np.abs(axis - at) <= GATE * spacing_mm for axis, at in zip((x, y), place, strict=True))
        peak = peaks[:, near_y][:, :, near_x]
        if not peak.any():
            continue
        top = np.unravel_index(peak.argmax(), peak.shape)
        centre = np.array([x[near_x][top[2]], y[near_y][top[1]], z[top[0]]])
        for _ in range(STEPS):  # a fixed window would bias the centroid towards its middle
            inside = [np.abs(axis - at) <= edge for axis, at, edge in zip((x, y, z), centre, half, strict=True)]
            bright = values[np.ix_(*inside[::-1])]
            light[row, column] = bright.sum()
            if not light[row, column] > 0:
                break
            sums = (bright.sum((0, 1)), bright.sum((0, 2)), bright.sum((1, 2)))
            centre = np.array(
                [np.average(axis[part], weights=w) for axis, part, w in zip((x, y, z), inside, sums, strict=True)]
            )
        if light[row, column] > 0:
            found[row, column] = centre
    found[light < LEAST_SHARE * np.median(light)] = np.nan
    return found


def _draw_dots(positions: np.ndarray, planes_mm: Sequence[float], path: Path) -> None:
    drawn = plots.figure(8, 3.8)
    axes: Any = drawn.add_subplot(projection="3d")  # matplotlib does not type axes in space
    x, y, z = positions.reshape(-1, 3).T
    shown = axes.scatter(z, x, y, c=z, cmap="turbo", s=7, depthshade=False, vmin=min(planes_mm), vmax=max(planes_mm))
    axes.set(xlabel="z [mm]", ylabel="x [mm]", zlabel="y [mm]")
    axes.set_box_aspect((2.4, 1.2, 1.1), zoom=1.3)
    axes.view_init(elev=20, azim=-56)
    for axis in (axes.yaxis, axes.zaxis):  # short axes, seen from the side
        axis.set_major_locator(MaxNLocator(3, steps=(1, 2, 5, 10)))
    axes.xaxis.labelpad = 12
    drawn.colorbar(shown, ax=axes, shrink=0.7, pad=0.1, label="z [mm]")
    plots.save(drawn, path)


def _draw_errors(error: metrics.DotError, planes_mm: Sequence[float], path: Path) -> None:
    drawn = plots.figure(7, 3.2)
    axes = drawn.subplots()
    blue, orange = "#2f81d6", "#e0762a"
    axes.plot(planes_mm, 1000 * error.lateral_mm, "o-", color=blue, label="lateral, Eq. 18", ms=4)
    between = (np.array(planes_mm[1:]) + planes_mm[:-1]) / 2
    axes.plot(between, 1000 * error.depth_mm, "s-", color=orange, label="depth, Eq. 19", ms=4)
    for value, colour, name in ((PAPER_LATERAL_MM, blue, "lateral"), (PAPER_DEPTH_MM, orange, "depth")):
        axes.axhline(1000 * value, color=colour, ls=":", lw=1, label=f"the paper's mean, {name}")
    axes.set(xlabel="z [mm]", ylabel="mean error [µm]", yscale="log")
    plots.plain(axes)
    axes.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plots.save(drawn, path)
