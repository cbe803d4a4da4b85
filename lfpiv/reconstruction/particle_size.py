"""Size of the particles and scatter of their brightness, measured in the cameras' images: `ParticleSizer`.

A sub-aperture image has one pixel of every lens, those that see the same pupil point. Particles at random places make
it shot noise. Its autocovariance is that of one particle's image times the mean square of the particles' light, at any
seeding density (Campbell's theorem [1]_). So the ratio of the covariance one lens away to that at the same lens depends
on the particles' size only. Images of random voxels, blurred by Gaussians of known sizes and projected with the
weights, give the ratio for each size. These voxels lie in the volume and not in the guard layers, as the particles do:
the light that ends at the volume's faces adds to the covariance one lens away.

Noise of different pixels is independent, so a pixel is never multiplied with itself but with a neighbour in the pupil.
That neighbour lies across the direction in which the two lenses lie. So a particle's depth shifts its image by the same
amount in the numerator and in the denominator of the ratio.

The mean light, the covariance and the third cumulant are proportional to the means of a, a^2 and a^3 over the
particles, a the light of one. So mean times third cumulant over the square of the covariance, relative to the same of
equal particles, is <a><a^3> / <a^2>^2 at any seeding density. It is 1 for equal particles and exp(s^2) for a log-normal
a whose logarithm has the standard deviation s.

.. [1] S. O. Rice, "Mathematical analysis of random noise", Bell Syst. Tech. J. 23 (1944) 282-332,
   doi:10.1002/j.1538-7305.1944.tb00874.x.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import special

from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.lightfield.microimage_layout import microimage_centres
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

WIDTHS_VOXEL = (0.0, 0.4, 0.55, 0.7, 1.0, 1.5)
"""Standard deviations of the Gaussians of known size [voxel]."""
SPARSITY = 128
"""Number of voxels per lit one in the volumes of known particle size."""
LEAST_LIT = 64
"""Least number of lit voxels in these volumes."""
KNOWN_VOXELS = 1 << 17
"""Least number of voxels in all volumes of one known size. Small volumes are lit several times, at other places."""
MOST_DRAWS = 4
"""Largest number of volumes of one known size."""
SUB_APERTURES = 5
"""Number of sub-aperture images along each axis of the pupil."""
PUPIL_SHARE = 0.6
"""Largest coordinate of a sub-aperture along an axis of the pupil, as a share of the pupil's radius."""
MEAN_LENSES = 3.0
"""Standard deviation of the Gaussian over which the mean light is taken [lens]."""
MEAN_REACH = 4
"""Distance at which that Gaussian ends [standard deviation]."""
FAR_LENSES = (4, 5, 6)
"""Distances at which products show no particles any more, only light that varies slowly [lens]."""
PROTRUDING_VOXEL = 0.93
"""Standard deviation of the particles that protrude from an evenly lit volume [reconstructed voxel].

Voxels are refined until particles are about as large, see `lfpiv.reconstruction.refinement`.
"""
LIT_SHARE = 0.1
"""Least light of a lens that counts, as a share of the brightest lens's light of an evenly lit volume."""
LEAST_RANGE = 0.1
"""Least difference of the ratio between the smallest and the largest width. Below it the lenses are too coarse."""
UNLIKE = 1.25
"""Least scatter of the brightness, <a><a^3> / <a^2>^2, of particles that are called unlike bright."""
SIGNIFICANCE = 5.0
"""Least ratio of the covariance to its standard error over the sub-apertures. Below it noise hides the particles."""
VOXEL_VARIANCE = 1 / 12
"""Variance of an evenly lit voxel along each axis [voxel^2]."""
LEAST_SIEVE_VOXEL = 0.5
"""Least standard deviation of a sieve that is chosen [voxel]. Single voxels describe narrower particles well."""
SIEVE_STEP_VOXEL = 0.05
"""Sieves are rounded to multiples of this [voxel], so that the frames of a run have the same sieve."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fluctuations:
    """Fluctuations of one camera's sub-aperture images and of their neighbours in the pupil: independent noise."""

    light: np.ndarray
    """Light of each sub-aperture image, shape (sub-aperture,) [counts]."""
    here: np.ndarray
    """Light less its mean, shape (sub-aperture, j, i) [counts]."""
    right: np.ndarray
    """The same of the neighbours to the right."""
    below: np.ndarray
    """The same of the neighbours below."""

    @cached_property
    def covariances(self) -> np.ndarray:
        """Sums of products of neighbours in the pupil, shape (2, sub-aperture): at the same lens, one away.

        The mean product `FAR_LENSES` away is subtracted: light that varies slowly and was not removed with the mean.
        """
        far = np.mean([self._apart(lenses) for lenses in FAR_LENSES], axis=0)
        return np.stack([2 * self._products - far, self._apart(1) - far])

    @cached_property
    def cumulants(self) -> np.ndarray:
        """Sums over the lenses, shape (3, sub-aperture): the light, products of two and of three fluctuations.

        The fluctuations are those of neighbours in the pupil at the same lens.
        """
        return np.stack([self.light, self._products, (self.here * self.right * self.below).sum((1, 2))])

    @cached_property
    def _products(self) -> np.ndarray:
        """Sums of products at the same lens, mean of both neighbours, shape (sub-aperture,)."""
        return (self.here * (self.right + self.below)).sum((1, 2)) / 2

    def _apart(self, lenses: int) -> np.ndarray:
        """Return the sums of products some lenses apart, mean of both directions, shape (sub-aperture,)."""
        here, right, below = self.here, self.right, self.below
        along_i = here[..., :-lenses] * below[..., lenses:] + here[..., lenses:] * below[..., :-lenses]
        along_j = here[:, :-lenses] * right[:, lenses:] + here[:, lenses:] * right[:, :-lenses]
        return (along_i.sum((1, 2)) + along_j.sum((1, 2))) / 2


