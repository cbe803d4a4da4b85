"""The misfits of one reconstruction so far, and whether it should stop."""

from __future__ import annotations

from dataclasses import dataclass, field

from lfpiv.reconstruction.result import SmartStop
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.smart import Misfit

DIVERGENCE = 1.5
"""Rise of the misfit over its first value that counts as divergence. A relaxation above 1 may raise it a little."""


@dataclass
class History:
    """Misfits of an iteration so far, and whether it should stop."""

    settings: SmartSettings
    iterations: int
    squares: list[float] = field(default_factory=list)
    divergence: list[float] = field(default_factory=list)
    subsets: list[int] = field(default_factory=list)
    """Number of subsets of each iteration over subsets. These come first. Their misfits are sums over the subsets'
    pixels, so not quite exact."""

    def append(self, misfit: Misfit) -> None:
        """Add the misfit of a volume."""
        self.squares.append(misfit.squares)
        self.divergence.append(misfit.divergence)

    def scale(self, squares: float, light: float) -> None:
        """Divide all misfits by the part of the images that their rays see: that of the squares and of the light."""
        self.squares = [one / squares for one in self.squares]
        self.divergence = [one / light for one in self.divergence]

    @property
    def epochs(self) -> int:
        """Number of iterations over subsets."""
        return len(self.subsets)

    @property
    def early_stop(self) -> SmartStop | None:
        """Reason to stop before the last iteration; None to go on."""
        count, misfit, tolerance = len(self.divergence) - 1, self.divergence, self.settings.tolerance
        if count > 0 and not misfit[-1] <= DIVERGENCE * misfit[0]:  # true for NaN
            return SmartStop.DIVERGED
        whole = self.epochs < count  # both misfits are those of all rays
        if tolerance > 0 and whole and count < self.iterations and misfit[-2] - misfit[-1] < tolerance * misfit[-2]:
            return SmartStop.CONVERGED
        return None

    @property
    def settled(self) -> bool:
        """Whether the last epoch hardly lowered the misfit of the same subsets, or made it no number."""
        if self.settings.tolerance == 0 or self.epochs < 2 or self.subsets[-1] != self.subsets[-2]:
            return False
        before, after = self.divergence[-2:]
        return not before - after >= self.subsets[-1] * self.settings.tolerance * before
