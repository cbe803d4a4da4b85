"""The report's section on the calibration: figures of each camera, its microimages, its board, its mapping."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.report import calibration_panels as panels
from lfpiv.report import markup
from lfpiv.report.dot_map import DotMap, dot_map, dot_outlines_px
from lfpiv.report.lens_map import LensMap, lens_map
from lfpiv.report.markup import number

PERCENTILES = (50, 75, 90, 95, 99)
"""Percentiles of the errors of held-out labels."""

_ROWS = (
    ("error on held-out dots, σ_nor (Eq. 8) [pitch]", "sigma_nor_test", 4),
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


def section(experiment: Experiment, calibration: Calibration, summary: Mapping[str, Any]) -> str:
    """Write the section on the calibration.

    Parameters
    ----------
    experiment : Experiment
        Its white and board images are shown.
    calibration : Calibration
        The calibration that was used.
    summary : dict
        The content of ``summary.json``.
    """
    reports = summary["calibration"]
    rows = [
        [title, *(number(report.get(key), digits) for report in reports.values())]
        for title, key, digits in _ROWS
        if any(report.get(key) is not None for report in reports.values())
    ]
    parts = [
        '<h2 id="calibration">Calibration</h2>',
        markup.table(["camera", *reports], rows, caption="Figures of the calibration by camera"),
        markup.paragraph("A pitch is the distance between microlenses; errors in pitches lie on the microlens array."),
    ]
    for setup in experiment.cameras:
        camera = calibration.cameras[setup.name]
        parts.append(f"<h3>{markup.escape(setup.name)}</h3>")
        parts.append(_lens_figure(experiment, setup, camera))
        found = dot_map(camera)
        parts.append(_board_figure(experiment, setup, camera, found))
        if found is not None:
            parts.append(_mapping_figure(experiment, camera, found))
    return "\n".join(parts)


def _lens_figure(experiment: Experiment, setup: CameraSetup, camera: CalibratedCamera) -> str:
    white, optics = experiment.white(setup.name), setup.optics
    found = lens_map(white, experiment.dark(setup.name), optics, camera.lattice)
    edge = panels.crop_edge(white.shape, optics)
    corner, name = _worst_corner(found, white.shape, edge)
    middle = tuple((n - edge) // 2 for n in white.shape)
    shown = [
        panels.lens_residuals(found, white.shape),
        panels.white_crop(white, optics, camera.lattice, middle, "middle of the sensor"),
        panels.white_crop(white, optics, camera.lattice, corner, f"{name}: the worst corner"),
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
        "minus lattice: where they follow a pattern, the lattice is wrong; at random, they are noise. Crosses should "
        "sit in the middle of every microimage."
    )
    table = markup.table(titles, rows, caption=f"Microimages of {setup.name} off the lattice, by cell of the sensor")
    return markup.figure(shown, caption, table)


def _worst_corner(found: LensMap, shape: tuple[int, int], edge: int) -> tuple[tuple[int, int], str]:
    """Corner of the sensor whose cell is farthest off the lattice: its first row and column, and its name."""
    places = {
        "top left": (0, 0, 0, 0),
        "top right": (0, -1, 0, shape[1] - edge),
        "bottom left": (-1, 0, shape[0] - edge, 0),
        "bottom right": (-1, -1, shape[0] - edge, shape[1] - edge),
    }
    rms = {name: np.nan_to_num(found.rms_px[place[:2]], nan=np.inf) for name, place in places.items()}
    name = max(rms, key=rms.__getitem__)
    return places[name][2:], name


def _board_figure(experiment: Experiment, setup: CameraSetup, camera: CalibratedCamera, found: DotMap | None) -> str:
    """First, middle and last plane by depth; figures of all planes."""
    board = experiment.board
    per_plane = board.dots[0] * board.dots[1]
    order = np.argsort(board.planes_mm)
    known = np.zeros(0, int) if camera.dots is None else camera.dots.measured_dot
    shown = []
    for plane in dict.fromkeys((order[0], order[len(order) // 2], order[-1])):
        depth = board.planes_mm[plane]
        outlines = dot_outlines_px(camera.map, setup.optics, board.dots, board.spacing_mm, depth)
        measured = np.isin(plane * per_plane + np.arange(per_plane), known)
        photo = experiment.board_image(setup.name, int(plane))
        shown.append(panels.board_photo(photo, outlines, measured, f"z = {markup.general(depth)} mm"))
    caption = (
        f"Board of {setup.name}, brightness by its square root, with the outline of each dot's light as the calibrated "
        "mapping predicts it. Dots and outlines should coincide in all planes. Dashed: not measured."
    )
    return markup.figure(shown, caption, "" if found is None else _plane_table(experiment, camera, found, order))


def _plane_table(experiment: Experiment, camera: CalibratedCamera, found: DotMap, order: np.ndarray) -> str:
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
    board, grid = experiment.board, experiment.grid
    shown = [panels.mapping_field(found, board.dots, grid, depth=depth) for depth in (False, True)]
    numbers = markup.table(
        ["x, y, z [mm]", "labels", "mapping [pitch]", "labels, rms [pitch]"],
        _worst_dots(found),
        caption=f"Dots of {camera.name} with the largest error of the mapping",
    )
    held_out = camera.test_errors
    if held_out is not None and len(held_out):
        shown.append(panels.error_histogram(np.asarray(held_out)))
        rows = [["mean, σ_nor", number(float(held_out.mean()), 4)]]
        rows += [[f"{share} % below", number(float(np.percentile(held_out, share)), 4)] for share in PERCENTILES]
        rows += [["largest", number(float(held_out.max()), 4)], ["labels", f"{len(held_out):,}"]]
        table = markup.table(
            ["held-out labels", "[pitch]"], rows, caption=f"Errors of held-out labels of {camera.name}"
        )
        numbers = table + numbers
    rms = float(np.sqrt((found.error**2).mean()))
    caption = (
        f"Mapping of {camera.name} against its dots, over the field and over the depth: for each dot the mean over its "
        f"rays, {rms:.4f} pitch (rms of {len(found.number):,} dots), rms over the third axis. What a dot's own place "
        "errs by is part of it. The dashed frame is the volume: where it holds no dots, nothing is known of the "
        "mapping. Held-out labels are single rays of dots that the training did not see."
    )
    return markup.figure(shown, caption, numbers)


def _worst_dots(found: DotMap, most: int = 15) -> list[list[str]]:
    worst = np.argsort(-found.error, kind="stable")[:most]
    return [
        [
            ", ".join(map(markup.general, found.position_mm[dot].round(6))),
            str(found.labels[dot]),
            number(found.error[dot], 4),
            number(found.label_rms[dot], 4),
        ]
        for dot in worst
    ]
