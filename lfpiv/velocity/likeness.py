"""`Likeness`: whether simulated pairs are as hard to measure as recorded ones, from what vectors show without truth.

Ghosts and noise lower the correlation. So they show in the share of vectors that are valid and in the random standard
deviation that correlation statistics state. Damping that was measured in pairs with more ghosts than the recorded pairs
have is too strong, and vectors corrected by it are worse than raw vectors.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.systematic import variance_without_ghosts

WHOLE_FLUID = 0.99
"""Least share of fluid of a window that is compared."""
FEWER_VALID = 0.05
"""Share of vectors that may be valid in recorded pairs only."""
LARGER_DEVIATION = 1.2
"""Largest ratio of the random standard deviations of simulated and recorded pairs that are still alike. Damping of 0.15
is then
wrong by some 0.03."""
SIGNIFICANT = 2.0
"""Least difference of simulated from recorded pairs [standard error]."""
UNKNOWN = 1e6
"""Standard error of what cannot be known."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A figure of recorded and of simulated pairs."""

    recorded: float
    simulated: float
    error: float
    """Standard error of their difference."""

    def exceeds(self, allowed: float) -> bool:
        """Return whether simulated minus recorded is larger than allowed, and significant."""
        return self.simulated - self.recorded > max(allowed, SIGNIFICANT * self.error)


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """Figures of recorded and simulated pairs that both show without truth."""

    invalid_share: Compared
    """Share of the windows whose vector is not valid."""
    deviation_voxel: Compared | None = None
    """Median random standard deviation of the displacement [voxel]; None if none is stated, as after a single pass."""

    @property
    def harder(self) -> bool:
        """Whether simulated pairs are harder to measure than recorded ones."""
        random = self.deviation_voxel
        larger = random is not None and random.exceeds((LARGER_DEVIATION - 1) * random.recorded)
        return larger or self.invalid_share.exceeds(FEWER_VALID)

    @property
    def errors_ratio(self) -> float:
        """Ratio of the random standard deviations of recorded and simulated pairs; 1 if none is stated."""
        random = self.deviation_voxel
        if random is None or not min(random.recorded, random.simulated) > 0:
            return 1.0
        return random.recorded / random.simulated

    @property
    def doubt(self) -> float:
        """Share of the damping that is in doubt, since it grows with the random standard deviation."""
        return float(abs(np.log(self.errors_ratio)))

    def __str__(self) -> str:
        random = self.deviation_voxel
        text = f"valid vectors {1 - self.invalid_share.simulated:.3f}, recorded {1 - self.invalid_share.recorded:.3f}"
        if random is not None:
            text += f"; random deviation {random.simulated:.3f} voxel, recorded {random.recorded:.3f}"
        return text


def compare(recorded: Sequence[xr.Dataset], simulated: Sequence[xr.Dataset]) -> Likeness | None:
    """Compare vectors of recorded and simulated pairs; None if either have no window that can be measured.

    Standard errors are those of octants, which are nearly independent.
    """
    both = [[part for one in vectors for part in _octant_figures(one)] for vectors in (recorded, simulated)]
    if not all(both):
        return None
    invalid, random = (_compared(*([part[k] for part in parts] for parts in both)) for k in range(2))
    assert invalid is not None
    return Likeness(invalid_share=invalid, deviation_voxel=random)


def usable(vectors: xr.Dataset) -> np.ndarray:
    """Return True where all of a window is fluid that can be measured, shape (z, y, x).

    Vectors that validation replaced count.
    """
    from lfpiv.velocity.coverage import LEAST_SEEDED  # imports Warp, which readers of results need not

    whole: np.ndarray = vectors["fluid_share"].values >= WHOLE_FLUID
    seeded: np.ndarray = vectors["seeded_share"].values >= LEAST_SEEDED
    return whole & seeded & np.isfinite(vectors["displacement_x"].values)


def octants(shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return flags of the octants of a grid of windows."""
    halves = [np.arange(count) >= count / 2 for count in shape]
    z, y, x = np.meshgrid(*halves, indexing="ij")
    return [(z == a) & (y == b) & (x == c) for a, b, c in itertools.product((False, True), repeat=3)]


def _octant_figures(vectors: xr.Dataset) -> Iterator[tuple[float, float]]:
    """Yield the share of invalid vectors and the median random standard deviation, nan if none, of each octant."""
    used, valid = usable(vectors), vectors["valid"].values
    variance = np.zeros(used.shape)
    for axis in AXES:
        found = vectors[f"displacement_{axis}"].values
        distance = found - (found[valid].mean() if valid.any() else 0.0)
        variance += variance_without_ghosts(vectors[f"uncertainty_{axis}"].values, distance)
    for octant in octants(used.shape):
        if (some := used & octant).any():
            known = variance[some & valid & (variance > 0)]
            yield float(1 - valid[some].mean()), float(np.sqrt(np.median(known))) if known.size else np.nan


def _compared(recorded: Sequence[float], simulated: Sequence[float]) -> Compared | None:
    """Compare the means of a figure of parts; None if no part of either has it."""
    first, second = ([value for value in values if np.isfinite(value)] for values in (recorded, simulated))
    if not first or not second:
        return None
    squares = [np.var(values, ddof=1) / len(values) if len(values) > 1 else np.inf for values in (first, second)]
    error = min(float(np.sqrt(sum(squares))), UNKNOWN)
    return Compared(recorded=float(np.mean(first)), simulated=float(np.mean(second)), error=error)
