"""Compare a calibrated mapping with the labels of the board's dots; outline the dots' light on the sensor (Eq. 9)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.geometry.optics import Optics

RIM_POINTS = (12, 48)
"""Smallest and largest number of points of the outline of a dot's light."""
OUTLINE_POINTS = 6000
"""Number of points of all outlines of a plane, shared by its dots."""


@dataclass(frozen=True, kw_only=True)
class DotMap:
    """Errors of the mapping at each dot, in microlens pitches.

    Averaging over the labels of a dot, some dozens of rays through the whole pupil, removes the noise of single labels.
    It leaves the error of the mapping plus the position error of the dot, which all its labels share.
    """

    dots: BoardDots
    """Labels of the dots."""
    number: np.ndarray
    """Numbers of the dots, plane * (nx ny) + row * nx + column, shape (dot,)."""
    position_mm: np.ndarray
    """Positions (x, y, z) [mm], shape (dot, 3)."""
    labels: np.ndarray
    """Number of labels of each dot, shape (dot,)."""
    error: np.ndarray
    """Length of the mean difference between labels and mapping [pitch], shape (dot,)."""
    label_rms: np.ndarray
    """Root mean square difference between labels and mapping [pitch], shape (dot,)."""


def dot_map(camera: CalibratedCamera) -> DotMap | None:
    """Compare a camera's mapping with all labels of its dots, training labels included; None without dots."""
    dots = camera.dots
    if dots is None:
        return None
    difference = (dots.array_mm - camera.map(dots.points_mm, dots.pupil_mm)) / camera.lattice.pitch_mm
    number, first, inverse = np.unique(dots.dot, return_index=True, return_inverse=True)
    labels = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, part) / labels for part in difference.T], axis=1)
    return DotMap(
        dots=dots,
        number=number,
        position_mm=dots.points_mm[first],
        labels=labels,
        error=np.hypot(*mean.T),
        label_rms=np.sqrt(np.bincount(inverse, (difference**2).sum(1)) / labels),
    )


def rms_by(key: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first index of each distinct key and the root mean square of its values, in the same order."""
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    return first, np.sqrt(np.bincount(inverse, values**2) / np.bincount(inverse))


def dot_outlines_px(
    mapping: Callable[[np.ndarray, np.ndarray], np.ndarray],
    optics: Optics,
    points: np.ndarray,
) -> np.ndarray:
    """Trace the outline of each dot's light on the sensor, by the rays through the edge of the pupil (Eq. 9).

    Parameters
    ----------
    mapping : callable
        Maps points (n, 3) and pupil positions (n, 2) [mm] to the microlens array (n, 2) [mm].
    optics : Optics
        Nominal optics of the camera.
    points : ndarray, shape (dot, 3)
        Positions of the dots [mm].

    Returns
    -------
    ndarray, shape (dot, point, 2)
        (column, row) [pixel].
    """
    rays = int(np.clip(OUTLINE_POINTS // len(points), *RIM_POINTS))
    angle = np.linspace(0, 2 * np.pi, rays, endpoint=False)
    rim = optics.pupil_radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    on_array = mapping(np.repeat(points, rays, axis=0), np.tile(rim, (len(points), 1)))
    on_array = np.asarray(on_array).reshape(len(points), rays, 2)
    return optics.sensor_px(on_array + (on_array - rim) * optics.sensor_per_pupil)
