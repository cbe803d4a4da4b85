"""Write the report's section on the calibration: figures, microimages, board images and mapping of each camera."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import PathPatch, Polygon, Rectangle

from lfpiv.calibration.board.dot_model import zone_middles
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.errors import BoardErrors
from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import float_pair
from lfpiv.report import markup
from lfpiv.report.board_errors import board_part
from lfpiv.report.dot_map import DotMap, dot_map, dot_outlines_px, rms_by
from lfpiv.report.lens_figure import lens_figure
from lfpiv.report.markup import number, significant
from lfpiv.report.summary import CameraFigures
from lfpiv.report.svg import INK, SERIES, arrows, colour_bar, new_panel, spread_ticks, style, to_svg

PERCENTILES = (50, 75, 90, 95, 99)
"""Percentiles of the errors of held-out labels in the table [%]."""
PHOTO_WIDTH = 640
"""Largest edge of a board image in the page [pixel], twice the width of a panel."""
BINS = 50
"""Number of bins of a histogram of errors."""
WORST_DOTS = 15
"""Number of dots in the table of the largest errors."""

_ROWS = (
    ("estimated error of the mapping, σ_nor [pitch]", "sigma_nor_test", 4),
    ("distance to held-out dots as stated (Eq. 8) [pitch]", "sigma_nor_stated", 4),
    ("dots measured", "dots_found", 0),
    ("dots in the field", "dots_expected", 0),
    ("labels", "labels", 0),
    ("lens array off its lattice, rms [px]", "lens_array_rms_px", 4),
    ("microimage pitch [px]", "lens_array_pitch_px", 4),
    ("roll of the lens array [°]", "lens_array_rotation_deg", 3),
    ("magnification in the board's middle", "magnification", 4),
    ("turn from the nominal pose [°]", "turn_from_nominal_deg", 2),
    ("network's correction to the thin lens, rms [pitch]", "network_correction_pitch", 4),
    ("training epochs", "epochs", 0),
    ("training [s]", "training_s", 1),
)


def section(experiment: Experiment, calibration: Calibration, figures: Mapping[str, CameraFigures]) -> str:
    """Return the section on the calibration, as HTML.

    Parameters
    ----------
    experiment : Experiment
        Source of the white and board images.
    calibration : Calibration
        Calibration of the run.
    figures : dict
        Camera -> figures of its calibration.
    """
    values = {key: [getattr(camera, key) for camera in figures.values()] for _, key, _ in _ROWS}
    rows = [
        [title, *(number(value, digits) for value in values[key])]
        for title, key, digits in _ROWS
        if any(value is not None for value in values[key])
    ]
    folded = [
        markup.table(["camera", *figures], rows, caption="Figures of the calibration by camera"),
        markup.paragraph("A pitch is the distance between microlenses; errors in pitches lie on the microlens array."),
    ]
    if calibration.board is not None:
        folded.append(board_part(calibration.board))
    for setup in experiment.cameras:
        camera = calibration.cameras[setup.name]
        folded.append(f"<h3>{markup.escape(setup.name)}</h3>")
        folded.append(lens_figure(experiment, setup, camera))
        found = dot_map(camera)
        folded.append(_board_figure(experiment, setup, camera, found, calibration.board))
        if found is not None:
            folded.append(_mapping_figure(experiment, camera, found))
    heading = '<h2 id="calibration">Calibration</h2>' + markup.paragraph(_overview(figures))
    title = "Microlens arrays, board and mapping of each camera"
    return heading + markup.details(title, "\n".join(folded), name="calibration-fold")


def _overview(figures: Mapping[str, CameraFigures]) -> str:
    """State the error of the mapping and the dots of each camera."""
    texts = [
        f"{name}: {significant(camera.sigma_nor_test, 2)} pitch"
        + (f", {camera.dots_found:,} of {camera.dots_expected:,} dots" if camera.dots_expected else "")
        for name, camera in figures.items()
        if camera.sigma_nor_test is not None
    ]
    if not texts:
        return "Rays by the nominal geometry, without a board."
    return f"Error of the mapping: {'; '.join(texts)}. A pitch is the distance between microlenses."


def _board_figure(
    experiment: Experiment,
    setup: CameraSetup,
    camera: CalibratedCamera,
    found: DotMap | None,
    errors: BoardErrors | None,
) -> str:
    """Draw the first, middle and last plane by depth; tabulate all planes."""
    board = experiment.board
    stated = DotBoard.from_settings(board)
    order = np.argsort(board.planes_mm)
    known = np.zeros(0, int) if camera.dots is None else camera.dots.measured_dot
    shown = []
    for plane in dict.fromkeys((order[0], order[len(order) // 2], order[-1])):
        depth = board.planes_mm[plane]
        numbers = plane * stated.size + np.flatnonzero(stated.occupied)
        points = stated.of_dots_mm(numbers) if errors is None else errors.points_mm(stated, numbers)
        outlines = dot_outlines_px(camera.map, setup.optics, points)
        measured = np.isin(numbers, known)
        photo = experiment.board_image(setup.name, int(plane))
        shown.append(board_photo(photo, outlines, measured, f"z = {markup.general(depth)} mm"))
    caption = (
        f"Board of {setup.name}, brightness by its square root, with the outline of each dot's light as the calibrated "
        "mapping predicts it. Dots and outlines should coincide in all planes. Dashed: not measured."
    )
    return markup.figure(shown, caption, "" if found is None else _plane_table(experiment, camera, found, order))


def _plane_table(experiment: Experiment, camera: CalibratedCamera, found: DotMap, order: np.ndarray) -> str:
    """Tabulate counts and errors of the dots, by plane of the board."""
    board, dots = experiment.board, found.dots
    plane_of = found.number // (board.dots[0] * board.dots[1])
    rows = []
    for plane in order:
        here = plane_of == plane
        error, noise = found.error[here], found.label_rms[here]
        rows.append(
            [
                markup.general(board.planes_mm[plane]),
                str(int(dots.expected[plane])),
                str(int(dots.found[plane])),
                str(int(dots.rejected[plane])),
                number(float(np.sqrt((error**2).mean())) if here.any() else None, 4),
                number(float(error.max()) if here.any() else None, 4),
                number(float(np.sqrt((noise**2).mean())) if here.any() else None, 4),
            ]
        )
    titles = [
        "z [mm]",
        "in the field",
        "measured",
        "not trusted",
        "mapping, rms [pitch]",
        "mapping, largest [pitch]",
        "labels, rms [pitch]",
    ]
    return markup.table(titles, rows, caption=f"Dots of {camera.name} by plane of the board")


def _mapping_figure(experiment: Experiment, camera: CalibratedCamera, found: DotMap) -> str:
    """Draw the errors of the mapping at the dots and of the held-out labels; tabulate the worst."""
    board, grid = experiment.board, experiment.grid
    shown = [mapping_field(found, board.dots, grid, depth=depth) for depth in (False, True)]
    numbers = markup.table(
        ["x, y, z [mm]", "labels", "mapping [pitch]", "labels, rms [pitch]"],
        _worst_dots(found),
        caption=f"Dots of {camera.name} with the largest error of the mapping",
    )
    held_out = camera.test_errors
    if held_out is not None and len(held_out):
        shown.append(error_histogram(np.asarray(held_out)))
        rows = [["mean (Eq. 8)", number(float(held_out.mean()), 4)]]
        rows += [[f"{share} % below", number(float(np.percentile(held_out, share)), 4)] for share in PERCENTILES]
        rows += [["largest", number(float(held_out.max()), 4)], ["labels", f"{len(held_out):,}"]]
        table = markup.table(
            ["held-out labels", "[pitch]"], rows, caption=f"Errors of held-out labels of {camera.name}"
        )
        numbers = table + numbers
    left_over = np.zeros((0, 0, 2)) if camera.dots is None else camera.dots.left_over_mm
    if left_over.any():
        shown.append(pupil_residual(left_over.mean(0) / camera.lattice.pitch_mm))
    rms = float(np.sqrt((found.error**2).mean()))
    caption = (
        f"Mapping of {camera.name} against its dots, over the field and over the depth: for each dot the mean over its "
        f"rays, {rms:.4f} pitch (rms of {len(found.number):,} dots), rms over the third axis. Position errors of the "
        "dots are included. The dashed frame is the volume: where it holds no dots, the mapping is not checked. "
        "Held-out labels are single rays of dots that the training did not see."
    )
    return markup.figure(shown, caption, numbers)


def pupil_residual(displacement: np.ndarray) -> str:
    """Draw how far the light of the dots lies beside the fitted rays, by zone of the pupil (zone, 2) [pitch]."""
    figure, axes = new_panel(3.1)
    middle, size = zone_middles(), np.linalg.norm(displacement, axis=1)
    shown = axes.scatter(*middle.T, c=size, s=60, cmap="viridis", vmin=0)
    step = displacement * (0.2 / max(float(size.max()), 1e-12))
    axes.add_patch(PathPatch(arrows(middle, step, 0.07), edgecolor=INK, fill=False, lw=1.1))
    axes.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal")
    title = f"light beside the fitted rays, up to {size.max():.3f} pitch"
    style(axes, title=title, xlabel="u [pupil radii]", ylabel="v [pupil radii]")
    colour_bar(figure, shown, axes, "[pitch]")
    return to_svg(figure, f"Map over the pupil: {title}.")


def _worst_dots(found: DotMap) -> list[list[str]]:
    """Return table rows of the `WORST_DOTS` dots with the largest errors."""
    worst = np.argsort(-found.error, kind="stable")[:WORST_DOTS]
    return [
        [
            ", ".join(map(markup.general, found.position_mm[dot].round(6))),
            str(found.labels[dot]),
            number(found.error[dot], 4),
            number(found.label_rms[dot], 4),
        ]
        for dot in worst
    ]


def board_photo(image: np.ndarray, outlines_px: np.ndarray, measured: np.ndarray, title: str) -> str:
    """Draw a raw board image with the outline of each dot's light, dashed for dots that were not measured."""
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
    figure, axes = new_panel(float(np.clip(3.2 * (bottom - top) / (right - left), 1.6, 3.4)) + 0.5)
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
    """Draw the error of the mapping at the dots over x and y, or over x and z: rms over the third axis."""
    nx, per_plane = board_dots[0], board_dots[0] * board_dots[1]
    plane, place = np.divmod(dots.number, per_plane)
    key = np.stack([plane, place % nx], axis=1) if depth else place[:, None]
    first, rms = rms_by(key, dots.error)
    up = 2 if depth else 1
    at = dots.position_mm[first][:, [0, up]]
    figure, axes = new_panel(2.8)
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
    """Draw a histogram of the errors of held-out labels [microlens pitch]."""
    figure, axes = new_panel(2.8)
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
