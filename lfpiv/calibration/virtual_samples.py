"""Virtual training samples between the dots of a board, taken from a polynomial through the labels.

A board has few dots along each axis. A network of tens of nodes can pass through all of them and be wrong in between,
where neither training nor test dots show it. The virtual samples prevent that. Their standard deviations are large, so
that the labels decide wherever there are labels.

The polynomial has the terms x^a y^b z^c u^d v^e with a + b + c <= 3, d + e <= 3 and a + b + c + d + e <= 4.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

CUBIC = 3
"""Largest order in (x, y, z), and in (u, v)."""
TOTAL_ORDER = 4
"""Largest order in all five inputs."""
DOTS_PER_TERM = 2
"""Least number of dots for each term in (x, y, z). Fewer dots lower the order."""
RANK_TOLERANCE = 1e-9
"""Singular value below which the dots do not determine a combination of terms, relative to the largest one."""
LOOSENESS = 3.0
"""Standard deviation of a virtual sample over the error expected of the polynomial."""
LEAST_MISFIT_PITCH = 0.005
"""Lower limit of the polynomial's misfit [microlens pitch]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VirtualSamples:
    """Virtual samples and their standard deviations."""

    inputs: np.ndarray
    """Object and pupil points (x, y, z, u, v) [mm], shape (m, 5)."""
    outputs: np.ndarray
    """Value of the polynomial there [mm], shape (m, 2)."""
    std: np.ndarray
    """Standard deviation of each output [mm], shape (m,)."""


VirtualSampler = Callable[[np.ndarray], VirtualSamples]
"""Make virtual samples from the sample numbers of the training part."""


def sampler_between_dots(
    points: np.ndarray, pupil: np.ndarray, outputs: np.ndarray, std: np.ndarray, *, pitch_mm: float, seed: int
) -> VirtualSampler:
    """Return a function that calls `between_dots` for some of the labels. Parameters as for `between_dots`."""

    def sampler(part: np.ndarray) -> VirtualSamples:
        return between_dots(points[part], pupil[part], outputs[part], std[part], pitch_mm=pitch_mm, seed=seed)

    return sampler


def between_dots(
    points: np.ndarray, pupil: np.ndarray, outputs: np.ndarray, std: np.ndarray, *, pitch_mm: float, seed: int
) -> VirtualSamples:
    """Fit a polynomial to labels and evaluate it at random places between the dots.

    The standard deviation of a virtual sample grows where the dots determine the polynomial badly, for example far from
    planes that stand close to each other.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Board position (x, y, z) of each label's dot [mm].
    pupil : ndarray, shape (n, 2)
        Pupil point (u, v) of each label [mm].
    outputs : ndarray, shape (n, 2)
        Output of the network at each label [mm].
    std : ndarray, shape (n,)
        Standard deviation of each label [mm].
    pitch_mm : float
        Microlens pitch [mm].
    seed : int
        Seed of the random places. Each lies on the line between two labels in (x, y, z, u, v).

    Returns
    -------
    VirtualSamples
        Half as many as there are labels.
    """
    labelled = np.hstack([points, pupil])
    centre, half_range = labelled.mean(0), np.maximum(np.ptp(labelled, axis=0) / 2, 1e-9)
    dots = len(np.unique(points, axis=0))
    powers = _powers(points, dots)

    def design(inputs: np.ndarray) -> np.ndarray:
        scaled = (inputs - centre) / half_range
        return np.stack([np.prod(scaled**power, axis=1) for power in powers], axis=1)

    terms = design(labelled)
    reduced = np.linalg.qr(np.hstack([terms, outputs]) / std[:, None])[1][: len(powers)]
    left, strength, right = np.linalg.svd(reduced[:, : len(powers)])
    known = strength > RANK_TOLERANCE * strength[0]
    coefficients = right[known].T @ ((left.T @ reduced[:, len(powers) :])[known] / strength[known, None])
    misfit = float(np.sqrt(np.mean((outputs - terms @ coefficients) ** 2)))

    inputs = _places_between(labelled, np.random.default_rng(seed))
    terms = design(inputs)
    variance = ((terms @ right.T / np.maximum(strength, RANK_TOLERANCE * strength[0])) ** 2).sum(1)
    variance = variance / np.mean(std**2) * len(labelled) / dots  # relative; the labels of a dot share their error
    deviation = LOOSENESS * max(misfit, LEAST_MISFIT_PITCH * pitch_mm) * np.sqrt(1 + variance)
    return VirtualSamples(inputs=inputs, outputs=terms @ coefficients, std=deviation)


def _powers(points: np.ndarray, dots: int) -> list[tuple[int, ...]]:
    """Return the powers (a, b, c, d, e) of the polynomial's terms that this number and lattice of dots determine."""
    limits = [min(CUBIC, len(np.unique(points[:, axis])) - 1) for axis in range(3)]
    orders = range(CUBIC + 1)
    of_points = [p for p in itertools.product(orders, repeat=3) if sum(p) <= CUBIC and all(np.less_equal(p, limits))]
    order = max(n for n in orders if sum(sum(p) <= n for p in of_points) * DOTS_PER_TERM <= max(dots, 2))
    return [
        (*p, *q)
        for p in of_points
        for q in itertools.product(orders, repeat=2)
        if sum(p) <= order and sum(q) <= CUBIC and sum(p) + sum(q) <= TOTAL_ORDER
    ]


def _places_between(labelled: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    first, second = rng.integers(len(labelled), size=(2, len(labelled) // 2))
    part = rng.random((len(first), 1))
    return part * labelled[first] + (1 - part) * labelled[second]
