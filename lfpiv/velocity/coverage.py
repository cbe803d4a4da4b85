"""Windows that can hold a vector: with enough fluid, seen by two cameras, and with particles in enough of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lfpiv.velocity.settings import Triple
from lfpiv.velocity.validation import LEAST_SEEN, seen_windows
from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation.fluid import flags_on_device, inverted
from lfpiv_kernels.transfer import Values

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

    @cached_property
    def solid_on_device(self) -> Values | None:
        """`solid` on the device, brought there once."""
        return None if self.solid is None else flags_on_device(self.solid)

    def coverage(self, windows: Windows, last: Triple, *, predicts: bool) -> Coverage:
        """Return what the windows of a pass hold; `last` is the window of the last pass.

        A window is masked if less than `LEAST_FLUID` of it is fluid. A larger window of an earlier pass needs no more
        fluid than a window of the last pass can hold. The vectors of a pass that only `predicts` those of the last one
        need neither two cameras nor particles.
        """
        everywhere = np.ones(windows.count)
        fluid = everywhere if self.solid_on_device is None else windows.means(inverted(self.solid_on_device))
        seeded = everywhere
        if self.unseeded is not None and not predicts:
            empty = self.unseeded & ~self.solid if self.solid is not None else self.unseeded
            seeded = 1 - np.divide(windows.means(empty), fluid, out=np.zeros_like(fluid), where=fluid > 0)
        least = min(LEAST_FLUID, math.prod(last) / math.prod(windows.window))
        return Coverage(
            fluid_share=fluid,
            seeded_share=seeded,
            seen=np.ones(windows.count, bool) if predicts else self._seen(windows, fluid),
            masked=fluid < least - ROUNDING,
            seeded=seeded >= LEAST_SEEDED - ROUNDING,
        )

    def _seen(self, windows: Windows, fluid: np.ndarray) -> np.ndarray:
        """Return whether two cameras see enough of each window's fluid."""
        if self.seen is None:
            return np.ones(windows.count, bool)
        if self.solid is None:
            return seen_windows(self.seen, windows)
        return windows.means(self.seen & ~self.solid) >= LEAST_SEEN * fluid - ROUNDING


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
        return self.seen & self.seeded & ~self.masked
