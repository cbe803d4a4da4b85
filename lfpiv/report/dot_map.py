"""Errors of a calibrated mapping at the board's dots: by dot, by plane, over the field and the depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.geometry.optics import Optics

RIM_POINTS = (12, 48)
"""Fewest and most points on the pupil's edge that draw the outline of a dot's light."""
OUTLINE_POINTS = 6000
"""Points of all outlines of a plane: boards of many dots have fewer for each."""


@dataclass(frozen=True, kw_only=True)
class DotMap:
    """Mapping against the labels of each dot, in microlens pitches.

    The mean over a dot's labels, some dozens of rays through the whole pupil, is free of what each label errs by alone,
    not of what they share, the error of the dot's place: its length bounds the error of the mapping there.
    """

    dots: BoardDots
    """The labels."""
    number: np.ndarray
    """Numbers of the dots, plane * (nx ny) + row * nx + column, shape (dot,)."""
    position_mm: np.ndarray
    """Their places (x, y, z) [mm], shape (dot, 3)."""
    labels: np.ndarray
    """Labels of each, shape (dot,)."""
    error: np.ndarray
    """Length of the mean over a dot's labels [pitch], shape (dot,)."""
    label_rms: np.ndarray
    """Root mean square of its labels' errors [pitch], shape (dot,)."""


def dot_map(camera: CalibratedCamera) -> DotMap | None:
    """Hold a camera's mapping against all labels of its dots, those of the training included; None without dots."""
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
    """Root mean square of values by their key: the first place of each key, and the figures in the same order."""
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    return first, np.sqrt(np.bincount(inverse, values**2) / np.bincount(inverse))


def dot_outlines_px(
    mapping: Callable[[np.ndarray, np.ndarray], np.ndarray],
    optics: Optics,
    dots: tuple[int, int],
    spacing_mm: float,
    depth_mm: float,
) -> np.ndarray:
    """Outline of each dot's light on the sensor: the rays through the pupil's edge, Eq. 9.

    Returns
    -------
    ndarray, shape (dot, point, 2)
        (column, row) [pixel].
    """
    x, y = ((np.arange(n) - (n - 1) / 2) * spacing_mm for n in dots)
    points = np.array([(a, b, depth_mm) for b in y for a in x])
    rays = int(np.clip(OUTLINE_POINTS // len(points), *RIM_POINTS))
    angle = np.linspace(0, 2 * np.pi, rays, endpoint=False)
    rim = optics.pupil_radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    on_array = mapping(np.repeat(points, rays, axis=0), np.tile(rim, (len(points), 1)))
    on_array = np.asarray(on_array).reshape(len(points), rays, 2)
    return optics.sensor_px(on_array + (on_array - rim) * optics.sensor_per_pupil)
