"""Some steps of conjugate gradients, for nodes of a displacement."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def conjugate_gradients(
    matrix: Callable[[np.ndarray], np.ndarray],
    rest: np.ndarray,
    *,
    steps: int,
    least: float,
    inverse: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return an approximate solution of matrix x = rest, started from zeros.

    Parameters
    ----------
    matrix : callable
        Symmetric positive map of arrays.
    rest : ndarray
        Right-hand side.
    steps : int
        Largest number of steps.
    least : float
        Share of the first squared residual at which the steps end.
    inverse : ndarray or float
        Diagonal preconditioner.
    """
    found, scaled = np.zeros_like(rest), inverse * rest
    way, square = scaled.copy(), float((rest * scaled).sum())
    least *= square
    for _ in range(steps):
        if square <= least:
            break
        image = matrix(way)
        length = square / float((way * image).sum())
        found += length * way
        rest = rest - length * image
        scaled = inverse * rest
        square, before = float((rest * scaled).sum()), square
        way = scaled + (square / before) * way
    return found
