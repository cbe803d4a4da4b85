"""Check the stated volume and board against the nominal field of view of each camera.

The nominal rig is correct to some degrees and millimetres only. The checks refuse larger differences only.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.settings import bounds
from lfpiv.settings.rig import Board

ANGLE_ERROR_DEG = 10.0
"""Largest error of a nominal angle that a calibration tolerates [degree]."""
FIELDS_AWAY = 1.5
"""Distance of a volume from the edge of the field above which it is refused [fields of view]."""
LARGEST_OVERLAP = 4.0
"""Largest diameter of a microimage, relative to the distance of the microlenses; more is a wrong f-number."""
MICROLENS_SHARE = 0.2
"""Largest focal length of the microlenses over the main lens's image distance; more is a wrong unit."""
FEWEST_LENSES = 3
"""Least number of microlenses along each axis of a sensor; fewer are a wrong pitch or pixel size."""
LARGEST_BOARD = 4.0
"""Largest size of a board, along x or y, relative to the part that a camera may see."""
FEWEST_LENSES_APART = 0.5
"""Least distance of dots as an oblique camera sees them [microlens]. Two are needed; this little is never enough."""

STEEPEST_COSINE = 0.17
"""Cosine of the steepest angle at which a camera sees a board well, 80 degrees."""
ALONG_COSINE = 0.087
"""Cosine of the angle above which a camera looks along a board, 85 degrees."""


def field_mm(optics: Optics) -> np.ndarray:
    """Return the field of view (x, y) in the focal plane [mm], shape (2,)."""
    return np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / abs(optics.magnification)


def require_volume(path: Path, grid: Grid, name: str, optics: Optics, orientation: Orientation) -> None:
    """Refuse a volume that a nominal camera certainly does not see.

    Raises
    ------
    InputError
        If the volume lies behind the camera's main lens, or several fields of view away from the field.
    """
    low, high = (np.array([grid.axis_mm(axis)[end] for axis in (2, 1, 0)]) for end in (0, -1))
    centre = (low + high) / 2
    x, y, depth = orientation.rotation @ centre
    if depth >= optics.object_distance_mm:
        raise InputError(
            f"{path}: volume.centre_mm: expected a volume in front of camera {name!r}, whose main lens is "
            f"{optics.object_distance_mm:g} mm from the origin, found one around {grid.centre_text()}, {depth:g} mm "
            "towards and behind the lens. Coordinates are millimetres from where the cameras' axes meet."
        )
    beside = np.hypot(x, y) - np.linalg.norm(high - low) / 2 - np.radians(ANGLE_ERROR_DEG) * np.linalg.norm(centre)
    m = optics.image_distance_mm / max(optics.object_distance_mm - depth, optics.object_distance_mm / 100)
    blur = abs(1 - optics.image_distance_mm / optics.focal_length_mm + m) * optics.pupil_radius_mm
    field = np.hypot(*optics.sensor_shape) * optics.pixel_mm
    reach = (field / 2 + blur) / m  # largest distance from the axis of a ray through the pupil's edge
    if beside > reach + FIELDS_AWAY * field / abs(optics.magnification):
        wide, tall = field_mm(optics)
        raise InputError(
            f"{path}: volume.centre_mm: expected a volume in the view of camera {name!r}, which sees about {wide:.3g} "
            f"x {tall:.3g} mm around the origin, found one around {grid.centre_text()}, {np.hypot(x, y):.3g} mm beside "
            "the camera's axis. Coordinates are millimetres from where the cameras' axes meet."
        )


