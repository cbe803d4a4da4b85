"""Tell particles from false ones: noise, ghosts, and pieces of a bright particle that the model does not fit.

A particle is confirmed where the images of every camera that sees it hold light that noise does not explain, and that
brighter particles do not explain either. The model of a particle's image is never exact: size, blur and calibration are
known within limits. What it leaves of a bright particle looks like a weak one beside it. So the share of their light
that the model leaves is measured, and light below that share of an overlapping particle's is no particle. Photometry of
crowded stars treats errors of its profiles alike [1]_.

.. [1] P. B. Stetson, "DAOPHOT: A computer program for crowded-field stellar photometry", Publ. Astron. Soc. Pac. 99
   (1987) 191-222, doi:10.1086/131977.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Normal, Scene, diagonal_blocks, overlaps, prior

SIGNIFICANCE = 5.0
"""Least light of a particle in each camera that sees it [standard error]."""
SEEN = 0.3
"""Least root of a camera's information about a particle's light, relative to the largest one, for the camera to see
it."""
MERGED_VOXEL = 0.8
"""Distance below which two candidates are one particle [voxel]."""
MERGED_OVERLAP = 0.75
"""Overlap of their images in all cameras above which two candidates are one particle."""
MERGED_SIGMA = 3.0
"""The same [standard error of their distance]."""
TELLING = 0.25
"""Share of the particles, the brightest ones, that tell the error of the model."""
LEAST_TELLING = 3
"""Least number of particles that tell the error of the model."""
LEFT_RATIO = 2.0
"""Light that a particle must have beside brighter ones, over what the usual error of the model leaves of them."""
MISFIT_RATIO = 8.0
"""A particle is rejected if its pixels lack more light than this many errors of the model."""
LACKING_SIGMA = 5.0
"""Significance that such an error must have [standard error]."""
USUAL_ERROR = 0.05
"""Error of the model where too few particles tell it."""
ERROR_RANGE = (0.02, 0.5)
"""Limits of the error of the model."""


@dataclass(frozen=True)
class Signals:
    """Light of particles in units of noise; every array is of shape (particle, camera)."""

    light: np.ndarray
    """Light that the images alone show, without what is known from the other cameras [counts]."""
    error: np.ndarray
    """Its standard error, position unknown, neighbours known [counts]."""
    strength: np.ndarray
    """Norm of the particle's image [noise]: signal to noise of the light where all else is known."""
    position_error: np.ndarray
    """Standard error of the position, neighbours known [voxel], shape (particle, 3)."""
    seen: np.ndarray
    """Whether the camera sees the particle."""

    @property
    def ratio(self) -> np.ndarray:
        """Signal to noise of the light, least of the cameras that see it, shape (particle,)."""
        return np.where(self.seen, self.light / np.maximum(self.error, 1e-12), np.inf).min(1)


def signals(normal: Normal, scatter: float) -> Signals:
    """Return the light of particles in units of noise, from the images alone.

    Parameters
    ----------
    scatter : float
        Scatter of light between cameras that they assume.
    """
    blocks, pull = prior(normal.light, scatter)
    own = diagonal_blocks(normal.matrix, normal.right.shape) - blocks
    size = np.sqrt(np.maximum(np.einsum("pii->pi", own), 1e-30))
    inverse = np.linalg.pinv(own / size[:, :, None] / size[:, None, :], hermitian=True)
    error = np.sqrt(np.maximum(np.einsum("pii->pi", inverse), 0)) / size
    information = size[:, 3:]
    free = normal.light + (normal.right[:, 3:] - pull) / information**2
    return Signals(
        light=free,
        error=error[:, 3:],
        strength=np.maximum(free, 0) * information,
        position_error=error[:, :3],
        seen=information > SEEN * np.maximum(information.max(1), 1e-30)[:, None],
    )


def unexplained(normal: Normal, found: Signals) -> np.ndarray:
    """Return the overlapping light of brighter particles, shape (particle, camera), in the unit of `Signals.strength`.

    Of each neighbour counts the part of its image that overlaps the particle's. The model error times this is what
    neighbours may leave at a particle.
    """
    first, second, overlap = overlaps(normal)
    square = np.zeros_like(found.strength)
    share = np.clip(overlap, 0, 1)
    for one, other in ((first, second), (second, first)):
        np.add.at(square, one, share * found.strength[other] ** 2)
    return np.sqrt(square)


