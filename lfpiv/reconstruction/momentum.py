"""Nesterov's momentum for SMART, in the logarithm of the coefficients: c' (c' / c)^beta.

SMART's step minimises the tangent of the misfit plus sum_j s_j KL(c'_j, c_j) / mu: it is mirror descent, for which this
momentum is Nesterov's. Every iterate keeps the form c_0 exp(sum_i w m_i / s). If volumes explain the images exactly,
only one of them has this form. So the limit is the same with and without momentum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv_kernels.reconstruction.update import Leap, extrapolate
from lfpiv_kernels.reconstruction.voxels import replace_resting
from lfpiv_kernels.transfer import DeviceArray, empty

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

    def forget(self, coefficients: DeviceArray, active: DeviceArray) -> None:
        """Forget the voxels where `active` is 0: their `coefficients` will not change by the momentum."""
        replace_resting(self.previous, active, coefficients)

    def leap(self, ahead: DeviceArray) -> Leap:
        """Return what a step needs to extrapolate its coefficients into `ahead`."""
        return Leap(self.previous, self.exponent, ahead)

    def after(self, coefficients: DeviceArray) -> Momentum:
        """Return the momentum after a step to `coefficients`."""
        return Momentum(coefficients, self.following_time, self.largest)

    def extrapolate(self, coefficients: DeviceArray) -> tuple[DeviceArray, Momentum]:
        """Return extrapolated coefficients after a step, and the momentum after it.

        `coefficients` are lifted in place to the smallest normal float32 where they were not zero before the step.
        """
        ahead = empty(coefficients.size)
        extrapolate(coefficients, self.leap(ahead))
        return ahead, self.after(coefficients)
