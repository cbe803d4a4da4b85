"""Write the report's part on the board: where its planes stand, against where they are stated to be."""

from __future__ import annotations

import numpy as np

from lfpiv.calibration.board.errors import KINDS, BoardErrors
from lfpiv.report import markup
from lfpiv.report.markup import number
from lfpiv.report.svg import INK, SERIES, new_panel, spread_ticks, style, to_svg

TITLES = (
    "stated z [mm]",
    "fitted z [mm]",
    "± [mm]",
    "shift x [mm]",
    "± [mm]",
    "shift y [mm]",
    "± [mm]",
    "turn about x [mrad]",
    "± [mrad]",
    "about y [mrad]",
    "± [mrad]",
    "about z [mrad]",
    "± [mrad]",
)
"""Columns of the table."""


def board_part(board: BoardErrors) -> str:
    """Return a figure and a table of the fitted planes, as HTML."""
    rows = [_row(board, plane) for plane in np.argsort(board.planes_mm)]
    caption = "Planes of the board: stated and fitted places with standard errors"
    return markup.figure([depth_panel(board)], _text(board), markup.table(TITLES, rows, caption=caption))


def _row(board: BoardErrors, plane: int) -> list[str]:
    error, std = board.plane[plane], board.plane_std[plane]
    row = [markup.general(board.planes_mm[plane]), number(board.depth_mm[plane], 4), number(std[2], 4)]
    for component, factor, digits in ((0, 1.0, 4), (1, 1.0, 4), (3, 1e3, 2), (4, 1e3, 2), (5, 1e3, 2)):
        row += [number(factor * error[component], digits), number(factor * std[component], digits)]
    return row


def _text(board: BoardErrors) -> str:
    seen = board.plane_std[np.isfinite(board.plane_std[:, 2]), 2]
    known = f"Depths are known to {1e3 * float(np.median(seen)):.1f} µm." if len(seen) else ""
    if not len(seen):
        found = "There are too few planes or dots to tell errors of the board from the lens: it is used as stated."
    elif board.corrected:
        names = ", ".join(KINDS[kind] for kind in board.corrected)
        scatter = float(np.sqrt(np.mean(board.dot_mm**2)))
        dots = f" Dots lie {1e3 * scatter:.1f} µm (rms, along x and y) off their places." if scatter else ""
        found = f"The labels of all cameras show errors of the board, which are corrected: {names}.{dots}"
    else:
        found = "The labels of all cameras show no significant error of the board: it is used as stated."
    gauge = (
        "A world that is moved, sheared or scaled along z as a whole looks the same to all cameras, so it is chosen so "
        "that most planes stand where they are stated to be."
    )
    return " ".join(part for part in (found, known, gauge) if part)


def depth_panel(board: BoardErrors) -> str:
    """Draw fitted minus stated depth of each plane, with standard errors."""
    order = np.argsort(board.planes_mm)
    order = order[np.isfinite(board.plane_std[order, 2])]
    figure, axes = new_panel(2.4)
    axes.axhline(0, color=INK, linewidth=0.8)
    off, std = 1e3 * board.plane[order, 2], 1e3 * board.plane_std[order, 2]
    axes.errorbar(board.planes_mm[order], off, yerr=std, fmt="o", color=SERIES[0], markersize=4, capsize=3)
    style(axes, title="planes of the board", xlabel="stated z [mm]", ylabel="fitted − stated z [µm]")
    spread_ticks(axes)
    largest = float(np.abs(off).max()) if len(off) else 0.0
    return to_svg(figure, f"Fitted minus stated depth of the board's planes, at most {largest:.1f} µm.")
