"""SMART's iteration (Eq. 5): what the cameras say of a volume, its correction, and the momentum that speeds it up.

With E the volume, w the weights, s = sum_i w the column sums, I the images, b the noise floor and P = sum w E, SMART
lowers the misfit f(E) = sum_i (P + b) log((P + b) / (I + b)) - P + I. Its step, E' = E exp(mu sum_i w log((I + b) /
(P + b)) / s), is the minimum of f's tangent plus sum_j s_j KL(E'_j, E_j) / mu, which lies above f for mu <= 1: the
misfit cannot rise. That is mirror descent, and momentum in the logarithm, E (E / E_before)^beta, is Nesterov's. Every
iterate has the form E_0 exp(sum_i w m_i / s), and where volumes explain the images, only one of them has this form:
momentum keeps it, and so the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv_kernels import smart as kernels
from lfpiv_kernels.project import Projector

MOMENTUM = 0.9
"""Largest exponent beta: a memory of ten iterations."""
LARGEST_LEAP = 50.0
"""Largest ratio of two iterates that momentum repeats, and the inverse of the smallest one."""
SMALLEST = float(np.finfo(np.float32).tiny)
"""Least light of an active voxel under momentum: below, float32 is slow, and a zero would never come back."""
TRUNCATE = 3.5
"""Reach of the sieve's Gaussian [standard deviation]."""


@dataclass(frozen=True)
class Misfit:
    """How far a volume's projections are from the images."""

    squares: float
    """Sum of (I - P)^2 [counts^2]."""
    divergence: float
    """f [counts], which SMART lowers."""

    def __add__(self, other: Misfit) -> Misfit:
        return Misfit(self.squares + other.squares, self.divergence + other.divergence)


@dataclass(frozen=True, kw_only=True)
class View:
    """One camera's image and what the volume at hand projects onto it; arrays are float32, shape (pixel,)."""

    image: np.ndarray
    """Counts >= 0, zero where `gain` is."""
    gain: np.ndarray
    """What a pixel records per unit of light."""
    floor: float
    """Noise floor b [counts]."""
    projector: Projector
    projected: np.ndarray
    """Written: the projection P, gain included."""
    ratio: np.ndarray
    """Written: gain * log((I + b) / (P + b))."""

    def compare(self, volume: np.ndarray) -> Misfit:
        """Project `volume`, shape (voxel,), and compare it with the image."""
        self.projector.project(volume, self.projected)
        kernels.log_ratio(self.image, self.gain, self.floor, self.projected, self.ratio)
        np.multiply(self.projected, self.gain, out=self.projected)
        difference = self.image - self.projected
        logarithm = np.divide(self.ratio, self.gain, out=np.zeros_like(self.ratio), where=self.gain > 0)
        divergence = difference.sum(dtype=np.float64) - np.dot(self.projected + np.float32(self.floor), logarithm)
        return Misfit(float(np.dot(difference, difference)), float(divergence))


Blur = Callable[[np.ndarray], np.ndarray]


def gaussian(sigma_voxel: float, shape: tuple[int, int, int]) -> Blur:
    """Return the Gaussian blur of flat volumes of `shape`: a symmetric matrix, so its own adjoint; 0 for identity."""
    if sigma_voxel == 0:
        return lambda volume: volume

    def blur(volume: np.ndarray) -> np.ndarray:
        shaped = volume.reshape(shape)
        blurred: np.ndarray = ndimage.gaussian_filter(shaped, sigma_voxel, mode="constant", truncate=TRUNCATE)
        return blurred.ravel()

    return blur


def iterate(
    views: Sequence[View],
    first: np.ndarray,
    step: np.ndarray,
    *,
    iterations: int,
    accelerate: bool,
    sieve: Blur,
    smooth: Blur,
) -> Iterator[tuple[np.ndarray, Misfit]]:
    """Iterate SMART; yield the first volume and each one after it, with their misfits.

    Parameters
    ----------
    views : sequence of View
        The cameras.
    first : ndarray, shape (voxel,), float32
        First guess of the volume, or of the sieve's coefficients; overwritten. Zeros stay zero.
    step : ndarray, shape (voxel,), float32
        mu / s, s the column sums of the weights, with a sieve mu / sieve(s).
    iterations : int
        Number of iterations.
    accelerate : bool
        Take the momentum; where the misfit would rise by it, the iteration is done without it, and it starts anew.
    sieve : callable
        The volume is the sieve's image of the coefficients that SMART iterates [1]_.
    smooth : callable
        Applied to the volume after each iteration but the last.

    Yields
    ------
    volume : ndarray, shape (voxel,), float32
        Overwritten by the next iteration.
    misfit : Misfit
        Its misfit.

    References
    ----------
    .. [1] D. L. Snyder, M. I. Miller, "The use of sieves to stabilize images produced with the EM algorithm for
       emission tomography", IEEE Trans. Nucl. Sci. 32 (1985) 3864-3872, doi:10.1109/TNS.1985.4334521.
    """
    coefficients, last, time = first, first.copy() if accelerate else first, 1.0
    exponent = np.empty_like(first)
    volume = sieve(coefficients)
    misfit = compare(views, volume)
    for left in reversed(range(iterations)):
        yield volume, misfit
        exponent[:] = 0.0
        for view in views:
            view.projector.back_project(view.ratio, exponent, active=volume)
        kernels.update(coefficients, sieve(exponent), step)
        if left:
            coefficients = smooth(coefficients)
        if accelerate:
            later = (1 + np.sqrt(1 + 4 * time**2)) / 2
            beta = min((time - 1) / later, MOMENTUM)
            extrapolate(coefficients, last, beta)
            coefficients, last, time = last, coefficients, later
        before, volume = misfit, sieve(coefficients)
        misfit = compare(views, volume)
        if accelerate and misfit.divergence > before.divergence and beta > 0:
            coefficients[:], time = last, 1.0
            volume = sieve(coefficients)
            misfit = compare(views, volume)
    yield volume, misfit


def compare(views: Sequence[View], volume: np.ndarray) -> Misfit:
    """Misfit of all cameras; their projections and ratios are left in the views."""
    misfit = Misfit(0.0, 0.0)
    for view in views:
        misfit += view.compare(volume)
    return misfit


def extrapolate(volume: np.ndarray, last: np.ndarray, exponent: float) -> None:
    """Overwrite `last` by volume * (volume / last)^exponent, shape (voxel,), float32; zeros of `last` stay zero.

    The others, `volume`'s included, are kept above zero.
    """
    active = last > 0
    np.maximum(volume, SMALLEST, out=volume, where=active)
    with np.errstate(over="ignore"):  # clipped
        np.divide(volume, last, out=last, where=active)
    np.clip(last, 1 / LARGEST_LEAP, LARGEST_LEAP, out=last)
    np.power(last, np.float32(exponent), out=last)
    np.multiply(last, volume, out=last)
    np.maximum(last, SMALLEST, out=last, where=active)
