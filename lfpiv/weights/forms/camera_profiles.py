"""Profiles that planes of voxels share, of one camera: the axes, the lenses and the ray models that they are made of.

A plane has rows and columns of voxels, along the rows and columns of the sensor. The output is `SeparableWeights`, see
there and `lfpiv_kernels.weights.separable`. `lfpiv.weights.forms.shared_profiles` chooses where they are used.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.lightfield.microimage_layout import microimage_centres
from lfpiv.progress import StepProgress
from lfpiv.weights.blocks import PackedCamera
from lfpiv.weights.ray_fit import grid_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.projector_separable import MOST_VALUES, lines_bytes
from lfpiv_kernels.reconstruction.separable_gpu import device_bytes
from lfpiv_kernels.reconstruction.separable_weights import COLUMN_BLOCK, MOST_TAPS, PARTS, STRIP, SeparableWeights
from lfpiv_kernels.weights.separable import PlaneProfiles, Profiles

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

FAR_ENOUGH = 0.4
"""Least movement of an image by a voxel of the innermost axis, as a part of the largest one, with which columns lie
along this axis."""
SAMPLED_PLANES = 3
"""Planes from which the memory of all planes is estimated."""
SAMPLED_EDGE = 32
"""Rows and columns of the parts of these planes that are looked at: some in the middle, and some in each corner."""
RAY_BYTES = 1 + 8 + 8 + 16
"""Memory of a ray [byte]: its rim; its pixel and share; its light there and back; its place, share and pixel in the map
between rays and pixels."""


def radius_px(camera: CalibratedCamera) -> float:
    """Return the radius of a camera's microimages [pixel]."""
    optics = camera.optics
    return float(optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm)


def camera_axes(stored: StoredGrid, camera: CalibratedCamera) -> tuple[int, int, int]:
    """Return the axes in memory that count rows, planes and columns of voxels for a camera.

    Rows follow each other down the sensor, columns across it. Columns lie along the innermost axis in memory where that
    moves an image far enough.
    """
    middle = (np.array(stored.shape) - 1) / 2
    steps = np.concatenate([middle + 0.5 * np.eye(3), middle - 0.5 * np.eye(3)])
    places = camera.map(stored.positions_mm(steps), np.zeros((6, 2)))
    moved = np.abs(places[:3] - places[3:])
    rows = int(np.argmax(moved[:, 1]))
    across = np.where(np.arange(3) == rows, -1.0, moved[:, 0])
    columns = 2 if across[2] >= FAR_ENOUGH * across.max() else int(np.argmax(across))
    return rows, 3 - rows - columns, columns


