"""Turbulence for simulated flows: homogeneous, isotropic, divergence-free fluctuations as a sum of Fourier modes [1]_.

Each pair of frames has its own realisation, which is constant between the two frames. The mean over realisations is
zero.

.. [1] R. H. Kraichnan, "Diffusion by a random velocity field", Physics of Fluids 13 (1970) 22-31.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field, model_validator
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import brentq

from lfpiv.settings import bounds
from lfpiv.settings.bounds import Count, Length
from lfpiv.settings.table import Table

SPECTRUM_NODES = 4000
"""Number of tabulated wave numbers, evenly spaced in their logarithm."""
LOWEST = 1e-3
"""Lowest tabulated wave number times the length scale of the spectrum."""
CHUNK = 20_000
"""Points in one batch."""


def checked_points(points_mm: np.ndarray) -> np.ndarray:
    """Return points as float64 of shape (n, 3), or raise ValueError."""
    points_mm = np.asarray(points_mm, float)
    if points_mm.ndim != 2 or points_mm.shape[1] != 3:
        raise ValueError(f"points_mm: expected shape (n, 3), got {points_mm.shape}. Columns are x, y, z.")
    return points_mm


class Turbulence(Table):
    """Table ``[turbulence]``: homogeneous isotropic fluctuations with von Karman's energy spectrum.

    E(k) ~ (k l)^4 / (1 + (k l)^2)^(17/6) up to 2 pi / smallest_mm, zero beyond. The length l follows from the
    longitudinal integral length scale, which is 3 pi / 4 times the mean of 1/k over the energy.
    """

    rms_mm: Length
    """Root mean square of each component of the fluctuating displacement [mm]."""
    integral_scale_mm: Length
    """Longitudinal integral length scale [mm]."""
    smallest_mm: Length = 0.5
    """Shortest wavelength [mm]."""
    modes: Count = Field(default=300, ge=20, le=bounds.MOST_MODES)
    """Number of Fourier modes. More modes come closer to a Gaussian random field, at proportional cost."""

    @model_validator(mode="after")
    def _scales_apart(self) -> Turbulence:
        if self.smallest_mm > 2 * self.integral_scale_mm:
            raise ValueError("smallest_mm of at most twice integral_scale_mm")
        return self

    def realisation(self, *, seed: int | Sequence[int]) -> Fluctuation:
        """Draw one realisation, determined by the seed."""
        rng = np.random.default_rng(seed)
        wave_number, energy = _spectrum(self.integral_scale_mm, self.smallest_mm)
        # all modes have equal energy: draw one wave number from each part of the cumulative spectrum
        quantile = (rng.permutation(self.modes) + rng.random(self.modes)) / self.modes
        length = np.interp(quantile, energy, wave_number)
        direction = rng.standard_normal((self.modes, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        across = np.cross(direction, rng.standard_normal((self.modes, 3)))  # normal to the wave vector: no divergence
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        return Fluctuation(
            wave=length[:, None] * direction,
            amplitude_mm=self.rms_mm * np.sqrt(6 / self.modes) * across,
            phase=rng.uniform(0, 2 * np.pi, self.modes),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Fluctuation:
    """Realisation: the sum over modes of amplitude cos(wave . x + phase), called with points (n, 3) [mm]."""

    wave: np.ndarray
    """Wave vectors (x, y, z) [rad/mm], shape (mode, 3)."""
    amplitude_mm: np.ndarray
    """Displacement amplitudes (x, y, z) [mm], normal to the wave vectors, shape (mode, 3)."""
    phase: np.ndarray
    """Phases [rad], shape (mode,)."""

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        return self._sum(points_mm, self.amplitude_mm)

    def window_mean(self, centres_mm: np.ndarray, window_mm: float | tuple[float, float, float]) -> np.ndarray:
        """Return the exact mean displacement over boxes of edges `window_mm` (x, y, z) [mm], shape (n, 3) [mm]."""
        half = np.broadcast_to(np.asarray(window_mm, float), 3) / 2
        damping = np.sinc(self.wave * half / np.pi).prod(axis=1)
        return self._sum(centres_mm, self.amplitude_mm * damping[:, None])

    def _sum(self, points_mm: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
        points_mm = checked_points(points_mm)
        parts = (points_mm[first : first + CHUNK] for first in range(0, len(points_mm), CHUNK))
        return np.concatenate(
            [np.empty((0, 3)), *(np.cos(part @ self.wave.T + self.phase) @ amplitude for part in parts)]
        )


@dataclass(frozen=True)
class TurbulentFlow:
    """Sum of a mean flow and one realisation of turbulence, called with points (n, 3) [mm]."""

    mean: Callable[[np.ndarray], np.ndarray]
    fluctuation: Fluctuation

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        return self.mean(points_mm) + self.fluctuation(points_mm)


@functools.lru_cache(maxsize=16)
def _spectrum(integral_scale_mm: float, smallest_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return wave numbers [rad/mm] and the part of the energy below each."""

    def table(length: float) -> tuple[np.ndarray, np.ndarray, float]:
        k = np.geomspace(LOWEST / length, max(2 * np.pi / smallest_mm, 2 * LOWEST / length), SPECTRUM_NODES)
        square = (k * length) ** 2
        density = square**2 * (1 + square) ** (-17 / 6)
        energy = cumulative_trapezoid(density, k, initial=0)
        inverse = float(np.trapezoid(density / k, k) / energy[-1])
        return k, energy / energy[-1], 3 * np.pi / 4 * inverse

    # the integral scale is 0.747 l for the full spectrum, and larger for the truncated one
    low, high = 1e-3 * smallest_mm, 10 * integral_scale_mm
    length = brentq(lambda value: table(value)[2] - integral_scale_mm, low, high)
    return table(length)[:2]
