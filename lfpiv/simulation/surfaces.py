"""Bright surfaces and solid walls of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, field_validator

from lfpiv.experiment.settings import Point, Positive, Table
from lfpiv.simulation.light import Pulses

Edges = Literal["sharp", "gaussian"]


def _direction(value: Point) -> Point:
    if not any(value):
        raise ValueError("a direction other than (0, 0, 0)")
    return value


class Surface(Table):
    """Table ``[[surface]]``: a lit patch of a plane, such as a wall or a streak of light on it.

    The patch radiates evenly in all directions and to both sides, and hides nothing behind it.
    """

    centre_mm: Point
    """Centre of the patch (x, y, z) [mm]."""
    normal: Point = (0.0, 0.0, 1.0)
    """Normal of the plane (x, y, z), of any length."""
    along: Point = (1.0, 0.0, 0.0)
    """Direction of the patch's length; its part along the normal is left out."""
    length_mm: Positive
    """Length: from edge to edge, or standard deviation of a Gaussian [mm]."""
    width_mm: Positive
    """Width across the length: from edge to edge, or standard deviation of a Gaussian [mm]."""
    edges: tuple[Edges, Edges] = ("sharp", "sharp")
    """Ends of the light along the length and along the width."""
    counts: Positive
    """Level of a pixel of a microlens that only the brightest part of the patch lights [count]."""
    power: Pulses | None = None
    """Light in the first and the second frame; absent: the power of the sheet's pulses."""

    _has_direction = field_validator("normal", "along")(_direction)

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


class HalfSpace(Table):
    """Table ``[[wall]]`` with ``kind = "half_space"``: everything behind a plane is solid."""

    kind: Literal["half_space"] = "half_space"
    point_mm: Point
    """A point of the wall's surface (x, y, z) [mm]."""
    normal: Point
    """Normal of the surface, out of the wall into the fluid (x, y, z), of any length."""

    _has_direction = field_validator("normal")(_direction)

    def contains(self, points_mm: np.ndarray) -> np.ndarray:
        """Return which points (n, 3) [mm] are in the wall, shape (n,)."""
        inside: np.ndarray = (np.asarray(points_mm, float) - self.point_mm) @ np.asarray(self.normal, float) < 0
        return inside


class Box(Table):
    """Table ``[[wall]]`` with ``kind = "box"``: a solid box along the axes."""

    kind: Literal["box"] = "box"
    centre_mm: Point
    """Centre of the box (x, y, z) [mm]."""
    size_mm: tuple[Positive, Positive, Positive]
    """Size of the box (x, y, z) [mm]."""

    def contains(self, points_mm: np.ndarray) -> np.ndarray:
        """Return which points (n, 3) [mm] are in the box, shape (n,)."""
        inside = np.abs(np.asarray(points_mm, float) - self.centre_mm) < np.divide(self.size_mm, 2)
        every: np.ndarray = np.logical_and.reduce(inside, axis=1)
        return every


Wall = Annotated[HalfSpace | Box, Field(discriminator="kind")]


WALLS = ("half_space", "box")
"""Kinds of walls."""


def _as_list(value: Any) -> Any:
    return value if isinstance(value, (list, tuple)) else (value,)


def _known_walls(value: Any) -> Any:
    walls = _as_list(value)
    if any(isinstance(wall, Mapping) and wall.get("kind") not in WALLS for wall in walls):
        raise ValueError(f"a wall with kind = {' or '.join(map(repr, WALLS))}")
    return walls


Walls = Annotated[tuple[Wall, ...], BeforeValidator(_known_walls)]
"""Solid regions without particles. They hide nothing behind them."""
Surfaces = Annotated[tuple[Surface, ...], BeforeValidator(_as_list)]


def solid(walls: tuple[HalfSpace | Box, ...] | None, points_mm: np.ndarray) -> np.ndarray:
    """Return which points are in a wall.

    Parameters
    ----------
    walls : tuple of HalfSpace or Box, or None
        The walls of a scene.
    points_mm : ndarray, shape (n, 3)
        Points (x, y, z) [mm].

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    inside = np.zeros(len(points_mm), bool)
    for wall in walls or ():
        inside |= wall.contains(points_mm)
    return inside
