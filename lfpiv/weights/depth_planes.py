"""Nodes on planes across a camera's line of sight, whose weights stand for those of all voxels.

Along its line of sight a point's image changes slowly: a ray through the pupil's edge moves by a sixteenth of the way
at f/4 and unit magnification. So the image of a voxel is interpolated between those of nodes on planes several layers
apart, at the places where its line of sight meets the planes: W = V R with the nodes' weights V, and R of
`lfpiv_kernels.reconstruction.depth_planes`. This is the factorisation of shear and warp [1]_, here with an image of
the optics per node. It needs a third of the weights, and of the time of a projection. `choose_planes` takes the widest
distance of planes with which images of voxels agree with their own footprints.

Across the line of sight nothing is interpolated, because images of voxels change fast there. So nodes lie whole voxels
aside from one another, along the lattice direction next to the line of sight: 0 or 45 degrees from an axis. Where the
two differ by more than some degrees, no distance serves, and the weights of all voxels are stored.

.. [1] P. Lacroute, M. Levoy, "Fast volume rendering using a shear-warp factorization of the viewing transformation",
   SIGGRAPH 1994, 451-458, doi:10.1145/192161.192283.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.weights.blocks import WHOLE, Cuts, PackedCamera, blocks_of
from lfpiv.weights.counting import draw_seen
from lfpiv.weights.ray_fit import grid_models, ray_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.depth_planes import TAPS, PlaneShares
from lfpiv_kernels.reconstruction.projector import Blocks

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

DISTANCES = (8, 7, 6, 5, 4, 3, 2)
"""Distances of planes that are tried, widest first [layer of voxels]."""
LARGEST_ERROR = 0.015
"""Largest root mean square of the relative L2 differences of interpolated images from those of the voxels."""
WORST_ERROR = 0.03
"""Largest of these differences."""
LEAST_GAIN = 1.5
"""Least ratio of voxels to nodes with which nodes are used."""
FEWEST_VOXELS = 100_000
"""Voxels of a volume from which on nodes are used. The weights of smaller ones take little time and memory."""
SEEDS = (1, 2, 3, 4)
"""Seeds of the samples of voxels whose images are compared."""


@dataclass(frozen=True)
class NodeGrid:
    """Nodes of one camera for the voxels of a grid: its voxels in every n-th layer, and some beyond its sides."""

    stored: StoredGrid
    axes: tuple[int, int, int]
    """Axes of the volume in memory that count rows, layers and columns; layers lie across the line of sight."""
    slopes: tuple[int, int]
    """Rows and columns by which nodes move from one layer to the next."""
    distance: int
    """Layers from one plane to the next."""

    @classmethod
    def of(cls, stored: StoredGrid, camera: CalibratedCamera, distance: int) -> NodeGrid:
        """Lay nodes along the lattice direction next to the line of sight to the middle of the grid."""
        sight = line_of_sight(camera, stored.grid.centre_mm)
        along = np.array([sight[2 - axis] for axis in stored.order])
        layers = int(np.argmax(np.abs(along)))
        rows, columns = (axis for axis in range(3) if axis != layers)
        row, column = np.rint(along[[rows, columns]] / along[layers]).astype(int).tolist()
        return cls(stored, (rows, layers, columns), (row, column), distance)

    @cached_property
    def shares(self) -> PlaneShares:
        """How voxels are shared among the nodes."""
        rows, layers, columns = (self.stored.shape[axis] for axis in self.axes)
        place = (np.arange(layers) - self._first_layer) / self.distance
        plane = np.clip(np.floor(place).astype(int) - 1, 0, self._planes - TAPS)
        share = np.stack(_lagrange(place - plane - 1), axis=-1)
        low, high = self._aside
        return PlaneShares(
            axes=self.axes,
            voxels=self.stored.shape,
            nodes=(rows + high[0] - low[0], self._planes, columns + high[1] - low[1]),
            plane=plane.astype(np.int32),
            share=share.astype(np.float32),
            shift=(self._moved(plane) - low).astype(np.int32),
        )

    @property
    def _planes(self) -> int:
        """Number of planes. One lies beyond each end, so that every layer lies between the middle two of four."""
        return math.ceil((self.stored.shape[self.axes[1]] - 1) / self.distance) + 3

    @property
    def _first_layer(self) -> int:
        """Layer of the first plane, below 0."""
        return (self.stored.shape[self.axes[1]] - 1 - (self._planes - 1) * self.distance) // 2

    def _moved(self, plane: np.ndarray) -> np.ndarray:
        """Return the rows and columns from each layer's voxels to their nodes on four planes, shape (layer, 4, 2)."""
        gap = self._first_layer + self.distance * (plane[:, None] + np.arange(TAPS)) - np.arange(len(plane))[:, None]
        moved: np.ndarray = gap[..., None] * np.array(self.slopes)
        return moved

    @property
    def _aside(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows and columns by which nodes lie aside of their voxels: the least and the largest ones."""
        reach = 2 * self.distance
        row, column = (reach * abs(slope) for slope in self.slopes)
        return (-row, -column), (row, column)

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
        """Return places (x, y, z) [mm] by indices along rows, planes and columns, shape (node, 3)."""
        low, _ = self._aside
        along = np.empty(np.shape(steps))
        along[:, self.axes[0]] = steps[:, 0] + low[0]
        along[:, self.axes[1]] = self._first_layer + self.distance * steps[:, 1]
        along[:, self.axes[2]] = steps[:, 2] + low[1]
        return self.stored.positions_mm(along)

    def centres_mm(self, index: np.ndarray) -> np.ndarray:
        """Return places (x, y, z) [mm] of nodes by their index, shape (node, 3)."""
        return self.positions_mm(np.stack(np.unravel_index(index, self.shape), axis=1))

    def models(self, camera: CalibratedCamera) -> Iterator[np.ndarray]:
        """Yield the ray models of the nodes, row by row."""
        world = [2 - self.stored.order[axis] for axis in self.axes]
        depth = world[1]
        for model in grid_models(camera, self.shape, self.positions_mm, (world[0], world[1], world[2])):
            model[:, 12 + 2 * depth : 14 + 2 * depth] /= self.distance  # edges are those of voxels
            model[:, 18 + 4 * depth : 22 + 4 * depth] /= self.distance
            yield model


def line_of_sight(camera: CalibratedCamera, point_mm: np.ndarray) -> np.ndarray:
    """Return the direction (x, y, z) along which the chief ray's place on the microlens array does not change."""
    step = 0.5 * np.eye(3)
    places = camera.map(np.concatenate([point_mm + step, point_mm - step]), np.zeros((6, 2)))
    direction: np.ndarray = np.linalg.svd(np.asarray(places[:3] - places[3:], float).T)[2][2]
    return direction


def choose_planes(stored: StoredGrid, camera: CalibratedCamera, form: str, cuts: Cuts = WHOLE) -> NodeGrid | None:
    """Choose the nodes of a camera: the fewest whose images are accurate enough.

    Parameters
    ----------
    stored : StoredGrid
        The voxels.
    camera : CalibratedCamera
        The camera.
    form : {"profiles", "pixels"}
        Form of the weights.
    cuts : tuple of int
        Parts of a voxel along x, y, z.

    Returns
    -------
    NodeGrid or None
        None if the weights of all voxels are to be stored.
    """
    if stored.grid.size < FEWEST_VOXELS:
        return None
    sample = np.unique(np.concatenate([draw_seen(stored, camera, seed) for seed in SEEDS]))
    for distance in DISTANCES if len(sample) else ():
        nodes = NodeGrid.of(stored, camera, distance)
        if LEAST_GAIN * nodes.size > stored.grid.size:
            continue
        errors = interpolation_errors(nodes, camera, sample, form, cuts)
        error = float(np.sqrt(np.mean(np.square(errors))))
        if error <= LARGEST_ERROR and max(errors) <= WORST_ERROR:
            text = "%s: weights of %d nodes for %d voxels, planes %d layers apart: images differ by %.1f %%"
            log.info(text, camera.name, nodes.size, stored.grid.size, distance, 100 * error)
            return nodes
    return None


def interpolation_errors(
    nodes: NodeGrid, camera: CalibratedCamera, voxels: np.ndarray, form: str, cuts: Cuts = WHOLE
) -> list[float]:
    """Return the relative L2 difference of the interpolated images of some voxels from their own footprints."""
    found = [nodes.shares.nodes_of(int(voxel)) for voxel in voxels]
    places = [nodes.centres_mm(node) for node, _ in found]
    centres = np.concatenate([nodes.stored.centres_mm(voxels), *places])
    models = ray_models(camera, centres, nodes.voxel_mm)
    blocks = blocks_of(PackedCamera.of(camera), [models], form, cuts=cuts)
    errors, first = [], len(voxels)
    for number, (_, shares) in enumerate(found):
        parts = [(number, -1.0), *zip(range(first, first + len(shares)), shares.tolist(), strict=True)]
        first += len(shares)
        own = _image(blocks, parts[:1])
        light = math.sqrt(sum(value**2 for value in own.values()))
        if light > 0:
            errors.append(math.sqrt(sum(value**2 for value in _image(blocks, parts).values())) / light)
    return errors or [math.inf]


def _image(blocks: Blocks, parts: list[tuple[int, float]]) -> dict[int, float]:
    """Return the pixels of a weighted sum of voxels' images."""
    pixels, values = [], []
    for voxel, factor in parts:
        ray, weight = blocks.entries(voxel)
        share = blocks.microimages.share[ray]
        pixels.append(blocks.microimages.pixel[ray[share > 0]])
        values.append(factor * (weight * share)[share > 0])
    pixel, place = np.unique(np.concatenate(pixels), return_inverse=True)
    sums = np.bincount(place, np.concatenate(values), len(pixel))
    return dict(zip(pixel.tolist(), sums.tolist(), strict=True))


def _lagrange(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the shares of values at -1, 0, 1 and 2 in the cubic through them at t."""
    return (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
