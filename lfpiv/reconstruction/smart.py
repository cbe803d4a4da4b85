"""SMART's iteration (Eq. 5): what the cameras say of a volume, its correction, and the momentum that speeds it up.

With E the volume, w the weights, s = sum_i w the column sums, I the images, b the noise floor and P = sum w E, SMART
lowers the misfit f(E) = sum_i (P + b) log((P + b) / (I + b)) - P + I. Its step, E' = E exp(mu sum_i w log((I + b) /
(P + b)) / s), is the minimum of f's tangent plus sum_j s_j KL(E'_j, E_j) / mu, which lies above f for mu <= 1: the
misfit cannot rise. That is mirror descent, and momentum in the logarithm, E (E / E_before)^beta, is Nesterov's. Every
iterate has the form E_0 exp(sum_i w m_i / s), and where volumes explain the images, only one of them has this form:
momentum keeps it, and so the limit.

With a sieve the volume is G c, and the step of c is the misfit's gradient blurred once more: slow, as each blur hides
what is smaller than itself. So the momentum comes with a sharper step there, log c' / c = mu F sum_i w log((I + b) /
(P + b)) / s with F = 1 + `SHARPENING` (1 - B), B a blur of `SHARPENED_VOXEL`: an unmatched back projection [1]_. It
vanishes where the gradient does, so solutions stay solutions; that the misfit falls is seen to after each iteration.

.. [1] G. L. Zeng, G. T. Gullberg, "Unmatched projector/backprojector pairs in an iterative reconstruction algorithm",
   IEEE Trans. Med. Imaging 19 (2000) 548-555, doi:10.1109/42.870265.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.update import Comparison, extrapolate, update

MOMENTUM = 0.9
"""Largest exponent beta: a memory of ten iterations."""
TRUNCATE = 3.5
"""Reach of the sieve's Gaussian [standard deviation]."""
SHARPENING = 0.5
"""What a sharp step adds of the finest correction, as a share of it."""
SHARPENED_VOXEL = 2.0
"""Standard deviation of the Gaussian above which corrections are not sharpened [voxel]."""
LARGEST_STEP = 3.0
"""Largest logarithm by which a sharp step changes a voxel."""


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
    """One camera's image and its weights; arrays are float32, shape (pixel,)."""

    image: np.ndarray
    """Counts >= 0, zero where `gain` is and where no voxel lights a pixel."""
    gain: np.ndarray
    """What a pixel records per unit of light."""
    floor: float
    """Noise floor b [counts]."""
    projector: Projector
    """Holds the light of one volume or image at a time: `kept` while SMART iterates."""

    @cached_property
    def comparison(self) -> Comparison:
        """The image beside projections."""
        return Comparison(self.projector, self.image, self.gain, self.floor)

    def compare(self, volume: np.ndarray) -> Misfit:
        """Project `volume`, shape (voxel,); gain * log((I + b) / (P + b)) lies on the projector's rays then."""
        return Misfit(*self.comparison.compare(volume))


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


def sharpen(logarithm: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Sharpen the logarithms of a correction, shape (voxel,), of a volume of `shape`: F of the module's head."""
    blurred = ndimage.gaussian_filter(logarithm.reshape(shape), SHARPENED_VOXEL, mode="nearest", truncate=TRUNCATE)
    sharp: np.ndarray = logarithm + np.float32(SHARPENING) * (logarithm - blurred.ravel())
    return np.clip(sharp, -LARGEST_STEP, LARGEST_STEP, out=sharp)


def iterate(
    views: Sequence[View],
    first: np.ndarray,
    step: np.ndarray,
    *,
    iterations: int,
    accelerate: bool,
    sieve: Blur,
    smooth: Blur,
    sharp: Blur | None = None,
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
    sharp : callable, optional
        Gives the logarithm of a sharper step for an exponent sum_i w log((I + b) / (P + b)), shape (voxel,). Where the
        misfit would rise by it, this iteration and all later ones take the step above.

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
            view.projector.gather(exponent, active=volume)
        start = coefficients
        if sharp is None:
            update(coefficients, sieve(exponent), step)
        else:
            coefficients = start * np.exp(sharp(exponent))
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
        if sharp is not None and misfit.divergence > before.divergence:
            sharp, time = None, 1.0
            update(start, sieve(exponent), step)
            coefficients[:] = smooth(start) if left else start
            last[:] = coefficients
            volume = sieve(coefficients)
            misfit = compare(views, volume)
    yield volume, misfit


@contextlib.contextmanager
def kept(views: Sequence[View]) -> Iterator[None]:
    """Keep everybody else from the views' projectors while SMART iterates."""
    with contextlib.ExitStack() as held:
        for view in views:
            held.enter_context(view.projector.kept())
        yield


def compare(views: Sequence[View], volume: np.ndarray) -> Misfit:
    """Misfit of all cameras; the logarithms of their ratios are left on the projectors' rays."""
    misfit = Misfit(0.0, 0.0)
    for view in views:
        misfit += view.compare(volume)
    return misfit
