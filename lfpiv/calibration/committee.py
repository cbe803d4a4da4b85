"""Choose one of several networks that differ by the seed of their training only, and estimate the error of the mapping.

A network whose first weights or split were unlucky can leave the true mapping between the dots or at the border of the
board, where no held-out dot shows it. Such errors differ from network to network. So the network nearest to the others
is taken. Its distance to the median of all, and what that median is uncertain by, estimate its error [1]_. What the
noise of the labels makes, all of them share in part. So two mappings are fitted as well, each to half of the dots: half
of their distance is the error of a mapping that is fitted to all dots [2]_.

References
----------
.. [1] L. K. Hansen, P. Salamon, "Neural network ensembles", IEEE Trans. Pattern Anal. Mach. Intell. 12 (1990) 993-1001,
   doi:10.1109/34.58871.
.. [2] P. C. Mahalanobis, "On large-scale sample surveys", Phil. Trans. R. Soc. B 231 (1944) 329-451 (interpenetrating
   samples), doi:10.1098/rstb.1944.0002.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from lfpiv.calibration.board.pupil_zones import INNER
from lfpiv.calibration.training import Training
from lfpiv.geometry.optics import random_on_pupil

log = logging.getLogger(__name__)

NETWORKS, MOST_NETWORKS = 3, 7
"""Least and largest number of networks that are trained for a camera. Two networks are equally far from each other, so
one that is wrong shows among three. More are trained while they scatter by more than the held-out dots show."""
OF_MEDIAN = math.sqrt(math.pi / 2)
"""Standard error of a median over that of a mean, for normal errors."""
RAYS = 2000
"""Rays on which networks are compared."""
FEWEST_DOTS = 40
"""Least number of dots that are halved."""
SPLITS = 5
"""Pairs of halves to take where the first pair is further apart than the held-out dots allow: the network of a half may
be unlucky."""
CHANCE = 1e-3
"""Probability that labels about a mapping that follows them show a smooth departure by chance."""

Rays = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Map points (n, 3) and pupil points (n, 2) to the array (n, 2) [mm]."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """The network nearest to the others."""

    training: Training
    """The network, as it was trained."""
    scatter: float
    """Typical error of a network by chance. It is the median distance to the other networks over the square root of 2,
    since both ends of a distance have errors. A few networks that are far off do not change a median."""
    error: float
    """Error of this network by chance: its distance to the median of all, and the standard error of that median."""


def train_several(
    train: Callable[[int], Training], region_mm: np.ndarray, pupil_radius_mm: float, *, seed: int, unit: float
) -> Chosen:
    """Train networks of seeds `seed`, `seed` + 1, ... and choose the one nearest to the others.

    Parameters
    ----------
    train : callable
        Trains a network with a seed, see `lfpiv.calibration.training.train`.
    region_mm, pupil_radius_mm
        As `nearest_to_others` takes them.
    seed : int
        Seed of the first network, and of the rays.
    unit : float
        Length in which the trainings state their errors [mm].

    Returns
    -------
    Chosen
        With the time of all trainings, and the errors in multiples of `unit`.
    """
    trainings = [train(seed + number) for number in range(NETWORKS)]
    found = nearest_to_others(trainings, region_mm, pupil_radius_mm, seed)
    while found.scatter >= found.training.sigma_nor * unit and len(trainings) < MOST_NETWORKS:
        trainings.append(train(seed + len(trainings)))
        found = nearest_to_others(trainings, region_mm, pupil_radius_mm, seed)
    number = trainings.index(found.training) + 1
    log.debug(
        "network %d of %d is nearest to the others, which scatter by %.2g mm", number, len(trainings), found.scatter
    )
    training = replace(found.training, seconds=sum(one.seconds for one in trainings))
    return Chosen(training=training, scatter=found.scatter / unit, error=found.error / unit)


def nearest_to_others(
    trainings: Sequence[Training], region_mm: np.ndarray, pupil_radius_mm: float, seed: int
) -> Chosen:
    """Choose the network with the least median distance to the others, over rays of a box through the whole pupil.

    Parameters
    ----------
    trainings : sequence of Training
        Two or more networks, which map object point and pupil point (x, y, z, u, v) [mm].
    region_mm : ndarray, shape (2, 3)
        Lowest and highest corner of the box [mm].
    pupil_radius_mm : float
        Radius of the pupil [mm].
    seed : int
        Seed of the rays.

    Returns
    -------
    Chosen
        An element of `trainings`, and the errors in the unit of the networks' outputs.
    """
    rng, (low, high) = np.random.default_rng(seed), region_mm
    rays = np.hstack([rng.uniform(low, high, (RAYS, 3)), random_on_pupil(pupil_radius_mm, RAYS, rng)])
    mapped = np.stack([one.network(rays) for one in trainings])
    between = np.linalg.norm(mapped[:, None] - mapped, axis=-1).mean(-1)  # distance of each two networks, over the rays
    distances = np.median(np.sort(between, axis=1)[:, 1:], axis=1)  # less the distance to itself, which is 0
    best = int(distances.argmin())
    scatter, apart = float(distances[best] / np.sqrt(2)), mapped[best] - np.median(mapped, axis=0)
    error = math.hypot(np.linalg.norm(apart, axis=1).mean(), OF_MEDIAN * scatter / math.sqrt(len(trainings)))
    return Chosen(training=trainings[best], scatter=scatter, error=error)


def distance_of_halves(
    fit: Callable[[np.ndarray], Rays],
    dot: np.ndarray,
    region_mm: np.ndarray,
    pupil_radius_mm: float,
    seed: int,
    held_out: float,
) -> float:
    """Return the mean error of a mapping that the noise of its labels makes, from mappings of half of the dots each.

    A half has twice the variance of the whole, the difference of two halves four times. Rays pass within `INNER` of the
    pupil's radius.

    Parameters
    ----------
    fit : callable
        Fits a mapping to some of the labels, an array of bool.
    dot : ndarray, shape (n,)
        Number of each label's dot.
    region_mm, pupil_radius_mm, seed
        As `nearest_to_others` takes them.
    held_out : float
        Error of held-out dots. A first pair of halves with a larger error is followed by others, `SPLITS` in all. Then
        the median of the others counts, because the first one was chosen for its large error.

    Returns
    -------
    float
        The error in the unit of the mappings' outputs; nan with less than `FEWEST_DOTS` dots.
    """
    rng, (low, high), dots = np.random.default_rng(seed), region_mm, np.unique(dot)
    if len(dots) < FEWEST_DOTS:
        return np.nan
    errors: list[float] = []
    while not errors or (errors[0] > held_out and len(errors) < SPLITS):
        half = np.isin(dot, rng.permutation(dots)[: len(dots) // 2])
        rays = rng.uniform(low, high, (RAYS, 3)), random_on_pupil(INNER * pupil_radius_mm, RAYS, rng)
        apart = fit(half)(*rays) - fit(~half)(*rays)
        errors.append(float(np.linalg.norm(apart, axis=1).mean() / 2))
    return float(np.median(errors[1:] or errors))


def smooth_departure(inputs: np.ndarray, departure: np.ndarray, dot: np.ndarray) -> float:
    """Return what labels depart from a mapping on average by a quadratic function of the rays.

    Two halves of the dots do not show where no mapping follows the labels, as after too few epochs.

    Parameters
    ----------
    inputs : ndarray, shape (n, 5)
        Rays (x, y, z, u, v) [mm].
    departure : ndarray, shape (n, 2)
        Labels minus the mapping.
    dot : ndarray, shape (n,)
        Number of each label's dot. The labels of a dot count as a single one.

    Returns
    -------
    float
        The mean length of the function, in the unit of the departures; 0 where chance explains it.
    """
    scaled = (inputs - inputs.mean(0)) / np.maximum(inputs.std(0), 1e-12)
    first, second = np.triu_indices(scaled.shape[1])
    terms = np.hstack([np.ones((len(scaled), 1)), scaled, scaled[:, first] * scaled[:, second]])
    smooth = terms @ np.linalg.lstsq(terms, departure, rcond=None)[0]
    count, free = terms.shape[1], len(np.unique(dot)) - terms.shape[1]
    if free < 1:
        return 0.0
    ratio = (smooth**2).sum() / count / max(((departure - smooth) ** 2).sum() / free, 1e-300)
    shown = stats.f.sf(ratio, 2 * count, 2 * free) < CHANCE
    return float(np.linalg.norm(smooth, axis=1).mean()) if shown else 0.0
