"""`UnresolvedFlow`: motion of shorter wavelength than windows show, as strong as the errors of recorded vectors demand.

Vectors are means over windows. Waves about as long as a window nearly vanish in them, but particles of a window that
move unlike lower its correlation and make it err. Simulated pairs without such waves are easier to measure than
recorded ones, and show too little damping. The waves are a random field of Fourier modes [1]_ without divergence. The
variance of the errors that correlation statistics state grows with their mean square, so that both follow from the
deviations of pairs simulated so far.

References
----------
.. [1] R. H. Kraichnan, "Diffusion by a random velocity field", Physics of Fluids 13 (1970) 22-31.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.settings import CorrelationSettings

WAVES = 64
"""Number of waves."""
LENGTHS = (0.8, 1.25)
"""Shortest and longest wave over the edge of a window. The means over windows of longer ones are measured."""
GROWTH = 0.1
"""Expected growth of the variance of errors, all components together, over the mean square of a component of the waves:
three over the some thirty particles of a window."""
LEAST_GROWTH = 0.03
"""Least growth that simulated pairs may show. It limits the waves where they hardly change the errors."""


class UnresolvedFlow:
    """Random waves about as long as the windows of vectors.

    Parameters
    ----------
    vectors : Dataset
        From `lfpiv.correlate`: places and windows.
    rms_voxel : float
        Root mean square of each component [voxel].
    rng : Generator
        Determines the waves.
    """

    def __init__(self, vectors: xr.Dataset, rms_voxel: float, rng: np.random.Generator):
        self._voxel_mm = np.asarray(vectors.attrs["voxel_mm"], float)
        self._window_mm = np.array(CorrelationSettings.of(vectors).windows[-1]) * self._voxel_mm
        self._centres_mm = [vectors[axis].values for axis in AXES]
        directions = rng.standard_normal((WAVES, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        edge_mm = float(np.prod(self._window_mm)) ** (1 / 3)
        self._waves = directions / (edge_mm * rng.uniform(*LENGTHS, (WAVES, 1)))  # cycles per mm along (z, y, x)
        across = np.cross(directions, rng.standard_normal((WAVES, 3)))
        across /= np.linalg.norm(across, axis=1)[:, None]
        self._amplitudes = rms_voxel * np.sqrt(6 / WAVES) * across
        self._phases = rng.uniform(0, 2 * np.pi, WAVES)

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (x, y, z) at points (x, y, z) [mm], shape (point, 3)."""
        return (self._sum(points_mm[:, ::-1], self._amplitudes) * self._voxel_mm)[:, ::-1]

    def window_means(self) -> np.ndarray:
        """Return the means over the windows along (z, y, x) [voxel], shape (z, y, x, 3)."""
        left = np.sinc(self._waves * self._window_mm).prod(axis=1)
        places = np.stack(np.meshgrid(*self._centres_mm, indexing="ij"), axis=-1)
        means: np.ndarray = self._sum(places, self._amplitudes * left[:, None])
        return means

    def _sum(self, places_mm: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        total: np.ndarray = np.cos(2 * np.pi * places_mm @ self._waves.T + self._phases) @ amplitudes
        return total


def needed_rms(recorded: float, simulated: Sequence[tuple[float, float]], largest: float) -> float:
    """Return the root mean square of the waves with which simulated vectors err as recorded ones do [voxel].

    Parameters
    ----------
    recorded : float
        Random deviation of recorded vectors [voxel].
    simulated : sequence of pairs of floats
        Root mean square of the waves and random deviation of pairs simulated so far [voxel].
    largest : float
        Limit of the result [voxel].
    """
    if not simulated:
        return 0.0
    waves, errors = (np.square([one[k] for one in simulated]) for k in range(2))
    away, known = waves - waves.mean(), largest**4  # as much as one pair with the strongest waves
    growth = (away @ errors + GROWTH * known) / (away @ away + known) if known > 0 else GROWTH
    growth = max(growth, LEAST_GROWTH)
    without = errors.mean() - growth * waves.mean()
    return float(np.sqrt(np.clip((recorded**2 - without) / growth, 0.0, largest**2)))