@dataclass(frozen=True)
class CameraProfiles:
    """The planes of a volume as one camera sees them, and their profiles."""

    stored: StoredGrid
    camera: CalibratedCamera

    @cached_property
    def axes(self) -> tuple[int, int, int]:
        """Axes in memory that count rows, planes and columns."""
        return camera_axes(self.stored, self.camera)

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Rows, planes and columns."""
        rows, planes, columns = (self.stored.shape[axis] for axis in self.axes)
        return rows, planes, columns

    @property
    def possible(self) -> bool:
        """Whether the kernels have room for the profiles of a lens, and numbers for its rows and columns."""
        limit = np.iinfo(np.int16).max
        values = self.profiles.pixels * MOST_TAPS * PARTS + STRIP
        return values <= MOST_VALUES and max(self.shape) < limit and max(self._taps[1]) <= MOST_TAPS

    @property
    def stored_bytes(self) -> int:
        """Memory of the profiles [byte], about."""
        blocks = -(-self.shape[2] // COLUMN_BLOCK)
        rows = self.profiles.ray_rows * self._strips * blocks * STRIP
        down, across = (float(np.mean(taps)) for taps in self._taps)
        return int(self.shape[1] * (rows * (2 + COLUMN_BLOCK * down) + self._pixels * (2 + PARTS * across)))

    @property
    def estimated_bytes(self) -> int:
        """Memory of the profiles and of the rays [byte], about."""
        _, planes, columns = self.shape
        return self.stored_bytes + RAY_BYTES * self._rays + lines_bytes(planes, columns)

    @property
    def device_bytes(self) -> int:
        """Memory of the profiles on a GPU, and of what projects with them [byte], about."""
        _, planes, columns = self.shape
        seen = int(planes * self._pixels * np.mean(self._taps[1]))
        lines = planes * self._strips, columns
        return device_bytes(self.stored_bytes, seen, lines, self._rays, self.profiles.ray_rows)

    @property
    def _pixels(self) -> int:
        """Columns of pixels under the lenses of all strips."""
        return int(self._strips * self._lenses * self.profiles.pixels)

    @property
    def _rays(self) -> int:
        return int(self.profiles.ray_rows * self._pixels * STRIP)

    def weights(self, progress: StepProgress) -> SeparableWeights | None:
        """Integrate the profiles of all planes; None if a pixel sees too many columns of voxels."""
        rows, planes, columns = self.shape
        found: list[PlaneProfiles] = []
        turns = np.empty((planes, self._strips, 2), np.float32)
        with threadpool_limits(1, "blas"):
            for plane, model in enumerate(self._models((0, 0, 0), (planes, rows, columns))):
                one, turns[plane] = self._profiles_of(model, (rows, columns))
                if one is None:
                    return None
                found.append(one)
                progress((plane + 1) / planes)
        pixel, share, rim = self.profiles.rays()
        return SeparableWeights(
            voxels=self.stored.shape,
            axes=self.axes,
            sensor_shape=self.camera.optics.sensor_shape,
            ray_rows=self.profiles.ray_rows,
            strips=self._strips,
            lenses=self._lenses,
            pixels=self.profiles.pixels,
            middle=self._middle,
            turn=turns,
            rim=rim,
            pixel=pixel,
            share=share,
            **PlaneProfiles.joined(found),
        )

    @cached_property
    def _taps(self) -> tuple[list[int], list[int]]:
        """Largest numbers of rows of voxels in a profile down, and of columns in one across, of some planes."""
        rows, planes, columns = self.shape
        edges = min(rows, SAMPLED_EDGE), min(columns, SAMPLED_EDGE)
        corners = [(rows - edges[0]) * part for part in (0, 1)], [(columns - edges[1]) * part for part in (0, 1)]
        middle = (rows - edges[0]) // 2, (columns - edges[1]) // 2
        down, across = [], []
        for plane in np.unique(np.linspace(0, planes - 1, SAMPLED_PLANES).round().astype(int)).tolist():
            found = [
                self._profiles_of(next(self._models((plane, *first), (1, *edges))), edges)[0]
                for first in {middle, *itertools.product(*corners)}
            ]
            down.append(max(one.down_taps if one else 0 for one in found))
            across.append(max(int(one.lens[:, 2].max()) if one else MOST_TAPS + 1 for one in found))
        return down, across

    def _models(self, first: tuple[int, int, int], count: tuple[int, int, int]) -> Iterator[np.ndarray]:
        """Yield the ray models of some voxels (plane, row, column), plane by plane."""

        def positions_mm(steps: np.ndarray) -> np.ndarray:
            """Return places [mm] by indices (plane, row, column)."""
            along = np.empty(np.shape(steps))
            along[:, self.axes[1]], along[:, self.axes[0]], along[:, self.axes[2]] = (steps + first).T
            return self.stored.positions_mm(along)

        order = (self.axes[1], self.axes[0], self.axes[2])
        planes, down, across = (2 - self.stored.order[axis] for axis in order)
        return grid_models(self.camera, count, positions_mm, (planes, down, across), "profiles")

    def _profiles_of(self, model: np.ndarray, shape: tuple[int, int]) -> tuple[PlaneProfiles | None, np.ndarray]:
        """Return the profiles of a plane of rows and columns, and its turns (strip, 2), from its voxels' ray models."""
        rows, columns = shape
        part_rows = STRIP // PARTS
        middle_rows = self._first_lens[1] + part_rows * np.arange(PARTS * self._strips) + (part_rows - 1) / 2
        seen, turn = _seen_by_parts(self.camera, model.reshape(rows, columns, -1), middle_rows)
        profiles = self.profiles.of_plane(model, seen.reshape(len(middle_rows) * columns, -1), rows, columns)
        return profiles, turn.reshape(self._strips, PARTS, 2).mean(1)

    @cached_property
    def profiles(self) -> Profiles:
        """The kernels' launcher for this camera."""
        packed, radius, every = PackedCamera.from_camera(self.camera), radius_px(self.camera), self._centres
        return Profiles(
            packed.camera,
            packed.lattice,
            packed.cell_mm,
            frame=packed.frame,
            first_lens=self._first_lens,
            lens_rows=self._lens_rows,
            first_column=self._first_column,
            first_row=self._first_row,
            pixels=int((np.ceil(self._of_strips.max(1) + radius) - self._first_column).max()),
            ray_rows=int((np.ceil(every[..., 1].max(1) + radius) - self._first_row).max()),
        )

    @cached_property
    def _layout(self) -> tuple[tuple[int, int], np.ndarray]:
        first, centre = microimage_centres(self.camera.optics, self.camera.lattice, radius_px(self.camera) + 1)
        i, j = first.tolist()
        return (i, j), centre

    @property
    def _first_lens(self) -> tuple[int, int]:
        return self._layout[0]

    @property
    def _lens_rows(self) -> int:
        return len(self._layout[1])

    @property
    def _lenses(self) -> int:
        return int(self._layout[1].shape[1])

    @property
    def _strips(self) -> int:
        return -(-self._lens_rows // STRIP)

    @cached_property
    def _centres(self) -> np.ndarray:
        """Centres of the microimages of whole strips [pixel], shape (lens row, lens, 2)."""
        centre = self._layout[1]
        beyond = np.arange(1, self._strips * STRIP - len(centre) + 1)  # rows that fill the last strip
        more = centre[-1] + beyond[:, None, None] * (centre[-1] - centre[-2] if len(centre) > 1 else 0)
        return np.concatenate([centre, more])

    @property
    def _of_strips(self) -> np.ndarray:
        """Columns of the centres [pixel], shape (strip, lens row of the strip, lens)."""
        return self._centres[..., 0].reshape(self._strips, STRIP, self._lenses)

    @cached_property
    def _first_column(self) -> np.ndarray:
        return np.floor(self._of_strips.min(1) - radius_px(self.camera)).astype(np.int32)

    @cached_property
    def _first_row(self) -> np.ndarray:
        return np.floor(self._centres[..., 1].min(1) - radius_px(self.camera)).astype(np.int32)

    @property
    def _middle(self) -> np.ndarray:
        """`SeparableWeights.middle`."""
        rows = self._centres[:, self._lenses // 2, 1] - self._first_row
        lanes = rows.reshape(self._strips, PARTS, STRIP // PARTS).swapaxes(1, 2)  # parts take turns
        return np.ascontiguousarray(lanes, np.float32).ravel()


def _seen_by_parts(
    camera: CalibratedCamera, models: np.ndarray, middle_rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ray models of a plane's columns where the middle row of lenses of parts sees them, and the turns.

    Parameters
    ----------
    models : ndarray, shape (row, column, 38)
        Ray models of the plane's voxels.
    middle_rows : ndarray, shape (part,)
        Lattice index j of the middle of each part of a strip.

    Returns
    -------
    seen : ndarray, shape (part, column, 38), float32
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
