"""The rig in space: cameras with their pyramids of view, board planes, the volume, solids, and who sees each voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike

from lfpiv.geometry.orientation import Orientation
from lfpiv.settings.rig import Board, CameraTable
from lfpiv.settings.volume import Box, HalfSpace

SEEN_VOXELS = 32
"""Cells along the longest edge of the volume in which the cameras that see them are counted."""
REACH = 2.0
"""Length of the drawn pyramids of view towards the cameras [diagonals of the volume]."""
UNKNOWN_PIXELS = (2048, 2048)
"""Assumed sensor of a camera whose white image is missing, (rows, columns)."""


@dataclass(frozen=True)
class View:
    """A nominal camera for VTK: at the centre of its main lens, looking at the origin [mm]."""

    camera: pv.Camera
    aspect: float
    """Columns of the sensor over its rows."""

    @classmethod
    def from_table(cls, table: CameraTable, shape: tuple[int, int]) -> View:
        """Return the view of a camera of the experiment file, with the rows and columns of its sensor."""
        optics, camera = table.optics_of(shape), pv.Camera()
        _, up, towards = (table.orientation or Orientation(0.0)).rotation
        camera.position, camera.up = optics.object_distance_mm * towards, up
        half = 0.5 * shape[0] * optics.pixel_mm / abs(optics.magnification)
        camera.view_angle = 2 * np.degrees(np.arctan2(half, optics.object_distance_mm))
        return cls(camera, shape[1] / shape[0])

    def pyramid(self, length: float) -> pv.PolyData:
        """Return the edges of the field of view, from a length [mm] in front of the plane of focus to behind it."""
        distance, parts = self.camera.distance, []
        share = min(1.0, length / distance)
        for near, far in ((max(1 - share, 1e-3), 1.0), (1.0, 1 + 0.35 * share)):
            self.camera.clipping_range = near * distance, far * distance
            parts.append(self.camera.view_frustum(self.aspect).extract_all_edges())
        return pv.merge(parts)

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Return which points (n, 3) [mm] lie in the pyramid of view, shape (n,), bool."""
        planes = [0.0] * 24
        self.camera.GetFrustumPlanes(self.aspect, planes)
        sides = np.reshape(planes, (6, 4))[:4]
        return np.asarray((points @ sides[:, :3].T + sides[:, 3] >= 0).all(axis=1))


def count_seen(views: list[View], centre: np.ndarray, size: np.ndarray) -> pv.ImageData:
    """Return the number of cameras that see each cell of a coarse grid; volume by centre and size [mm]."""
    counts = np.maximum(2, np.round(SEEN_VOXELS * size / size.max())).astype(int)
    grid = pv.ImageData(dimensions=counts + 1, spacing=size / counts, origin=centre - size / 2)
    points = np.asarray(grid.cell_centers().points, float)
    grid.cell_data["cameras"] = np.sum([view.sees(points) for view in views], axis=0).astype(np.float32)
    return grid


def board_plane(board: Board, z_mm: float) -> pv.PolyData:
    """Return the dots of a plane of the board as points."""
    x, y = ((np.arange(n) - (n - 1) / 2) * board.spacing_mm for n in board.dots)
    return pv.PolyData(np.stack(np.meshgrid(x, y, [z_mm]), axis=-1).reshape(-1, 3))


def solid_shape(solid: Box | HalfSpace, volume: np.ndarray) -> pv.DataSet:
    """Return the part of a solid that lies in the bounds of the volume."""
    if isinstance(solid, HalfSpace):
        return pv.Box(volume).clip_closed_surface(normal=-np.asarray(solid.normal, float), origin=solid.point_mm)
    return pv.Box(bounds_of(solid.centre_mm, solid.size_mm))


def bounds_of(centre: ArrayLike, size: ArrayLike) -> np.ndarray:
    """Return the least and largest x, y and z of a box, shape (6,)."""
    half = np.asarray(size, float) / 2
    return np.column_stack([np.asarray(centre) - half, np.asarray(centre) + half]).ravel()
