"""Order in which the voxels of a grid lie in memory.

Weights and SMART work on flat arrays of voxels. Neighbours in memory share pixels if the axis that moves a voxel's
image across the sensor's rows is the outermost one. `StoredGrid` picks that order and converts volumes to it and back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lfpiv.geometry.grid import Grid
from lfpiv.weights.ray_fit import grid_models

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera


@dataclass(frozen=True)
class StoredGrid:
    """A grid and the order of its axes in memory."""

    grid: Grid
    order: tuple[int, int, int]
    """Axes of the grid (0: z, 1: y, 2: x), outermost first."""

    @classmethod
    def for_cameras(
        cls, grid: Grid, cameras: Iterable[CalibratedCamera], *, columns_inmost: bool = False
    ) -> StoredGrid:
        """Choose the order by how far 1 mm along each axis moves a point's image.

        The axis with the largest movement across the sensors' rows is the outermost one. Of the other two, the axis
        with the larger movement across the columns is the middle axis, or the innermost one for `columns_inmost`.
        """
        points = grid.centre_mm + np.concatenate([np.zeros((1, 3)), np.eye(3)[::-1]])  # the centre, 1 mm along z, y, x
        shift = np.zeros((3, 2))
        for camera in cameras:
            image = camera.map(points, np.zeros((4, 2)))
            shift += np.abs(image[1:] - image[0])
        outer = int(np.argmax(shift[:, 1]))
        far, near = sorted((axis for axis in range(3) if axis != outer), key=lambda axis: -float(shift[axis, 0]))
        return cls(grid, (outer, near, far) if columns_inmost else (outer, far, near))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxel counts, outermost axis first."""
        outer, middle, inner = (self.grid.shape[axis] for axis in self.order)
        return outer, middle, inner

    @property
    def size(self) -> int:
        """Number of voxels."""
        return self.grid.size

    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """Voxel counts of the grid, order (z, y, x)."""
        return self.grid.shape

    @property
    def voxel_mm(self) -> float:
        """Edge of a voxel [mm]."""
        return self.grid.voxel_mm

    def models(self, camera: CalibratedCamera, form: str = "pixels") -> Iterator[np.ndarray]:
        """Yield the ray models of the voxels, plane by plane of the outermost axis, see `grid_models`."""
        outer, middle, inner = (2 - axis for axis in self.order)  # 0: x, 1: y, 2: z
        return grid_models(camera, self.shape, self.positions_mm, (outer, middle, inner), form)

    def centres_mm(self, index: np.ndarray) -> np.ndarray:
        """Return the centres (x, y, z) of voxels by their stored index, shape (voxel, 3) [mm]."""
        return self.positions_mm(np.stack(np.unravel_index(index, self.shape), axis=1))

    def positions_mm(self, indices: np.ndarray) -> np.ndarray:
        """Return positions (x, y, z) [mm] by indices along the stored axes, perhaps fractional; shapes (point, 3)."""
        positions = np.empty((len(indices), 3))
        for column, axis in enumerate(self.order):
            positions[:, 2 - axis] = self.grid.first_centre_mm[axis] + indices[:, column] * self.grid.voxel_mm
        return positions

    def index(self, voxel: tuple[int, int, int]) -> int:
        """Return the stored index of voxel (iz, iy, ix)."""
        return int(np.ravel_multi_index([voxel[axis] for axis in self.order], self.shape))

    def store(self, volume: ArrayLike) -> np.ndarray:
        """Flatten a (z, y, x) volume in stored order: shape (voxel,), float32, contiguous.

        Raises
        ------
        ValueError
            If the volume does not have the grid's shape.
        """
        array = np.asarray(volume, np.float32)
        if array.shape != self.grid.shape:
            raise ValueError(f"volume: expected shape {self.grid.shape} (z, y, x), got {array.shape}.")
        return np.ascontiguousarray(array.transpose(self.order)).ravel()

    def restore(self, flat: np.ndarray) -> np.ndarray:
        """Invert `store`: return a C-contiguous (z, y, x) array."""
        return np.ascontiguousarray(flat.reshape(self.shape).transpose(np.argsort(self.order)))
