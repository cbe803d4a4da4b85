"""Nodes on planes across a camera's line of sight, whose weights stand for those of all voxels.

Along its line of sight a point's image changes slowly: a ray through the pupil's edge moves by a sixteenth of the way
at f/4 and unit magnification. So the image of a voxel is interpolated between those of nodes on planes several layers
apart, at the places where its line of sight meets the planes: W = V R with the nodes' weights V, and R of
`lfpiv_kernels.reconstruction.depth_planes`. This is the factorisation of shear and warp [1]_, here with an image of
the optics per node. It needs a third of the weights, and of the time of a projection. `choose_planes` takes the widest
distance of planes with which images of voxels agree with their own footprints.

Images of voxels change fast across the line of sight. So nodes lie whole voxels aside from one another where a lattice
direction is near: 0 or 45 degrees from an axis, up to some degrees beside it. Then nothing is interpolated across the
line of sight. Where none is near along an axis across it, nodes lie along the line of sight itself, and voxels are
first shared among lines of sight along this axis, see `lfpiv.weights.line_shares`. Images of single voxels are not the
same then, but those of particles are, up to the steps that voxels have at their edges. These are compared instead.

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
from numpy.typing import ArrayLike
from scipy import sparse

from lfpiv.weights.blocks import WHOLE, Cuts, PackedCamera, blocks_of
from lfpiv.weights.counting import draw_seen
from lfpiv.weights.line_shares import BEFORE, line_shares
from lfpiv.weights.ray_fit import grid_models, ray_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.depth_planes import TAPS, PlaneShares

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

DISTANCES: tuple[int, ...] = (10, 8, 7, 6, 5, 4, 3, 2)
"""Distances of planes that are tried, widest first [layer of voxels]."""
VOXEL_ERROR, WORST_VOXEL_ERROR = 0.015, 0.03
"""Largest root mean square, and largest, of the relative L2 differences of voxels' interpolated images from their own
ones: for points and particles of unknown size."""
PARTICLE_ERROR, WORST_PARTICLE_ERROR = 0.03, 0.04
"""The same of the images of particles, where these are large enough."""
FARTHEST_ASIDE = 1.0
"""Rows or columns by which a line of sight may leave its nodes from one plane to the next. From 0.6 on images no longer
agree."""
LEAST_GAIN = 1.5
"""Least ratio of voxels to nodes with which nodes are used."""
NEAR_LATTICE = 0.02
"""Difference of the line of sight from a lattice direction up to which voxels are not shared [voxel/layer]."""
PARTICLE_VOXEL = 0.85
"""Standard deviation of the particles whose images are compared, and of the smallest ones that are large enough
[voxel]."""
PARTICLES = 8
"""Number of particles whose images are compared."""
VOXELS_AT_A_TIME = 400
"""Voxels whose images are compared at a time: more take more memory."""
FEWEST_VOXELS = 100_000
"""Voxels of a volume from which on nodes are used. The weights of smaller ones take little time and memory."""
SEEDS = (1, 2, 3, 4)
"""Seeds of the samples of voxels whose images are compared."""


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
    def of(
        cls, stored: StoredGrid, camera: CalibratedCamera, distance: int, *, lines: tuple[bool, bool] = (False, False)
    ) -> NodeGrid:
        """Lay nodes along the lattice direction next to the line of sight to the middle of the grid.

        Along rows or columns for which `lines` is true they lie along this line of sight itself.
        """
        axes, slopes = _slopes(stored, camera)
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
        low, high = (of.tolist() for of in self._aside)
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
        plane: np.ndarray = np.clip(np.floor(place).astype(int) - 1, 0, self._planes - TAPS)
        return plane

    def _whole(self, layer: np.ndarray) -> np.ndarray:
        """Return the whole rows and columns by which the line of sight through voxel 0 of layer 0 has moved."""
        whole: np.ndarray = np.ceil(layer[..., None] * np.array(self.slopes)).astype(int)
        return whole

    def _parts(self, layer: np.ndarray) -> np.ndarray:
        """Return the parts of a row and of a column, above -1 and at most 0, by which it has moved besides."""
        parts: np.ndarray = layer[..., None] * np.array(self.slopes) - self._whole(layer)
        return parts

    @cached_property
    def _moved(self) -> np.ndarray:
        """Rows and columns from each layer's lines of sight to their nodes on four planes, shape (layer, 4, 2)."""
        planes = self._first_layer + self.distance * (self._plane[:, None] + np.arange(TAPS))
        moved: np.ndarray = self._whole(planes) - self._whole(np.arange(len(planes)))[:, None]
        return moved

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

    def models(self, camera: CalibratedCamera) -> Iterator[np.ndarray]:
        """Yield the ray models of the nodes, row by row."""
        world = [2 - self.stored.order[axis] for axis in self.axes]
        depth = world[1]
        parts = self._parts(self._first_layer + self.distance * np.arange(self._planes))
        for model in grid_models(camera, self.shape, self.positions_mm, (world[0], world[1], world[2])):
            model[:, 12 + 2 * depth : 14 + 2 * depth] /= self.distance  # edges are those of voxels
            model[:, 18 + 4 * depth : 22 + 4 * depth] /= self.distance
            of_planes = model.reshape(*self.shape[1:], -1)
            for axis, part in zip((world[0], world[2]), parts.T[:, :, None], strict=True):
                for of in range(2):  # the point on the array and its slopes; they change linearly over a voxel
                    place, edge, slope = 6 * of, 12 + 2 * axis + of, 18 + 4 * axis + 2 * of
                    of_planes[..., place] += part * of_planes[..., edge]
                    of_planes[..., place + 1 : place + 3] += part[..., None] * of_planes[..., slope : slope + 2]
            yield model


