"""Settings of a cross-correlation: checked once, passed on as one frozen value, stored with the vectors."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import is_finite
from lfpiv.settings.processing import DEFAULT_WINDOWS, Correlation

Triple = tuple[int, int, int]
"""Whole numbers along (z, y, x)."""

DEFAULTS = Correlation()
"""Settings of a correlation where none are stated."""
FIRST_SEARCH = 0.25
"""Default search range of the first pass, as a part of its window: the one-quarter rule."""
REFINE_SEARCH = 3
"""Largest lag of every pass after the first, for particles of about a voxel [voxel]."""


@dataclass(frozen=True, kw_only=True)
class CorrelationSettings:
    """Settings of `lfpiv.correlate`, which describes them. Stored as JSON in the attribute ``settings``."""

    windows: tuple[Triple, ...]
    """Window of each pass (z, y, x) [voxel], from `windows_of`."""
    overlap: float
    max_displacement_voxel: float | None
    smoothing_voxel: float
    intensity_power: float

    def __post_init__(self) -> None:
        """Check the values that do not depend on the volume: raise ValueError."""
        if not (is_finite(self.overlap) and 0 <= self.overlap < 1):
            raise ValueError(f"overlap: expected 0 <= overlap < 1, got {self.overlap!r}.")
        if not (is_finite(self.smoothing_voxel) and self.smoothing_voxel >= 0):
            raise ValueError(f"smoothing_voxel: expected a value >= 0, got {self.smoothing_voxel!r}.")
        if not (is_finite(self.intensity_power) and self.intensity_power > 0):
            raise ValueError(f"intensity_power: expected a value > 0, got {self.intensity_power!r}.")

    @classmethod
    def from_vectors(cls, vectors: xr.Dataset) -> CorrelationSettings:
        """Read the settings that vectors were measured with."""
        stored = json.loads(vectors.attrs["settings"])
        return cls(**{**stored, "windows": tuple(triple(window) for window in stored["windows"])})

    def to_json(self) -> str:
        """Return the attribute ``settings``."""
        return json.dumps(asdict(self))

    def first_search(self, shape: Triple) -> Triple:
        """Return the largest lag of the first pass in a volume. A peak can be located up to one lag less."""
        farthest = self.max_displacement_voxel
        if farthest is None:
            return triple(max(REFINE_SEARCH, math.ceil(FIRST_SEARCH * edge) + 1) for edge in self.windows[0])
        if not (is_finite(farthest) and 0 < farthest < max(shape)):
            raise ValueError(
                f"max_displacement_voxel: expected a value > 0 and within the volume {shape}, got {farthest}."
            )
        return triple(min(max(REFINE_SEARCH, math.ceil(farthest) + 1), max(2, n - 1)) for n in shape)


def triple(values: Iterable[int]) -> Triple:
    """Return three values as a tuple."""
    z, y, x = values
    return z, y, x


def windows_of(windows: int | Sequence[int | Sequence[int]] | None, shape: Triple) -> tuple[Triple, ...]:
    """Check the windows of all passes against the shape of the volumes, and return each as (z, y, x).

    A number is the window of a single pass. Default windows are cut to the volume; others raise ValueError.
    """
    if windows is None:
        return cut_windows(DEFAULT_WINDOWS, shape)
    if isinstance(windows, str):
        raise ValueError(f"windows: expected a window or a sequence, one window per pass, got {windows!r}.")
    if not isinstance(windows, Iterable):
        return (_check_window(windows, shape),)
    if len(windows) == 0:
        raise ValueError("windows: expected at least one pass, got none.")
    return tuple(_check_window(window, shape) for window in windows)


def _check_window(window: Any, shape: Triple) -> Triple:
    """Return one window as (z, y, x)."""
    given = tuple(window) if np.ndim(window) else (window,) * 3
    if len(given) != 3 or not all(is_finite(edge) and int(edge) == edge and edge >= 4 for edge in given):
        raise ValueError(f"windows: expected edges of whole voxels >= 4, one or (z, y, x) per pass, got {window}.")
    edges = triple(int(edge) for edge in given)
    for axis, edge, n in zip(AXES, edges, shape, strict=True):
        if edge > n:
            raise ValueError(
                f"windows: expected edges within the volume, got {edge} along {axis}, which has {n} voxels. "
                f"The largest window of this kind is {largest_within(edges, shape)}, as (z, y, x)."
            )
    return edges


def cut_windows(windows: Iterable[int | Sequence[int]], shape: Sequence[int]) -> tuple[Triple, ...]:
    """Return windows of whole voxels, one edge or (z, y, x) each, cut to a volume of a shape."""
    given = (triple(window) if isinstance(window, Iterable) else (window,) * 3 for window in windows)
    return tuple(largest_within(edges, triple(shape)) for edges in given)


def largest_within(edges: Triple, shape: Triple) -> Triple:
    """Return a window (z, y, x) cut to a volume."""
    return triple(min(edge, n) for edge, n in zip(edges, shape, strict=True))
