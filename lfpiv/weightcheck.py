"""Counted rays of a few voxels: the judge of integrated weights (Eq. 10)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.raymodel import ray_models
from lfpiv.weightblocks import StoredGrid, blocks_of, count_voxels, pack_camera
from lfpiv_kernels.project import Blocks

if TYPE_CHECKING:
    from lfpiv.camera import CalibratedCamera

VOXELS = 6
"""Voxels counted per camera."""
SAMPLES = 100
"""Pupil points per axis of each of two counts: 4e6 rays per voxel, 0.7 % noise, known from the two and subtracted."""
PROFILES_MEAN, PROFILES_WORST = 0.015, 0.025
"""Largest relative L2 difference from counted rays, mean and worst voxel of the sample, with which profiles serve:
three quarters of the project's goals, for a small sample may miss the worst; straight rays have about 0.010, 0.017."""


class CountedVoxels:
    """A few random voxels of one camera, counted twice with independent rays."""

    def __init__(self, stored: StoredGrid, camera: CalibratedCamera, seed: int = 0):
        self.camera = camera
        rng = np.random.default_rng(seed)
        self.voxels = np.sort(rng.choice(stored.grid.size, min(VOXELS, stored.grid.size), replace=False))
        self.centres_mm = stored.centres_mm(self.voxels)
        counts, total, corner = count_voxels(
            camera, np.repeat(self.centres_mm, 2, axis=0), stored.grid.voxel_mm, samples=SAMPLES, seed=seed
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
            half *= _cut(camera.gain, start, half.shape[1:])

    def errors(self, blocks: Blocks, voxels: Sequence[int] | None = None) -> list[float]:
        """Relative L2 difference of stored weights from the counts, their noise subtracted; voxels seen only.

        `voxels` are the indices of the counted voxels in `blocks`; default: those of the grid.
        """
        errors = []
        columns = blocks.microimages.sensor_shape[1]
        for number, voxel in enumerate(self.voxels if voxels is None else voxels):
            first, second = self._halves[number].astype(np.float64)
            mean = (first + second) / 2
            light = np.linalg.norm(mean)
            if light == 0:
                continue
            image, corner = np.zeros(mean.shape), self._corner[number]
            ray, weight = blocks.entries(int(voxel))
            pixel = blocks.microimages.pixel[ray]
            seen = pixel >= 0
            row, column = np.divmod(pixel[seen], columns)
            weight = weight[seen] * blocks.microimages.share[ray[seen]] * self.camera.gain[row, column]
            row, column = row - corner[1], column - corner[0]
            inside = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
            np.add.at(image, (row[inside], column[inside]), weight[inside])
            outside = (weight[~inside] ** 2).sum()
            noise = np.linalg.norm(first - second) / 2  # of the mean of the two
            error = np.linalg.norm(image - mean) ** 2 + outside - noise**2
            errors.append(float(np.sqrt(max(error, 0.0)) / light))
        return errors

    def errors_of_form(self, form: str, voxel_mm: float) -> list[float]:
        """Errors of the footprint in a form, of the counted voxels alone."""
        pack = pack_camera(self.camera)
        model = ray_models(self.camera, self.centres_mm, voxel_mm)
        blocks = blocks_of(pack, [model], form, (0, 0))
        return self.errors(blocks, range(len(model)))


def profiles_serve(errors: Sequence[float]) -> bool:
    """Whether profiles are near enough to counted rays."""
    return not errors or bool(np.mean(errors) <= PROFILES_MEAN and max(errors) <= PROFILES_WORST)


def add_entries(image: np.ndarray, blocks: Blocks, voxel: int) -> None:
    """Add one voxel's stored weights to a sensor image, in place."""
    ray, weight = blocks.entries(voxel)
    share = blocks.microimages.share[ray]
    lit = share > 0
    np.add.at(image.ravel(), blocks.microimages.pixel[ray[lit]], weight[lit] * share[lit])


def add_window(image: np.ndarray, window: np.ndarray, corner: np.ndarray) -> None:
    """Add a window whose first pixel is `corner` (column, row) to a sensor image, in place."""
    column, row = (int(c) for c in corner)
    rows = slice(max(row, 0), min(row + window.shape[0], image.shape[0]))
    columns = slice(max(column, 0), min(column + window.shape[1], image.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] += window[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]


def _cut(image: np.ndarray, corner: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cut a window out of a sensor image, zero outside it."""
    out = np.zeros(shape, image.dtype)
    column, row = (int(c) for c in corner)
    rows = slice(max(row, 0), min(row + shape[0], image.shape[0]))
    columns = slice(max(column, 0), min(column + shape[1], image.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        out[rows.start - row : rows.stop - row, columns.start - column : columns.stop - column] = image[rows, columns]
    return out
