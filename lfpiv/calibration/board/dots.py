"""Values that describe the dots of a calibration board: the stated board, detected and expected dots, and labels.

A dot of plane p, row j and column i has the number p * (nx ny) + j * nx + i. A label is one ray of a dot: a pupil point
(u, v) and the position (s, t) where that ray meets the microlens array. The chief ray is the ray through (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.calibration.board.pose import CameraPose
from lfpiv.geometry.optics import NEIGHBOURS, Optics

if TYPE_CHECKING:
    from lfpiv.settings.rig import Board

FEWEST_DOTS = 4
"""Least number of dots that make a board."""


@dataclass(frozen=True, kw_only=True)
class DotBoard:
    """A flat board with a square lattice of dots, moved along z."""

    dots: tuple[int, int]
    """Dots along x and y."""
    spacing_mm: float
    """Distance of neighbouring dots [mm]."""
    diameter_mm: float
    """Diameter of a dot [mm]."""
    planes_mm: tuple[float, ...]
    """Depth z of each plane [mm]."""
    mark: tuple[tuple[int, int], ...] = ()
    """Lattice sites (column, row) without a dot."""

    @classmethod
    def from_settings(cls, board: Board) -> DotBoard:
        """Return the board of an experiment file's table ``[board]``."""
        return cls(
            dots=board.dots,
            spacing_mm=board.spacing_mm,
            diameter_mm=board.dot_diameter_mm,
            planes_mm=tuple(board.planes_mm),
            mark=board.mark,
        )

    @property
    def size(self) -> int:
        """Dots on the board."""
        return self.dots[0] * self.dots[1]

    @property
    def occupied(self) -> np.ndarray:
        """Sites that hold a dot, bool, shape (rows, columns)."""
        occupied = np.ones(self.dots[::-1], bool)
        for column, row in self.mark:
            occupied[row, column] = False
        return occupied

    def points_mm(self, plane: int, margin: int = 0) -> np.ndarray:
        """Return the world positions of the dots of one plane, row by row, shape (dot, 3) [mm].

        `margin` adds columns and rows of lattice sites around the board.
        """
        x, y = ((np.arange(-margin, n + margin) - (n - 1) / 2) * self.spacing_mm for n in self.dots)
        x, y = np.meshgrid(x, y)
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, float(self.planes_mm[plane]))], axis=1)

    def of_dots_mm(self, dot: np.ndarray) -> np.ndarray:
        """Return the world positions of dots given by number, shape (n, 3) [mm]."""
        plane, site = np.divmod(dot, self.size)
        points = self.points_mm(0)[site]
        points[:, 2] = np.asarray(self.planes_mm)[plane]
        return points


@dataclass(frozen=True, eq=False, kw_only=True)
class Detection:
    """Dots of one camera as the rectified images show them, and the camera pose fitted to them."""

    pose: CameraPose
    """Pose fitted to the dots."""
    sign: int
    """+1 for dots brighter than the board, -1 for darker ones."""
    dot: np.ndarray
    """Numbers of the detected dots in rising order, shape (d,)."""
    chief_mm: np.ndarray
    """Position of their chief rays on the array, to a fraction of a lens [mm], shape (d, 2)."""
    in_field: np.ndarray
    """Dots with at least half of their light on the sensor, shape (plane, dot), bool."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExpectedDot:
    """Prior knowledge of one dot."""

    plane: int
    """Number of its plane."""
    theta: np.ndarray
    """Mean of the prior on the ray model [mm], shape (6, 2)."""
    information: np.ndarray
    """Its inverse covariance, of theta.T.ravel() [1/mm^2], shape (12, 12)."""
    board_jacobian: np.ndarray
    """A = d(s, t)/d(x, y) at the dot, through the pupil's centre, shape (2, 2)."""
    tilt: np.ndarray
    """Change of A from the pupil's centre to its edge along u and v (last axis), shape (2, 2, 2)."""
    neighbours_mm: np.ndarray
    """Chief rays of the eight neighbouring dots from the dot's own on the array [mm], shape (8, 2)."""


def expect_dots(
    pose: CameraPose, board: DotBoard, optics: Optics, dots: np.ndarray, theta: np.ndarray, sigma: np.ndarray
) -> list[ExpectedDot]:
    """Return the prior knowledge of dots, given by number.

    `theta` and `sigma` are the means and standard deviations of their ray models, shape (d, 6, 2) [mm].
    """
    points = board.of_dots_mm(dots)
    jacobians, tilts = pose.board_jacobian(points, optics.pupil_radius_mm)
    around = np.stack([pose.rays(points + board.spacing_mm * np.array([*step, 0]))[0] for step in NEIGHBOURS], axis=1)
    neighbours = around - pose.rays(points)[0][:, None]
    information = (1 / sigma**2).transpose(0, 2, 1).reshape(len(dots), -1)
    return [
        ExpectedDot(
            plane=int(dot) // board.size,
            theta=theta[k],
            information=np.diag(information[k]),
            board_jacobian=jacobians[k],
            tilt=tilts[k],
            neighbours_mm=neighbours[k],
        )
        for k, dot in enumerate(dots)
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Labels:
    """Labels and measured dots of one camera."""

    pupil_mm: np.ndarray
    """Pupil point (u, v) of each label [mm], shape (n, 2)."""
    array_mm: np.ndarray
    """Position (s, t) where that ray meets the microlens array [mm], shape (n, 2)."""
    std_mm: np.ndarray
    """Standard error of each label, per coordinate [mm], shape (n,)."""
    dot: np.ndarray
    """Number of each label's dot, shape (n,)."""
    rejected_dot: np.ndarray
    """Numbers of the dots that were detected but not trusted, shape (r,)."""
    measured_dot: np.ndarray
    """Numbers of the measured dots, shape (d,)."""
    chief_mm: np.ndarray
    """Position of the measured dots' chief rays on the array [mm], shape (d, 2)."""
    slope: np.ndarray
    """Slopes d(s, t)/d(u, v) of their rays, shape (d, 2, 2)."""
    reduced_chi2: np.ndarray
    """Quality of their fits, about 1; nan for the Gaussian estimator, shape (d,)."""
    response_share: float
    """Share of the white image's scatter from pixel to pixel that is pixel response; the rest is noise.
    See `LightFieldDecoder.shrunk_gain`. nan for the Gaussian estimator."""
    diameter_mm: float
    """Diameter of the dots as the images show it [mm]; the stated one for the Gaussian estimator."""
    blur_px: float
    """Blur of sensor and microlenses, standard deviation [pixel]; nan for the Gaussian estimator."""
    left_over_mm: np.ndarray
    """Displacement of rays that their pixels show beside the labels, by part of the field and zone of the pupil [mm],
    shape (PARTS, ZONES, 2); zero where they show none, and for the Gaussian estimator."""
    shared_error_mm: float
    """Error that the labels of all dots share, so that no comparison of labels shows it, mean within 0.9 of the pupil's
    radius [mm]: what their pixels show beside the form of their rays, and errors of diameter, blur and bend. 0 for the
    Gaussian estimator."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardDots(Labels):
    """Labels of one camera with their world points, and the number of dots in each plane."""

    points_mm: np.ndarray
    """Board position (x, y, z) of each label's dot [mm], shape (n, 3)."""
    found: np.ndarray
    """Measured dots of each plane, shape (plane,)."""
    expected: np.ndarray
    """Dots of each plane in the camera's field, shape (plane,)."""
    rejected: np.ndarray
    """Dots of each plane that were detected but not trusted, shape (plane,)."""
