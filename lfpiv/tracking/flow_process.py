"""`FlowProcess`: the flow as a Gaussian process whose covariance the displacements of linked particles decide.

A link measures y = u(x) + e. The error e has the stated variance, and the variance of structures smaller than the
process resolves. Once the links' median is subtracted, components of the flow u have the mean 0 and the covariance [1]_

    independent:     diag(s_x^2, s_y^2, s_z^2) exp(-r^2 / 2 l^2)
    incompressible:  s^2 [(1 - r^2 / 2 l^2) I + r r' / 2 l^2] exp(-r^2 / 2 l^2)

Strengths s, length l, and the unresolved scatter maximise the evidence of the links [2]_. The form is chosen by the
logarithm of this evidence, less half the logarithm of the number of data for each parameter [3]_. Independent
components share one strength, or each has its own. With a shared one, components that stand still would hide a flow
along the line of sight: links of a single camera show depth many times less precisely than the other components. Where
the flow is incompressible, these tell about depth. Links that disagree with the process lose weight (Cauchy).

References
----------
.. [1] F. J. Narcowich, J. D. Ward, "Generalized Hermite interpolation via matrix-valued conditionally positive definite
   functions", Math. Comp. 63 (1994) 661, doi:10.1090/S0025-5718-1994-1254147-6.
.. [2] C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", MIT Press, 2006, chapter 5.
.. [3] G. Schwarz, "Estimating the dimension of a model", Ann. Stat. 6 (1978) 461-464, doi:10.1214/aos/1176344136.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Hyperparameter, Kernel

LENGTHS = (2.0, 100.0)
"""Bounds of the length of the flow [voxel]."""
STRENGTHS = (0.03, 30.0)
"""Bounds of the strength of fluctuations [voxel]."""
SCATTERS = (0.01, 1.0)
"""Bounds of the scatter of unresolved structures [voxel]."""
START = (1.0, 12.0, 0.05)
"""Strength, length and scatter from which the evidence is maximised [voxel]."""
FIRST_LENGTHS = (5.0, 40.0)
"""Other lengths from which it is maximised [voxel]: of a shear, one start ended at no flow that varies."""
MEAN = 3.0
"""Standard deviation of the flow's mean about the median of the links [voxel]: so large that it tells nothing."""
CAUCHY = 2.5
"""Residual at which a link counts half [standard deviation]."""
ROUNDS = 3
"""Fits, each with the weights of the one before."""
MOST_FITTED = 150
"""Links by which the evidence is maximised; of more, every second, third, ... is taken."""
MOST_SOLVED = 300
"""Links that are solved for at once; places with more around them take the nearest."""
MOST_POINTS = 2000
"""Points of windows whose covariances are held at once."""
REACH = 2.5
"""Distance within which links tell about a window [length of the flow]."""
POINTS = 4
"""Points along each edge of a window whose mean is taken."""
JITTER = 1e-10
"""Variance added to each link, so that the covariance stays positive in rounding [voxel^2]."""


