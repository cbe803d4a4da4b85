"""Tracer positions at two or more instants: read from a file, scaled into a box, and interpolated."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lfpiv.errors import InputError
from lfpiv.settings.bounds import Point

NEIGHBOURS = 16
"""Tracers of each local linear fit."""

CHUNK = 20_000
"""Points in one batch of local fits."""


@dataclass(frozen=True, kw_only=True)
class TracerScaling:
    """Map from the unit of a tracer file to a box of the volume."""

    size_mm: Point
    """Edges of the box (x, y, z) [mm]."""
    centre_mm: Point
    """Centre of the box (x, y, z) [mm]."""
    box: tuple[Point, Point] | None
    """Opposite corners that are mapped to the box [unit of the file]; None: the extent of the tracers."""
    peak_mm: float | None
    """Largest displacement [mm]; None: as scaled."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TracerSet:
    """Tracers in the volume."""

    position_mm: np.ndarray
    """Positions midway in time (x, y, z) [mm], shape (tracer, 3)."""
    displacement_mm: np.ndarray
    """Displacements between the two instants [mm], shape (tracer, 3)."""
    tree: cKDTree
    """Search tree of the positions."""

    def interpolate(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement at points (n, 3), shape (n, 3) [mm]. Points are clipped to the tracers' extent."""
        points = np.clip(points_mm, self.position_mm.min(0), self.position_mm.max(0))
        parts = [self._fit(points[first : first + CHUNK]) for first in range(0, len(points), CHUNK)]
        return np.concatenate([np.empty((0, 3)), *parts])

    def _fit(self, points: np.ndarray) -> np.ndarray:
        """Fit a weighted linear field to the nearest tracers of each point, and evaluate it there."""
        distance, index = self.tree.query(points, k=NEIGHBOURS + 1)
        reach = np.maximum(distance[:, -1:], 1e-300)
        index, weight = index[:, :-1], (1 - (distance[:, :-1] / reach) ** 2) ** 2 + 1e-6
        offset = (self.tree.data[index] - points[:, None]) / reach[..., None]
        design = np.concatenate([np.ones((*index.shape, 1)), offset], axis=2)
        weighted = (design * weight[..., None]).transpose(0, 2, 1)
        normal = weighted @ design
        normal += 1e-10 * normal[:, :1, :1] * np.eye(4)
        return np.linalg.solve(normal, weighted @ self.displacement_mm[index])[:, 0]


@functools.lru_cache(maxsize=4)
def load_tracers(file: str, first: str, second: str, scaling: TracerScaling) -> TracerSet:
    """Read the tracers of a .npz file and scale them into a box.

    Parameters
    ----------
    file : str
        A .npz file.
    first, second : str
        Arrays (tracer, >= 3) of the same tracers at two instants.
    scaling : TracerScaling
        Box and largest displacement.

    Raises
    ------
    InputError
        If the file is missing or does not contain the two arrays.
    """
    start, end = _read_pair(file, first, second)
    middle, displacement = (start + end) / 2, end - start
    scale, shift = _box_map(file, middle, scaling)
    position = (middle - shift) * scale + scaling.centre_mm
    displacement = displacement * scale
    largest = np.linalg.norm(displacement, axis=1).max()
    if scaling.peak_mm is not None and largest > 0:
        displacement *= scaling.peak_mm / largest
    return TracerSet(position_mm=position, displacement_mm=displacement, tree=cKDTree(position))


@functools.lru_cache(maxsize=4)
def load_series(file: str, series: str, scaling: TracerScaling) -> np.ndarray:
    """Read the tracers of a .npz file at the instants of a time series and scale them into a box.

    Parameters
    ----------
    file : str
        A .npz file.
    series : str
        Array (instant, tracer, >= 3) of the same tracers.
    scaling : TracerScaling
        Box; `peak_mm` has no meaning here.

    Returns
    -------
    ndarray, shape (instant, tracer, 3)
        Positions (x, y, z) [mm], not writable.

    Raises
    ------
    InputError
        If the file is missing or does not contain the array.
    """
    (array,) = _read(file, (series,), "flow.series")
    if array.ndim != 3 or array.shape[0] < 2 or array.shape[1] <= NEIGHBOURS or array.shape[2] < 3:
        raise InputError(
            f"{file}: expected an array of shape (instant, tracer, 3 or more) with two or more instants and more than "
            f"{NEIGHBOURS} tracers, found {series} {array.shape}. Set flow.series."
        )
    array = array[..., :3]
    _require_finite(file, array)
    scale, shift = _box_map(file, array.reshape(-1, 3), scaling)
    position: np.ndarray = (array - shift) * scale + scaling.centre_mm
    position.flags.writeable = False
    return position


@functools.lru_cache(maxsize=2)
def tracers_between(file: str, series: str, scaling: TracerScaling, start: int, end: int) -> TracerSet:
    """Return the tracers of a series midway between two of its instants, and their displacements between these."""
    positions = load_series(file, series, scaling)
    first, second = positions[start], positions[end]
    middle = (first + second) / 2
    return TracerSet(position_mm=middle, displacement_mm=second - first, tree=cKDTree(middle))


def _box_map(file: str, points: np.ndarray, scaling: TracerScaling) -> tuple[np.ndarray, np.ndarray]:
    """Return the scale [mm per unit of the file] and the centre [unit] of the map into the box."""
    corners = scaling.box if scaling.box is not None else (points.min(0), points.max(0))
    low, high = (np.asarray(corner, float) for corner in corners)
    if not (high > low).all():
        raise InputError(f"{file}: expected tracers that fill a volume, found them in a plane. Set flow.box.")
    return np.asarray(scaling.size_mm) / (high - low), (low + high) / 2


def _read(file: str, names: tuple[str, ...], key: str) -> list[np.ndarray]:
    """Return arrays of a .npz file as float64. `key` of the scene names them, for the message if they are missing."""
    try:
        with np.load(Path(file), allow_pickle=False) as data:
            missing = [name for name in names if name not in data]
            if missing:
                raise InputError(f"{file}: expected the array {missing[0]!r}, found {', '.join(data)}. Set {key}.")
            return [np.asarray(data[name], float) for name in names]
    except FileNotFoundError:
        raise InputError(f"flow.file: expected a .npz file of tracers, found no file {file}. Check the path.") from None
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"flow.file: {file} cannot be read as a .npz file of numbers ({error}).") from None


def _read_pair(file: str, first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the tracers at both instants, each (tracer, 3), in the unit of the file."""
    start, end = _read(file, (first, second), "flow.first/second")
    if start.ndim != 2 or start.shape[1] < 3 or start.shape != end.shape or len(start) <= NEIGHBOURS:
        raise InputError(
            f"{file}: expected two arrays of shape (tracer, 3 or more) with more than {NEIGHBOURS} tracers, "
            f"found {first} {start.shape} and {second} {end.shape}."
        )
    start, end = start[:, :3], end[:, :3]
    _require_finite(file, start, end)
    return start, end


def _require_finite(file: str, *positions: np.ndarray) -> None:
    if not all(np.isfinite(array).all() for array in positions):
        raise InputError(f"{file}: expected finite tracer positions, found NaN or infinity. Remove those tracers.")