def line_of_sight(camera: CalibratedCamera, point_mm: np.ndarray, pupil_mm: ArrayLike = (0.0, 0.0)) -> np.ndarray:
    """Return the direction (x, y, z) along which the place of a ray on the microlens array does not change.

    The ray crosses the pupil at `pupil_mm` (u, v); default: the chief ray.
    """
    step = 0.5 * np.eye(3)
    places = camera.map(np.concatenate([point_mm + step, point_mm - step]), np.tile(pupil_mm, (6, 1)))
    direction: np.ndarray = np.linalg.svd(np.asarray(places[:3] - places[3:], float).T)[2][2]
    return direction


def choose_planes(
    stored: StoredGrid, camera: CalibratedCamera, form: str, cuts: Cuts = WHOLE, particle_voxel: float = 0.0
) -> NodeGrid | None:
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
    particle_voxel : float
        Standard deviation of the particles [voxel]; 0 for points and where it is unknown. From `PARTICLE_VOXEL` on
        images of particles count in place of those of voxels, and voxels may be shared among lines of sight.

    Returns
    -------
    NodeGrid or None
        None if the weights of all voxels are to be stored.
    """
    if stored.grid.size < FEWEST_VOXELS:
        return None
    seen = np.unique(np.concatenate([draw_seen(stored, camera, seed) for seed in SEEDS]))
    if not len(seen):
        return None
    slopes = _slopes(stored, camera)[1]
    aside, ways = np.abs(slopes - np.rint(slopes)), _ways_to_share(slopes)
    if particle_voxel >= PARTICLE_VOXEL:
        kind, largest, worst = "particles", PARTICLE_ERROR, WORST_PARTICLE_ERROR
        sample = Sample(camera, *blobs_about(stored, seen[:: len(seen) // PARTICLES + 1]), form, cuts)
    else:
        kind, largest, worst, ways = "voxels", VOXEL_ERROR, WORST_VOXEL_ERROR, ways[:1]
        sample = Sample(camera, seen[:, None], np.ones((len(seen), 1)), form, cuts)
    own, chosen = sample.own_images(stored), None
    for lines in ways:
        kept = aside[~np.array(lines)].max(initial=0)
        for distance in (one for one in DISTANCES if one * kept <= FARTHEST_ASIDE):
            nodes = NodeGrid.of(stored, camera, distance, lines=lines)
            if LEAST_GAIN * nodes.size > stored.grid.size or (chosen is not None and nodes.size >= chosen.size):
                break
            errors = interpolation_errors(nodes, sample, own)
            error = float(np.sqrt(np.mean(np.square(errors))))
            if error <= largest and max(errors) <= worst:
                text = "%s: planes %d layers apart, shared along (rows, columns) %s: images of %s differ by %.1f %%"
                log.debug(text, camera.name, distance, lines, kind, 100 * error)
                chosen = nodes
                break
    return chosen


def _slopes(stored: StoredGrid, camera: CalibratedCamera) -> tuple[tuple[int, int, int], np.ndarray]:
    """Return the axes of rows, layers and columns, and by how many rows and columns a line of sight moves per layer."""
    sight = line_of_sight(camera, stored.grid.centre_mm)
    along = np.array([sight[2 - axis] for axis in stored.order])
    layers = int(np.argmax(np.abs(along)))
    rows, columns = (axis for axis in range(3) if axis != layers)
    return (rows, layers, columns), along[[rows, columns]] / along[layers]


def _ways_to_share(slopes: np.ndarray) -> list[tuple[bool, bool]]:
    """Return along which of rows and columns to share voxels: neither, where a lattice direction is farther, both.

    Shares among lines of sight that move slowly are the least accurate, so one axis alone is often better than both.
    """
    aside = np.abs(slopes - np.rint(slopes))
    along_rows = bool(aside[0] > aside[1])
    ways = [(False, False), (along_rows, not along_rows), (True, True)]
    return ways[: 1 + int((aside > NEAR_LATTICE).sum())]


@dataclass(frozen=True)
class Sample:
    """Groups of voxels, such as particles, whose images are compared."""

    camera: CalibratedCamera
    voxels: np.ndarray
    """Indices of the voxels, shape (group, voxel)."""
    light: np.ndarray
    """Their light, shape (group, voxel)."""
    form: str
    """Form of the weights, "profiles" or "pixels"."""
    cuts: Cuts = WHOLE
    """Parts of a voxel along x, y, z."""

    @property
    def parts(self) -> list[slice]:
        """Groups that are compared at a time: those of some `VOXELS_AT_A_TIME` voxels."""
        groups, each = self.voxels.shape
        step = max(1, VOXELS_AT_A_TIME // each)
        return [slice(first, first + step) for first in range(0, groups, step)]

    def images(self, centres_mm: np.ndarray, voxel_mm: float, light: sparse.csr_array) -> sparse.csr_array:
        """Return sums of the images of cubes at some places with the light (group, cube), shape (group, pixel)."""
        models = ray_models(self.camera, centres_mm, voxel_mm)
        found = light @ blocks_of(PackedCamera.of(self.camera), [models], self.form, cuts=self.cuts).pixel_weights()
        found.sum_duplicates()  # sorts the pixels, without which a difference takes time for each pixel of the sensor
        return found

    def own_images(self, stored: StoredGrid) -> list[sparse.csr_array]:
        """Return the images of each part of the groups by the voxels' own footprints, shapes (group, pixel)."""
        found = []
        for part in self.parts:
            voxels, light = self.voxels[part], self.light[part]
            each = np.arange(voxels.size + 1)
            groups = sparse.csr_array((light.ravel(), each[:-1], each[:: voxels.shape[1]]))
            found.append(self.images(stored.centres_mm(voxels.ravel()), stored.voxel_mm, groups))
        return found


