"""Weights of all voxels of a grid for one camera, as blocks: integrated in closed form, or counted rays (Eq. 10)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lfpiv.raymodel import fit_rays, ray_models
from lfpiv.rig import Grid
from lfpiv_kernels import footprint, runtime
from lfpiv_kernels.lattice import pack_lattice
from lfpiv_kernels.project import Blocks
from lfpiv_kernels.trace import count_rays

log = logging.getLogger(__name__)

Progress = Callable[[float], None]

CHUNK_VOXELS = 32768
"""Voxels per kernel launch: keeps every index below 2^31 and the scratch memory small."""
BEND_PITCH = 0.03
"""Second-order terms of the rays [pitch, at the pupil's edge] above which slopes are followed pixel by pixel."""
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
        centres = np.empty((len(index), 3))
        for axis, steps in zip(self.order, np.unravel_index(index, self.shape), strict=True):
            centres[:, 2 - axis] = self.grid.first_centre_mm[axis] + steps * self.grid.voxel_mm
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


@dataclass(frozen=True, kw_only=True)
class CameraKernels:
    """One camera's constants as the kernels take them."""

    stride: int
    camera: object
    lattice: object
    cell_mm: float
    frame: np.ndarray
    rectangles: np.ndarray


def pack_camera(camera) -> CameraKernels:
    """Pack a camera for the kernels."""
    optics, lattice = camera.optics, camera.lattice
    basis = np.asarray(lattice.basis_mm)
    stride = optics.sensor_shape[1] + 2 * footprint.LANES
    if lattice.layout == "square":
        cell = 0.5 * np.abs(basis).sum(0).max()
    else:
        cell = lattice.pitch_mm / math.sqrt(3)
    return CameraKernels(
        stride=stride,
        camera=footprint.pack_camera(
            sensor_per_pupil=optics.sensor_per_pupil,
            pixel_mm=optics.pixel_mm,
            sensor_shape=optics.sensor_shape,
            pupil_radius_mm=optics.pupil_radius_mm,
            stride=stride,
        ),
        lattice=pack_lattice(lattice.origin_mm, lattice.basis_mm),
        cell_mm=float(cell),
        frame=footprint.cell_frame(basis, lattice.layout),
        rectangles=footprint.cell_rectangles(lattice.layout),
    )


def footprint_blocks(stored: StoredGrid, camera, progress: Progress) -> Blocks:
    """Compute the blocks of one camera: count them, allocate once, fill chunk by chunk."""
    pack, size, voxel_mm = pack_camera(camera), stored.grid.size, stored.grid.voxel_mm
    edges = list(range(0, size, CHUNK_VOXELS)) + [size]
    chunks = list(pairwise(edges))
    first_block, first_row = np.zeros(size + 1, np.int64), np.zeros(size + 1, np.int64)
    bend = 0.0
    models = []
    for number, (a, b) in enumerate(chunks):
        model = ray_models(camera, stored.centres_mm(np.arange(a, b)), voxel_mm)
        models.append(model)
        quadratic = np.abs(model[:, [3, 4, 5, 9, 10, 11]]).sum(1).mean() * camera.optics.pupil_radius_mm**2
        bend = max(bend, float(quadratic) / camera.lattice.pitch_mm)
        blocks, rows = footprint.measure_blocks(model, pack.camera, pack.lattice, pack.cell_mm)
        first_block[a + 1 : b + 1], first_row[a + 1 : b + 1] = blocks, rows
        progress(0.4 * (number + 1) / len(chunks))
    np.cumsum(first_block, out=first_block)
    np.cumsum(first_row, out=first_row)
    bends = bend > BEND_PITCH
    log.info(
        "%s: rays bend by %.3f pitch over the pupil: %s slopes", camera.name, bend, "local" if bends else "constant"
    )
    pixel, height = np.zeros(first_block[-1], np.int32), np.zeros(first_block[-1], np.int32)
    value = np.zeros((first_row[-1], footprint.LANES), np.uint8)
    scale = np.zeros(size, np.float32)
    for number, (a, b) in enumerate(chunks):
        block, row = slice(first_block[a], first_block[b]), slice(first_row[a], first_row[b])
        if block.start < block.stop:
            footprint.fill_blocks(
                models[number],
                pack.camera,
                pack.lattice,
                pack.cell_mm,
                frame=pack.frame,
                rectangles=pack.rectangles,
                bends=bends,
                first_block=first_block[a : b + 1],
                first_row=first_row[a : b + 1],
                pixel=pixel[block],
                height=height[block],
                value=value[row],
                scale=scale[a:b],
            )
        models[number] = None
        progress(0.4 + 0.6 * (number + 1) / len(chunks))
    return Blocks(
        first_block=first_block.astype(np.int32),
        first_row=first_row,
        pixel=pixel,
        height=height,
        value=value,
        scale=scale,
        shape=(camera.optics.sensor_shape[0], pack.stride),
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
    pack, size = pack_camera(camera), stored.grid.size
    log.warning("%s: counting rays for %d voxels; 'footprint' is about a thousand times faster", camera.name, size)
    parts = []
    for first in range(0, size, COUNT_CHUNK):
        last = min(first + COUNT_CHUNK, size)
        counts, total, corner = count_voxels(
            camera, stored.centres_mm(np.arange(first, last)), stored.grid.voxel_mm, samples=COUNT_SAMPLES, seed=first
        )
        parts.append(_pack_windows(counts / total[:, None, None], corner, camera.optics.sensor_shape, pack.stride))
        progress(last / size)
    blocks, rows = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Blocks(
        first_block=np.concatenate([[0], np.cumsum(blocks)]).astype(np.int32),
        first_row=np.concatenate([[0], np.cumsum(rows)]).astype(np.int64),
        pixel=np.concatenate([part[2] for part in parts]),
        height=np.concatenate([part[3] for part in parts]),
        value=np.concatenate([part[4] for part in parts]),
        scale=np.concatenate([part[5] for part in parts]),
        shape=(camera.optics.sensor_shape[0], pack.stride),
    )


def _pack_windows(windows: np.ndarray, corner: np.ndarray, sensor_shape, stride: int):
    """Pack windows of weights, shape (voxel, rows, columns), into blocks of one column of tiles each.

    Returns blocks and rows per voxel, and the arrays pixel, height, value, scale of `Blocks`.
    """
    lanes = footprint.LANES
    row = corner[:, 1, None] + np.arange(windows.shape[1])
    column = corner[:, 0, None] + np.arange(windows.shape[2])
    seen = ((row >= 0) & (row < sensor_shape[0]))[:, :, None] & ((column >= 0) & (column < sensor_shape[1]))[:, None]
    windows = np.where(seen, windows, 0.0)
    windows = np.pad(windows, ((0, 0), (0, 0), (0, -windows.shape[2] % lanes)))
    tiles = windows.reshape(*windows.shape[:2], -1, lanes).transpose(0, 2, 1, 3)  # voxel, tile column, row, lane
    scale = tiles.max((1, 2, 3)) / footprint.LEVELS
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
        (ends[:, 2] - first + 1).astype(np.int32),
        value,
        scale.astype(np.float32),
    )
