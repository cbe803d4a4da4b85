"""How large particles are, from their images: the autocovariance of the light in each pupil point's view.

Particles lie at random, so the views are shot noise, whose autocovariance is that of one particle's image, whatever the
seeding, times the mean square of the particles' light (Campbell's theorem [1]_). Its fall from one lens to the next
tells the size; what optics, lenses and depth do to it is not calculated but projected, with the weights, from random
voxels blurred by Gaussians of known sizes. Noise of different pixels is independent, so a pixel is never compared with
itself: light next to it in the pupil takes its place, along the axis across the one that the lenses lie on, where depth
moves a particle's image away as much in the numerator as in the denominator.

.. [1] S. O. Rice, "Mathematical analysis of random noise", Bell Syst. Tech. J. 23 (1944) 282-332,
   doi:10.1002/j.1538-7305.1944.tb00874.x.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.lightfield.microimage_layout import microimage_centres
from lfpiv.reconstruction.smart import gaussian
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

WIDTHS_VOXEL = (0.0, 0.4, 0.55, 0.7, 1.0, 1.5)
"""Gaussians whose images the measured ones are compared with [voxel]."""
SPARSITY = 128
"""Voxels per random voxel that is lit in them; of small grids at least `LEAST_LIT` voxels are."""
LEAST_LIT = 64
VIEWS = 5
"""Views along each axis of the pupil, whose edge would cut some off; more of them show the same particles."""
PUPIL_SHARE = 0.6
"""Farthest view from the middle of the pupil along each axis, as a share of its radius."""
MEAN_LENSES = 3.0
"""Standard deviation of the Gaussian over which the mean light is taken [lens]: it is not what tells particles."""
LIT_SHARE = 0.1
"""Lenses count that see at least this share of the most that one sees of an evenly lit volume."""
LEAST_RANGE = 0.1
"""Least difference of the ratio between the smallest and the largest width: below, lenses are too coarse to tell."""
SIGNIFICANCE = 5.0
"""Least ratio of the covariance to its standard error, from view to view: below, noise hides the particles. Views see
the same particles, so they differ by noise, and by what the pupil's points see differently."""
VOXEL_VARIANCE = 1 / 12
"""Of an evenly lit voxel along each axis [voxel^2]; a particle between voxels is spread over them, as if it were as
large."""
LEAST_SIEVE_VOXEL = 0.3
"""Narrower Gaussians, sampled at voxels, are single voxels."""
SIEVE_STEP_VOXEL = 0.05
"""Sieves are multiples of it: the frames of a run, whose estimates scatter less, have the same one, or nearly."""


@dataclass(frozen=True)
class _Reference:
    """What a camera's images of known sizes look like."""

    views: _Views
    ratio: np.ndarray
    """Covariance one lens away over that at the same lens, rising, shape (width,)."""


def particle_size(weights: Weights, images: Mapping[str, np.ndarray]) -> float | None:
    """Estimate the size of particles: the Gaussian of voxels whose images are as wide as the measured ones.

    Assumes that particles lie at random and are of about one size; their number and brightness do not matter, nor does
    light that varies slowly over the volume.

    Parameters
    ----------
    weights : Weights
        The operator.
    images : mapping of str to ndarray
        Camera name -> image, shape (rows, columns) [counts], background subtracted, its noise left as it is.

    Returns
    -------
    float or None
        Standard deviation of the Gaussian, sampled at the voxels as SMART's sieve is [voxel], root mean square of the
        cameras; rather too small by the standard error than too large. 0 for particles not larger than a voxel, at most
        the largest of `WIDTHS_VOXEL`. None: no camera can tell, because noise hides its particles or its lenses are too
        coarse.
    """
    reference = _references.get(weights)
    if reference is None:
        reference = _references[weights] = _project(weights)
    variances = []
    for name, known in reference.items():
        here, next_lens = known.views.covariances(images[name])
        count = len(here)
        if known.ratio[-1] - known.ratio[0] < LEAST_RANGE or not here.mean() > SIGNIFICANCE * here.std() / count**0.5:
            continue
        without_one = (next_lens.sum() - next_lens) / (here.sum() - here)
        ratio = next_lens.sum() / here.sum() - np.sqrt((count - 1) * without_one.var())  # jackknife
        variances.append(np.interp(ratio, known.ratio, np.square(WIDTHS_VOXEL)))
    return float(np.sqrt(np.mean(variances))) if variances else None


