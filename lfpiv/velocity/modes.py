"""Modes of vector fields: their discrete cosine transforms, and the shells of wave numbers in which modes are alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy  # loads its parts where they are used: readers of results need no transform

SHELL_WIDTH = 0.1
"""Width of the shells of wave numbers [1 / distance of windows]."""


def modes_of(field: np.ndarray) -> np.ndarray:
    """Return the discrete cosine transform of the fluctuations of a finite field along its first three axes."""
    return scipy.fft.dctn(field - field.mean((0, 1, 2)), axes=(0, 1, 2), norm="ortho")


def field_of(modes: np.ndarray) -> np.ndarray:
    """Return the fluctuations whose modes are given."""
    return scipy.fft.idctn(modes, axes=(0, 1, 2), norm="ortho")


def shells_of(shape: tuple[int, ...]) -> np.ndarray:
    """Return the number of the shell of each mode, by its wave number."""
    waves = np.meshgrid(*(np.arange(count) / (2 * count) for count in shape), indexing="ij")
    return (np.sqrt(sum(wave**2 for wave in waves)) / SHELL_WIDTH).astype(int)


def coherences(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, ...]:
    """Return the coherence of each shell, the squared correlation of the modes of two fields.

    Parameters
    ----------
    pairs : sequence of pairs of ndarrays, shape (z, y, x)
        Both fields of each pair, finite. All have one shape.

    Returns
    -------
    tuple of float
        0 to 1; 0 for a shell without modes.
    """
    shells = shells_of(pairs[0][0].shape).ravel()
    modes = [(modes_of(first).ravel(), modes_of(second).ravel()) for first, second in pairs]
    powers = [(first * first, first * second, second * second) for first, second in modes]
    first, both, second = (np.bincount(shells, sum(power)) for power in zip(*powers, strict=True))
    found = np.divide(both**2, first * second, out=np.zeros_like(both), where=first * second > 0)
    return tuple(float(value) for value in np.minimum(found, 1.0))


def weighted(field: np.ndarray, weights: Sequence[float]) -> np.ndarray:
    """Return the fluctuations of a finite field (z, y, x), the modes of each shell times its weight.

    Shells beyond the last weight have that weight.
    """
    of_shell = np.asarray(weights, float)
    return field_of(modes_of(field) * of_shell[np.minimum(shells_of(field.shape), len(of_shell) - 1)])
