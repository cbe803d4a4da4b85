"""Grid of interrogation windows in a volume, as one frozen value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.velocity.settings import Triple, triple
from lfpiv_kernels.correlation.plan import window_grid
from lfpiv_kernels.correlation.window_means import window_means, window_middles
from lfpiv_kernels.transfer import Values


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Evenly spaced windows; all tuples are ordered (z, y, x) [voxel]."""

    window: Triple
    """Edges of a window."""
    origin: Triple
    """First voxel of the first window."""
    step: Triple
    """Distance of neighbouring windows."""
    count: Triple
    """Number of windows."""

    @classmethod
    def covering(cls, shape: Triple, window: Triple, step: Triple) -> Windows:
        """Return the windows that cover a volume, with equal margins at both ends."""
        origin, count = window_grid(shape, window, step)
        return cls(window=window, origin=origin, step=step, count=count)

    @classmethod
    def overlapping(cls, shape: Triple, window: Triple, overlap: float) -> Windows:
        """Return the windows that cover a volume, each of which shares a part with its neighbours."""
        return cls.covering(shape, window, triple(max(1, round(edge * (1 - overlap))) for edge in window))

    def means(self, values: Values) -> np.ndarray:
        """Return the mean over each window, shape (z, y, x); of flags the share. `values` has the volume's shape."""
        return window_means(values, self.window, self.origin, self.step, self.count)

    def middles(self, flags: Values) -> np.ndarray:
        """Return the mean place of each window's flagged voxels, shape (z, y, x, 3) [voxel]; NaN without any."""
        return window_middles(flags, self.window, self.origin, self.step, self.count)

    @property
    def centres(self) -> list[np.ndarray]:
        """Window centres along each axis [voxel]."""
        return [first + (edge - 1) / 2 for edge, first in zip(self.window, self.first_voxels, strict=True)]

    @property
    def first_voxels(self) -> list[np.ndarray]:
        """First voxel of each window along each axis."""
        layout = zip(self.origin, self.step, self.count, strict=True)
        return [origin + step * np.arange(count) for origin, step, count in layout]
