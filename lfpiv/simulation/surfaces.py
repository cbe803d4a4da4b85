"""Bright surfaces and solid walls of a scene."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, field_validator

from lfpiv.settings import bounds
from lfpiv.settings.bounds import Direction, Length, Point, Positive
from lfpiv.settings.table import Table
from lfpiv.settings.volume import Box, HalfSpace, Solid
from lfpiv.simulation.light import Pulses

Edges = Literal["sharp", "gaussian"]


class Surface(Table):
    """Table ``[[surface]]``: a lit patch of a plane, such as a wall or a streak of light on it.

    The patch radiates evenly in all directions and to both sides, and hides nothing behind it.
    """

    centre_mm: Point
    """Centre of the patch (x, y, z) [mm]."""
    normal: Direction = (0.0, 0.0, 1.0)
    """Normal of the plane (x, y, z), of any length."""
    along: Direction = (1.0, 0.0, 0.0)
    """Direction of the patch's length; its part along the normal is left out."""
    length_mm: Length
    """Length: from edge to edge, or standard deviation of a Gaussian [mm]."""
    width_mm: Length
    """Width across the length: from edge to edge, or standard deviation of a Gaussian [mm]."""
    edges: tuple[Edges, Edges] = ("sharp", "sharp")
    """Ends of the light along the length and along the width."""
    counts: Positive
    """Level of a pixel of a microlens that only the brightest part of the patch lights [count]."""
    power: Pulses | None = None
    """Light in the first and the second frame; absent: the power of the sheet's pulses."""

    @field_validator("along")
    @classmethod
    def _not_along_normal(cls, value: Point, info: Any) -> Point:
        normal = info.data.get("normal")
        if normal is not None:
            sine = np.linalg.norm(np.cross(value, normal)) / (np.linalg.norm(value) * np.linalg.norm(normal))
            if sine < 1e-3:
                raise ValueError("a direction in the plane, other than its normal (0, 0, 1 unless stated)")
        return value

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors along and across the patch, shape (2, 3)."""
        normal = np.asarray(self.normal, float) / np.linalg.norm(self.normal)
        along = np.asarray(self.along, float) - (normal @ self.along) * normal
        along /= np.linalg.norm(along)
        return np.stack([along, np.cross(normal, along)])

    @property
    def half_mm(self) -> tuple[float, float]:
        """Half length and half width, or their standard deviations [mm]."""
        length, width = (
            size if edge == "gaussian" else size / 2
            for size, edge in zip((self.length_mm, self.width_mm), self.edges, strict=True)
        )
        return length, width

    def powers(self, sheet: np.ndarray) -> np.ndarray:
        """Return the light in both frames of a pair whose pulses have the powers `sheet`, shape (2,)."""
        return sheet if self.power is None else np.asarray(self.power, float)


def _as_list(value: Any) -> Any:
    return value if isinstance(value, (list, tuple)) else (value,)


Walls = Annotated[tuple[Solid, ...], Field(max_length=bounds.MOST_SOLIDS), BeforeValidator(_as_list)]
"""Solid regions without particles. They hide nothing behind them."""
Surfaces = Annotated[tuple[Surface, ...], Field(max_length=bounds.MOST_SOLIDS), BeforeValidator(_as_list)]


def solid(walls: tuple[HalfSpace | Box, ...] | None, points_mm: np.ndarray) -> np.ndarray:
    """Return which points are in a wall, shape (n,), bool.

    Parameters
    ----------
    walls : tuple of HalfSpace or Box, or None
        The walls of a scene.
    points_mm : ndarray, shape (n, 3)
        Points (x, y, z) [mm].
    """
    inside = np.zeros(len(points_mm), bool)
    for wall in walls or ():
        inside |= wall.contains(*np.asarray(points_mm, float).T)
    return inside
