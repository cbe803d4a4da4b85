"""`build_weights`: calibrated mapping x grid -> the weights of Eq. 10 as a linear operator.

``weights(volume)`` projects a volume to images, ``weights.T(images)`` is its adjoint. Two methods give the weights:
"footprint" integrates them over voxel, pupil pixel and microlens in closed form; "count" traces rays and counts them,
as the paper does, and judges the other. Both are stored alike, as 8-bit blocks of pixels with a scale per voxel.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

import numpy as np

from lfpiv.raymodel import ray_models
from lfpiv.rig import Grid
from lfpiv.weightblocks import CHUNK_VOXELS, StoredGrid, count_blocks, count_voxels, footprint_blocks, pack_camera
from lfpiv_kernels import footprint, runtime
from lfpiv_kernels.project import Blocks, Projector

log = logging.getLogger(__name__)

METHODS = ("footprint", "count")
COUNT_SAMPLES_ONE = 144
"""Pupil points per axis for one voxel's image: the paper's 0.05 degrees."""
SAMPLED_VOXELS = 4096
"""Voxels from which the memory of all is estimated."""

Images = dict[str, np.ndarray]
Progress = Callable[[float], None]


class Weights:
    """The weights of a grid's voxels on every camera's pixels, a linear operator.

    Made by `build_weights`. ``weights(volume)`` returns a dict camera -> image, ``weights.T(images)`` a volume.
    """

    def __init__(self, cameras: Mapping[str, object], grid: Grid, method: str, progress: Progress | None = None):
        self.cameras = dict(cameras)
        self.grid = grid
        self.method = method
        self.stored = StoredGrid.for_cameras(grid, self.cameras.values())
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
        flat = self.stored.store(volume)
        images = {}
        for name, camera in self.cameras.items():
            projector = self.projector(name)
            padded = projector.project(flat, np.empty(projector.blocks.shape, np.float32).ravel())
            target = None if out is None else _checked_image(out, name, camera)
            images[name] = np.multiply(self.crop(name, padded), camera.gain, out=target)
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
        index = self.stored.place(voxel)
        if self.method == "count" and not self._projectors:
            centre = self.stored.centres_mm(np.array([index]))
            counts, total, corner = count_voxels(setup, centre, self.grid.voxel_mm, samples=COUNT_SAMPLES_ONE)
            _add_window(image, counts[0] / max(int(total[0]), 1), corner[0])
        else:
            _add_blocks(image, self.projector(camera).blocks, index)
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
            value, first_row = projector.blocks.value, projector.blocks.first_row
            for a in range(0, self.grid.size, CHUNK_VOXELS):
                edges = first_row[a : a + CHUNK_VOXELS + 1]
                lit = np.count_nonzero(value[edges[0] : edges[-1]], axis=1)
                total[a : a + CHUNK_VOXELS] += np.diff(np.concatenate([[0], np.cumsum(lit)])[edges - edges[0]])
        return self.stored.restore(total)

    @property
    def largest(self) -> float:
        """Largest weight of all (Eq. 5 is scaled by it)."""
        self._build()
        return max(float(projector.blocks.scale.max()) * footprint.LEVELS for projector in self._projectors.values())

    @property
    def memory_bytes(self) -> int:
        """Memory of the stored weights [byte]."""
        return sum(projector.blocks.nbytes for projector in self._projectors.values())

    # -- what reconstruction works on: voxels in stored order, images padded and flat ---------------------------------

    def projector(self, name: str) -> Projector:
        """One camera's stored weights, white-image gain left out; built where they are not yet."""
        self._build()
        return self._projectors[name]

    def pad(self, name: str, image: np.ndarray) -> np.ndarray:
        """Copy a sensor image into the padded flat form of the projectors."""
        rows, stride = self.projector(name).blocks.shape
        padded = np.zeros((rows, stride), np.float32)
        padded[:, : self.cameras[name].optics.sensor_shape[1]] = image
        return padded.ravel()

    def crop(self, name: str, padded: np.ndarray) -> np.ndarray:
        """View the sensor's part of a padded flat image."""
        shape = self.projector(name).blocks.shape
        return padded.reshape(shape)[:, : self.cameras[name].optics.sensor_shape[1]]

    def _camera(self, name: str):
        if name not in self.cameras:
            raise ValueError(f"camera: expected one of {', '.join(self.cameras)}, got {name!r}.")
        return self.cameras[name]

    def _build(self, progress: Progress | None = None) -> None:
        if len(self._projectors) == len(self.cameras):
            return
        runtime.device()
        fill = footprint_blocks if self.method == "footprint" else count_blocks
        for number, (name, camera) in enumerate(self.cameras.items()):

            def step(fraction, number=number):
                if progress is not None:
                    progress((number + fraction) / len(self.cameras))

            self._projectors[name] = Projector(fill(self.stored, camera, step))


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
        flat = np.zeros(weights.grid.size, np.float32)
        for name, camera in weights.cameras.items():
            image = _checked_image(images, name, camera)
            weights.projector(name).back_project(weights.pad(name, image * camera.gain), flat)
        volume = weights.stored.restore(flat)
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
    centres = StoredGrid(grid, (0, 1, 2)).centres_mm(sample)
    for camera in calibration.cameras.values():
        pack = pack_camera(camera)
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
    centres = weights.stored.centres_mm(indices)
    errors: dict[str, list[float]] = {}
    for name, camera in weights.cameras.items():
        counts, total, corner = count_voxels(
            camera, centres, weights.grid.voxel_mm, samples=COUNT_SAMPLES_ONE, seed=seed
        )
        errors[name] = []
        for index, window, rays, at in zip(indices, counts, total, corner, strict=True):
            stored, counted = (np.zeros(camera.optics.sensor_shape, np.float32) for _ in range(2))
            _add_blocks(stored, weights.projector(name).blocks, int(index))
            _add_window(counted, window / rays, at)
            if counted.any():
                difference = np.linalg.norm((stored - counted) * camera.gain)
                errors[name].append(float(difference / np.linalg.norm(counted * camera.gain)))
    return errors


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


def _checked_image(images: Mapping[str, np.ndarray], name: str, camera) -> np.ndarray:
    if name not in images:
        raise ValueError(f"images: camera {name!r} is missing; found {', '.join(images) or 'none'}.")
    image = np.asarray(images[name])
    if image.shape != camera.optics.sensor_shape:
        raise ValueError(f"images[{name!r}]: expected shape {camera.optics.sensor_shape}, got {image.shape}.")
    return image
