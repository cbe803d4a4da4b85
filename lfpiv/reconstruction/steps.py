"""SMART's steps: from the coefficients c and the exponent sum_i w log((I + b) / (P + b)) to the next coefficients.

`SmartStep` is Eq. 5: c' = c exp(mu G exponent / G s) with the column sums s = sum_i w and the sieve G. Its exponent is
the misfit's gradient blurred once more. Each blur hides what is smaller than itself, so convergence is slow.
`SharpenedStep` leaves that blur out and sharpens instead: log c' / c = mu F exponent / s with
F = 1 + `SHARPENING` (1 - B), B a Gaussian blur of `SHARPENED_VOXEL`. This is an unmatched back projection [1]_. It is
zero where the gradient is zero, so both steps have the same solutions.

.. [1] G. L. Zeng, G. T. Gullberg, "Unmatched projector/backprojector pairs in an iterative reconstruction algorithm",
   IEEE Trans. Med. Imaging 19 (2000) 548-555, doi:10.1109/42.870265.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from lfpiv.reconstruction.sieve import TRUNCATE, Sieve
from lfpiv_kernels.reconstruction.blur import GaussianBlur
from lfpiv_kernels.reconstruction.update import sharpened, update

SHARPENING = 0.5
"""Share of a correction's fine part that a sharpened step adds to it."""
SHARPENED_VOXEL = 2.0
"""Standard deviation of the Gaussian whose difference from a correction is its fine part [voxel]."""
LARGEST_STEP = 3.0
"""Largest absolute logarithm by which a sharpened step changes a voxel."""

LEAST_ACTIVE = 0.05
"""Least share of active voxels, weighted by the sharpening's Gaussian, by which a blur of theirs is divided."""


class Step(Protocol):
    """Step of the iteration; arrays have shape (voxel,), float32."""

    def __call__(self, coefficients: np.ndarray, exponent: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
        """Return the next coefficients. Zeros stay zero.

        `active` is 1 for voxels that take part and 0 for those that do not change; `exponent` is 0 there.
        """
        ...


@dataclass(frozen=True)
class SmartStep:
    """SMART's own step. For mu <= 1 and without smoothing the misfit cannot rise."""

    size: np.ndarray
    """mu / G s, shape (voxel,), float32."""
    sieve: Sieve

    def __call__(self, coefficients: np.ndarray, exponent: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
        """Return the next coefficients."""
        blurred = self.sieve(exponent)
        if active is not None:
            blurred = blurred * active
        following: np.ndarray = update(coefficients.copy(), blurred, self.size)
        return following


@dataclass(frozen=True)
class SharpenedStep:
    """Step without the sieve's second blur, sharpened. The misfit may rise."""

    size: np.ndarray
    """mu / s, shape (voxel,), float32."""
    shape: tuple[int, int, int]
    """Voxel counts in stored order."""

    def __call__(self, coefficients: np.ndarray, exponent: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
        """Return the next coefficients. The blur is the mean over active voxels."""
        logarithm = exponent * self.size
        blurred = self._blur(logarithm)
        if active is not None:
            blurred *= active / np.maximum(self._blur(active), np.float32(LEAST_ACTIVE))
        following: np.ndarray = sharpened(coefficients.copy(), logarithm, blurred, SHARPENING, LARGEST_STEP)
        return following

    @cached_property
    def _blur(self) -> GaussianBlur:
        return GaussianBlur(SHARPENED_VOXEL, self.shape, truncate=TRUNCATE, border="nearest")
