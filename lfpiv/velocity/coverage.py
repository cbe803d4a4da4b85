"""Windows that can hold a vector: with enough fluid, seen by two cameras, and with particles in enough of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from lfpiv.velocity.settings import Triple
from lfpiv.velocity.validation import LEAST_SEEN, seen_windows
from lfpiv.velocity.windows import Windows

LEAST_FLUID = 0.5
"""Least share of a window's voxels that hold fluid. Windows with less are masked."""
LEAST_SEEDED = 0.5
"""Least share of a window's fluid that holds particles. Vectors of windows with less are not valid."""
ROUNDING = 1e-9
"""Largest rounding error of a share."""


@dataclass(frozen=True, kw_only=True)
class Voxels:
    """Flags of voxels, shape (z, y, x); None where no voxel needs one."""

    seen: np.ndarray | None = None
    """True where two cameras see the voxel; None: everywhere."""
    solid: np.ndarray | None = None
    """True where there is no fluid; None: nowhere."""
    unseeded: np.ndarray | None = None
    """True where the fluid holds no particles; None: nowhere."""

    @property
    def unseeded_fraction(self) -> float:
        """Part of the fluid that two cameras see and that holds no particles."""
        if self.unseeded is None:
            return 0.0
        usable = np.ones_like(self.unseeded)
        for flags in (self.seen, None if self.solid is None else ~self.solid):
            if flags is not None:
                usable &= flags
        return float(self.unseeded[usable].mean()) if usable.any() else 0.0

    @property
    def coarse(self) -> Voxels:
        """Flags for all passes but the last, whose vectors are only predictions."""
        return Voxels(solid=self.solid)

    def coverage(self, windows: Windows, last: Triple) -> Coverage:
        """Return what the windows of a pass hold; `last` is the window of the last pass.

        A window is masked if less than `LEAST_FLUID` of it is fluid. A larger window of an earlier pass needs no more
        fluid than a window of the last pass can hold.
        """
        everywhere = np.ones(windows.count)
        fluid = everywhere if self.solid is None else windows.means(~self.solid)
        seeded = everywhere
        if self.unseeded is not None:
            empty = self.unseeded & ~self.solid if self.solid is not None else self.unseeded
            seeded = 1 - np.divide(windows.means(empty), fluid, out=np.zeros_like(fluid), where=fluid > 0)
        least = min(LEAST_FLUID, math.prod(last) / math.prod(windows.window))
        return Coverage(
            fluid_share=fluid,
            seeded_share=seeded,
            seen=self._seen(windows, fluid),
            masked=fluid < least - ROUNDING,
            seeded=seeded >= LEAST_SEEDED - ROUNDING,
        )

    def _seen(self, windows: Windows, fluid: np.ndarray) -> np.ndarray:
        """Return whether two cameras see enough of each window's fluid."""
        if self.seen is None:
            return np.ones(windows.count, bool)
        if self.solid is None:
            return seen_windows(self.seen, windows)
        enough: np.ndarray = windows.means(self.seen & ~self.solid) >= LEAST_SEEN * fluid - ROUNDING
        return enough


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Contents of windows, shape (z, y, x) of the grid of windows."""

    fluid_share: np.ndarray
    """Share of a window's voxels that hold fluid."""
    seeded_share: np.ndarray
    """Share of a window's fluid that holds particles."""
    seen: np.ndarray
    """True where two cameras see enough of the fluid."""
    masked: np.ndarray
    """True where the window holds too little fluid to be measured."""
    seeded: np.ndarray
    """True where enough of the fluid holds particles."""

    @property
    def measurable(self) -> np.ndarray:
        """True where a vector can be measured."""
        flags: np.ndarray = self.seen & self.seeded & ~self.masked
        return flags


@dataclass(frozen=True, kw_only=True)
class MaskedPair:
    """Two volumes in which some voxels hold no fluid."""

    volumes: tuple[np.ndarray, np.ndarray]
    """Shape (z, y, x), float32, 0 without fluid."""
    solids: tuple[np.ndarray, np.ndarray]
    """True where each volume holds no fluid."""

    @cached_property
    def fluid(self) -> np.ndarray:
        """Voxels that hold fluid in both volumes, shape (z, y, x).

        Where the two solids differ, the flow carries particles across the wall. One volume then shows particles
        cut by the edge of the other. So voxels beside the difference are left out too.
        """
        first, second = self.solids
        differ = first ^ second
        if differ.any():
            differ = ndimage.binary_dilation(differ)
        common: np.ndarray = ~(first | second | differ)
        return common

    def levelled(self, window: Triple) -> tuple[np.ndarray, np.ndarray]:
        """Return both volumes less the local mean of their fluid, 0 where either of them holds none.

        The coefficient of volumes whose local mean is 0 needs no mean over the fluid of each window at each lag. Their
        edges do not correlate with each other. The mean is that over a window around each voxel.
        """
        fluid = self.fluid
        share = np.maximum(_local_mean(fluid.astype(np.float32), window), np.finfo(np.float32).tiny)
        first, second = (
            np.where(fluid, volume - _local_mean(np.where(fluid, volume, 0), window) / share, 0).astype(np.float32)
            for volume in self.volumes
        )
        return first, second


def _local_mean(values: np.ndarray, window: Triple) -> np.ndarray:
    mean: np.ndarray = ndimage.uniform_filter(values, window, mode="constant")
    return mean
