"""Fit the size of the particles to the images of those whose images hardly overlap others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lfpiv.tracking import candidates
from lfpiv.tracking.fit import Fit
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Normal, overlaps, refine, rendered

OUTLIER_SIGMA = 5.0
"""Largest residual of a pixel that tells sizes apart [standard deviation]."""
SIZE_STEP = 1.25
"""Ratio of the sizes that are compared."""
CLEAR_OVERLAP = 0.3
"""A particle whose image overlaps another image by more is not used to find the size."""
LEAST_CLEAR, MOST_CLEAR = 8, 100
"""Least and largest number of particles that tell the size."""
WEAK = 0.5
"""A particle dimmer than this share of an overlapping particle may be a residual of a wrong size."""
MOSTLY = 0.5
"""Least share of the particles that are clear once weak ones are left out. In dense seeding weak particles are true."""
LARGEST_RATIO = 1.15
"""Largest size of the particles over that which the autocovariance of the images shows, before particles are found.
Particles that are not told apart look larger."""
SIZE_FITS = 4
"""Largest number of comparisons of sizes in a round."""
USUAL_SIGMA_VOXEL = 0.7
"""Size of particles where the images do not show it [voxel]."""


def fit_size(fit: Fit) -> None:
    """Change the size of the particles to the one that explains the images best."""
    for _ in range(SIZE_FITS):
        before, fit.model = fit.model, _better_size(fit)
        fit.refine(1)
        if abs(np.log(fit.model.sigma_voxel / before.sigma_voxel)) < np.log(SIZE_STEP) / 2:
            break


def _better_size(fit: Fit) -> ParticleImages:
    """Return the model with the size that explains the images of clear particles best, from three sizes."""
    clear, weak = _clear(fit.normal, fit.cloud.light)
    cloud, explained = fit.cloud[clear], fit.cloud[np.concatenate([clear, weak])]
    own = rendered(fit.model, fit.model.lists(cloud.positions_mm), cloud.light)
    theirs = rendered(fit.model, fit.model.lists(explained.positions_mm), explained.light) if len(weak) else own
    scene = replace(fit.scene, counts=fit.scene.counts - (fit.normal.model - theirs))
    variance, lit = fit.scene.variance(fit.normal.model), own > 0
    chi2 = []
    for power in (-1, 0, 1):
        other = fit.model.of_size(fit.model.sigma_voxel * SIZE_STEP**power)
        moved, _ = refine(other, scene, cloud, iterations=1, scatter=fit.scatter)
        left = scene.residual(rendered(other, other.lists(moved.positions_mm), moved.light))
        chi2.append(float(np.minimum(np.square(left) / variance, OUTLIER_SIGMA**2)[lit].sum(dtype=np.float64)))
    below, here, above = chi2
    curvature, slope = below - 2 * here + above, (below - above) / 2
    change = float(np.clip(slope / curvature, -2, 2)) if curvature > 0 else 2 * float(np.sign(slope))
    return fit.model.of_size(min(fit.model.sigma_voxel * SIZE_STEP**change, fit.largest_voxel))


def _clear(normal: Normal, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose particles of typical light whose images hardly overlap others, of all particles if few do not.

    Where few are clear, weak particles that overlap brighter ones are left out first. A size that is too small leaves
    light of each particle. Weak ones beside it explain that light.

    Returns
    -------
    clear : ndarray of int
        Numbers of the particles that tell the size.
    weak : ndarray of int
        Numbers of the particles that are left out.
    """
    first, second, overlap = overlaps(normal)
    close = (overlap > CLEAR_OVERLAP).any(1)
    first, second, mean = first[close], second[close], np.maximum(light.mean(1), 1e-9)
    every = np.ones(len(light), bool)
    kept, alone = every, _alone(every, first, second)
    if alone.sum() < LEAST_CLEAR:
        kept = every.copy()
        kept[first[mean[first] < WEAK * mean[second]]] = False
        kept[second[mean[second] < WEAK * mean[first]]] = False
        alone = _alone(kept, first, second)
        if alone.sum() < max(LEAST_CLEAR, MOSTLY * kept.sum()):
            kept = alone = every
    clear = np.flatnonzero(alone)
    unlike = np.abs(np.log(mean[clear] / max(candidates.typical(mean[clear]), 1e-9)))
    usual = clear[np.argsort(unlike, kind="stable")[:MOST_CLEAR]]
    return usual, np.flatnonzero(~kept)


def _alone(kept: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return which kept particles are in no pair of kept ones, shape (particle,), bool."""
    alone, both = kept.copy(), kept[first] & kept[second]
    alone[first[both]] = alone[second[both]] = False
    return alone
