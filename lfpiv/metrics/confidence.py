"""Standard errors and confidence intervals of figures of merit by a block bootstrap.

Vectors of overlapping windows have errors in common, so single vectors are no independent samples. Blocks of neighbours
are drawn with replacement instead [1]_, [2]_.

References
----------
.. [1] B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap", Chapman & Hall, 1993.
.. [2] H. R. Kuensch, "The jackknife and the bootstrap for general stationary observations", Ann. Statist. 17 (1989)
       1217-1241, doi:10.1214/aos/1176347265.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

RESAMPLES = 200
"""Number of draws."""
CONFIDENCE = 0.95
"""Part of the draws within the stated interval."""
LEAST_BLOCKS = 4
"""Least number of blocks for which a scatter is stated."""

Statistic = Callable[[np.ndarray], Mapping[str, float]]
"""Figures by name, as a function of the weights of the samples."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A figure and how well it is known."""

    value: float
    standard_error: float
    """Standard deviation over the draws; NaN if there are too few blocks."""
    low: float
    """Lower end of the interval of `CONFIDENCE`."""
    high: float
    """Upper end."""


def block_bootstrap(
    statistic: Statistic, block: np.ndarray, *, resamples: int = RESAMPLES, seed: int = 0
) -> dict[str, Estimate]:
    """Estimate figures and their standard errors by drawing blocks of samples with replacement.

    Parameters
    ----------
    statistic : callable
        Takes one weight per sample, shape (sample,), and returns figures by name.
    block : ndarray of int, shape (sample,)
        Number of the block of each sample.
    resamples : int
        Number of draws.
    seed : int
        Seed of the draws.

    Returns
    -------
    dict
        Figure name -> `Estimate`. Intervals are percentiles of the draws.
    """
    block = np.asarray(block)
    if block.ndim != 1:
        raise ValueError(f"block: expected shape (sample,), got {block.shape}.")
    values = dict(statistic(np.ones(len(block))))
    names, member = np.unique(block, return_inverse=True)
    unknown = float("nan")
    if len(names) < LEAST_BLOCKS:
        return {
            name: Estimate(value=value, standard_error=unknown, low=unknown, high=unknown)
            for name, value in values.items()
        }
    rng = np.random.default_rng(seed)
    drawn = [
        statistic(rng.multinomial(len(names), np.full(len(names), 1 / len(names)))[member].astype(float))
        for _ in range(resamples)
    ]
    return {name: _estimate(value, np.array([one[name] for one in drawn])) for name, value in values.items()}


def _estimate(value: float, drawn: np.ndarray) -> Estimate:
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) < 2 or not np.isfinite(value):
        return Estimate(value=value, standard_error=float("nan"), low=float("nan"), high=float("nan"))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(drawn, [tail, 100 - tail])
    return Estimate(value=value, standard_error=float(drawn.std(ddof=1)), low=float(low), high=float(high))
