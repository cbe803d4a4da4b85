"""Choose one of several networks that differ by the seed of their training only.

A network whose first weights or split were unlucky can leave the true mapping between the dots or at the border of the
board, where no held-out dot shows it. Such errors differ from network to network. So the network nearest to the others
is taken, and its distance to them is an estimate of its error [1]_.

References
----------
.. [1] L. K. Hansen, P. Salamon, "Neural network ensembles", IEEE Trans. Pattern Anal. Mach. Intell. 12 (1990) 993-1001,
   doi:10.1109/34.58871.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.training import Training
from lfpiv.geometry.optics import random_on_pupil

NETWORKS, MOST_NETWORKS = 3, 7
"""Least and largest number of networks that are trained for a camera. Two networks are equally far from each other, so
one that is wrong shows among three. More are trained while they scatter by more than the held-out dots show."""
RAYS = 2000
"""Rays on which networks are compared."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """The network nearest to the others."""

    training: Training
    """The network, as it was trained; an element of the sequence given."""
    scatter: float
    """Error that the chance of the training makes, in the unit of the networks' outputs. It is the median distance to
    the other networks over the square root of 2, since both ends of a distance have errors. A few networks that are far
    off do not change a median."""


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
    """
    rng, (low, high) = np.random.default_rng(seed), region_mm
    rays = np.hstack([rng.uniform(low, high, (RAYS, 3)), random_on_pupil(pupil_radius_mm, RAYS, rng)])
    mapped = np.stack([one.network(rays) for one in trainings])
    between = np.linalg.norm(mapped[:, None] - mapped, axis=-1).mean(-1)  # distance of each two networks, over the rays
    distances = np.median(np.sort(between, axis=1)[:, 1:], axis=1)  # less the distance to itself, which is 0
    best = int(distances.argmin())
    return Chosen(training=trainings[best], scatter=float(distances[best] / np.sqrt(2)))
