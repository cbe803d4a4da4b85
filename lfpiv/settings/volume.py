"""Tables of the volume and of solids in it."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from lfpiv.settings import bounds
from lfpiv.settings.bounds import Direction, Length, PathText, Point, Thickness
from lfpiv.settings.table import Table


class Volume(Table):
    """Table ``[volume]``: the voxel grid, in the order (x, y, z)."""

    centre_mm: Point
    """Centre (x, y, z) of the volume [mm]."""
    size_mm: tuple[Length, Length, Length]
    """Size (x, y, z) of the volume, at least 4 voxels along each axis [mm]."""
    voxel_mm: Length
    """Edge of a voxel [mm]."""
    guard_mm: Thickness | tuple[Thickness, Thickness, Thickness] | Literal["auto"] = "auto"
    """Thickness of the guard layers beyond the volume's faces, one number or (x, y, z), which are reconstructed and cut
    away [mm]; "auto" measures in the particle images how far their light reaches and takes at least one voxel, 0
    reconstructs no guard layers."""


class HalfSpace(Table):
    """Solid of kind "half_space": everything behind a plane. Table ``[[volume.solid]]``, in scenes ``[[wall]]``."""

    kind: Literal["half_space"] = "half_space"
    point_mm: Point
    """A point (x, y, z) on the solid's surface [mm]."""
    normal: Direction
    """Direction (x, y, z) from the surface into the fluid, of any length."""

    def contains(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which points (x, y, z) [mm] are behind the plane; the coordinates are broadcast against each other."""
        axes = zip(self.normal, (x, y, z), self.point_mm, strict=True)
        return np.asarray(sum(n * (at - point) for n, at, point in axes) < 0)


class Box(Table):
    """Solid of kind "box", its faces normal to x, y, z. Table ``[[volume.solid]]``, in scenes ``[[wall]]``."""

    kind: Literal["box"] = "box"
    centre_mm: Point
    """Centre (x, y, z) of the box [mm]."""
    size_mm: tuple[Length, Length, Length]
    """Edges (x, y, z) of the box [mm]."""

    def contains(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which points (x, y, z) [mm] are within the faces; the coordinates are broadcast against each other."""
        axes = zip((x, y, z), self.centre_mm, self.size_mm, strict=True)
        within = [np.abs(at - centre) < size / 2 for at, centre, size in axes]
        return np.asarray(within[0] & within[1] & within[2])


Solid = Annotated[HalfSpace | Box, Field(discriminator="kind")]


class ExperimentVolume(Volume):
    """Table ``[volume]`` of an experiment: the voxel grid, and where it holds no fluid."""

    mask: PathText | None = None
    """Path of a NetCDF file, true or 1 where there is solid, over z, y, x with coordinates in mm; absent: none. With
    ``{pair}`` and perhaps ``{frame}``, or ``{image}``, or in a time series ``{instant}``, a file of each frame, for a
    body that moves."""
    solid: Annotated[tuple[Solid, ...], Field(max_length=bounds.MOST_SOLIDS)] = ()
    """Solids in the volume, each a table."""
