"""What the cameras see: nonsense refused by the nominal rig before any work, and by the calibrated one before weights.

The nominal rig is right only to some degrees and millimetres, so it refuses what no such error explains, and no more.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.errors import InputError
from lfpiv.geometry.optics import Grid, Optics

if TYPE_CHECKING:
    from lfpiv.calibration.cameras import CalibratedCamera, Calibration
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
SAMPLES = 8
"""Voxels along each axis that tell how much of a volume a camera sees."""
FEW = 0.5
"""Part of the volume below which a camera sees so little of it that a warning is due."""

SEEN_SHARE = 0.1
"""Least sum of a voxel's weights in a camera that sees it, as a share of the largest one in the volume: a tenth of the
pupil."""
LEAST_ALONE = 0.01
"""Part of the volume, seen by fewer than two cameras, above which a warning is due."""


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
            f"{optics.object_distance_mm:g} mm from the origin, found one around {_place(grid)}, {depth:g} mm towards "
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
            f"x {tall:.3g} mm around the origin, found one around {_place(grid)}, {np.hypot(x, y):.3g} mm beside the "
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


def require_seen(path: Path, calibration: Calibration, grid: Grid) -> None:
    """Refuse a volume of which a calibrated camera sees nothing; warn where it sees less than half.

    Raises
    ------
    InputError
        Names the camera.
    """
    for camera in calibration.cameras.values():
        share = seen_share(camera, grid)
        if share == 0:
            raise InputError(
                f"{path}: volume: expected a volume in the view of every camera, found one around "
                f"{_place(grid)} of which camera {camera.name!r} sees nothing by its calibration. Check "
                "volume.centre_mm and size_mm against the board's extent."
            )
    for text in sight_warnings(calibration, grid):
        log.warning("%s", text)


def sight_warnings(calibration: Calibration, grid: Grid) -> list[str]:
    """Say of every calibrated camera that sees less than half of a volume how much it sees, and what two do not see."""
    sampled = {camera.name: _sees(camera, grid) for camera in calibration.cameras.values()}
    texts = [
        f"{name}: sees only about {100 * seen.mean():.0f} % of the volume"
        for name, seen in sampled.items()
        if seen.mean() < FEW
    ]
    if len(sampled) > 1:
        texts += _alone(np.sum(list(sampled.values()), 0), _sampled_axes(grid))
    return texts


def seen_share(camera: CalibratedCamera, grid: Grid) -> float:
    """Part of a volume's voxels of which some ray through the pupil meets a camera's sensor, by a sample of them."""
    return float(_sees(camera, grid).mean())


def _sampled_axes(grid: Grid) -> list[np.ndarray]:
    """Places of some planes of voxels along z, y, x [mm], the outer ones among them."""
    return [
        grid.axis_mm(axis)[np.unique(np.linspace(0, n - 1, SAMPLES).round().astype(int))]
        for axis, n in enumerate(grid.shape)
    ]


def _sees(camera: CalibratedCamera, grid: Grid) -> np.ndarray:
    """Whether some ray from a voxel through the pupil meets the sensor, for voxels on all of the sampled planes."""
    z, y, x = np.meshgrid(*_sampled_axes(grid), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    half = np.array(camera.optics.sensor_shape[::-1]) * camera.optics.pixel_mm / 2
    seen = np.zeros(len(points), bool)
    for u, v in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        pupil = np.tile(0.9 * camera.optics.pupil_radius_mm * np.array([u, v], float), (len(points), 1))
        seen |= (np.abs(camera.map(points, pupil)) <= half).all(1)
    return seen.reshape(x.shape)


def warn_alone(views: np.ndarray, grid: Grid, cameras: int) -> None:
    """Log a warning where voxels of a grid are seen by but one of several cameras; `views` counts them, (z, y, x)."""
    if cameras > 1:
        for text in _alone(views, [grid.axis_mm(axis) for axis in range(3)]):
            log.warning("%s", text)


def _alone(views: np.ndarray, axes_mm: Sequence[np.ndarray]) -> list[str]:
    """Say how much of a volume fewer than two cameras see, and where; `views` counts them at places along z, y, x."""
    seen = views >= 2
    if 1 - seen.mean() < LEAST_ALONE:
        return []
    where = "none of it is seen by two"
    if seen.any():
        reach = []
        for axis, name in ((2, "x"), (1, "y"), (0, "z")):
            inside = axes_mm[axis][seen.any(tuple({0, 1, 2} - {axis}))]
            reach.append(f"{name} {inside[0]:.3g} to {inside[-1]:.3g}")
        where = f"two see no more than {', '.join(reach)} mm"
    share = 100 * (1 - seen.mean())
    return [
        f"about {share:.0f} % of the volume is seen by fewer than two cameras; vectors there are not valid: {where}"
    ]


def _place(grid: Grid) -> str:
    """Centre of a grid in words."""
    centre = (round(float(grid.axis_mm(axis).mean()), 6) + 0.0 for axis in (2, 1, 0))
    return f"({', '.join(f'{value:g}' for value in centre)}) mm"
