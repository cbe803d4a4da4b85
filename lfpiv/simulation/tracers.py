"""Tracers followed from one instant to another: read from a file, scaled into a box, interpolated between."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lfpiv.errors import InputError

Point = tuple[float, float, float]
TracerMap = tuple[Point, Point, tuple[Point, Point] | None, float | None]
"""Size and centre of the box that tracers fill, the same box in their file, and their peak displacement."""

NEIGHBOURS = 16
"""Tracers of each local linear fit: four per unknown. Fewer follow noise, more blur what the tracers resolve."""

CHUNK = 20_000
"""Points evaluated at once, which bounds the memory of local fits."""


@functools.lru_cache(maxsize=4)
def load_tracers(file: str, first: str, second: str, mapping: TracerMap) -> tuple[np.ndarray, np.ndarray, cKDTree]:
    """Read the tracers of a file, and scale them.

    Parameters
    ----------
    file : str
        A .npz file.
    first, second : str
        Arrays (tracer, >= 3) of the same tracers at two instants.
    mapping : tuple
        How they are scaled, see `TracerMap`.

    Returns
    -------
    position, displacement : ndarray, shape (tracer, 3)
        Positions midway in time, and displacements [mm].
    tree : cKDTree
        Of the positions.

    Raises
    ------
    InputError
        If the file is missing or does not hold the two arrays.
    """
    size, centre, box, peak = mapping
    try:
        with np.load(Path(file), allow_pickle=False) as data:
            missing = [name for name in (first, second) if name not in data]
            if missing:
                raise InputError(
                    f"{file}: expected the array {missing[0]!r}, found {', '.join(data)}. Set flow.first/second."
                )
            start, end = (np.asarray(data[name], float) for name in (first, second))
    except FileNotFoundError:
        raise InputError(f"flow.file: expected a .npz file of tracers, found no file {file}. Check the path.") from None
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"flow.file: {file} cannot be read as a .npz file of numbers ({error}).") from None
    if start.ndim != 2 or start.shape[1] < 3 or start.shape != end.shape or len(start) <= NEIGHBOURS:
        raise InputError(
            f"{file}: expected two arrays of shape (tracer, 3 or more) with more than {NEIGHBOURS} tracers, "
            f"found {first} {start.shape} and {second} {end.shape}."
        )
    start, end = start[:, :3], end[:, :3]
    if not (np.isfinite(start).all() and np.isfinite(end).all()):
        raise InputError(f"{file}: expected finite tracer positions, found NaN or infinity. Remove those tracers.")
    middle, displacement = (start + end) / 2, end - start
    low, high = (np.asarray(corner, float) for corner in (box if box is not None else (middle.min(0), middle.max(0))))
    if not (high > low).all():
        raise InputError(f"{file}: expected tracers that fill a volume, found them in a plane. Set flow.box.")
    scale = np.asarray(size) / (high - low)
    position = (middle - (low + high) / 2) * scale + centre
    displacement = displacement * scale
    largest = np.linalg.norm(displacement, axis=1).max()
    if peak is not None and largest > 0:
        displacement *= peak / largest
    return position, displacement, cKDTree(position)


def interpolate(tree: cKDTree, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values at points (n, 3) between the tracers, shape (n, 3): a weighted linear fit to the nearest ones."""
    parts = [_local_fit(tree, values, points[first : first + CHUNK]) for first in range(0, len(points), CHUNK)]
    return np.concatenate([np.empty((0, 3)), *parts])


def _local_fit(tree: cKDTree, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weighted linear fit to the nearest tracers, evaluated at each point: exact where the field is linear."""
    distance, index = tree.query(points, k=NEIGHBOURS + 1)
    reach = np.maximum(distance[:, -1:], 1e-300)
    index, weight = index[:, :-1], (1 - (distance[:, :-1] / reach) ** 2) ** 2 + 1e-6
    arm = (tree.data[index] - points[:, None]) / reach[..., None]
    design = np.concatenate([np.ones((*index.shape, 1)), arm], axis=2)
    weighted = (design * weight[..., None]).transpose(0, 2, 1)
    normal = weighted @ design
    normal += 1e-10 * normal[:, :1, :1] * np.eye(4)
    return np.linalg.solve(normal, weighted @ values[index])[:, 0]
