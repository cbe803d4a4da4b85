"""Linear mixed model: unknowns of several kinds, each kind with a variance of its own that the data determine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

STD_RANGE = (1e-4, 1e2)
"""Range of a fitted standard deviation, relative to the typical one."""
SIGNIFICANT = 10.8
"""Twice the gain of the logarithmic likelihood by one variance that chance exceeds in one of 1,000 cases."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Unknowns, given the standard deviation of each kind."""

    values: np.ndarray
    """Means, 0 for unknowns of kinds without a standard deviation, shape (size,)."""
    covariance: np.ndarray
    """Covariance, shape (size, size)."""
    likelihood: float
    """Logarithmic likelihood, relative to that of unknowns that are all 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NormalEquations:
    """Normal equations of the unknowns, for noise of variance 1, after free terms are eliminated."""

    gram: np.ndarray
    """Shape (size, size)."""
    right: np.ndarray
    """Shape (size,)."""
    kind: np.ndarray
    """Name of each unknown's kind, shape (size,)."""
    typical: Mapping[str, float]
    """Typical standard deviation of each kind, from which a search starts."""

    @classmethod
    def from_parts(
        cls, parts: Iterable[tuple[np.ndarray, np.ndarray]], kind: np.ndarray, typical: Mapping[str, float]
    ) -> NormalEquations:
        """Sum up parts of equations, each a matrix (rows, size) and its right side (rows,)."""
        gram, right = np.zeros((len(kind), len(kind))), np.zeros(len(kind))
        for matrix, side in parts:
            gram += matrix.T @ matrix
            right += matrix.T @ side
        return cls(gram=gram, right=right, kind=kind, typical=typical)

    def solve(self, std: Mapping[str, float]) -> Solution:
        """Return the unknowns given the standard deviations of some kinds; unknowns of other kinds are 0."""
        prior = np.array([std.get(kind, 0.0) for kind in self.kind])
        has = prior > 0
        values, covariance = np.zeros(len(prior)), np.zeros((len(prior), len(prior)))
        scale, right = prior[has], self.right[has] * prior[has]
        factor = cho_factor(self.gram[np.ix_(has, has)] * np.outer(scale, scale) + np.eye(len(scale)))
        values[has] = scale * cho_solve(factor, right)
        covariance[np.ix_(has, has)] = cho_solve(factor, np.eye(len(scale))) * np.outer(scale, scale)
        likelihood = right @ cho_solve(factor, right) / 2 - np.log(factor[0].diagonal()).sum()
        return Solution(values=values, covariance=covariance, likelihood=float(likelihood))

    def best_std(self, start: Mapping[str, float]) -> dict[str, float]:
        """Return the most likely standard deviations of the kinds in `start`; unknowns of other kinds are 0."""
        kinds = list(start)
        if not kinds:
            return {}
        typical = np.array([self.typical[kind] for kind in kinds])
        members = [self.kind == kind for kind in kinds]

        def cost(logarithm: np.ndarray) -> tuple[float, np.ndarray]:
            std = typical * np.exp(logarithm)
            found = self.solve(dict(zip(kinds, std, strict=True)))
            square = found.values**2 + found.covariance.diagonal()
            rise = [square[member].sum() / s**2 - member.sum() for member, s in zip(members, std, strict=True)]
            return -found.likelihood, -np.array(rise)

        first = np.clip(np.log(np.array(list(start.values())) / typical), *np.log(STD_RANGE))
        limits = [tuple(np.log(STD_RANGE))] * len(kinds)
        best = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=limits)
        return {kind: float(value) for kind, value in zip(kinds, typical * np.exp(best.x), strict=True)}

    def significant_std(self, std: Mapping[str, float]) -> dict[str, float]:
        """Leave out kinds one by one, the least likely first, until all are significant."""
        std = dict(std)
        while std:
            whole = self.solve(std).likelihood
            gain = {
                kind: 2 * (whole - self.solve({k: v for k, v in std.items() if k != kind}).likelihood) for kind in std
            }
            weakest = min(gain, key=gain.__getitem__)
            if gain[weakest] > SIGNIFICANT:
                break
            del std[weakest]
            std = self.best_std(std)
        return std
