"""Weights of voxels for one camera: blocks integrated in closed form, and rays counted in windows of the sensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid
from lfpiv.lightfield.microimage_layout import microimage_edge
from lfpiv.weights.ray_fit import fit_rays, grid_models, ray_models
from lfpiv_kernels import runtime
from lfpiv_kernels.rays.count import count_rays
from lfpiv_kernels.rays.lattice import Lattice, cell_frame, cell_steps, pack_lattice
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.weights import footprint
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, LEVELS, Camera, pack_optics

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

Progress = Callable[[float], None]
Cuts = tuple[int, int, int]
"""Parts of a voxel along x, y, z whose footprints are integrated apart and added."""

WHOLE: Cuts = (1, 1, 1)
"""A voxel in one piece."""
CHUNK_VOXELS = 16384
"""Voxels whose ray models are held at once."""
SAMPLED_VOXELS = 1024
"""Voxels from which the memory of all is estimated."""
MOST_BLOCKS = np.iinfo(np.int32).max
"""Blocks of a camera at most: their numbers have 32 bits."""
BLOCK_BYTES, VOXEL_BYTES = 6, 16
"""Memory of a block beside its values, and of a voxel beside its blocks [byte]."""
COUNT_POINTS = 8
"""Object points per voxel edge: 512 per voxel, the paper has 500."""


@dataclass(frozen=True)
class StoredGrid:
    """A grid whose voxels are stored in an order of its own, so that neighbours in memory share pixels."""

    grid: Grid
    order: tuple[int, int, int]
    """Axes of the grid (0: z, 1: y, 2: x), outermost first."""

    @classmethod
    def for_cameras(cls, grid: Grid, cameras: Iterable[CalibratedCamera]) -> StoredGrid:
        """Put the axis outermost that runs along the sensors' rows the most, then the one along their columns."""
        centre = [
            first + (n - 1) / 2 * grid.voxel_mm for first, n in zip(grid.first_centre_mm, grid.shape, strict=True)
        ]
        steps = np.concatenate([[centre[::-1]], centre[::-1] + np.eye(3)[::-1]])  # 1 mm along z, y, x
        shift = np.zeros((3, 2))
        for camera in cameras:
            st = camera.map(steps, np.zeros((4, 2)))
            shift += np.abs(st[1:] - st[0])
        outer = int(np.argmax(shift[:, 1]))
        middle, inner = sorted((axis for axis in range(3) if axis != outer), key=lambda axis: -float(shift[axis, 0]))
        return cls(grid, (outer, middle, inner))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxel counts, outermost axis first."""
        outer, middle, inner = (self.grid.shape[axis] for axis in self.order)
        return outer, middle, inner

    def centres_mm(self, index: np.ndarray) -> np.ndarray:
        """Centres (x, y, z) [mm] of voxels by their stored index, shape (voxel, 3)."""
        return self.positions_mm(np.stack(np.unravel_index(index, self.shape), axis=1))

    def positions_mm(self, steps: np.ndarray) -> np.ndarray:
        """Centres (x, y, z) [mm] of voxels by their indices along the stored axes, shape (voxel, 3)."""
        centres = np.empty((len(steps), 3))
        for column, axis in enumerate(self.order):
            centres[:, 2 - axis] = self.grid.first_centre_mm[axis] + steps[:, column] * self.grid.voxel_mm
        return centres

    def place(self, voxel: tuple[int, int, int]) -> int:
        """Return the stored index of voxel (iz, iy, ix)."""
        return int(np.ravel_multi_index([voxel[axis] for axis in self.order], self.shape))

    def store(self, volume: ArrayLike) -> np.ndarray:
        """Voxels of a (z, y, x) volume in stored order, shape (voxel,), float32, contiguous.

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
        """Inverse of `store`: a C-contiguous (z, y, x) array."""
        return np.ascontiguousarray(flat.reshape(self.shape).transpose(np.argsort(self.order)))


@dataclass(kw_only=True)
class CameraKernels:
    """One camera's constants as the kernels take them."""

    setup: CalibratedCamera
    camera: Camera
    lattice: Lattice
    cell_mm: float
    frame: np.ndarray
    outline: np.ndarray

    def footprints(self, form: str, cuts: Cuts = WHOLE) -> footprint.Footprints:
        """Return what computes this camera's blocks of a form."""
        return footprint.Footprints(
            self.camera,
            self.lattice,
            self.cell_mm,
            self.setup.microimages,
            frame=self.frame,
            outline=self.outline,
            form=form,
            cuts=cuts,
        )


def pack_camera(camera: CalibratedCamera) -> CameraKernels:
    """Pack a camera for the kernels."""
    optics, lattice = camera.optics, camera.lattice
    basis = np.asarray(lattice.basis_mm)
    if lattice.layout == "square":
        cell = 0.5 * np.abs(basis).sum(0).max()
    else:
        cell = lattice.pitch_mm / math.sqrt(3)
    return CameraKernels(
        setup=camera,
        camera=pack_optics(
            sensor_per_pupil=optics.sensor_per_pupil,
            pixel_mm=optics.pixel_mm,
            sensor_shape=optics.sensor_shape,
            pupil_radius_mm=optics.pupil_radius_mm,
            edge=microimage_edge(optics),
        ),
        lattice=pack_lattice(np.asarray(lattice.origin_mm), basis),
        cell_mm=float(cell),
        frame=cell_frame(basis, lattice.layout),
        outline=cell_steps(lattice.layout),
    )