def require_board(path: Path, board: Board, name: str, optics: Optics, orientation: Orientation) -> None:
    """Refuse a board whose dots a nominal camera certainly cannot resolve, or that is far larger than its field.

    Raises
    ------
    InputError
        If the camera looks along the board's planes, the dots cannot be told apart as it sees them, the board is more
        than `LARGEST_BOARD` times as large as the part of it that the camera may see, a plane is behind the lens, or
        there are more than `bounds.MOST_DOTS` dots.
    """
    lens_mm = optics.microlens_pitch_mm / abs(optics.magnification)
    if board.spacing_mm < lens_mm * (1 - 1e-9):
        raise InputError(
            f"{path}: board.spacing_mm: expected dots at least one microlens apart, {lens_mm:g} mm on the board for "
            f"camera {name!r}, found {board.spacing_mm:g} mm. Use a coarser board, or check the unit."
        )
    towards = float(orientation.rotation[2, 2])
    depth = max(board.planes_mm, key=lambda z: z * towards)
    if depth * towards >= optics.object_distance_mm:
        raise InputError(
            f"{path}: board.planes_mm: expected planes in front of camera {name!r}, whose main lens is "
            f"{optics.object_distance_mm:g} mm from the origin, found one at z = {depth:g} mm, behind the lens. Depths "
            "are millimetres from where the cameras' axes meet."
        )
    oblique = abs(float(orientation.rotation[2, 2]))
    if oblique < ALONG_COSINE:
        raise InputError(
            f"{path}: camera {name!r}: expected a camera that sees the board's planes at no more than "
            f"{np.degrees(np.arccos(STEEPEST_COSINE)):.0f} degrees from their normal, the z axis, found one "
            f"{orientation}, at {np.degrees(np.arccos(oblique)):.0f} degrees. Turn the board towards all cameras: z is "
            "its normal."
        )
    if board.spacing_mm * oblique < FEWEST_LENSES_APART * lens_mm:
        raise InputError(
            f"{path}: board.spacing_mm: expected dots about two microlenses apart as camera {name!r} sees them, found "
            f"{board.spacing_mm * oblique:.3g} mm where a microlens covers {lens_mm:g} mm: it sees the board at "
            f"{np.degrees(np.arccos(oblique)):.0f} degrees from its normal. Use a coarser board."
        )
    across, cosines, along = np.linalg.svd(orientation.rotation[:2, :2])  # of the board's axes to the picture's
    widened = np.abs(along.T @ np.diag(1 / np.maximum(cosines, STEEPEST_COSINE)) @ across.T)
    deepest = max(abs(depth) for depth in board.planes_mm)
    seen = widened @ (field_mm(optics) + 2 * deepest)
    size = (np.array(board.dots) - 1) * board.spacing_mm
    if (size > LARGEST_BOARD * seen).any():
        wide, tall = (max(2, int(length / board.spacing_mm)) for length in field_mm(optics))
        raise InputError(
            f"{path}: board.dots: expected a board of about the size that the cameras see, found {board.dots[0]} x "
            f"{board.dots[1]} dots {board.spacing_mm:g} mm apart where camera {name!r} sees about {wide} x {tall} of "
            "them. Check dots and spacing_mm, or state only the dots around the middle."
        )
    dots = board.dots[0] * board.dots[1] * len(board.planes_mm)
    if dots > bounds.MOST_DOTS:
        raise InputError(
            f"{path}: board.dots: expected at most {bounds.MOST_DOTS:,} dots in all planes, found {dots:,}. State only "
            "the dots around the middle, or fewer planes."
        )


def require_microimages(path: Path, name: str, optics: Optics) -> None:
    """Refuse nominal optics whose microimages cannot be told apart, or that have a wrong unit.

    Raises
    ------
    InputError
        If the microlenses' focal length is not far less than the image distance, microimages are smaller than two
        pixels, fewer than `FEWEST_LENSES` fit on the sensor, or overlap by more than `LARGEST_OVERLAP`.
    """
    place, shape, pitch_px = f"{path}: camera {name!r}", optics.sensor_shape, optics.microimage_pitch_px
    if optics.microlens_focal_length_mm > MICROLENS_SHARE * optics.image_distance_mm:
        raise InputError(
            f"{place}, microlens_focal_length_mm: expected far less than the image distance "
            f"f (1 + |M|) = {optics.image_distance_mm:g} mm, found {optics.microlens_focal_length_mm:g}. Are it and "
            "focal_length_mm in mm?"
        )
    if not (math.isfinite(pitch_px) and 2 <= pitch_px <= min(shape) / FEWEST_LENSES):
        raise InputError(
            f"{place}, microlens_pitch_mm: expected microimages of at least 2 pixels, and "
            f"at least {FEWEST_LENSES} of them across the sensor of {shape} pixels, found {pitch_px:.4g}. "
            "Check microlens_pitch_mm and pixel_um."
        )
    diameter = 2 * optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    if not 1 <= diameter <= LARGEST_OVERLAP * pitch_px:
        raise InputError(
            f"{place}, f_number: expected microimages from 1 pixel to {LARGEST_OVERLAP:g} times their distance, "
            f"{LARGEST_OVERLAP * pitch_px:.4g} pixels, found a diameter of {diameter:.4g} pixels. Check f_number, "
            "focal_length_mm and microlens_focal_length_mm."
        )
