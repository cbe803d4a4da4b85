"""Vectors of a result: values at any points, and the part of the volume that each of them stands for."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from lfpiv.benchmark.truth import Point, Truth

SAME_VOXEL = 1e-3
"""Largest distance of coordinates that count as equal [voxel]."""
MOST_GAPS = 50
"""Largest number of nodes per vector at which points count as a lattice with gaps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredField:
    """Vectors of one pair or instant."""

    number: int
    """Number of the pair or instant."""
    positions_mm: np.ndarray
    """Positions (x, y, z) midway in time [mm], shape (vector, 3)."""
    displacement_mm: np.ndarray
    """Displacements (x, y, z) [mm], shape (vector, 3); NaN where there is none."""
    valid: np.ndarray
    """Which vectors the result states as measured, shape (vector,)."""
    uncertainty_mm: np.ndarray | None = None
    """Stated standard deviations (x, y, z) [mm], shape (vector, 3)."""
    window_mm: Point | None = None
    """Edges (x, y, z) of the interrogation window [mm]; None: not stated, or none."""
    is_particles: bool = False
    """Whether the vectors are particles, each with a position of its own."""
    seconds: float | None = None
    """Computing time [s]; None: not stated."""
    memory_mib: float | None = None
    """Largest memory [MiB]; None: not stated."""
    notes: tuple[str, ...] = field(default=())
    """What was assumed in reading."""

    def __post_init__(self) -> None:
        """Check shapes; raise ValueError."""
        count = len(self.positions_mm)
        if self.positions_mm.shape != (count, 3) or self.displacement_mm.shape != (count, 3):
            raise ValueError(
                f"positions_mm, displacement_mm: expected (vector, 3), got {self.positions_mm.shape}, "
                f"{self.displacement_mm.shape}."
            )
        if self.valid.shape != (count,) or self.valid.dtype != bool:
            raise ValueError(f"valid: expected bool of shape ({count},), got {self.valid.dtype} {self.valid.shape}.")

    @cached_property
    def kept(self) -> np.ndarray:
        """Which vectors are stated as measured and are numbers, shape (vector,)."""
        return self.finite & self.valid

    @cached_property
    def finite(self) -> np.ndarray:
        """Which vectors are numbers, replaced ones included, shape (vector,)."""
        return np.isfinite(self.displacement_mm).all(1) & np.isfinite(self.positions_mm).all(1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Regular places of vectors; some may be empty."""

    axes_mm: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Coordinates along x, y, z, increasing [mm]."""
    vector: np.ndarray
    """Number of the vector at each node, -1 where there is none, shape (x, y, z)."""


def lattice_of(positions_mm: np.ndarray, voxel_mm: float) -> Lattice | None:
    """Return the lattice on which points lie; None if they are scattered, or two share a node.

    Parameters
    ----------
    positions_mm : ndarray, shape (vector, 3)
        Points (x, y, z) [mm], finite.
    voxel_mm : float
        Edge of a voxel [mm].
    """
    if not len(positions_mm):
        return None
    axes, places = [], []
    for values in positions_mm.T:
        order = np.argsort(values, kind="stable")
        step = np.concatenate([[False], np.diff(values[order]) > SAME_VOXEL * voxel_mm])
        place = np.empty(len(values), int)
        place[order] = np.cumsum(step)
        places.append(place)
        axes.append(np.bincount(place, values) / np.bincount(place))
    shape = tuple(len(axis) for axis in axes)
    if np.prod(shape, dtype=float) > MOST_GAPS * len(positions_mm):
        return None
    vector = np.full(shape, -1)
    vector[tuple(places)] = np.arange(len(positions_mm))
    if (vector >= 0).sum() != len(positions_mm):
        return None
    return Lattice(axes_mm=(axes[0], axes[1], axes[2]), vector=vector)


def represented_by(measured: MeasuredField, truth: Truth) -> np.ndarray:
    """Return the vector that stands for each sample point of the measurable region, -1 for none.

    A vector on a lattice stands for its cell, of at most a reference window. Scattered vectors stand for the points to
    which they are the nearest ones, up to half a reference window away.

    Returns
    -------
    ndarray of int, shape (sample,)
        Numbers of vectors of `measured` that are kept.
    """
    samples, window = truth.samples_mm, np.asarray(truth.reference_window_mm)
    known = np.flatnonzero(np.isfinite(measured.positions_mm).all(1))
    found = np.full(len(samples), -1)
    if not len(known):
        return found
    lattice = None if measured.is_particles else lattice_of(measured.positions_mm[known], truth.voxel_mm)
    if lattice is None:
        kept = np.flatnonzero(measured.kept)
        if not len(kept):
            return found
        tree = cKDTree(measured.positions_mm[kept] / window)
        distance, nearest = tree.query(samples / window, p=np.inf, distance_upper_bound=0.5)
        found[np.isfinite(distance)] = kept[nearest[np.isfinite(distance)]]
        return found
    nodes, near = [], np.ones(len(samples), bool)
    for axis, values, edge in zip(lattice.axes_mm, samples.T, window, strict=True):
        node = np.abs(values[:, None] - axis).argmin(1)
        step = float(np.median(np.diff(axis))) if len(axis) > 1 else edge
        near &= np.abs(values - axis[node]) <= min(step, edge) / 2 * (1 + 1e-6)
        nodes.append(node)
    vector = lattice.vector[tuple(nodes)]
    vector = np.where(vector >= 0, known[vector], -1)
    good = near & (vector >= 0) & measured.kept[vector]
    found[good] = vector[good]
    return found
