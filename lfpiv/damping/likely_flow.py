"""`LikelyFlow`: a flow whose simulated vectors resemble measured ones.

A measured field is no true flow: it has errors, mostly of short wavelength, and its fluctuations are damped already. So
the modes of measured fields (their discrete cosine transforms) get other amplitudes. Simulated pairs show the slope S
of a shell of modes and the power N of the errors of each of its modes. The modes of several pairs are taken apart into
their mean and what differs from pair to pair, as in a random-effects model [1]_. With the mean m of K pairs and the
variance V between them, the true mean has the power m^2 - V / K, and what truly differs has the power V - N, each over
S^2. Errors of a steady flow lie mostly in V, where they are told from the flow.

References
----------
.. [1] S. R. Searle, G. Casella, C. E. McCulloch, "Variance Components", Wiley, 1992, chapter 3.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfpiv.velocity.damping import displacement
from lfpiv.velocity.damping_estimate import Simulated
from lfpiv.velocity.modes import field_of, modes_of, shells_of

SLOPES = (0.5, 1.2)
"""Limits of the slope of all modes."""
LEAST_SLOPE = 0.1
"""Least slope of a shell. Vectors show too little of what lies below for it to be made from them."""
SHELL_SPREAD = 0.2
"""Standard deviation of the slopes of shells around that of all modes. A shell without flow, such as that of
the mean, gets the slope of all."""


class LikelyFlow:
    """Flows of pairs whose measured displacements are given.

    Parameters
    ----------
    measured : sequence of ndarrays, shape (z, y, x, 3)
        Measured displacements along (z, y, x) of all pairs [voxel], finite.
    """

    def __init__(self, measured: Sequence[np.ndarray]):
        self._levels = [field.mean((0, 1, 2)) for field in measured]
        self._shells = shells_of(measured[0].shape[:3])
        self._counts = np.maximum(np.bincount(self._shells.ravel()), 1)[:, None]
        modes = np.stack([modes_of(field) for field in measured])
        self._pairs = len(modes)
        self._mean = modes.mean(0)
        self._others = modes - self._mean
        """What differs from pair to pair."""

    def __call__(self, pair: int, simulated: Sequence[Simulated]) -> np.ndarray:
        """Return the flow of a pair.

        Parameters
        ----------
        pair : int
            Number of the pair among the measured ones.
        simulated : sequence of Simulated
            Simulated pairs so far; without any the measured field is returned.

        Returns
        -------
        ndarray, shape (z, y, x, 3)
            Displacement along (z, y, x), means over the windows [voxel].
        """
        steady, other = self._mean, self._others[pair]
        if simulated:
            for_steady, for_other = self.gains(simulated)
            steady, other = for_steady * steady, for_other * other
        return self._levels[pair] + field_of(steady + other)

    def gains(self, simulated: Sequence[Simulated]) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of the modes of the mean, and of what differs from it, each of shape (z, y, x, 3)."""
        slope, errors = (found[self._shells] for found in self._slopes_and_errors(simulated))
        if self._pairs == 1:
            return self._gain(self._mean**2, errors) / slope, np.zeros_like(self._mean)
        between = np.square(self._others).sum(0) / (self._pairs - 1)
        whole = np.sqrt(self._pairs / (self._pairs - 1))  # the mean holds a part of what differs
        steady = self._gain(self._mean**2, between / self._pairs)
        return steady / slope, whole * self._gain(between, errors) / slope

    def _gain(self, power: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the roots of the shares of the power of modes that are not errors.

        The positive parts of differences are too large on average. They are scaled such that each shell has the power
        that its sums have.
        """
        left = np.maximum(power - errors, 0)
        whole = np.maximum(self._sums(power - errors), 0) / np.maximum(self._sums(left), _TINY)
        return np.sqrt(np.minimum(whole, 1)[self._shells] * left / np.maximum(power, _TINY))

    def _slopes_and_errors(self, simulated: Sequence[Simulated]) -> tuple[np.ndarray, np.ndarray]:
        """Return the slope and the power of the errors of a mode of each shell, shape (shell, 3)."""
        pairs = [(modes_of(one.imposed), modes_of(displacement(one.vectors))) for one in simulated]
        imposed = np.mean([self._sums(exact * exact) for exact, _ in pairs], axis=0)
        products = np.mean([self._sums(exact * found) for exact, found in pairs], axis=0)
        found = np.mean([self._sums(found * found) for _, found in pairs], axis=0)
        overall = np.clip(products.sum(0) / np.maximum(imposed.sum(0), _TINY), *SLOPES)
        known = _errors(overall, imposed, products, found) / (len(simulated) * SHELL_SPREAD**2 * self._counts)
        whole = imposed + known
        slope = np.divide(products + known * overall, whole, out=np.tile(overall, (len(whole), 1)), where=whole > 0)
        slope = np.maximum(slope, LEAST_SLOPE)
        return slope, _errors(slope, imposed, products, found) / self._counts

    def _sums(self, powers: np.ndarray) -> np.ndarray:
        """Return the sums over each shell, shape (shell, 3)."""
        return np.stack([np.bincount(self._shells.ravel(), powers[..., k].ravel()) for k in range(3)], axis=1)


_TINY = np.finfo(float).tiny


def _errors(slope: np.ndarray, imposed: np.ndarray, products: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return the power of what a slope leaves of the modes found, from sums of products of modes."""
    return np.maximum(found - 2 * slope * products + slope**2 * imposed, 0)
