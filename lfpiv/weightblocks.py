"""Weights of all voxels of a grid for one camera, as blocks: integrated in closed form, or counted rays (Eq. 10)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.raylayout import lay_out, microimage_edge, plain
from lfpiv.raymodel import fit_rays, grid_models
from lfpiv.rig import Grid
from lfpiv_kernels import footprint, runtime
from lfpiv_kernels.lattice import cell_frame, cell_rectangles, pack_lattice
from lfpiv_kernels.microimages import Microimages
from lfpiv_kernels.project import Blocks
from lfpiv_kernels.raymodel import LANES, LEVELS
from lfpiv_kernels.trace import count_rays

log = logging.getLogger(__name__)

Progress = Callable[[float], None]

CHUNK_VOXELS = 32768
"""Voxels per kernel launch: keeps every index below 2^31 and the scratch memory small."""
COUNT_POINTS = 8
"""Object points per voxel edge: 512 per voxel, the paper has 500."""
COUNT_SAMPLES = 36
"""Pupil points per axis when every voxel is counted, about 1,000 per object point."""
COUNT_CHUNK = 64
"""Voxels counted at once: each has a window of the sensor."""


@dataclass(frozen=True)
class StoredGrid:
    """A grid whose voxels are stored in an order of its own, so that neighbours in memory share pixels."""

    grid: Grid
    order: tuple[int, int, int]
    """Axes of the grid (0: z, 1: y, 2: x), outermost first."""

    @classmethod
    def for_cameras(cls, grid: Grid, cameras: Iterable) -> StoredGrid:
        """Put the axis outermost that runs along the sensors' rows the most, then the one along their columns."""
        middle = [
            first + (n - 1) / 2 * grid.voxel_mm for first, n in zip(grid.first_centre_mm, grid.shape, strict=True)
        ]
        steps = np.concatenate([[middle[::-1]], middle[::-1] + np.eye(3)[::-1]])  # 1 mm along z, y, x
        shift = np.zeros((3, 2))
        for camera in cameras:
            st = camera.map(steps, np.zeros((4, 2)))
            shift += np.abs(st[1:] - st[0])
        outer = int(np.argmax(shift[:, 1]))
        rest = sorted((axis for axis in range(3) if axis != outer), key=lambda axis: -shift[axis, 0])
        return cls(grid, (outer, *rest))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxel counts, outermost axis first."""
        return tuple(self.grid.shape[axis] for axis in self.order)

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

    def store(self, volume: np.ndarray) -> np.ndarray:
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

    setup: object
    camera: object
    lattice: object
    cell_mm: float
    frame: np.ndarray
    rectangles: np.ndarray

    @cached_property
    def microimages(self) -> Microimages:
        """How the rays lie in memory."""
        return lay_out(self.setup.optics, self.setup.lattice)


def pack_camera(camera) -> CameraKernels:
    """Pack a camera for the kernels."""
    optics, lattice = camera.optics, camera.lattice
    basis = np.asarray(lattice.basis_mm)
    if lattice.layout == "square":
        cell = 0.5 * np.abs(basis).sum(0).max()
    else:
        cell = lattice.pitch_mm / math.sqrt(3)
    return CameraKernels(
        setup=camera,
        camera=footprint.pack_camera(
            sensor_per_pupil=optics.sensor_per_pupil,
            pixel_mm=optics.pixel_mm,
            sensor_shape=optics.sensor_shape,
            pupil_radius_mm=optics.pupil_radius_mm,
            edge=microimage_edge(optics),
        ),
        lattice=pack_lattice(lattice.origin_mm, lattice.basis_mm),
        cell_mm=float(cell),
        frame=cell_frame(basis, lattice.layout),
        rectangles=cell_rectangles(lattice.layout),
    )


def footprint_blocks(
    stored: StoredGrid, camera, form: str, progress: Progress, allow: Callable[[int], None] = lambda _: None
) -> Blocks:
    """Compute the blocks of one camera: count them, allocate once, fill chunk by chunk.

    `allow` is called with the memory they take [byte] before it is allocated, and may raise.
    """
    pack, size = pack_camera(camera), stored.grid.size
    plane = size // stored.shape[0]
    first_block, first_row = np.zeros(size + 1, np.int64), np.zeros(size + 1, np.int64)
    models = []
    axes = tuple(2 - axis for axis in stored.order)
    with threadpool_limits(1, "blas"):  # products of a plane each: BLAS's own threads cost more than they bring
        for model in grid_models(camera, stored.shape, stored.positions_mm, axes):
            models.append(model)
            progress(0.3 * len(models) / stored.shape[0])
    step = max(1, CHUNK_VOXELS // plane)
    chunks = [(a, np.concatenate(models[a : a + step])) for a in range(0, len(models), step)]
    del models
    for a, model in chunks:
        part = slice(a * plane + 1, a * plane + len(model) + 1)
        first_block[part], first_row[part] = measure(pack, model, form)
    np.cumsum(first_block, out=first_block)
    np.cumsum(first_row, out=first_row)
    allow(int(6 * first_block[-1] + LANES * first_row[-1] + 16 * size))
    blocks = Blocks(
        form=form,
        first_block=first_block.astype(np.int32),
        first_row=first_row,
        ray=np.zeros(first_block[-1], np.int32),
        height=np.zeros(first_block[-1], np.uint16),
        value=np.zeros((first_row[-1], LANES), np.uint8),
        scale=np.zeros(size, np.float32),
        microimages=pack.microimages,
    )
    for number in range(len(chunks)):
        a, model = chunks[number]
        chunks[number] = None
        fill(pack, model, blocks, a * plane, first_block)
        progress(0.4 + 0.6 * (number + 1) / len(chunks))
    return blocks


def measure(pack: CameraKernels, model: np.ndarray, form: str) -> tuple[np.ndarray, np.ndarray]:
    """Blocks and rows of each voxel."""
    return footprint.measure_blocks(model, pack.camera, pack.lattice, pack.cell_mm, pack.microimages, form=form)


def fill(pack: CameraKernels, model: np.ndarray, blocks: Blocks, first: int, first_block) -> None:
    """Fill the blocks of the voxels from `first` on."""
    voxels = slice(first, first + len(model))
    edges = slice(first, first + len(model) + 1)
    block = slice(first_block[first], first_block[voxels.stop])
    row = slice(blocks.first_row[first], blocks.first_row[voxels.stop])
    if block.start == block.stop:
        return
    footprint.fill_blocks(
        model,
        pack.camera,
        pack.lattice,
        pack.cell_mm,
        pack.microimages,
        frame=pack.frame,
        rectangles=pack.rectangles,
        form=blocks.form,
        first_block=first_block[edges],
        first_row=blocks.first_row[edges],
        ray=blocks.ray[block],
        height=blocks.height[block],
        value=blocks.value[row],
        scale=blocks.scale[voxels],
    )


def count_voxels(camera, centres_mm: np.ndarray, voxel_mm: float, *, samples: int, seed: int = 0):
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
    strata = np.stack(np.meshgrid(*[np.arange(COUNT_POINTS)] * 3, indexing="ij"), -1).reshape(-1, 3)
    inside = (strata + rng.random((len(centres_mm), len(strata), 3))) / COUNT_POINTS - 0.5
    points = (np.asarray(centres_mm)[:, None] + inside * voxel_mm).reshape(-1, 3)
    rays = fit_rays(camera, points, degree=3)
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
        rng.random((len(points), 2)).astype(np.float32),
        np.repeat(np.arange(len(centres_mm), dtype=np.int32), len(strata)),
        first_pixel,
        pack.camera,
        pack.lattice,
        hexagonal=camera.lattice.layout == "hexagonal",
        samples=samples,
        shape=(int(rows), int(columns)),
    )
    return count, total, first_pixel


def count_blocks(stored: StoredGrid, camera, progress: Progress) -> Blocks:
    """Count the rays of every voxel and pack the counts into blocks."""
    rays, size = plain(camera.optics.sensor_shape), stored.grid.size
    log.warning("%s: counting rays for %d voxels; 'footprint' is about a thousand times faster", camera.name, size)
    parts = []
    for first in range(0, size, COUNT_CHUNK):
        last = min(first + COUNT_CHUNK, size)
        counts, total, corner = count_voxels(
            camera, stored.centres_mm(np.arange(first, last)), stored.grid.voxel_mm, samples=COUNT_SAMPLES, seed=first
        )
        parts.append(_pack_windows(counts / total[:, None, None], corner, camera.optics.sensor_shape, rays.edge))
        progress(last / size)
    blocks, rows = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Blocks(
        form="pixels",
        first_block=np.concatenate([[0], np.cumsum(blocks)]).astype(np.int32),
        first_row=np.concatenate([[0], np.cumsum(rows)]).astype(np.int64),
        ray=np.concatenate([part[2] for part in parts]),
        height=np.concatenate([part[3] for part in parts]),
        value=np.concatenate([part[4] for part in parts]),
        scale=np.concatenate([part[5] for part in parts]),
        microimages=rays,
    )


def _pack_windows(windows: np.ndarray, corner: np.ndarray, sensor_shape, stride: int):
    """Pack windows of weights, shape (voxel, rows, columns), into blocks of one column of tiles each.

    Returns blocks and rows per voxel, and the arrays ray, height, value, scale of `Blocks`.
    """
    lanes = LANES
    row = corner[:, 1, None] + np.arange(windows.shape[1])
    column = corner[:, 0, None] + np.arange(windows.shape[2])
    seen = ((row >= 0) & (row < sensor_shape[0]))[:, :, None] & ((column >= 0) & (column < sensor_shape[1]))[:, None]
    windows = np.where(seen, windows, 0.0)
    windows = np.pad(windows, ((0, 0), (0, 0), (0, -windows.shape[2] % lanes)))
    tiles = windows.reshape(*windows.shape[:2], -1, lanes).transpose(0, 2, 1, 3)  # voxel, tile column, row, lane
    scale = tiles.max((1, 2, 3)) / LEVELS
    lit = tiles.any(-1)
    starts = np.argwhere(lit & ~np.pad(lit, ((0, 0), (0, 0), (1, 0)))[:, :, :-1])
    ends = np.argwhere(lit & ~np.pad(lit, ((0, 0), (0, 0), (0, 1)))[:, :, 1:])
    voxel, tile, first = starts.T
    # a tile may begin left of the sensor: its block's pixel then lies at the end of the row above, where weights are 0
    pixel = (corner[voxel, 1] + first) * stride + corner[voxel, 0] + tile * lanes
    unit = np.where(scale > 0, scale, 1.0)
    value = np.rint(tiles[lit] / unit[np.nonzero(lit)[0], None]).astype(np.uint8)
    shift = np.maximum(-pixel, 0)  # above the sensor's first pixel: move the block's lanes instead
    if shift.any():
        rows_of = np.repeat(shift, ends[:, 2] - first + 1)
        for amount in np.unique(rows_of[rows_of > 0]):
            some = rows_of == amount
            value[some] = np.roll(value[some], -amount, axis=1)
        pixel = pixel + shift
    return (
        np.bincount(voxel, minlength=len(windows)),
        np.bincount(voxel, weights=ends[:, 2] - first + 1, minlength=len(windows)).astype(np.int64),
        pixel.astype(np.int32),
        (ends[:, 2] - first + 1).astype(np.uint16),
        value,
        scale.astype(np.float32),
    )
