"""Nesterov's momentum for SMART, in the logarithm of the coefficients: c' (c' / c)^beta.

SMART's step minimises the tangent of the misfit plus sum_j s_j KL(c'_j, c_j) / mu: it is mirror descent, for which this
momentum is Nesterov's. Every iterate keeps the form c_0 exp(sum_i w m_i / s). If volumes explain the images exactly,
only one of them has this form. So the limit is the same with and without momentum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv_kernels.reconstruction.update import extrapolate

MOMENTUM = 0.9
"""Largest exponent beta: a memory of ten iterations."""


@dataclass(frozen=True)
class Momentum:
    """Memory of the last step."""

    previous: np.ndarray
    """Coefficients after the last step, before they were extrapolated, shape (voxel,), float32."""
    time: float = 1.0
    """Nesterov's t_k; 1 when the momentum starts."""
    largest: float = MOMENTUM
    """Largest exponent beta."""

    @property
    def following_time(self) -> float:
        """Nesterov's t_k+1."""
        return float((1 + np.sqrt(1 + 4 * self.time**2)) / 2)

    @property
    def exponent(self) -> float:
        """Exponent beta of the next extrapolation; 0 when the momentum starts."""
        return min((self.time - 1) / self.following_time, self.largest)

    def stopped(self, coefficients: np.ndarray, where: np.ndarray) -> Momentum:
        """Return the momentum without memory of some voxels, whose coefficients do not change by it.

        `where` is true there, shape (voxel,).
        """
        return Momentum(np.where(where, coefficients, self.previous), self.time, self.largest)

    def extrapolate(self, coefficients: np.ndarray) -> tuple[np.ndarray, Momentum]:
        """Return extrapolated coefficients after a step, and the momentum after it.

        `coefficients` are lifted in place to the smallest normal float32 where they were not zero before the step.
        """
        ahead = self.previous.copy()
        extrapolate(coefficients, ahead, self.exponent)
        return ahead, Momentum(coefficients, self.following_time, self.largest)