class _Growing:
    """An array of unknown length, filled piece by piece; memory that nobody wrote to yet costs nothing."""

    def __init__(self, dtype: type, expected: int):
        self._array: np.ndarray = np.empty(max(expected, 1), dtype)
        self._used = 0

    def take(self, count: int) -> np.ndarray:
        """Return the next `count` entries, to be written before the next call."""
        first, self._used = self._used, self._used + count
        if self._used > len(self._array):
            self._array.resize(self._used + self._used // 8, refcheck=False)  # moves pages where the system can
        return self._array[first : self._used]

    def done(self) -> np.ndarray:
        """Return all entries taken."""
        self._array.resize(self._used, refcheck=False)
        return self._array


def footprint_blocks(
    stored: StoredGrid,
    camera: CalibratedCamera,
    form: str,
    progress: Progress,
    allow: Callable[[int], None] = lambda _: None,
    cuts: Cuts = WHOLE,
) -> Blocks:
    """Compute the blocks of one camera.

    `allow` is called with the memory they will take [byte], known from a sample of the voxels, and may raise.

    Raises
    ------
    InputError
        If there are more blocks than can be numbered: before they are computed.
    """
    size = stored.grid.size
    plane = size // stored.shape[0]
    pack = pack_camera(camera)
    blocks, values = sample_blocks(pack, stored, form, cuts)
    require_numbers(size * blocks, stored.grid.shape)
    allow(int(size * (BLOCK_BYTES * blocks + values + VOXEL_BYTES)))
    outer, middle, inner = (2 - axis for axis in stored.order)
    planes = grid_models(camera, stored.shape, stored.positions_mm, (outer, middle, inner))

    def batches() -> Iterator[np.ndarray]:
        step = max(1, CHUNK_VOXELS // plane)
        with threadpool_limits(1, "blas"):  # products of a plane each: BLAS's own threads cost more than they bring
            for first in range(0, stored.shape[0], step):
                yield np.concatenate(list(islice(planes, step)))
                progress(min(first + step, stored.shape[0]) / stored.shape[0])

    return blocks_of(pack, batches(), form, (int(size * blocks), int(size * values)), cuts)


def require_numbers(blocks: float, shape: tuple[int, ...]) -> None:
    """Refuse more blocks than 32-bit numbers can tell apart."""
    if blocks > MOST_BLOCKS:
        voxels = " x ".join(map(str, shape))
        raise InputError(
            f"volume: the weights of {voxels} voxels on one camera need {blocks:.2g} blocks, but "
            f"{MOST_BLOCKS:.2g} can be numbered. Raise volume.voxel_mm, or shrink volume.size_mm."
        )


def sample_blocks(pack: CameraKernels, stored: StoredGrid, form: str, cuts: Cuts = WHOLE) -> tuple[float, float]:
    """Blocks and values per voxel, from a sample of a grid's voxels."""
    sample = np.unique(np.linspace(0, stored.grid.size - 1, SAMPLED_VOXELS).astype(np.int64))
    model = ray_models(pack.setup, stored.centres_mm(sample), stored.grid.voxel_mm)
    blocks, values = (
        np.concatenate(counts) for counts in zip(*pack.footprints(form, cuts).compute(model), strict=True)
    )
    return float(blocks.mean()), float(values.mean())


def blocks_of(
    pack: CameraKernels, models: Iterable[np.ndarray], form: str, expected: tuple[int, int], cuts: Cuts = WHOLE
) -> Blocks:
    """Compute the blocks of voxels from their ray models, batch by batch.

    Parameters
    ----------
    pack : CameraKernels
        The camera.
    models : iterable of ndarray, shape (voxel, 30), float32
        Ray models, one batch after the other.
    form : {"profiles", "pixels"}
        Form of the blocks.
    expected : tuple of int
        Blocks and values to be expected: what is reserved at first.
    cuts : tuple of int
        Parts of the voxels, where the form is "pixels".
    """
    footprints = pack.footprints(form, cuts)
    blocks, values = (int(1.02 * count) + BLOCK_WIDTH for count in expected)
    ray, height, width = (_Growing(dtype, blocks) for dtype in (np.int32, np.uint8, np.uint8))
    value = _Growing(np.uint8, values)
    counts, scales = [], []
    for model in models:
        for count in footprints.compute(model):
            some, scale = int(count[0].sum(dtype=np.int64)), np.empty(len(count[0]), np.float32)
            room = value.take(int(count[1].sum(dtype=np.int64)))
            footprints.write(ray.take(some), height.take(some), width.take(some), room, scale)
            counts.append(count)
            scales.append(scale)
    value.take(BLOCK_WIDTH)[:] = 0
    first_block, first_value = (
        np.concatenate([[0], *(count[k] for count in counts)]).cumsum(dtype=np.int64) for k in range(2)
    )
    require_numbers(first_block[-1], (len(first_block) - 1,))
    return Blocks(
        form=form,
        first_block=first_block.astype(np.int32),
        first_value=first_value,
        ray=ray.done(),
        height=height.done(),
        width=width.done(),
        value=value.done(),
        scale=np.concatenate(scales),
        microimages=pack.setup.microimages,
    )


def count_voxels(
    camera: CalibratedCamera,
    centres_mm: np.ndarray,
    voxel_mm: float,
    *,
    samples: int,
    points: int = COUNT_POINTS,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trace rays from stratified points in voxels and count them per pixel (Eq. 10).

    Parameters
    ----------
    camera : CalibratedCamera
        Mapping, optics and lattice.
    centres_mm : ndarray, shape (voxel, 3)
        Voxel centres (x, y, z) [mm].
    voxel_mm : float
        Voxel edge [mm].
    samples : int
        Pupil points per axis.
    points : int
        Object points per voxel edge.
    seed : int
        Seed of the positions inside the strata.

    Returns
    -------
    count : ndarray, shape (voxel, rows, columns), int32
        Rays in a window of the sensor.
    total : ndarray, shape (voxel,), int32
        Rays traced.
    first_pixel : ndarray, shape (voxel, 2), int32
        (column, row) of each window's first pixel; may lie outside the sensor.
    """
    runtime.device()
    rng = np.random.default_rng(seed)
    pack, optics = pack_camera(camera), camera.optics
    strata = np.stack(np.meshgrid(*[np.arange(points)] * 3, indexing="ij"), -1).reshape(-1, 3)
    inside = (strata + rng.random((len(centres_mm), len(strata), 3))) / points - 0.5
    objects = (np.asarray(centres_mm)[:, None] + inside * voxel_mm).reshape(-1, 3)
    rays = fit_rays(camera, objects, degree=3)
    # the window: where the rays of a voxel meet the array, one lens and one microimage around it
    radius = optics.pupil_radius_mm
    corner = rays.reshape(len(centres_mm), len(strata), 2, -1)
    spread = np.abs(corner[..., 1]) * radius + np.abs(corner[..., 2]) * radius
    spread += np.abs(corner[..., 3:6]).sum(-1) * radius**2 + np.abs(corner[..., 6:]).sum(-1) * radius**3
    margin = (radius + optics.microlens_pitch_mm) * optics.sensor_per_pupil + optics.microlens_pitch_mm
    scale = 1 + optics.sensor_per_pupil
    low = optics.sensor_px(((corner[..., 0] - spread).min(1) * scale) - margin)
    high = optics.sensor_px(((corner[..., 0] + spread).max(1) * scale) + margin)
    first_pixel = np.floor(low).astype(np.int32)
    columns, rows = (np.ceil(high).astype(int) - first_pixel).max(0) + 1
    count, total = count_rays(
        rays,
        rng.random((len(objects), 2)).astype(np.float32),
        np.repeat(np.arange(len(centres_mm), dtype=np.int32), len(strata)),
        first_pixel,
        pack.camera,
        pack.lattice,
        hexagonal=camera.lattice.layout == "hexagonal",
        samples=samples,
        shape=(int(rows), int(columns)),
    )
    return count, total, first_pixel


def largest_weight(blocks: Blocks) -> float:
    """Largest weight of a ray: of a pixel, where it is not reached through two lenses."""
    order = 2 if blocks.form == "profiles" else 1
    share = blocks.microimages.share
    bound = blocks.scale.astype(np.float64) * LEVELS**order * share.max(initial=0.0)
    best = 0.0
    firsts = np.arange(0, len(bound), CHUNK_VOXELS)
    for first in firsts[np.argsort(-np.maximum.reduceat(bound, firsts))] if len(firsts) else ():
        last = min(first + CHUNK_VOXELS, len(bound))
        if bound[first:last].max() <= best:
            break
        bound[first:last] *= _levels(blocks, first, last) / LEVELS**order
        for voxel in first + np.argsort(-bound[first:last]):
            if bound[voxel] <= best:
                break
            ray, weight = blocks.entries(int(voxel))
            best = max(best, float((weight * share[ray]).max(initial=0.0)))
    return best


def _levels(blocks: Blocks, first: int, last: int) -> np.ndarray:
    """Largest level of each voxel from `first` to `last`; of profiles the product of two."""
    some = slice(blocks.first_block[first], blocks.first_block[last])
    width, height = (array[some].astype(np.int64) for array in (blocks.width, blocks.height))
    largest = np.zeros(last - first)
    if not len(width):
        return largest
    profiles = blocks.form == "profiles"
    sizes = np.stack([width, height], axis=1).ravel() if profiles else width * height
    level = blocks.value[blocks.first_value[first] : blocks.first_value[last]]
    tops = np.maximum.reduceat(level, np.cumsum(sizes) - sizes).astype(float)
    of_voxel = np.repeat(np.arange(last - first), np.diff(blocks.first_block[first : last + 1]))
    np.maximum.at(largest, of_voxel, tops[::2] * tops[1::2] if profiles else tops)
    return largest