class SubApertures:
    """Sub-aperture images of one camera, and the neighbours of their pixels in the pupil.

    Parameters
    ----------
    even : ndarray, shape (rows, columns)
        Image of an evenly lit volume.
    """

    def __init__(self, camera: CalibratedCamera, even: np.ndarray):
        optics, lattice = camera.optics, camera.lattice
        rows, columns = optics.sensor_shape
        _, centre = microimage_centres(optics, lattice, 0.0)
        place = np.linspace(-PUPIL_SHARE, PUPIL_SHARE, SUB_APERTURES) * optics.pupil_radius_mm * optics.sensor_per_pupil
        offset = np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 1, 1, 2) / optics.pixel_mm
        column, row = np.moveaxis(np.floor(centre + offset).astype(int), -1, 0)
        seen = ((column >= 0) & (column < columns - 1) & (row >= 0) & (row < rows - 1)).all(0)
        used = np.flatnonzero(seen.any(0)), np.flatnonzero(seen.any(1))
        cut = (slice(None), *(slice(at[0], at[-1] + 1) for at in reversed(used)))
        self._first = np.where(seen, row * columns + column, 0)[cut]  # (sub-aperture, j, i), pixel of the sensor
        self._steps = (0, 1, columns)
        steady = [even.reshape(-1)[self._first + step] * seen[cut[1:]] for step in self._steps]
        self._lit = steady[0] > LIT_SHARE * steady[0].max()
        self._even = [(light * self._lit, _local_mean(light * self._lit)) for light in steady]

    def fluctuations(self, image: np.ndarray) -> Fluctuations:
        """Measure the fluctuations of an image, shape (rows, columns)."""
        pixels = np.asarray(image, np.float32).reshape(-1)
        neighbours = [pixels[self._first + step] * self._lit for step in self._steps]
        here, right, below = (
            self._fluctuation(light, even, unit) for light, (even, unit) in zip(neighbours, self._even, strict=True)
        )
        return Fluctuations(light=neighbours[0].sum((1, 2)), here=here, right=right, below=below)

    def _fluctuation(self, light: np.ndarray, even: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """Subtract the mean light: that of an evenly lit volume times a slowly varying factor. 0 where it is dark.

        `unit` is the local mean of `even`.
        """
        mean = _local_mean(light)
        slow = np.divide(mean, unit, out=np.zeros_like(mean), where=self._lit & (unit > 0))
        return light - slow * even


def _local_mean(light: np.ndarray) -> np.ndarray:
    """Return the mean of nearby lenses, shape (sub-aperture, j, i)."""
    kernel, mean = cv2.getGaussianKernel(2 * round(MEAN_REACH * MEAN_LENSES) + 1, MEAN_LENSES), np.empty_like(light)
    for one, blurred in zip(light, mean, strict=True):
        cv2.sepFilter2D(one, -1, kernel, kernel, dst=blurred, borderType=cv2.BORDER_CONSTANT)
    return mean


def _evenly_lit(weights: Weights) -> np.ndarray:
    """Return the mean volume (z, y, x) of particles whose centres fill the volume evenly.

    Particles at the volume's faces protrude into the guard layers, which are dark beyond that.
    """
    if weights.volume == weights.grid:
        return np.ones(weights.grid.shape, np.float32)
    width = PROTRUDING_VOXEL * weights.grid.voxel_mm
    z, y, x = (
        special.ndtr((half + from_centre) / width) - special.ndtr((from_centre - half) / width)
        for from_centre, half in _from_centre_mm(weights)
    )
    lit: np.ndarray = z[:, None, None] * y[:, None] * x
    return lit.astype(np.float32)


def _inside(weights: Weights) -> np.ndarray:
    """Return the flat indices of the voxels whose centres lie in the volume, not in the guard layers."""
    z, y, x = (np.abs(from_centre) <= half for from_centre, half in _from_centre_mm(weights))
    return np.flatnonzero(z[:, None, None] & y[:, None] & x)


def _from_centre_mm(weights: Weights) -> list[tuple[np.ndarray, float]]:
    """Return the voxels' places from the volume's centre along z, y and x, and half the volume's edges."""
    volume = weights.volume
    return [
        (weights.grid.axis_mm(axis) - volume.centre_mm[2 - axis], volume.shape[axis] * volume.voxel_mm / 2)
        for axis in range(3)
    ]


def _sub_apertures(weights: Weights, even: Mapping[str, np.ndarray]) -> dict[str, SubApertures]:
    """Return the sub-aperture images of each camera, from its image of an evenly lit volume."""
    return {name: SubApertures(camera, even[name]) for name, camera in weights.cameras.items()}


def _random_points(weights: Weights) -> np.ndarray:
    """Return volumes of single lit voxels at random, shape (draw, voxel)."""
    inside, random = _inside(weights), np.random.default_rng(0)
    lit, draws = max(LEAST_LIT, inside.size // SPARSITY), min(math.ceil(KNOWN_VOXELS / inside.size), MOST_DRAWS)
    volumes = np.zeros((draws, weights.grid.size), np.float32)
    for points in volumes:
        points[random.choice(inside, min(lit, inside.size), replace=False)] = 1.0
    return volumes


class ParticleSizer:
    """Estimator of the particles' size and of the scatter of their brightness, for one rig.

    Making it projects a volume of each known size.

    Parameters
    ----------
    even : mapping of str to ndarray, optional
        Images of the evenly lit volume that the cameras record. Default: projected; required if the weights are those
        of a part of the volume.
    """

    def __init__(self, weights: Weights, even: Mapping[str, np.ndarray] | None = None):
        own = weights(_evenly_lit(weights))
        known = _sub_apertures(weights, own)
        self._sub_apertures = known if even is None else _sub_apertures(weights, even)
        ratios, self._equal = ({name: list[float]() for name in known} for _ in range(2))
        some, shape = _random_points(weights), weights.grid.shape
        for width in WIDTHS_VOXEL:
            sieve = Sieve(width, shape)
            projected = (weights(sieve(points).reshape(shape), out=own) for points in some)
            drawn = [{name: one.fluctuations(images[name]) for name, one in known.items()} for images in projected]
            for name in known:
                same, next_lens = np.sum([one[name].covariances.sum(1) for one in drawn], axis=0)
                ratios[name].append(next_lens / same if same > 0 else 0.0)
                self._equal[name].append(_skewness(np.sum([one[name].cumulants for one in drawn], axis=0)))
        self._ratios = {name: np.maximum.accumulate(values) for name, values in ratios.items()}
        """Covariance one lens away over that at the same lens for each of `WIDTHS_VOXEL`, rising. `_equal` is
        `_skewness` of equal particles for each of them."""

    def fluctuations(self, images: Mapping[str, np.ndarray]) -> dict[str, Fluctuations]:
        """Measure what the other methods take, by camera.

        Parameters
        ----------
        images : mapping of str to ndarray
            Camera name -> image, shape (rows, columns) [counts], background subtracted, its noise included.
        """
        return {name: one.fluctuations(images[name]) for name, one in self._sub_apertures.items()}

    def size(self, fluctuations: Mapping[str, Fluctuations]) -> float | None:
        """Estimate the size of the particles: the Gaussian of voxels whose images are as wide as the measured ones.

        Assumes that particles lie at random and are of about one size. Their number and brightness do not matter, nor
        does light that varies slowly over the volume.

        Parameters
        ----------
        fluctuations : mapping of str to Fluctuations
            From `fluctuations`.

        Returns
        -------
        float or None
            Standard deviation of the Gaussian, sampled at the voxels as SMART's sieve is [voxel]: root mean square of
            the cameras' estimates, each lowered by its standard error. 0 for particles not larger than a voxel, at most
            the largest of `WIDTHS_VOXEL`. None if noise hides the particles in every camera, or the lenses are too
            coarse.
        """
        variances = []
        for name, known in self._ratios.items():
            here, next_lens = fluctuations[name].covariances
            count = len(here)
            if known[-1] - known[0] < LEAST_RANGE or not is_above_noise(here):
                continue
            without_one = (next_lens.sum() - next_lens) / (here.sum() - here)
            ratio = next_lens.sum() / here.sum() - np.sqrt((count - 1) * without_one.var())  # jackknife
            variances.append(np.interp(ratio, known, np.square(WIDTHS_VOXEL)))
        return float(np.sqrt(np.mean(variances))) if variances else None

    def matching_sieve(self, fluctuations: Mapping[str, Fluctuations]) -> float:
        """Return the size of the sieve that matches the particles [voxel]; 0 if they are small or of unknown size.

        Its variance is that of the particles less `VOXEL_VARIANCE`: a particle between voxels is a sum of Gaussians.
        """
        size = self.size(fluctuations)
        exact = np.sqrt(max((size or 0.0) ** 2 - VOXEL_VARIANCE, 0.0))
        sieve = round(SIEVE_STEP_VOXEL * round(exact / SIEVE_STEP_VOXEL), 2)
        text = "unknown size, in" if size is None else f"{size:.2f}"
        log.debug("particles of %s voxel: sieve of %.2f voxel", text, sieve)
        return sieve if sieve >= LEAST_SIEVE_VOXEL else 0.0

    def brightness_scatter(self, fluctuations: Mapping[str, Fluctuations], sieve_voxel: float) -> float | None:
        """Estimate how unlike bright the particles are in a camera, <a><a^3> / <a^2>^2 of a particle's light a.

        Light that is no particle's, such as stray light, raises it.

        Parameters
        ----------
        fluctuations : mapping of str to Fluctuations
            From `fluctuations`.
        sieve_voxel : float
            The sieve that matches the particles' size [voxel], 0 for small ones.

        Returns
        -------
        float or None
            1 for equal particles; mean of the cameras. None if noise hides the particles in every camera.
        """
        scatters, variance = [], sieve_voxel**2 + VOXEL_VARIANCE if sieve_voxel else 0.0
        for name, known in self._equal.items():
            cumulants = fluctuations[name].cumulants
            products = cumulants[1]
            equal = float(np.interp(variance, np.square(WIDTHS_VOXEL), known))
            if equal > 0 and is_above_noise(products):
                scatters.append(_skewness(cumulants) / equal)
        return float(np.mean(scatters)) if scatters else None


def is_above_noise(products: np.ndarray) -> bool:
    """Return whether the products at the same lens, of each sub-aperture, show particles beyond noise."""
    return bool(products.mean() > SIGNIFICANCE * products.std() / len(products) ** 0.5)


def _skewness(cumulants: np.ndarray) -> float:
    """Return mean times third cumulant over the square of the covariance, 0 without light."""
    light, second, third = cumulants.sum(1)
    return float(light * third / second**2) if second > 0 else 0.0