def matching_sieve(weights: Weights, images: Mapping[str, np.ndarray]) -> float:
    """Size of the sieve that suits the particles of images [voxel]; 0, no sieve, where they are small or not told.

    It is the particles' own less `VOXEL_VARIANCE`, because particles between voxels are sums of several Gaussians.
    """
    size = particle_size(weights, images)
    exact = np.sqrt(max((size or 0.0) ** 2 - VOXEL_VARIANCE, 0.0))
    sieve = round(SIEVE_STEP_VOXEL * round(exact / SIEVE_STEP_VOXEL), 2)
    log.debug(
        "particles of %s voxel: sieve of %.2f voxel", "unknown size, in" if size is None else f"{size:.2f}", sieve
    )
    return sieve if sieve >= LEAST_SIEVE_VOXEL else 0.0


class _Views:
    """The views of some pupil points: for each, a pixel of every lens and its neighbours in the pupil."""

    def __init__(self, camera: CalibratedCamera, even: np.ndarray):
        """`even`: image of an evenly lit volume, shape (rows, columns)."""
        optics, lattice = camera.optics, camera.lattice
        rows, columns = optics.sensor_shape
        _, centre = microimage_centres(optics, lattice, 0.0)
        place = np.linspace(-PUPIL_SHARE, PUPIL_SHARE, VIEWS) * optics.pupil_radius_mm * optics.sensor_per_pupil
        offset = np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 1, 1, 2) / optics.pixel_mm
        column, row = np.moveaxis(np.floor(centre + offset).astype(int), -1, 0)
        seen = ((column >= 0) & (column < columns - 1) & (row >= 0) & (row < rows - 1)).all(0)
        used = np.flatnonzero(seen.any(0)), np.flatnonzero(seen.any(1))
        cut = (slice(None), *(slice(at[0], at[-1] + 1) for at in reversed(used)))
        self._first = np.where(seen, row * columns + column, 0)[cut]  # (view, j, i), pixel of the sensor
        self._steps = (0, 1, columns)
        self._even = [even.reshape(-1)[self._first + step] * seen[cut[1:]] for step in self._steps]
        self._lit = self._even[0] > LIT_SHARE * self._even[0].max()

    def covariances(self, image: np.ndarray) -> np.ndarray:
        """Sum of products of each view's light with its neighbours', at the same lens and one away, shape (2, view)."""
        pixels = np.asarray(image, np.float32).reshape(-1)
        here, right, below = (
            self._fluctuation(pixels[self._first + step], even)
            for step, even in zip(self._steps, self._even, strict=True)
        )
        same = (here * (right + below)).sum((1, 2))
        along_i = here[..., :-1] * below[..., 1:] + here[..., 1:] * below[..., :-1]
        along_j = here[:, :-1] * right[:, 1:] + here[:, 1:] * right[:, :-1]
        return np.stack([same, (along_i.sum((1, 2)) + along_j.sum((1, 2))) / 2])

    def _fluctuation(self, light: np.ndarray, even: np.ndarray) -> np.ndarray:
        """Light less its mean, which is that of an evenly lit volume times what varies slowly; 0 where it is dark."""
        light, even = light * self._lit, even * self._lit
        mean, unit = (
            ndimage.gaussian_filter(values, (0, MEAN_LENSES, MEAN_LENSES), mode="constant") for values in (light, even)
        )
        slow = np.divide(mean, unit, out=np.zeros_like(mean), where=self._lit & (unit > 0))
        fluctuation: np.ndarray = light - slow * even
        return fluctuation


def _project(weights: Weights) -> dict[str, _Reference]:
    """Images of random voxels blurred by each width, as every camera sees them."""
    even = weights(np.ones(weights.grid.shape, np.float32))
    views = {name: _Views(camera, even[name]) for name, camera in weights.cameras.items()}
    size = weights.grid.size
    lit = np.random.default_rng(0).choice(size, min(size, max(LEAST_LIT, size // SPARSITY)), replace=False)
    points = np.zeros(size, np.float32)
    points[lit] = 1.0
    ratios: dict[str, list[float]] = {name: [] for name in views}
    for width in WIDTHS_VOXEL:
        images = weights(gaussian(width, weights.grid.shape)(points).reshape(weights.grid.shape), out=even)
        for name, view in views.items():
            same, next_lens = view.covariances(images[name]).sum(1)
            ratios[name].append(next_lens / same if same > 0 else 0.0)
    return {name: _Reference(view, np.maximum.accumulate(ratios[name])) for name, view in views.items()}


_references: WeakKeyDictionary[Weights, dict[str, _Reference]] = WeakKeyDictionary()
