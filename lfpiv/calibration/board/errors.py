"""Errors of the board and its stage: where each plane stands and each dot is, against what is stated.

A plane has six errors: shifts along x, y, z [mm] and rotations about x, y, z through its middle [rad]. A dot has two,
along x and y on the board [mm], the same in every plane, because a board is printed once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.warn import Warning

KINDS = {
    "depth": "depths of the planes",
    "shift": "shifts of the planes",
    "tilt": "tilts of the planes",
    "rotation": "turns of the planes about z",
    "dots": "places of the dots on the board",
}
"""Name of each kind of errors in messages."""
COMPONENTS = {"depth": (2,), "shift": (0, 1), "tilt": (3, 4), "rotation": (5,)}
"""Kind of errors -> its components among a plane's six errors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardErrors:
    """Errors of a board, fitted to the labels of all cameras, with standard errors."""

    planes_mm: np.ndarray
    """Stated depth of each plane [mm], shape (plane,)."""
    plane: np.ndarray
    """Errors of each plane: shifts along x, y, z [mm], then rotations about x, y, z [rad], shape (plane, 6)."""
    plane_std: np.ndarray
    """Standard errors of `plane` [mm, rad], nan for planes without dots, shape (plane, 6)."""
    dot_mm: np.ndarray
    """Errors of each dot along x and y [mm], shape (dot, 2)."""
    dot_std_mm: np.ndarray
    """Standard errors of `dot_mm` [mm], nan for dots that no camera sees, shape (dot, 2)."""
    corrected: tuple[str, ...] = ()
    """Kinds of errors, keys of `KINDS`, that the labels show. Errors of other kinds are 0."""
    warnings: tuple[Warning, ...] = ()
    """Doubts about the board."""

    @property
    def depth_mm(self) -> np.ndarray:
        """Fitted depth of each plane's middle [mm], shape (plane,)."""
        return self.planes_mm + self.plane[:, 2]

    def points_mm(self, board: DotBoard, dot: np.ndarray) -> np.ndarray:
        """Return the corrected world positions (x, y, z) of dots by their numbers, shape (n, 3) [mm]."""
        plane, site = np.divmod(dot, board.size)
        points = board.of_dots_mm(dot)
        middle = np.zeros((len(points), 3))
        middle[:, 2] = points[:, 2]
        on_board = points - middle
        on_board[:, :2] += self.dot_mm[site]
        turned = Rotation.from_rotvec(self.plane[plane, 3:]).apply(on_board)
        return turned + middle + self.plane[plane, :3]

    def to_json(self) -> dict[str, Any]:
        """Return the figures of the planes and the dots' scatter, as the summary stores them."""
        return {
            "corrected": list(self.corrected),
            "planes_mm": self.planes_mm.tolist(),
            "planes_fitted_mm": self.depth_mm.tolist(),
            "planes_std_mm": _listed(self.plane_std[:, 2]),
            "shift_mm": self.plane[:, :2].tolist(),
            "shift_std_mm": _listed(self.plane_std[:, :2]),
            "rotation_mrad": (1e3 * self.plane[:, 3:]).tolist(),
            "rotation_std_mrad": _listed(1e3 * self.plane_std[:, 3:]),
            "dot_scatter_mm": float(np.sqrt(np.mean(self.dot_mm**2))),
        }


def _listed(values: np.ndarray) -> list[Any]:
    """Return nested lists with None for nan, which JSON does not have."""
    listed = values.astype(object)
    listed[np.isnan(values)] = None
    return list(listed.tolist())