def blobs_about(stored: StoredGrid, voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gaussian particles about some voxels, moved by parts of a voxel: indices and light, (particle, voxel)."""
    reach = math.ceil(3 * PARTICLE_VOXEL)
    steps = np.arange(-reach, reach + 1)
    last = np.array(stored.shape) - 1
    middle = np.stack(np.unravel_index(voxels, stored.shape), axis=1)
    middle = np.clip(middle, np.minimum(reach, last // 2), np.maximum(last - reach, last // 2))
    places, light = [], []
    for at, part in zip(middle, np.random.default_rng(SEEDS[0]).uniform(-0.5, 0.5, (len(voxels), 3)), strict=True):
        along = [np.clip(at[axis] + steps, 0, last[axis]) for axis in range(3)]
        places.append(np.ravel_multi_index(np.meshgrid(*along, indexing="ij"), stored.shape).ravel())
        of_axes = np.exp(-((steps - part[:, None]) ** 2) / (2 * PARTICLE_VOXEL**2))
        light.append(np.einsum("a,b,c->abc", *of_axes).ravel())
    return np.array(places), np.array(light)


def interpolation_errors(nodes: NodeGrid, sample: Sample, own: list[sparse.csr_array]) -> list[float]:
    """Compare interpolated images of groups of voxels with those from their own footprints.

    Parameters
    ----------
    nodes : NodeGrid
        The nodes.
    sample : Sample
        The groups of voxels.
    own : list of csr_array
        Their images, from `Sample.own_images`.

    Returns
    -------
    list of float
        Relative L2 difference of each group that the camera sees; infinity alone if it sees none.
    """
    errors: list[float] = []
    for part, exact in zip(sample.parts, own, strict=True):
        voxels, light = sample.voxels[part], sample.light[part]
        found = [nodes.shares.nodes_of(int(voxel)) for voxel in voxels.ravel()]
        used, place = np.unique(np.concatenate([node for node, _ in found]), return_inverse=True)
        shares = np.concatenate([of * share for of, (_, share) in zip(light.ravel(), found, strict=True)])
        first = np.cumsum([0, *(len(node) for node, _ in found)])[:: voxels.shape[1]]
        of_nodes = sparse.csr_array((shares, place, first), (len(voxels), len(used)))
        apart = exact - sample.images(nodes.centres_mm(used), nodes.voxel_mm, of_nodes)
        norms, differences = (np.sqrt(one.power(2).sum(axis=1)) for one in (exact, apart))
        errors += (differences[norms > 0] / norms[norms > 0]).tolist()
    return errors or [math.inf]


def _lagrange(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the shares of values at -1, 0, 1 and 2 in the cubic through them at t."""
    return (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
