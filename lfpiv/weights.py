"""`build_weights`: calibrated mapping x grid -> the weights of Eq. 10 as a linear operator.

``weights(volume)`` projects a volume to images, ``weights.T(images)`` is its adjoint. Two methods give the weights:
"footprint" integrates them over voxel, pupil pixel and microlens in closed form; "count" traces rays and counts them,
as the paper does, and judges the other. Both are stored alike, as 8-bit blocks of pixels with a scale per voxel.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lfpiv.raymodel import fit_rays, ray_models
from lfpiv.rig import Grid
from lfpiv_kernels import footprint, runtime
from lfpiv_kernels.lattice import pack_lattice
from lfpiv_kernels.project import Blocks, Projector
from lfpiv_kernels.trace import count_rays

log = logging.getLogger(__name__)

METHODS = ("footprint", "count")
CHUNK_VOXELS = 32768
"""Voxels per kernel launch: keeps every index below 2^31 and the scratch memory small."""
BEND_PITCH = 0.03
"""Second-order terms of the rays [pitch, at the pupil's edge] above which slopes are followed pixel by pixel."""
COUNT_POINTS = 8
"""Object points per voxel edge: 512 per voxel, the paper has 500."""
COUNT_SAMPLES = 36
"""Pupil points per axis when every voxel is counted, about 1,000 per object point."""
COUNT_SAMPLES_ONE = 144
"""Pupil points per axis for one voxel's image: the paper's 0.05 degrees."""
SAMPLED_VOXELS = 4096
"""Voxels from which the memory of all is estimated."""

Images = dict[str, np.ndarray]
Progress = Callable[[float], None]


@dataclass(frozen=True, kw_only=True)
class _CameraKernels:
    """One camera's constants as the kernels take them."""

    stride: int
    camera: object
    lattice: object
    cell_mm: float
    frame: np.ndarray
    rectangles: np.ndarray


def _pack(camera) -> _CameraKernels:
    optics, lattice = camera.optics, camera.lattice
    basis = np.asarray(lattice.basis_mm)
    stride = optics.sensor_shape[1] + 2 * footprint.LANES
    if lattice.layout == "square":
        cell = 0.5 * np.abs(basis).sum(0).max()
    else:
        cell = lattice.pitch_mm / math.sqrt(3)
    return _CameraKernels(
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


class Weights:
    """The weights of a grid's voxels on every camera's pixels, a linear operator.

    Made by `build_weights`. ``weights(volume)`` returns a dict camera -> image, ``weights.T(images)`` a volume.
    """

    def __init__(self, cameras: Mapping[str, object], grid: Grid, method: str, progress: Progress | None = None):
        self.cameras = dict(cameras)
        self.grid = grid
        self.method = method
        self._order = _storage_order(self.cameras.values(), grid)
        self._packs = {name: _pack(camera) for name, camera in self.cameras.items()}
        self._projectors: dict[str, Projector] = {}
        self._column_sum: np.ndarray | None = None
        if method == "footprint":  # counting a whole grid takes long: it waits until the operator is applied
            self._build(progress)

    # -- the operator ----------------------------------------------------------------------------------------------

    def __call__(self, volume: np.ndarray, out: Images | None = None) -> Images:
        """Project a volume: image[pixel] = sum over voxels of weight * volume (Eq. 4).

        Parameters
        ----------
        volume : array_like, shape (z, y, x)
            Voxel intensities; ndarray or xarray.DataArray.
        out : dict of ndarray, optional
            Images to overwrite, as returned by an earlier call.

        Returns
        -------
        dict of ndarray
            Camera name -> image, shape (rows, columns), float32.

        Raises
        ------
        ValueError
            If a shape does not fit the grid or the sensors.
        """
        self._build()
        flat = self.to_storage(volume)
        images = {}
        for name, camera in self.cameras.items():
            padded = self._projectors[name].project(flat, self._padded(name))
            image = _padded_view(padded, camera, self._packs[name])
            target = None if out is None else _checked_image(out, name, camera)
            images[name] = np.multiply(image, camera.gain, out=target)
        return images

    @property
    def T(self) -> Adjoint:
        """The adjoint operator: ``weights.T(images)`` sums weight * image over each voxel's pixels."""
        return Adjoint(self)

    def image(self, camera: str, voxel: tuple[int, int, int]) -> np.ndarray:
        """Sensor image of one voxel's weights (Fig. 10), white-image gain included.

        Parameters
        ----------
        camera : str
            Camera name.
        voxel : tuple of int
            Index (iz, iy, ix).

        Returns
        -------
        ndarray, shape (rows, columns), float32
        """
        setup = self._camera(camera)
        if len(voxel) != 3 or any(not 0 <= i < n for i, n in zip(voxel, self.grid.shape, strict=True)):
            raise ValueError(f"voxel: expected (iz, iy, ix) inside the grid {self.grid.shape}, got {tuple(voxel)}.")
        image = np.zeros(setup.optics.sensor_shape, np.float32)
        if self.method == "count" and camera not in self._projectors:
            index = np.ravel_multi_index(tuple(voxel), self.grid.shape)
            centre = self._centres([index])
            counts, total, corner = count_voxels(setup, centre, self.grid.voxel_mm, samples=COUNT_SAMPLES_ONE)
            _add_window(image, counts[0] / max(int(total[0]), 1), corner[0])
        else:
            blocks = self._projectors[camera].blocks
            flat = int(np.ravel_multi_index([voxel[axis] for axis in self._order], self.storage_shape))
            _add_blocks(image, blocks, flat)
        return image * setup.gain

    @property
    def column_sum(self) -> np.ndarray:
        """Sum of each voxel's weights over all pixels of all cameras, shape (z, y, x), float32."""
        if self._column_sum is None:
            ones = {name: np.ones(camera.optics.sensor_shape, np.float32) for name, camera in self.cameras.items()}
            self._column_sum = self.T(ones)
        return self._column_sum

    @property
    def affected_pixels(self) -> np.ndarray:
        """Number of pixels that each voxel lights, N_i of Eq. 5, over all cameras, shape (z, y, x), int64."""
        self._build()
        total = np.zeros(self.grid.size, np.int64)
        for projector in self._projectors.values():
            lit = np.add.reduce(projector.blocks.value > 0, axis=1, dtype=np.int64)
            sums = np.concatenate([[0], np.cumsum(lit)])
            total += np.diff(sums[projector.blocks.first_row])
        return self.from_storage(total)

    @property
    def largest(self) -> float:
        """Largest weight of all (Eq. 5 is scaled by it)."""
        self._build()
        return max(float(projector.blocks.scale.max()) * footprint.LEVELS for projector in self._projectors.values())

    @property
    def memory_bytes(self) -> int:
        """Memory of the stored weights [byte]."""
        return sum(projector.blocks.nbytes for projector in self._projectors.values())

    # -- storage -----------------------------------------------------------------------------------------------------

    @property
    def storage_shape(self) -> tuple[int, int, int]:
        """Voxel counts in the order of the stored weights, outermost axis first."""
        return tuple(self.grid.shape[axis] for axis in self._order)

    def to_storage(self, volume) -> np.ndarray:
        """Voxels of a (z, y, x) volume in the order of the stored weights, shape (voxel,), float32, contiguous."""
        array = np.asarray(volume, np.float32)
        if array.shape != self.grid.shape:
            raise ValueError(f"volume: expected shape {self.grid.shape} (z, y, x), got {array.shape}.")
        return np.ascontiguousarray(array.transpose(self._order)).ravel()

    def from_storage(self, flat: np.ndarray) -> np.ndarray:
        """Inverse of `to_storage`: a C-contiguous (z, y, x) array."""
        return np.ascontiguousarray(flat.reshape(self.storage_shape).transpose(np.argsort(self._order)))

    def _camera(self, name: str):
        if name not in self.cameras:
            raise ValueError(f"camera: expected one of {', '.join(self.cameras)}, got {name!r}.")
        return self.cameras[name]

    def _centres(self, indices) -> np.ndarray:
        """Centres (x, y, z) [mm] of voxels by their flat (z, y, x) index."""
        iz, iy, ix = np.unravel_index(np.asarray(indices), self.grid.shape)
        axes = [self.grid.axis_mm(axis) for axis in range(3)]
        return np.stack([axes[2][ix], axes[1][iy], axes[0][iz]], axis=1)

    def _padded(self, name: str) -> np.ndarray:
        camera, pack = self.cameras[name], self._packs[name]
        return np.zeros(camera.optics.sensor_shape[0] * pack.stride, np.float32)

    def back_project_padded(self, name: str, padded: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Add one camera's back projection of a padded flat image to `out`, in storage order."""
        return self._projectors[name].back_project(padded, out)

    def project_padded(self, name: str, flat: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Project voxels in storage order into one camera's padded flat image, white-image gain left out."""
        return self._projectors[name].project(flat, out)

    def pad(self, name: str, image: np.ndarray) -> np.ndarray:
        """Copy a sensor image into the padded flat form of the kernels."""
        camera, pack = self.cameras[name], self._packs[name]
        padded = self._padded(name)
        _padded_view(padded, camera, pack)[:] = image
        return padded

    def _build(self, progress: Progress | None = None) -> None:
        if len(self._projectors) == len(self.cameras):
            return
        runtime.device()
        for number, (name, camera) in enumerate(self.cameras.items()):

            def step(fraction, number=number):
                if progress is not None:
                    progress((number + fraction) / len(self.cameras))

            fill = _footprint_blocks if self.method == "footprint" else _count_blocks
            self._projectors[name] = Projector(fill(self, camera, self._packs[name], step))


class Adjoint:
    """The adjoint of `Weights`; ``adjoint.T`` is the operator itself."""

    def __init__(self, weights: Weights):
        self.T = weights

    def __call__(self, images: Mapping[str, np.ndarray], out: np.ndarray | None = None) -> np.ndarray:
        """Back-project images: volume[voxel] = sum over cameras and pixels of weight * image.

        Parameters
        ----------
        images : mapping of str to ndarray
            Camera name -> image, shape (rows, columns); every camera of the operator.
        out : ndarray, shape (z, y, x), float32, optional
            Volume to overwrite.

        Returns
        -------
        ndarray, shape (z, y, x), float32

        Raises
        ------
        ValueError
            If a camera is missing or a shape does not fit.
        """
        weights = self.T
        weights._build()
        flat = np.zeros(weights.grid.size, np.float32)
        for name, camera in weights.cameras.items():
            image = _checked_image(images, name, camera)
            weights.back_project_padded(name, weights.pad(name, image * camera.gain), flat)
        volume = weights.from_storage(flat)
        if out is None:
            return volume
        if out.shape != volume.shape:
            raise ValueError(f"out: expected shape {volume.shape} (z, y, x), got {out.shape}.")
        out[:] = volume
        return out


def build_weights(calibration, grid: Grid, method: str = "footprint", progress: Progress | None = None) -> Weights:
    """Weights of every voxel of a grid on every pixel of every camera (Eq. 10).

    Parameters
    ----------
    calibration : Calibration
        From `calibrate`, `load_calibration` or `thin_lens`.
    grid : Grid
        Voxels.
    method : {"footprint", "count"}
        Area-integrated weights, or counted rays: slow on a whole grid, where nothing is computed before the operator or
        `Weights.image` is called.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Weights

    Raises
    ------
    ValueError
        If `method` is unknown.
    """
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}.")
    weights = Weights(calibration.cameras, grid, method, progress)
    if method == "footprint":
        log.info(
            "weights of %d voxels on %d cameras: %.0f MiB",
            grid.size,
            len(weights.cameras),
            weights.memory_bytes / 2**20,
        )
    return weights


def estimate_memory(calibration, grid: Grid) -> int:
    """Memory that the weights of a grid will need [byte], from a sample of its voxels; nothing large is allocated."""
    runtime.device()
    total = 0.0
    sample = np.unique(np.linspace(0, grid.size - 1, SAMPLED_VOXELS).astype(np.int64))
    iz, iy, ix = np.unravel_index(sample, grid.shape)
    first = np.asarray(grid.first_centre_mm)
    centres = np.stack([first[2] + ix * grid.voxel_mm, first[1] + iy * grid.voxel_mm, first[0] + iz * grid.voxel_mm], 1)
    for camera in calibration.cameras.values():
        pack = _pack(camera)
        model = ray_models(camera, centres, grid.voxel_mm)
        blocks, rows = footprint.measure_blocks(model, pack.camera, pack.lattice, pack.cell_mm)
        per_voxel = 8 * blocks.mean() + footprint.LANES * rows.mean() + 16
        model_bytes = 4 * footprint.MODEL_SIZE * CHUNK_VOXELS
        images = 4 * (3 + runtime.CHUNKS) * camera.optics.sensor_shape[0] * pack.stride
        total += per_voxel * grid.size + model_bytes + images
    return int(total)


def compare_with_count(weights: Weights, voxels: int = 6, seed: int = 0) -> dict[str, list[float]]:
    """Relative L2 difference of stored weights from counted rays, for a few random voxels of every camera.

    Returns camera name -> one figure per voxel that the camera sees; the count's own noise (about 0.5 %) is included.
    """
    rng = np.random.default_rng(seed)
    indices = rng.choice(weights.grid.size, min(voxels, weights.grid.size), replace=False)
    errors: dict[str, list[float]] = {}
    for name, camera in weights.cameras.items():
        counts, total, corner = count_voxels(
            camera, weights._centres(indices), weights.grid.voxel_mm, samples=COUNT_SAMPLES_ONE, seed=seed
        )
        errors[name] = []
        for index, window, rays, at in zip(indices, counts, total, corner, strict=True):
            counted = np.zeros(camera.optics.sensor_shape, np.float32)
            _add_window(counted, window / rays, at)
            if counted.any():
                counted *= camera.gain
                voxel = tuple(int(i) for i in np.unravel_index(index, weights.grid.shape))
                difference = weights.image(name, voxel) - counted
                errors[name].append(float(np.linalg.norm(difference) / np.linalg.norm(counted)))
    return errors


def _storage_order(cameras, grid: Grid) -> tuple[int, int, int]:
    """Axes of the grid, outermost first: along sensor rows, then along columns, so that neighbours share pixels."""
    middle = np.array(
        [first + (n - 1) / 2 * grid.voxel_mm for first, n in zip(grid.first_centre_mm, grid.shape, strict=True)]
    )
    steps = np.concatenate([[middle[::-1]], middle[::-1] + np.eye(3)[::-1]])  # z, y, x
    shift = np.zeros((3, 2))
    for camera in cameras:
        st = camera.map(steps, np.zeros((4, 2)))
        shift += np.abs(st[1:] - st[0])
    outer = int(np.argmax(shift[:, 1]))
    rest = sorted((axis for axis in range(3) if axis != outer), key=lambda axis: -shift[axis, 0])
    return (outer, *rest)


def _footprint_blocks(weights: Weights, camera, pack: _CameraKernels, progress: Progress) -> Blocks:
    """Compute the blocks of one camera: count them, allocate once, fill chunk by chunk."""
    shape, size = weights.storage_shape, weights.grid.size
    edges = list(range(0, size, CHUNK_VOXELS)) + [size]
    chunks = list(pairwise(edges))
    first_block, first_row = np.zeros(size + 1, np.int64), np.zeros(size + 1, np.int64)
    bend = 0.0
    models = []
    for number, (a, b) in enumerate(chunks):
        stored = np.unravel_index(np.arange(a, b), shape)
        centres = [None] * 3
        for axis, index in zip(weights._order, stored, strict=True):
            centres[axis] = weights.grid.first_centre_mm[axis] + index * weights.grid.voxel_mm
        model = ray_models(camera, np.stack(centres[::-1], axis=1), weights.grid.voxel_mm)
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
    pixel, height = np.empty(first_block[-1], np.int32), np.empty(first_block[-1], np.int32)
    value = np.empty((first_row[-1], footprint.LANES), np.uint8)
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
    pack, optics = _pack(camera), camera.optics
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


def _count_blocks(weights: Weights, camera, pack: _CameraKernels, progress: Progress) -> Blocks:
    """Count the rays of every voxel and pack the counts into blocks."""
    size, shape = weights.grid.size, weights.storage_shape
    log.warning("%s: counting rays for %d voxels; 'footprint' is about a thousand times faster", camera.name, size)
    parts, chunk = [], 64
    for first in range(0, size, chunk):
        stored = np.unravel_index(np.arange(first, min(first + chunk, size)), shape)
        index = [None] * 3
        for axis, i in zip(weights._order, stored, strict=True):
            index[axis] = i
        flat = np.ravel_multi_index(index, weights.grid.shape)
        counts, total, corner = count_voxels(
            camera, weights._centres(flat), weights.grid.voxel_mm, samples=COUNT_SAMPLES, seed=first
        )
        parts.append(_pack_windows(counts / total[:, None, None], corner, camera.optics.sensor_shape, pack.stride))
        progress(min(first + chunk, size) / size)
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


def _add_window(image: np.ndarray, window: np.ndarray, corner: np.ndarray) -> None:
    """Add a window whose first pixel is `corner` (column, row) to a sensor image, in place."""
    column, row = (int(c) for c in corner)
    rows = slice(max(row, 0), min(row + window.shape[0], image.shape[0]))
    columns = slice(max(column, 0), min(column + window.shape[1], image.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] += window[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]


def _add_blocks(image: np.ndarray, blocks: Blocks, voxel: int) -> None:
    """Add one voxel's stored weights to a sensor image, in place."""
    stride = blocks.shape[1]
    padded = np.zeros(blocks.shape[0] * stride, np.float32)
    row = int(blocks.first_row[voxel])
    for block in range(blocks.first_block[voxel], blocks.first_block[voxel + 1]):
        for y in range(blocks.height[block]):
            at = blocks.pixel[block] + y * stride
            padded[at : at + footprint.LANES] += blocks.value[row] * blocks.scale[voxel]
            row += 1
    image += padded.reshape(blocks.shape)[:, : image.shape[1]]


def _padded_view(padded: np.ndarray, camera, pack: _CameraKernels) -> np.ndarray:
    rows, columns = camera.optics.sensor_shape
    return padded.reshape(rows, pack.stride)[:, :columns]


def _checked_image(images: Mapping[str, np.ndarray], name: str, camera) -> np.ndarray:
    if name not in images:
        raise ValueError(f"images: camera {name!r} is missing; found {', '.join(images) or 'none'}.")
    image = np.asarray(images[name])
    if image.shape != camera.optics.sensor_shape:
        raise ValueError(f"images[{name!r}]: expected shape {camera.optics.sensor_shape}, got {image.shape}.")
    return image