class FlowCovariance(Kernel):  # type: ignore[misc]
    """Covariance of links, for `sklearn.gaussian_process`.

    `strength` is one number, or three for independent components. A row is a component of a link: place (3) [voxel],
    component (0, 1, 2), variance [voxel^2], weight. With links given alone, the variances of their errors are added.
    """

    def __init__(
        self,
        strength: float | np.ndarray = START[0],
        length: float = START[1],
        scatter: float = START[2],
        incompressible: bool = False,
    ):
        self.strength = strength
        self.length = length
        self.scatter = scatter
        self.incompressible = incompressible

    @property
    def hyperparameter_length(self) -> Hyperparameter:
        """Bounds of the length, for scikit-learn."""
        return Hyperparameter("length", "numeric", LENGTHS)

    @property
    def hyperparameter_scatter(self) -> Hyperparameter:
        """Bounds of the scatter, for scikit-learn."""
        return Hyperparameter("scatter", "numeric", SCATTERS)

    @property
    def hyperparameter_strength(self) -> Hyperparameter:
        """Bounds of the strength, for scikit-learn."""
        return Hyperparameter("strength", "numeric", STRENGTHS, np.size(self.strength))

    def __call__(self, X: np.ndarray, Y: np.ndarray | None = None, eval_gradient: bool = False) -> Any:
        """Return the covariance, and with `eval_gradient` its derivatives by the logarithms of the parameters."""
        other = X if Y is None else Y
        smooth, by_length = self.smooth(X, other)
        covariance = smooth + MEAN**2 * (X[:, None, 3] == other[None, :, 3])
        if Y is None:
            covariance[np.diag_indices(len(X))] += self.noise(X) + JITTER
        if not eval_gradient:
            return covariance
        by_scatter = np.diag(2 * self.scatter**2 / X[:, 5])
        own = [smooth * (X[:, None, 3] == axis) for axis in range(3)] if np.size(self.strength) > 1 else [smooth]
        by_strength = [2 * part for part in own]
        return covariance, np.stack([by_length, by_scatter, *by_strength], axis=2)  # in the order of the names

    def noise(self, rows: np.ndarray) -> np.ndarray:
        """Return the variances of the errors of rows [voxel^2]."""
        return (rows[:, 4] + self.scatter**2) / rows[:, 5]

    def smooth(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariance of the fluctuations between rows, and its derivative by the length's logarithm."""
        apart = (a[: len(a) // 3, None, :3] - b[None, : len(b) // 3, :3]).transpose(2, 0, 1)
        square = np.square(apart).sum(0)
        value, slope = (np.zeros((3, len(a) // 3, 3, len(b) // 3)) for _ in range(2))
        scaled = square / self.length**2
        each = np.broadcast_to(self.strength, 3)
        for i in range(3):
            bell = each[i] ** 2 * np.exp(-scaled / 2)
            value[i, :, i] = bell * (1 - scaled / 2) if self.incompressible else bell
            slope[i, :, i] = bell * scaled * (2 - scaled / 2) if self.incompressible else bell * scaled
            for j in range(3) if self.incompressible else ():
                shared = bell * apart[i] * apart[j] / (2 * self.length**2)
                value[i, :, j] += shared
                slope[i, :, j] += shared * (scaled - 2)
        return value.reshape(len(a), len(b)), slope.reshape(len(a), len(b))

    def diag(self, X: np.ndarray) -> np.ndarray:
        """Return the variance of each row."""
        own = np.broadcast_to(self.strength, 3)[X[:, 3].astype(int)]
        return own**2 + MEAN**2 + self.noise(X) + JITTER

    def is_stationary(self) -> bool:
        """Return False: rows hold variances beside places."""
        return False


@dataclass(frozen=True, kw_only=True)
class FlowProcess:
    """A process fitted to links."""

    covariance: FlowCovariance
    level: np.ndarray
    """Median displacement of the links, shape (3,) [voxel]."""
    rows: np.ndarray
    """Rows of all links, components outermost, shape (3 link, 6)."""
    targets: np.ndarray
    """Displacements beyond the level in the order of the rows, shape (3 link,) [voxel]."""

    @classmethod
    def fitted(cls, places: np.ndarray, moved: np.ndarray, error: np.ndarray) -> FlowProcess:
        """Return the process of the form with the largest evidence.

        Parameters
        ----------
        places, moved, error : ndarray, shape (link, 3)
            Places of links, their displacements and standard errors [voxel].

        Returns
        -------
        FlowProcess
            Of all links. The evidence is maximised for an even choice of at most `MOST_FITTED`.
        """
        level = np.median(moved, axis=0)
        rows, targets = _rows(places, error), (moved - level).T.ravel()
        every = max(-(-len(places) // MOST_FITTED), 1)
        some = np.concatenate([np.arange(k * len(places), (k + 1) * len(places), every) for k in range(3)])
        part = cls(covariance=FlowCovariance(), level=level, rows=rows[some], targets=targets[some])
        forms = [FlowCovariance()]  # independent components tell which links are false
        others = [FlowCovariance(incompressible=True), FlowCovariance(np.full(3, START[0]))]
        for number in range(ROUNDS):
            fits = [_fit(form, part.rows, part.targets) for form in forms]
            part = replace(part, covariance=max(fits, key=_evidence).kernel_).weighted()
            forms = [part.covariance, *(others if number == 0 else [])]
        return cls(covariance=part.covariance, level=level, rows=rows, targets=targets).weighted()

    def weighted(self) -> FlowProcess:
        """Return the process with less weight for links that disagree with it."""
        count = len(self.rows) // 3
        residual = self.targets - (self.means(self.rows[:count, :3], np.zeros(3))[0] - self.level).T.ravel()
        variance = self.covariance.noise(self.rows) * self.rows[:, 5]
        off = np.square(residual) / variance
        weight = 1 / (1 + off.reshape(3, -1).mean(0) / CAUCHY**2)
        return replace(self, rows=np.column_stack([self.rows[:, :5], np.tile(weight, 3)]))

    def solution(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the Cholesky factor of the covariance of some rows, and the solution with their targets."""
        factor = np.linalg.cholesky(self.covariance(self.rows[some]))
        return factor, cho_solve((factor, True), self.targets[some])

    def left_out(self) -> np.ndarray:
        """Return residuals of links from the process of the other ones, over their standard errors, shape (link, 3).

        Of many links an even choice is taken. See [2]_, equations 5.10 to 5.12.
        """
        count = len(self.rows) // 3
        every = max(-(-count // MOST_SOLVED), 1)
        some = np.concatenate([np.arange(k * count, (k + 1) * count, every) for k in range(3)])
        inverse = np.linalg.inv(self.covariance(self.rows[some]))
        return ((inverse @ self.targets[some]) / np.sqrt(np.diag(inverse))).reshape(3, -1).T

    def means(self, centres: np.ndarray, edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return means over windows and their standard errors.

        Parameters
        ----------
        centres : ndarray, shape (window, 3)
            Centres of the windows [voxel].
        edge : ndarray, shape (3,)
            Edges of a window along x, y, z [voxel]; 0: a place.

        Returns
        -------
        mean, error : ndarray, shape (window, 3)
            Displacement [voxel].
        """
        points = _cube(np.asarray(edge, float))
        at = _rows(points, np.zeros_like(points))
        own = (
            self.covariance.smooth(at, at)[0].reshape(3, len(points), 3, len(points)).mean((1, 3)).diagonal() + MEAN**2
        )
        mean, error = (np.zeros((len(centres), 3)) for _ in range(2))
        for windows, links in self._parts(centres):
            rows = np.concatenate([links + k * (len(self.rows) // 3) for k in range(3)])
            factor, solved = self.solution(rows)
            for few in np.array_split(windows, -(-len(windows) * len(points) // MOST_POINTS)):
                places = (centres[few, None] + points).reshape(-1, 3)
                across = self.covariance(_rows(places, np.zeros_like(places)), self.rows[rows])
                across = across.reshape(3, len(few), len(points), -1).mean(2)
                mean[few] = (across @ solved).T
                known = solve_triangular(factor, across.reshape(3 * len(few), -1).T, lower=True)
                left = own[:, None] - np.square(known).sum(0).reshape(3, -1)
                error[few] = np.sqrt(np.maximum(left, 0)).T
        return self.level + mean, error

    def _parts(self, centres: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield numbers of windows, and of the links around them: at most `MOST_SOLVED`, the nearest of more."""
        places = self.rows[: len(self.rows) // 3, :3]
        reach, parts = REACH * self.covariance.length, [np.arange(len(centres))]
        while parts:
            windows = parts.pop()
            low, high = centres[windows].min(0), centres[windows].max(0)
            outside = np.linalg.norm(np.maximum(low - places, 0) + np.maximum(places - high, 0), axis=1)
            near = np.flatnonzero(outside <= reach)
            axis = int(np.argmax(high - low))
            if len(near) > MOST_SOLVED and (high - low)[axis] > self.covariance.length / 2:
                order = windows[np.argsort(centres[windows, axis], kind="stable")]
                parts += [order[: len(order) // 2], order[len(order) // 2 :]]
            else:
                few = min(MOST_SOLVED, len(places))
                yield windows, np.sort(np.argpartition(outside, few - 1)[:few])


def _evidence(fit: GaussianProcessRegressor) -> float:
    """Return the logarithm of the evidence, less what fitted parameters gain by chance (Schwarz [3]_)."""
    return float(fit.log_marginal_likelihood_value_ - np.log(len(fit.X_train_)) * len(fit.kernel_.theta) / 2)


def _fit(form: FlowCovariance, rows: np.ndarray, targets: np.ndarray) -> GaussianProcessRegressor:
    """Maximise the evidence from several lengths and from the form's own; return the best fit."""
    strengths = [START[0]] * np.size(form.strength)
    starts = [form, *(form.clone_with_theta(np.log([length, START[2], *strengths])) for length in FIRST_LENGTHS)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # of a parameter at its bound
        fits = [GaussianProcessRegressor(start, alpha=0.0).fit(rows, targets) for start in starts]
    return max(fits, key=lambda fit: float(fit.log_marginal_likelihood_value_))


def _rows(places: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the rows of all components, which are outermost."""
    count = len(places)
    parts = [
        np.tile(places, (3, 1)),
        np.repeat(np.arange(3.0), count)[:, None],
        np.square(error).T.reshape(-1, 1),
        np.ones((3 * count, 1)),
    ]
    return np.concatenate(parts, axis=1)


def _cube(edge: np.ndarray) -> np.ndarray:
    """Return points evenly spread over a window about 0, shape (point, 3); one point of an edge of 0."""
    steps = [
        ((np.arange(n) + 0.5) / n - 0.5) * size for size, n in zip(edge, np.where(edge > 0, POINTS, 1), strict=True)
    ]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
