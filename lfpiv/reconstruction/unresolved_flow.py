"""`UnresolvedFlow`: motion of shorter wavelength than windows show, as strong as the errors of recorded vectors demand.

Vectors are means over windows. Their best linear predictor (`lfpiv.velocity.imposed_field`) is smoother than the flow:
waves about as long as a window nearly vanish in the means. But particles of a window that move unlike lower its
correlation. Simulated pairs without such waves are easier to measure than recorded ones, and show too little damping.

So the field is a conditional simulation [1]_: to the prediction comes what the same predictor leaves of a random field
with the same covariance, a sum of Fourier modes without divergence [2]_. The variance of the errors that correlation
statistics state grows with its mean square, so that its strength follows from the deviations of the pairs simulated so
far.

References
----------
.. [1] N. A. C. Cressie, "Statistics for Spatial Data", Wiley, 1993, section 3.6.2.
.. [2] R. H. Kraichnan, "Diffusion by a random velocity field", Physics of Fluids 13 (1970) 22-31.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.imposed_field import LENGTH, ImposedField
from lfpiv.velocity.settings import CorrelationSettings

WAVES = 256
"""Number of waves."""
SHORTEST = 0.5
"""Shortest wave over the edge of a window."""
STRONGEST = 1.5
"""Largest root mean square of the field over that of the fluctuations of vectors, as of turbulence whose integral scale
is shorter than a window."""
PLACES = 500
"""Number of places at which the strength of a field is measured."""
GROWTH = 0.05
"""Expected growth of the variance of errors, all components together, over the mean square of a component of the
waves."""
LEAST_GROWTH = 0.01
"""Least growth that simulated pairs may show. It limits the waves where they hardly change the errors."""


class UnresolvedFlow:
    """Random field whose means over the windows of vectors nearly vanish.

    Parameters
    ----------
    vectors : Dataset
        From `lfpiv.correlate`: places and windows.
    rms_voxel : float
        Root mean square of a component in the volume of the windows [voxel].
    rng : Generator
        Determines the field.
    """

    def __init__(self, vectors: xr.Dataset, rms_voxel: float, rng: np.random.Generator):
        self._voxel_mm = np.asarray(vectors.attrs["voxel_mm"], float)
        window_mm = np.array(CorrelationSettings.of(vectors).windows[-1]) * self._voxel_mm
        # the spectrum of the Matern covariance of smoothness 3/2 is Student's distribution with 3 degrees of freedom
        waves = rng.standard_t(3, (WAVES, 3)) / (2 * np.pi * LENGTH)
        self._waves = np.clip(waves, -1 / SHORTEST, 1 / SHORTEST) / window_mm  # cycles per mm along (z, y, x)
        across = np.cross(self._waves, rng.standard_normal((WAVES, 3)))
        across /= np.linalg.norm(across, axis=1)[:, None]
        self._amplitudes = across
        self._phases = rng.uniform(0, 2 * np.pi, WAVES)
        places = np.stack(np.meshgrid(*(vectors[axis].values for axis in AXES), indexing="ij"), axis=-1)
        left = np.sinc(self._waves * window_mm).prod(axis=1)
        means = self._sum(places, self._amplitudes * left[:, None])
        self._shown, self._scale = ImposedField(vectors, means), 1.0
        first, last = (np.array([vectors[axis].values[end] for axis in AXES[::-1]]) for end in (0, -1))
        half_mm = (last - first + window_mm[::-1]) / 2
        inside = (first + last) / 2 + rng.uniform(-1, 1, (PLACES, 3)) * half_mm
        self._scale = rms_voxel / float(np.sqrt(np.mean((self(inside) / self._voxel_mm[::-1]) ** 2)))
        self.window_means: np.ndarray = self._scale * (means - self._shown.window_means)
        """Means over the windows along (z, y, x) [voxel], shape (z, y, x, 3)."""

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (x, y, z) at points (x, y, z) [mm], shape (point, 3)."""
        moved = (self._sum(points_mm[:, ::-1], self._amplitudes) * self._voxel_mm)[:, ::-1]
        return self._scale * (moved - self._shown(points_mm))

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
