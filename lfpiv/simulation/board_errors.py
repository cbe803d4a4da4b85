"""Errors of a simulated calibration board: of its stage, its dots and its light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from lfpiv.settings.bounds import Thickness
from lfpiv.settings.table import Table


class BoardErrors(Table):
    """Table ``[board.errors]``: what differs from the board that the experiment file states. Bright dots only."""

    stage_z_sd_mm: Thickness = 0.0
    """Standard deviation of each plane's depth [mm]."""
    stage_xy_sd_mm: Thickness = 0.0
    """Standard deviation of each plane's shift along x and along y [mm]."""
    tilt_sd_deg: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.0
    """Standard deviation of each plane's tilt about x and about y [degree]."""
    dot_sd_mm: Thickness = 0.0
    """Standard deviation of each dot's place on the board along x and along y, equal in all planes [mm]."""
    missing_share: Annotated[float, Field(strict=True, ge=0, le=0.5)] = 0.0
    """Share of the dots that are missing, the same in all planes."""
    uneven_light: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """Part of the light that the darkest dot of the board lacks. The light falls off linearly across the board, in a
    direction of its own for each camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardTruth:
    """Dots of all planes as they really are."""

    dots_mm: np.ndarray
    """True centres (x, y, z), shape (plane, dot, 3) [mm]."""
    present: np.ndarray
    """Whether the board has each dot, shape (dot,)."""
    light: np.ndarray
    """Light of each dot relative to the brightest, for each camera, shape (cameras, dot)."""


def true_board(errors: BoardErrors, nominal_mm: np.ndarray, cameras: int, rng: np.random.Generator) -> BoardTruth:
    """Draw the dots of a board with errors.

    Parameters
    ----------
    errors : BoardErrors
        Standard deviations.
    nominal_mm : ndarray, shape (plane, dot, 3)
        Dots as stated [mm].
    cameras : int
        Number of cameras.
    rng : Generator
        Generator. Each key draws the same whatever the other keys are.
    """
    planes, dots = nominal_mm.shape[:2]
    scatter = errors.dot_sd_mm * rng.standard_normal((dots, 2))
    present = np.greater_equal(rng.random(dots), errors.missing_share)
    shift = rng.standard_normal((planes, 3)) * (errors.stage_xy_sd_mm, errors.stage_xy_sd_mm, errors.stage_z_sd_mm)
    tilt = np.radians(errors.tilt_sd_deg * rng.standard_normal((planes, 2)))
    angle = rng.uniform(0, 2 * np.pi, cameras)
    true = nominal_mm.astype(float)
    true[..., :2] += scatter
    for plane, (about_x, about_y) in enumerate(tilt):  # a rigid board turns about its middle
        middle = np.array([0.0, 0.0, nominal_mm[plane, 0, 2]])
        turn = Rotation.from_rotvec([about_x, about_y, 0.0]).as_matrix()
        true[plane] = (true[plane] - middle) @ turn.T + middle
    true += shift[:, None]
    across = nominal_mm[0, :, :2] @ np.stack([np.cos(angle), np.sin(angle)])
    across = (across - across.min(0)) / np.maximum(np.ptp(across, axis=0), 1e-12)
    return BoardTruth(dots_mm=true, present=present, light=1 - errors.uneven_light * across.T)
