"""Nesterov's momentum for SMART, in the logarithm of the coefficients: c' (c' / c)^beta.

SMART's step minimises the tangent of the misfit plus sum_j s_j KL(c'_j, c_j) / mu: it is mirror descent, for which this
momentum is Nesterov's. Every iterate keeps the form c_0 exp(sum_i w m_i / s). If volumes explain the images exactly,
only one of them has this form. So the limit is the same with and without momentum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv_kernels.reconstruction.update import Extrapolation
from lfpiv_kernels.transfer import DeviceArray

MOMENTUM = 0.9
"""Largest exponent beta: a memory of ten iterations."""


@dataclass(frozen=True)
class Momentum:
    """Memory of the last step."""

    previous: DeviceArray
    """Coefficients after the last step, before they were extrapolated, shape (voxel,), float32, on the device."""
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

    def extrapolation(self, ahead: DeviceArray) -> Extrapolation:
        """Return what a step needs to extrapolate its coefficients into `ahead`."""
        return Extrapolation(self.previous, self.exponent, ahead)

    def after(self, coefficients: DeviceArray) -> Momentum:
        """Return the momentum after a step to `coefficients`."""
        return Momentum(coefficients, self.following_time, self.largest)
