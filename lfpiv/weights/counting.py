"""Weights by counting rays (Eq. 10): weight = rays that reach a pixel / rays traced from the voxel.

Object points in a voxel and points in the pupil are stratified samples. `count_voxels` traces and counts them. A few
counted voxels, `CountedVoxels`, measure the error of integrated weights. For whole grids see
`lfpiv.weights.forms.counted`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.weights.blocks import PackedCamera
from lfpiv.weights.ray_fit import fit_rays
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import runtime
from lfpiv_kernels.rays.count import count_rays
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.reconstruction.ray_projector import RayProjector

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

COUNT_POINTS = 8
"""Object points along each edge of a voxel: 512 per voxel. The paper has 500."""
PAPER_SAMPLES = 144
"""Pupil points along each axis: the paper's step of 0.05 degrees."""
VOXELS = 6
"""Number of voxels per camera that are compared with integrated weights."""
POOLS = 1 << 12, 1 << 18
"""Sizes of the random pools from which these voxels are drawn. The larger pool is used if the camera sees too few of
the smaller one."""
POINTS, SAMPLES = 12, 30
"""Object points along each voxel edge and pupil points along each axis in a comparison: 1.2e6 rays per voxel, counted
twice."""


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
        Pupil points along each axis.
    points : int
        Object points along each voxel edge.
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
    packed, optics = PackedCamera.from_camera(camera), camera.optics
    strata = np.stack(np.meshgrid(*[np.arange(points)] * 3, indexing="ij"), -1).reshape(-1, 3)
    inside = (strata + rng.random((len(centres_mm), len(strata), 3))) / points - 0.5
    objects = (np.asarray(centres_mm)[:, None] + inside * voxel_mm).reshape(-1, 3)
    rays = fit_rays(camera, objects, degree=3)
    # window: where a voxel's rays meet the array, widened by one lens and one microimage
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
        packed.camera,
        packed.lattice,
        hexagonal=camera.lattice.layout == "hexagonal",
        samples=samples,
        shape=(int(rows), int(columns)),
    )
    return count, total, first_pixel


def add_entries(image: np.ndarray, stored: Blocks | RayProjector, voxel: int) -> None:
    """Add one voxel's stored weights to a sensor image, in place."""
    ray, weight = stored.entries(voxel)
    share = stored.microimages.share[ray]
    lit = share > 0
    np.add.at(image.ravel(), stored.microimages.pixel[ray[lit]], weight[lit] * share[lit])


class CountedVoxels:
    """A few random voxels that a camera sees, counted twice with independent rays.

    The difference of the two counts gives their noise. There are no voxels if the camera sees none.
    """

    def __init__(self, stored: StoredGrid, camera: CalibratedCamera, seed: int = 0):
        self.stored, self.camera = stored, camera
        self.voxels = draw_seen(stored, camera, seed)
        self.centres_mm = stored.centres_mm(self.voxels)
        if not len(self.voxels):
            return
        counts, total, corner = count_voxels(
            camera,
            np.repeat(self.centres_mm, 2, axis=0),
            stored.grid.voxel_mm,
            samples=SAMPLES,
            points=POINTS,
            seed=seed,
        )
        shares = counts / np.maximum(total, 1)[:, None, None]
        self._corner = corner.reshape(-1, 2, 2).min(1)
        extent = np.array(counts.shape[:0:-1]) + (corner.reshape(-1, 2, 2).max(1) - self._corner).max(0)
        self._halves = np.zeros((len(self.voxels), 2, extent[1], extent[0]), np.float32)
        for number, (share, (column, row)) in enumerate(zip(shares, corner, strict=True)):
            column, row = (column, row) - self._corner[number // 2]
            window = self._halves[number // 2, number % 2, row : row + share.shape[0], column : column + share.shape[1]]
            window[:] = share
        for half, start in zip(self._halves, self._corner, strict=True):
            half *= _window(camera.gain, start, half.shape[1:])

    def errors(self, stored: Blocks | RayProjector, voxels: Sequence[int] | None = None) -> list[float]:
        """Return the relative L2 difference of weights from the counts, one per voxel, the counts' noise subtracted.

        `voxels` are the indices of the counted voxels in `stored`; default: their stored indices in the grid.
        """
        errors = []
        rays = stored.microimages
        columns = rays.sensor_shape[1]
        for number, voxel in enumerate(self.voxels if voxels is None else voxels):
            first, second = self._halves[number].astype(np.float64)
            mean = (first + second) / 2
            light = np.linalg.norm(mean)
            if light == 0:
                continue
            image, corner = np.zeros(mean.shape), self._corner[number]
            ray, weight = stored.entries(int(voxel))
            pixel = rays.pixel[ray]
            seen = pixel >= 0
            row, column = np.divmod(pixel[seen], columns)
            weight = weight[seen] * rays.share[ray[seen]] * self.camera.gain[row, column]
            row, column = row - corner[1], column - corner[0]
            inside = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
            np.add.at(image, (row[inside], column[inside]), weight[inside])
            outside = (weight[~inside] ** 2).sum()
            noise = np.linalg.norm(first - second) / 2  # of the mean of the two
            error = np.linalg.norm(image - mean) ** 2 + outside - noise**2
            errors.append(float(np.sqrt(max(error, 0.0)) / light))
        return errors


def draw_seen(stored: StoredGrid, camera: CalibratedCamera, seed: int = 0) -> np.ndarray:
    """Draw `VOXELS` random voxels whose chief rays meet the sensor, or as many as are found. Return sorted indices."""
    rng, size = np.random.default_rng(seed), stored.grid.size
    half_mm = np.array(camera.optics.sensor_shape[::-1]) / 2 * camera.optics.pixel_mm
    for pool in POOLS:
        drawn = rng.choice(size, min(pool, size), replace=False)
        chief = camera.map(stored.centres_mm(drawn), np.zeros((len(drawn), 2))) * (1 + camera.optics.sensor_per_pupil)
        seen = drawn[(np.abs(chief) < half_mm).all(-1)]
        if len(seen) >= VOXELS or pool >= size:
            break
    return np.sort(seen[:VOXELS])


def _overlap(shape: tuple[int, ...], window: tuple[int, ...], corner: np.ndarray) -> tuple[tuple[slice, ...], ...]:
    """Return the overlap of an image and a window whose first pixel is `corner` (column, row): slices of both."""
    column, row = (int(c) for c in corner)
    rows = slice(max(row, 0), max(min(row + window[0], shape[0]), max(row, 0)))
    columns = slice(max(column, 0), max(min(column + window[1], shape[1]), max(column, 0)))
    within = slice(rows.start - row, rows.stop - row), slice(columns.start - column, columns.stop - column)
    return (rows, columns), within


def _window(image: np.ndarray, corner: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cut a window out of a sensor image; zero outside it."""
    out = np.zeros(shape, image.dtype)
    on_sensor, in_window = _overlap(image.shape, shape, corner)
    out[in_window] = image[on_sensor]
    return out
