"""Samples that hold a network between the dots: a board has few dots along an axis, and none between to judge by."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

_ORDER = 4  # of the polynomial in board position and pupil point together, each at most cubic
_LOOSE = 3.0  # the guide is this many times looser than the polynomial's misfit and its own error,
_LEAST_PITCHES = 0.005  # which is never taken for less than this
_TOLD = 1e-9  # of the best known combination of terms: what is known less well than this is not known
_DOTS_PER_TERM = 2  # fewer dots than this for each term in (x, y, z) lower its order


Guide = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Given the training part's indices, what `between_dots` returns for it."""


def guide_between(
    points: np.ndarray, pupil: np.ndarray, outputs: np.ndarray, std: np.ndarray, *, pitch_mm: float, seed: int
) -> Guide:
    """Return `between_dots` of the part of the labels that a network is trained on; arguments as there."""

    def guide(part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return between_dots(points[part], pupil[part], outputs[part], std[part], pitch_mm=pitch_mm, seed=seed)

    return guide


def between_dots(
    points: np.ndarray, pupil: np.ndarray, outputs: np.ndarray, std: np.ndarray, *, pitch_mm: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return samples between the dots by a polynomial through the labels, for `lfpiv.calibration.training.train`.

    A network of tens of nodes can pass through every plane, row and column of dots and be wrong in between, where
    neither training nor held-out dots see it. These samples forbid that, loosely enough for dots to decide.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Board position (x, y, z) of each label's dot [mm].
    pupil : ndarray, shape (n, 2)
        Pupil point (u, v) of each label [mm].
    outputs : ndarray, shape (n, 2)
        What the network learns there [mm].
    std : ndarray, shape (n,)
        Standard deviation of each label [mm].
    pitch_mm : float
        Microlens pitch [mm].
    seed : int
        Of the samples' places: on lines between two dots, any pupil points of two labels mixed.

    Returns
    -------
    inputs : ndarray, shape (m, 5)
        Places (x, y, z, u, v) [mm].
    outputs : ndarray, shape (m, 2)
        The polynomial there [mm].
    std : ndarray, shape (m,)
        Their standard deviations [mm]: the polynomial's misfit, and what the dots leave open of it there, which is
        much where planes stand close together and far from the others.
    """
    where = np.hstack([points, pupil])
    middle, half = where.mean(0), np.maximum(np.ptp(where, axis=0) / 2, 1e-9)
    dots = len(np.unique(points, axis=0))
    limits = [min(3, len(np.unique(points[:, axis])) - 1) for axis in range(3)]
    places = [p for p in itertools.product(range(4), repeat=3) if sum(p) <= 3 and all(np.less_equal(p, limits))]
    order = max(order for order in range(4) if sum(sum(p) <= order for p in places) * _DOTS_PER_TERM <= max(dots, 2))
    powers = [
        (*p, *q)
        for p in places
        for q in itertools.product(range(4), repeat=2)
        if sum(p) <= order and sum(q) <= 3 and sum(p) + sum(q) <= _ORDER
    ]

    def design(inputs: np.ndarray) -> np.ndarray:
        scaled = (inputs - middle) / half
        return np.stack([np.prod(scaled**power, axis=1) for power in powers], axis=1)

    have = design(where)
    misses = np.linalg.qr(np.hstack([have, outputs]) / std[:, None])[1][: len(powers)]
    left, strength, right = np.linalg.svd(misses[:, : len(powers)])
    known = strength > _TOLD * strength[0]
    coefficients = right[known].T @ ((left.T @ misses[:, len(powers) :])[known] / strength[known, None])
    misfit = float(np.sqrt(np.mean((outputs - have @ coefficients) ** 2)))
    rng = np.random.default_rng(seed)
    first, second = rng.integers(len(where), size=(2, len(where) // 2))
    part = rng.random((len(first), 1))
    inputs = part * where[first] + (1 - part) * where[second]
    want = design(inputs)
    open_mm2 = ((want @ right.T / np.maximum(strength, _TOLD * strength[0])) ** 2).sum(1)  # of labels that err apart,
    open_share = open_mm2 / np.mean(std**2) * len(where) / dots  # but those of a dot err together
    misfit = _LOOSE * max(misfit, _LEAST_PITCHES * pitch_mm)
    return inputs, want @ coefficients, misfit * np.sqrt(1 + open_share)
