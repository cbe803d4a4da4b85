"""Weights of one camera as profiles that planes of voxels share: the lenses, the planes and the ray models they need.

The output is `SeparableWeights`, see there and `lfpiv_kernels.weights.separable`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.lightfield.microimage_layout import microimage_centres
from lfpiv.progress import StepProgress
from lfpiv.weights.blocks import PackedCamera
from lfpiv.weights.ray_fit import grid_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.separable_weights import PARTS, STRIP, SeparableWeights
from lfpiv_kernels.weights.separable import Profiles

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera


def camera_axes(stored: StoredGrid, camera: CalibratedCamera) -> tuple[int, int, int]:
    """Return the axes in memory that count rows, planes and columns of voxels for a camera.

    Rows follow each other down the sensor, columns across it.
    """
    middle = (np.array(stored.shape) - 1) / 2
    steps = np.concatenate([middle + 0.5 * np.eye(3), middle - 0.5 * np.eye(3)])
    places = camera.map(stored.positions_mm(steps), np.zeros((6, 2)))
    moved = np.abs(places[:3] - places[3:])
    rows = int(np.argmax(moved[:, 1]))
    columns = int(np.argmax(np.where(np.arange(3) == rows, -1.0, moved[:, 0])))
    return rows, 3 - rows - columns, columns


def separable_weights(
    stored: StoredGrid, camera: CalibratedCamera, progress: StepProgress, allow: Callable[[int], None]
) -> SeparableWeights:
    """Integrate the profiles of all voxels of a grid for one camera with square lenses."""
    axes = camera_axes(stored, camera)
    rows, planes, columns = (stored.shape[axis] for axis in axes)
    optics, packed = camera.optics, PackedCamera.of(camera)
    radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    first_lens, centre = microimage_centres(optics, camera.lattice, radius + 1)
    lens_rows, lenses = centre.shape[:2]
    strips = -(-lens_rows // STRIP)
    beyond = lens_rows + np.arange(strips * STRIP - lens_rows)  # rows that fill the last strip
    more = centre[-1] + (beyond - lens_rows + 1)[:, None, None] * (centre[-1] - centre[-2] if lens_rows > 1 else 0)
    every = np.concatenate([centre, more])
    first_row = np.floor(every[..., 1].min(1) - radius).astype(np.int32)
    ray_rows = int((np.ceil(every[..., 1].max(1) + radius) - first_row).max())
    in_strips = every[..., 0].reshape(strips, STRIP, lenses)
    first_column = np.floor(in_strips.min(1) - radius).astype(np.int32)
    pixels = int((np.ceil(in_strips.max(1) + radius) - first_column).max())
    profiles = Profiles(
        packed.camera,
        packed.lattice,
        packed.cell_mm,
        frame=packed.frame,
        first_lens=tuple(first_lens.tolist()),
        lens_rows=lens_rows,
        first_column=first_column,
        first_row=first_row,
        pixels=pixels,
        ray_rows=ray_rows,
    )

    def positions_mm(steps: np.ndarray) -> np.ndarray:
        """Return places [mm] by indices (plane, row, column)."""
        along = np.empty(np.shape(steps))
        along[:, axes[1]], along[:, axes[0]], along[:, axes[2]] = steps.T
        return stored.positions_mm(along)

    world = tuple(2 - stored.order[axis] for axis in (axes[1], axes[0], axes[2]))
    models = grid_models(camera, (planes, rows, columns), positions_mm, world)
    part_rows = STRIP // PARTS
    middle_rows = first_lens[1] + part_rows * np.arange(PARTS * strips) + (part_rows - 1) / 2
    down, across, turns = [], [], np.empty((planes, strips, 2), np.float32)
    with threadpool_limits(1, "blas"):
        for plane, model in enumerate(models):
            down.append(profiles.down(model, rows, columns))
            seen, turn = _seen_by_parts(camera, model.reshape(rows, columns, -1), middle_rows)
            turns[plane] = turn.reshape(strips, PARTS, 2).mean(1)
            across.append(profiles.across(seen.reshape(len(middle_rows) * columns, -1), columns))
            progress((plane + 1) / planes)
    counts = np.array([[strip[:3] for strip in plane] for plane in across])
    sizes = [[[strip[k].size for strip in plane] for plane in across] for k in (3, 4)]
    first_start, level_start = (
        np.concatenate([[0], np.cumsum(np.ravel(size))[:-1]]).reshape(planes, strips).astype(np.int64) for size in sizes
    )
    level_sizes = [one[1].size for one in down]
    pixel, share, rim = profiles.rays()
    centre_row = every[:, lenses // 2, 1] - first_row
    lanes = centre_row.reshape(strips, PARTS, part_rows).swapaxes(1, 2)  # parts take turns
    return SeparableWeights(
        voxels=stored.shape,
        axes=axes,
        first_lens=tuple(first_lens.tolist()),
        sensor_shape=optics.sensor_shape,
        ray_rows=ray_rows,
        first_column=first_column,
        first_row=first_row,
        pixels=pixels,
        middle=np.ascontiguousarray(lanes, np.float32).ravel(),
        down_first=np.stack([one[0] for one in down]),
        down=np.concatenate([one[1] for one in down] + [np.zeros(16, np.uint8)]),
        down_start=np.concatenate([[0], np.cumsum(level_sizes)[:-1]]).astype(np.int64),
        down_taps=np.array([one[2] for one in down], np.int32),
        down_scale=np.array([one[3] for one in down], np.float32) / profiles.across_per_level,
        lens=np.ascontiguousarray(counts[..., 0], np.int32),
        lens_count=np.ascontiguousarray(counts[..., 1], np.int32),
        taps=np.ascontiguousarray(counts[..., 2], np.int32),
        first_start=first_start,
        level_start=level_start,
        first=np.concatenate([strip[3].ravel() for plane in across for strip in plane] + [np.zeros(1, np.int16)]),
        level=np.concatenate([strip[4].ravel() for plane in across for strip in plane] + [np.zeros(STRIP, np.uint8)]),
        turn=turns,
        rim=rim,
        pixel=pixel,
        share=share,
    )


def _seen_by_parts(
    camera: CalibratedCamera, models: np.ndarray, middle_rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ray models of a plane's columns where the middle row of lenses of parts sees them, and the turns.

    Parameters
    ----------
    camera : CalibratedCamera
        The camera.
    models : ndarray, shape (row, column, 30)
        Ray models of the plane's voxels.
    middle_rows : ndarray, shape (part,)
        Lattice index j of the middle of each part of a strip.

    Returns
    -------
    seen : ndarray, shape (part, column, 30), float32
    turns : ndarray, shape (part, 2)
        See `SeparableWeights.turn`.
    """
    optics, basis = camera.optics, np.asarray(camera.lattice.basis_mm)
    inverse, middle = np.linalg.inv(basis), models.shape[1] // 2
    own = models[:, middle].astype(float)
    index = (own[:, [0, 6]] - camera.lattice.origin_mm) @ inverse[:, 1]
    if len(own) == 1:
        return np.repeat(models, len(middle_rows), axis=0), np.zeros((len(middle_rows), 2))
    per_row = np.gradient(index)
    order = np.argsort(index)
    row = np.interp(middle_rows, index[order], order.astype(float))
    for end in (order[0], order[-1]):  # straight on beyond the volume
        outside = middle_rows < index[end] if end == order[0] else middle_rows > index[end]
        row = np.where(outside, end + (middle_rows - index[end]) / per_row[end], row)
    lower = np.clip(np.floor(row).astype(int), 0, len(own) - 2)
    part = (row - lower)[:, None, None].astype(np.float32)
    seen = models[lower] * (1 - part) + models[lower + 1] * part
    nearest = np.clip(np.rint(row).astype(int), 0, len(own) - 1)
    along_rows = np.gradient(own[:, 0])[nearest]
    columns = models[nearest][:, :, 0].astype(float)
    along_columns = np.gradient(columns, axis=1)[:, middle] if columns.shape[1] > 1 else np.ones(len(nearest))
    slope_u, slope_v = own[nearest, 1], own[nearest, 2]
    index_v = slope_v * inverse[0, 1] + own[nearest, 8] * inverse[1, 1]
    ratio = optics.sensor_per_pupil
    per_lens_row = along_rows / per_row[nearest] + (slope_u * (1 + ratio) / ratio - 1) * basis[1, 0]
    per_mm = slope_v - index_v / per_row[nearest] * along_rows
    turns = np.stack([per_lens_row, -per_mm * optics.pixel_mm / ratio], axis=1) / along_columns[:, None]
    return seen, turns
