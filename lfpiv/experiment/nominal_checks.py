"""What the cameras see: nonsense refused by the nominal rig before any work, and by the calibrated one before weights.

The nominal rig is right only to some degrees and millimetres, so it refuses what no such error explains, and no more.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import Optics

if TYPE_CHECKING:
    from lfpiv.experiment.settings import Board

log = logging.getLogger(__name__)

ANGLE_ERROR_DEG = 10.0
"""Error of a nominal angle that a calibration still copes with [degree]."""
FIELDS_AWAY = 1.5
"""A volume this many fields of view beyond the edge of the field is not there by misalignment."""
LARGEST_BOARD = 4.0
"""Board against what a camera may see of it, along x or y: the dots outside are never seen, only searched for."""
STEEPEST_COSINE = 0.17
"""Cosine of the steepest angle, 80 degrees, at which a board is taken to be seen."""


def field_mm(optics: Optics) -> np.ndarray:
    """Field of view (x, y) in the focal plane [mm]."""
    return np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / abs(optics.magnification)


def require_volume(path: Path, grid: Grid, name: str, optics: Optics, angle_deg: float) -> None:
    """Refuse a volume that a nominal camera certainly does not see.

    Raises
    ------
    InputError
        If the volume lies behind the camera's main lens, or lies several fields of view beside the field.
    """
    low, high = (np.array([grid.axis_mm(axis)[end] for axis in (2, 1, 0)]) for end in (0, -1))
    alpha = np.radians(angle_deg)
    turn = np.array([[np.cos(alpha), 0, -np.sin(alpha)], [0, 1, 0], [np.sin(alpha), 0, np.cos(alpha)]])
    centre = (low + high) / 2
    x, y, depth = turn @ centre
    if depth >= optics.object_distance_mm:
        raise InputError(
            f"{path}: volume.centre_mm: expected a volume in front of camera {name!r}, whose main lens is "
            f"{optics.object_distance_mm:g} mm from the origin, found one around {grid.centre_text()}, {depth:g} mm towards "
            "and behind the lens. Coordinates are millimetres from where the cameras' axes meet."
        )
    beside = np.hypot(x, y) - np.linalg.norm(high - low) / 2 - np.radians(ANGLE_ERROR_DEG) * np.linalg.norm(centre)
    m = optics.image_distance_mm / max(optics.object_distance_mm - depth, optics.object_distance_mm / 100)
    blur = abs(1 - optics.image_distance_mm / optics.focal_length_mm + m) * optics.pupil_radius_mm
    field = np.hypot(*optics.sensor_shape) * optics.pixel_mm
    reach = (field / 2 + blur) / m  # rays through the pupil's edge may come in from this far
    if beside > reach + FIELDS_AWAY * field / abs(optics.magnification):
        wide, tall = field_mm(optics)
        raise InputError(
            f"{path}: volume.centre_mm: expected a volume in the view of camera {name!r}, which sees about {wide:.3g} "
            f"x {tall:.3g} mm around the origin, found one around {grid.centre_text()}, {np.hypot(x, y):.3g} mm beside the "
            "camera's axis. Coordinates are millimetres from where the cameras' axes meet."
        )


def require_board(path: Path, board: Board, name: str, optics: Optics, angle_deg: float) -> None:
    """Refuse a board whose dots a nominal camera certainly cannot tell apart, or of which it sees a small part only.

    Raises
    ------
    InputError
        If the dots are less than a microlens apart, or the board is `LARGEST_BOARD` times what the camera may see.
    """
    lens_mm = optics.microlens_pitch_mm / abs(optics.magnification)
    if board.spacing_mm < lens_mm * (1 - 1e-9):
        raise InputError(
            f"{path}: board.spacing_mm: expected dots at least one microlens apart, {lens_mm:g} mm on the board for "
            f"camera {name!r}, found {board.spacing_mm:g} mm. Use a coarser board, or check the unit."
        )
    cosine = max(abs(np.cos(np.radians(angle_deg))), STEEPEST_COSINE)
    deepest = max(abs(depth) for depth in board.planes_mm)
    seen = field_mm(optics) / [cosine, 1] + 2 * deepest * np.array([1 / cosine, 1])
    size = (np.array(board.dots) - 1) * board.spacing_mm
    if (size > LARGEST_BOARD * seen).any():
        wide, tall = (max(2, int(length / board.spacing_mm)) for length in field_mm(optics))
        raise InputError(
            f"{path}: board.dots: expected a board of about the size that the cameras see, found {board.dots[0]} x "
            f"{board.dots[1]} dots {board.spacing_mm:g} mm apart where camera {name!r} sees about {wide} x {tall} of "
            "them. Check dots and spacing_mm, or state only the dots around the middle."
        )