def misfits(images: ParticleImages, scene: Scene, cloud: Cloud, normal: Normal) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared error of the model relative to the light in each particle's pixels, beyond noise.

    Pixels count by the square of the particle's light, so that light of particles that are not found yet hardly enters.

    Returns
    -------
    whole, lacking : ndarray, shape (particle, camera)
        Squared relative error of all pixels, and of those that are darker than the model, with `LACKING_SIGMA` standard
        errors subtracted.
    """
    variance = scene.variance(normal.model)
    known = scene.known(normal.model)
    residual = scene.residual(normal.model)
    relative = np.square(normal.model) / variance * known
    square = np.square(residual) / variance
    both, dark = (square - 1) * known, (square * (residual < 0) - 0.5) * known
    shape = (len(cloud), len(images.cameras))
    whole, lacking = np.zeros(shape), np.zeros(shape)
    for camera, own in enumerate(images.lists(cloud.positions_mm)):
        particle = np.repeat(np.arange(len(cloud)), np.diff(own.first))
        pixel = own.pixel + images.first_pixel[camera]
        weight = np.square(own.values[:, 3], dtype=np.float64)
        below, above, above_dark, noise = (
            np.bincount(particle, values, minlength=len(cloud))
            for values in (weight * relative[pixel], weight * both[pixel], weight * dark[pixel], 1.25 * weight**2)
        )
        below = np.maximum(below, 1e-30)
        whole[:, camera] = above / below
        lacking[:, camera] = (above_dark - LACKING_SIGMA * np.sqrt(noise)) / below
    return whole, lacking


def model_error(misfit: np.ndarray, found: Signals) -> float:
    """Return the relative error of the model that bright particles show, from their `misfits`."""
    if found.seen.sum() < LEAST_TELLING:
        return USUAL_ERROR
    telling = np.argsort(-found.strength[found.seen])[: max(LEAST_TELLING, int(TELLING * found.seen.sum()))]
    square = float(np.median(misfit[found.seen][telling]))
    return float(np.clip(np.sqrt(max(square, 0.0)), *ERROR_RANGE))


def shown(normal: Normal, found: Signals, error: float, least: float, part: float = 1.0) -> np.ndarray:
    """Return where a camera shows a particle, shape (particle, camera), bool.

    Parameters
    ----------
    found : Signals
        Light in units of noise.
    error : float
        Error of the model, from `model_error`.
    least : float
        Least light [counts].
    part : float
        Part of the limits that applies.
    """
    by_noise = found.light > part * SIGNIFICANCE * found.error
    by_others = found.strength > part * LEFT_RATIO * error * unexplained(normal, found)
    return by_noise & by_others & (normal.light > part * least)


def fitting(lacking: np.ndarray, error: float, found: Signals) -> np.ndarray:
    """Return the particles whose light is in the image of every camera that sees them, shape (particle,), bool.

    A particle that joins the light of two others, one in each camera, is brighter than the images beside their peaks.
    Light that is not explained yet counts for no particle and against none. `lacking` is from `misfits`, `error` from
    `model_error`.
    """
    limit = (MISFIT_RATIO * error) ** 2
    return ((lacking < limit) | ~found.seen).all(1)


def merged(normal: Normal, cloud: Cloud, good: np.ndarray, position_error: np.ndarray, voxel_mm: float) -> Cloud:
    """Return the good particles, those that cannot be told apart replaced by one at the middle of their light.

    Parameters
    ----------
    good : ndarray, shape (particle,), bool
        Particles to keep.
    position_error : ndarray, shape (particle, 3)
        Standard errors of the positions [voxel].
    voxel_mm : float
        Edge of a voxel [mm].
    """
    first, second, overlap = overlaps(normal)
    same = (overlap > MERGED_OVERLAP).all(1) & good[first] & good[second]
    apart = (cloud.positions_mm[first] - cloud.positions_mm[second]) / voxel_mm
    variance = np.square(position_error[first]) + np.square(position_error[second])
    same |= (np.square(apart) / (MERGED_VOXEL**2 + MERGED_SIGMA**2 * variance)).sum(1) < 1
    pairs = np.stack([first[same], second[same]], axis=1)
    light, positions, kept = cloud.light.copy(), cloud.positions_mm.copy(), good.copy()
    for a, b in pairs[np.argsort(-light[pairs].mean(2).max(1), kind="stable")] if len(pairs) else ():
        if kept[a] and kept[b]:
            bright, dark = (a, b) if light[a].mean() >= light[b].mean() else (b, a)
            share = light[dark].mean() / (light[dark] + light[bright]).mean()
            positions[bright] += share * (positions[dark] - positions[bright])
            light[bright] += light[dark]
            kept[dark] = False
    return Cloud(positions_mm=positions, light=light)[kept]
