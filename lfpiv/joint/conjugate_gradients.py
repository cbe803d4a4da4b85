"""Some steps of the conjugate gradient method, for nodes of a displacement."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def conjugate_gradients(
    matrix: Callable[[np.ndarray], np.ndarray],
    right_side: np.ndarray,
    *,
    steps: int,
    tolerance: float,
    preconditioner: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return an approximate solution x of matrix x = right_side, started from zeros.

    Parameters
    ----------
    matrix : callable
        Symmetric positive map of arrays.
    right_side : ndarray
        Right-hand side.
    steps : int
        Largest number of steps.
    tolerance : float
        Share of the first squared residual at which the steps end.
    preconditioner : ndarray or float
        Approximate inverse of the matrix's diagonal.
    """
    residual, scaled = right_side, preconditioner * right_side
    solution, direction = np.zeros_like(residual), scaled.copy()
    square = float((residual * scaled).sum())
    least = tolerance * square
    for _ in range(steps):
        if square <= least:
            break
        image = matrix(direction)
        length = square / float((direction * image).sum())
        solution += length * direction
        residual = residual - length * image
        scaled = preconditioner * residual
        square, before = float((residual * scaled).sum()), square
        direction = scaled + (square / before) * direction
    return solution
