"""Nodes along a camera's lines of sight, and the shares of the voxels among them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lfpiv.weights.forms.line_shares import BEFORE, line_shares
from lfpiv.weights.ray_fit import grid_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.depth_planes import TAPS, PlaneShares

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera


@dataclass(frozen=True)
class NodeGrid:
    """Nodes of one camera for the voxels of a grid: lines of sight in every n-th layer, and some beyond its sides."""

    stored: StoredGrid
    axes: tuple[int, int, int]
    """Axes of the volume in memory that count rows, layers and columns; layers lie across the line of sight."""
    slopes: tuple[float, float]
    """Rows and columns by which lines of sight move from one layer to the next. Along an axis where this is no whole
    number, voxels are shared among lines of sight."""
    distance: int
    """Layers from one plane to the next."""

    @classmethod
    def for_camera(
        cls, stored: StoredGrid, camera: CalibratedCamera, distance: int, *, lines: tuple[bool, bool] = (False, False)
    ) -> NodeGrid:
        """Lay nodes along the lattice direction next to the line of sight to the middle of the grid.

        Along rows or columns for which `lines` is true they lie along this line of sight itself.
        """
        axes, slopes = slopes_of(stored, camera)
        row, column = np.where(lines, slopes, np.rint(slopes)).tolist()
        return cls(stored, axes, (row, column), distance)

    @property
    def lines(self) -> tuple[bool, bool]:
        """Whether voxels are shared among lines of sight, along rows and along columns."""
        row, column = self.slopes
        return row % 1 != 0, column % 1 != 0

    @cached_property
    def shares(self) -> PlaneShares:
        """How voxels are shared among the nodes."""
        rows, layers, columns = (self.stored.shape[axis] for axis in self.axes)
        layer, plane = np.arange(layers), self._plane
        share = np.stack(_lagrange((layer - self._first_layer) / self.distance - plane - 1), axis=-1)
        low, high = (nodes.tolist() for nodes in self._aside)
        row_share, column_share = (
            line_shares(-part) if slope % 1 else np.ones((layers, 1))
            for slope, part in zip(self.slopes, self._parts(layer).T, strict=True)
        )
        more = (row_share.shape[1] - 1, column_share.shape[1] - 1)
        return PlaneShares(
            axes=self.axes,
            voxels=self.stored.shape,
            nodes=(rows + more[0] + high[0] - low[0], self._planes, columns + more[1] + high[1] - low[1]),
            plane=plane.astype(np.int32),
            share=share.astype(np.float32),
            shift=(self._moved - low).astype(np.int32),
            row_share=row_share.astype(np.float32),
            column_share=column_share.astype(np.float32),
        )

    @property
    def _planes(self) -> int:
        """Number of planes. One lies beyond each end, so that every layer lies between the middle two of four."""
        return math.ceil((self.stored.shape[self.axes[1]] - 1) / self.distance) + 3

    @property
    def _first_layer(self) -> int:
        """Layer of the first plane, below 0."""
        return (self.stored.shape[self.axes[1]] - 1 - (self._planes - 1) * self.distance) // 2

    @property
    def _plane(self) -> np.ndarray:
        """First of the four planes of each layer, shape (layer,)."""
        place = (np.arange(self.stored.shape[self.axes[1]]) - self._first_layer) / self.distance
        return np.clip(np.floor(place).astype(int) - 1, 0, self._planes - TAPS)

    def _whole(self, layer: np.ndarray) -> np.ndarray:
        """Return the whole rows and columns by which the line of sight through voxel 0 of layer 0 has moved."""
        return np.ceil(layer[..., None] * np.array(self.slopes)).astype(int)

    def _parts(self, layer: np.ndarray) -> np.ndarray:
        """Return the parts of a row and of a column, above -1 and at most 0, by which it has moved besides."""
        return layer[..., None] * np.array(self.slopes) - self._whole(layer)

    @cached_property
    def _moved(self) -> np.ndarray:
        """Rows and columns from each layer's lines of sight to their nodes on four planes, shape (layer, 4, 2)."""
        planes = self._first_layer + self.distance * (self._plane[:, None] + np.arange(TAPS))
        return self._whole(planes) - self._whole(np.arange(len(planes)))[:, None]

    @cached_property
    def _aside(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns by which nodes lie aside of their voxels: the least and the largest ones."""
        return self._moved.min((0, 1)), self._moved.max((0, 1))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, planes and columns."""
        return self.shares.nodes

    @property
    def size(self) -> int:
        """Number of nodes."""
        return self.shares.size

    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """Voxels of the grid (z, y, x)."""
        return self.stored.volume_shape

    @property
    def voxel_mm(self) -> float:
        """Edge of the cubes whose images are stored [mm]."""
        return self.stored.voxel_mm

    def positions_mm(self, steps: np.ndarray) -> np.ndarray:
        """Return places (x, y, z) [mm] by indices along rows, planes and columns, shape (place, 3).

        Parts of a row or column by which lines of sight have moved on a plane are left out.
        """
        low, _ = self._aside
        before = [BEFORE if slope % 1 else 0 for slope in self.slopes]
        along = np.empty(np.shape(steps))
        along[:, self.axes[0]] = steps[:, 0] + low[0] - before[0]
        along[:, self.axes[1]] = self._first_layer + self.distance * steps[:, 1]
        along[:, self.axes[2]] = steps[:, 2] + low[1] - before[1]
        return self.stored.positions_mm(along)

    def centres_mm(self, index: np.ndarray) -> np.ndarray:
        """Return places (x, y, z) [mm] of nodes by their index, shape (node, 3)."""
        steps = np.stack(np.unravel_index(index, self.shape), axis=1).astype(float)
        steps[:, [0, 2]] += self._parts(self._first_layer + self.distance * steps[:, 1])
        return self.positions_mm(steps)

    def models(self, camera: CalibratedCamera, form: str = "pixels") -> Iterator[np.ndarray]:
        """Yield the ray models of the nodes, row by row."""
        world = [2 - self.stored.order[axis] for axis in self.axes]
        depth = world[1]
        parts = self._parts(self._first_layer + self.distance * np.arange(self._planes))
        for model in grid_models(camera, self.shape, self.positions_mm, (world[0], world[1], world[2]), form):
            model[:, 12 + 2 * depth : 14 + 2 * depth] /= self.distance  # edges are those of voxels
            model[:, 18 + 4 * depth : 22 + 4 * depth] /= self.distance
            of_planes = model.reshape(*self.shape[1:], -1)
            for axis, part in zip((world[0], world[2]), parts.T[:, :, None], strict=True):
                for coordinate in range(2):  # the point on the array and its slopes; they change linearly over a voxel
                    place, edge = 6 * coordinate, 12 + 2 * axis + coordinate
                    slope = 18 + 4 * axis + 2 * coordinate
                    of_planes[..., place] += part * of_planes[..., edge]
                    of_planes[..., place + 1 : place + 3] += part[..., None] * of_planes[..., slope : slope + 2]
            yield model


def line_of_sight(camera: CalibratedCamera, point_mm: np.ndarray, pupil_mm: ArrayLike = (0.0, 0.0)) -> np.ndarray:
    """Return the direction (x, y, z) along which the place of a ray on the microlens array does not change.

    The ray crosses the pupil at `pupil_mm` (u, v); default: the chief ray.
    """
    step = 0.5 * np.eye(3)
    places = camera.map(np.concatenate([point_mm + step, point_mm - step]), np.tile(pupil_mm, (6, 1)))
    return np.linalg.svd(np.asarray(places[:3] - places[3:], float).T)[2][2]


def slopes_of(stored: StoredGrid, camera: CalibratedCamera) -> tuple[tuple[int, int, int], np.ndarray]:
    """Return the axes of rows, layers and columns, and by how many rows and columns a line of sight moves per layer."""
    sight = line_of_sight(camera, stored.grid.centre_mm)
    along = np.array([sight[2 - axis] for axis in stored.order])
    layers = int(np.argmax(np.abs(along)))
    rows, columns = (axis for axis in range(3) if axis != layers)
    return (rows, layers, columns), along[[rows, columns]] / along[layers]


def _lagrange(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the shares of values at -1, 0, 1 and 2 in the cubic through them at t."""
    return (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
