"""SMART's steps: from the coefficients c and the exponent sum_i w log((I + b) / (P + b)) to the next coefficients.

`SmartStep` is Eq. 5: c' = c exp(mu G exponent / G s) with the column sums s = sum_i w and the sieve G. Its exponent is
the misfit's gradient blurred once more. Each blur hides what is smaller than itself, so convergence is slow.
`SharpenedStep` sharpens instead: log c' / c = mu F exponent / s with F = (1 + `SHARPENING`) N - `SHARPENING` B. N is a
Gaussian blur of `BAND` of the sieve's, B one of `SHARPENED_VOXEL`. This is an unmatched back projection [1]_. It is
zero where the gradient is zero, so both steps have the same solutions.

Sharpened steps need not converge to them, however short they are: eigenvalues of an unmatched pair can have negative
real parts [2]_. The exponent has details that the sieve hides from the misfit. N leaves most of them out.

.. [1] G. L. Zeng, G. T. Gullberg, "Unmatched projector/backprojector pairs in an iterative reconstruction algorithm",
   IEEE Trans. Med. Imaging 19 (2000) 548-555, doi:10.1109/42.870265.
.. [2] Y. Dong, P. C. Hansen, M. E. Hochstenbach, N. A. Brogaard Riis, "Fixing nonconvergence of algebraic iterative
   reconstruction with an unmatched backprojector", SIAM J. Sci. Comput. 41 (2019) A1822-A1839,
   doi:10.1137/18M1206448.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.sieve import TRUNCATE, Sieve
from lfpiv_kernels.filters.blur import GaussianBlur
from lfpiv_kernels.reconstruction.update import Extrapolation, sharpen, update
from lfpiv_kernels.reconstruction.voxels import multiply
from lfpiv_kernels.transfer import DeviceArray, empty

LEAST_SHARPENED_VOXEL = 0.5
"""Least standard deviation of a sieve whose steps are sharpened [voxel]. Sharpened steps of a narrower sieve enlarge
the finest details by half. The misfit then diverges on small voxels."""
SHARPENING = 0.5
"""Share of a correction's fine part that a sharpened step adds to it."""
SHARPENED_VOXEL = 2.0
"""Standard deviation of the Gaussian whose difference from a correction is its fine part [voxel]."""
LARGEST_STEP = 3.0
"""Largest absolute logarithm by which a sharpened step changes a voxel."""

BAND = 0.5
"""Standard deviation of the Gaussian that bounds the details of a sharpened step, as a part of the sieve's."""


class Step(Protocol):
    """Step of the iteration; arrays have shape (voxel,), float32, on the device."""

    def __call__(
        self,
        coefficients: DeviceArray,
        exponent: DeviceArray,
        momentum: Momentum | None = None,
        *,
        length: float = 1.0,
        in_place: bool = False,
    ) -> tuple[DeviceArray, Momentum | None]:
        """Return the next coefficients and the momentum after them. Zeros stay zero.

        Parameters
        ----------
        coefficients, exponent : array
            Coefficients and the back-projected exponent.
        momentum : Momentum, optional
            Momentum that extrapolates the step.
        length : float
            Factor of the exponent.
        in_place : bool
            Overwrite the coefficients, the exponent and the momentum's memory.
        """
        ...


@dataclass(frozen=True)
class SmartStep:
    """SMART's own step. For mu <= 1 and without smoothing the misfit cannot rise."""

    size: DeviceArray
    """mu / G s, shape (voxel,), float32, on the device."""
    sieve: Sieve

    def __call__(
        self,
        coefficients: DeviceArray,
        exponent: DeviceArray,
        momentum: Momentum | None = None,
        *,
        length: float = 1.0,
        in_place: bool = False,
    ) -> tuple[DeviceArray, Momentum | None]:
        """Return the next coefficients and the momentum after them."""
        stepped, extrapolation = _targets(coefficients, momentum, in_place)
        update(
            coefficients, self.sieve(exponent), self.size, length=length, extrapolation=extrapolation, stepped=stepped
        )
        return _followed(stepped, extrapolation, momentum)


@dataclass(frozen=True)
class SharpenedStep:
    """Step with a narrower blur than the sieve's, sharpened. The misfit may rise."""

    size: DeviceArray
    """mu / s, shape (voxel,), float32, on the device."""
    sieve: Sieve

    def __call__(
        self,
        coefficients: DeviceArray,
        exponent: DeviceArray,
        momentum: Momentum | None = None,
        *,
        length: float = 1.0,
        in_place: bool = False,
    ) -> tuple[DeviceArray, Momentum | None]:
        """Return the next coefficients and the momentum after them."""
        logarithm = multiply(exponent, self.size, exponent if in_place else None, factor=length)
        blurred = self._blur(logarithm)
        logarithm = self._narrow(logarithm)
        stepped, extrapolation = _targets(coefficients, momentum, in_place)
        sharpen(
            coefficients, logarithm, blurred, SHARPENING, LARGEST_STEP, extrapolation=extrapolation, stepped=stepped
        )
        return _followed(stepped, extrapolation, momentum)

    @cached_property
    def _blur(self) -> GaussianBlur:
        return GaussianBlur(SHARPENED_VOXEL, self.sieve.shape, truncate=TRUNCATE, border="nearest")

    @cached_property
    def _narrow(self) -> GaussianBlur:
        width = BAND * self.sieve.sigma_voxel
        return GaussianBlur(width, self.sieve.shape, truncate=TRUNCATE, border="nearest")


def _targets(
    coefficients: DeviceArray, momentum: Momentum | None, in_place: bool
) -> tuple[DeviceArray, Extrapolation | None]:
    """Return where the coefficients after a step go, and those that momentum extrapolates from them."""
    if momentum is None:
        return coefficients if in_place else empty(coefficients.size), None
    if in_place:
        return momentum.previous, momentum.extrapolation(coefficients)
    return empty(coefficients.size), momentum.extrapolation(empty(coefficients.size))


def _followed(
    stepped: DeviceArray, extrapolation: Extrapolation | None, momentum: Momentum | None
) -> tuple[DeviceArray, Momentum | None]:
    """Return the next coefficients and the momentum after a step."""
    if momentum is None or extrapolation is None:
        return stepped, None
    return extrapolation.ahead, momentum.after(stepped)
