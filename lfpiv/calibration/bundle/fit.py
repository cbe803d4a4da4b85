"""Fit the errors of the board jointly to the labels of all cameras.

A stage puts planes some hundredths of a millimetre from where they are said to be, and a board may be tilted or
inaccurately printed. A network that follows such errors bends between the planes, and cameras agree on wrong depths.

What tells the board from the lens: rays are straight in the fluid. So the departure of a real camera from a thin lens,
as a displacement on the array, is a(s, t, u, v) + z b(s, t, u, v) with smooth a and b, linear in the depth z along the
camera's axis for given (s, t, u, v), apart from the magnification. Errors of planes and dots do not have this form. The
fit is a linear mixed model ([1]_): free coefficients of a and b for each camera, and errors of the board as random
effects, with one variance for each kind of error. A kind that does not raise the likelihood significantly has variance
0, so that its errors are 0.

The noise of the labels is measured along s and along t: dots in step with the lenses show little of their place along
one of them.

No camera can tell a moved, scaled or sheared world. So shifts have no part that is constant or linear in z, rotations
no constant part, and errors of dots no part that is constant or linear in x and y.

References
----------
.. [1] H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
       58, 545-554 (1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.errors import BoardErrors
from lfpiv.calibration.bundle.dot_rays import CameraLabels, DotRays, orthogonal_part, smooth_terms, thin_lens_rays
from lfpiv.calibration.bundle.effects import Effects
from lfpiv.calibration.bundle.mixed_model import NormalEquations, Solution
from lfpiv.lightfield.decoder import NORMAL_MAD

FIRST_STD = {"depth": 0.05, "shift": 0.05, "tilt": 0.005, "rotation": 0.005, "dots": 0.005}
"""Standard deviation of each kind of error from which the fit starts [mm or rad]."""
FIRST_NOISE_MM = 1e-4
"""Noise of chief rays and slopes from which the fit starts [mm]. So small that the errors of the board start free."""
LEAST_NOISE_MM = 1e-6
"""Lower limit of the noise [mm]."""
RANK_TOLERANCE = 1e-9
"""Singular value below which the dots do not determine a combination of smooth terms, relative to the largest one."""
LEAST_FREEDOM = 0.1
"""Least share of a row that is taken for its freedom."""
OUTLIER = 4.0
"""Residual that has a quarter of the full weight [robust standard deviations]."""
PASSES, ROUNDS = 2, 6
"""Linearisations about the corrected positions, and rounds of weights in each."""
PLANE_ERROR_PITCH = 0.002
"""Least error that a camera's labels of one plane share, of chief rays and of slopes to the pupil's edge [pitch].

It is at least the error of a single dot, because what disturbs single dots, such as light of their neighbours, depends
on the plane's focus too.
"""
BELIEVED = 0.5
"""Error of a plane above which its image is taken for another plane's, and not used [distance of the planes]."""


def fit_board(cameras: Sequence[CameraLabels], board: DotBoard) -> BoardErrors:
    """Fit the errors of planes and dots to the labels of all cameras.

    Parameters
    ----------
    cameras : sequence of CameraLabels
        Labels and thin lens of each camera.
    board : DotBoard
        The board as stated.

    Returns
    -------
    BoardErrors
        Errors are 0 where the labels do not show them, and where there are too few planes or dots.
    """
    data = [DotRays.from_labels(camera) for camera in cameras]
    believed = np.full(len(board.planes_mm), True)
    limit = BELIEVED * float(np.median(np.diff(np.sort(board.planes_mm)))) if len(believed) > 1 else 0.0
    while True:
        found = _fit_planes([part.of_planes(believed, board) for part in data], board)
        wrong = (np.abs(found.plane[:, :3]) > limit).any(1)
        if not wrong.any():
            return found
        believed &= ~wrong


def _fit_planes(data: Sequence[DotRays], board: DotBoard) -> BoardErrors:
    """Fit the errors of the board, linearised about the positions that are corrected so far."""
    found = _no_errors(board)
    effects = Effects.from_dots(board, np.concatenate([part.dot for part in data]))
    if effects is None:
        return found
    values = np.zeros(effects.size)
    for _ in range(PASSES):
        equations = [Equations.from_rays(part, effects, board, found, values) for part in data]
        known = [camera for camera in equations if camera is not None]
        if not known:
            return found
        fit = _fit_effects(known, effects, found)
        effects, values, found = fit.effects, fit.values, fit.errors
        if not found.corrected:
            return found
    return found


def _no_errors(board: DotBoard) -> BoardErrors:
    planes = len(board.planes_mm)
    return BoardErrors(
        planes_mm=np.array(board.planes_mm, float),
        plane=np.zeros((planes, 6)),
        plane_std=np.full((planes, 6), np.nan),
        dot_mm=np.zeros((board.size, 2)),
        dot_std_mm=np.full((board.size, 2), np.nan),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations:
    """Linear equations of one camera: departure from the thin lens = smooth terms + errors of the board + noise.

    Rows are the chief rays of all dots and their slopes along u and v. An error that the camera's labels of one plane
    share, constant or linear in x or y, has a column in `smooth` and a row of its own. The row states that the error is
    0 within the noise of a dot, at least within `PLANE_ERROR_PITCH`.
    """

    smooth: np.ndarray  # (3d + 9 planes, terms + 9 planes)
    effects: np.ndarray  # for s and t, (2, 3d + 9 planes, size)
    departure: np.ndarray  # for s and t [mm], (2, 3d + 9 planes)
    variance: np.ndarray  # variance of the rows, relative to that of their kind, (3d + 9 planes,)
    kind: np.ndarray  # 0 for chief rays, 1 for slopes, 2 and 3 for the statements on them, (3d + 9 planes,)
    least_mm: float  # lower limit of the errors that a plane's labels share [mm]

    @classmethod
    def from_rays(
        cls, data: DotRays, effects: Effects, board: DotBoard, found: BoardErrors, values: np.ndarray
    ) -> Equations | None:
        """Linearise about the positions that are corrected by `values`; None if there are too few dots."""
        count = len(data.dot)
        points = found.points_mm(board, data.dot)
        rays, jacobian, depth = thin_lens_rays(data.lens, points, data.pupil_radius_mm)
        smooth = smooth_terms(data.rays, depth, data.lens)
        if smooth is None:
            return None
        moved = np.einsum("dkaj,djp->akdp", jacobian, effects.displacement(board, data.dot)).reshape(2, 3 * count, -1)
        departure = (data.rays - rays).transpose(2, 1, 0).reshape(2, -1) + moved @ values
        planes, plane = np.unique(data.dot // board.size, return_inverse=True)
        place = board.points_mm(0)[data.dot % board.size, :2]
        trend = np.column_stack([np.ones(count), place / np.maximum(np.abs(place).max(0), 1e-9)])
        of_plane = (trend[:, :, None] * np.eye(len(planes))[plane][:, None]).reshape(count, -1)
        shared = np.kron(np.eye(3), of_plane)
        stated = shared.shape[1]
        return cls(
            smooth=np.block([[smooth, shared], [np.zeros((stated, smooth.shape[1])), np.eye(stated)]]),
            effects=np.pad(moved, ((0, 0), (0, stated), (0, 0))),
            departure=np.pad(departure, ((0, 0), (0, stated))),
            variance=np.append(data.variance[:, [0, 1, 1]].T.ravel(), np.ones(stated)),
            kind=np.repeat([0, 1, 2, 3], [count, 2 * count, stated // 3, 2 * stated // 3]),
            least_mm=PLANE_ERROR_PITCH * data.pitch_mm,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedEquations:
    """Equations of one camera with weights, after the smooth terms are eliminated."""

    bases: tuple[np.ndarray, ...]  # for s and t: orthonormal basis of the weighted smooth terms, (rows, terms)
    effects: np.ndarray  # (2, rows, size)
    departure: np.ndarray  # (2, rows)

    @classmethod
    def from_equations(cls, system: Equations, noise: np.ndarray, robust: np.ndarray) -> WeightedEquations:
        """Weight by the noise of chief rays and slopes along s and t [mm], (2, 2), and the rows' robust weights."""
        roots, bases = [], []
        for along in noise.T:
            of_kind = np.append(along, np.maximum(along, system.least_mm))
            root = np.sqrt(robust / system.variance) / of_kind[system.kind]
            left, strength, _ = np.linalg.svd(system.smooth * root[:, None], full_matrices=False)
            roots.append(root)
            bases.append(left[:, strength > RANK_TOLERANCE * strength[0]])
        effects = [
            orthogonal_part(*part) for part in zip(bases, system.effects * np.stack(roots)[..., None], strict=True)
        ]
        departure = [orthogonal_part(*part) for part in zip(bases, system.departure * roots, strict=True)]
        return cls(bases=tuple(bases), effects=np.stack(effects), departure=np.stack(departure))

    def residual(self, solution: Solution) -> np.ndarray:
        """Return the residuals in standard deviations, freed of the part that the unknowns take, shape (2, rows)."""
        of_terms = np.stack([(basis**2).sum(1) for basis in self.bases])
        taken = of_terms + ((self.effects @ solution.covariance) * self.effects).sum(2)
        rest = self.departure - self.effects @ solution.values
        return rest / np.sqrt(np.maximum(1 - taken, LEAST_FREEDOM))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """Errors of the board, and what they were fitted with."""

    effects: Effects
    values: np.ndarray
    errors: BoardErrors


def _fit_effects(equations: Sequence[Equations], effects: Effects, board: BoardErrors) -> _Fit:
    """Fit the errors of the board with robust weights, and keep the kinds of errors that are significant."""
    noise = [np.full((2, 2), FIRST_NOISE_MM) for _ in equations]  # of chief rays and slopes, along s and t
    robust = [np.ones(len(camera.variance)) for camera in equations]
    std: dict[str, float] = dict(FIRST_STD)
    for _ in range(ROUNDS):
        weighted = [WeightedEquations.from_equations(*camera) for camera in zip(equations, noise, robust, strict=True)]
        parts = ((m, y) for camera in weighted for m, y in zip(camera.effects, camera.departure, strict=True))
        normal = NormalEquations.from_parts(parts, effects.kind, FIRST_STD)
        std = normal.best_std(std)
        solution = normal.solve(std)
        for k, (camera, of_camera) in enumerate(zip(equations, weighted, strict=True)):
            residual = np.abs(of_camera.residual(solution)) / np.sqrt(robust[k])
            scatter = [NORMAL_MAD * np.median(residual[:, camera.kind == kind], axis=1) for kind in range(2)]
            scale = np.maximum(scatter, LEAST_NOISE_MM / noise[k])
            noise[k] = noise[k] * scale
            robust[k] = _robust_weights(residual / np.vstack([scale, np.ones((2, 2))])[camera.kind].T, camera.kind)
    kept = normal.significant_std(std)
    values = normal.solve(kept).values
    effects = effects.as_most_planes(values, board.planes_mm)
    return _Fit(effects=effects, values=values, errors=_errors(normal, kept, effects, board))


def _errors(normal: NormalEquations, std: dict[str, float], effects: Effects, board: BoardErrors) -> BoardErrors:
    """Return the errors of planes and dots. Standard errors of kinds not corrected tell what the labels could show."""
    solution, covariance = normal.solve(std), normal.solve(FIRST_STD).covariance
    corrected = np.isin(effects.kind, list(std))
    covariance[np.ix_(corrected, corrected)] = solution.covariance[np.ix_(corrected, corrected)]
    plane_std, dot_std = (np.sqrt(((part @ covariance) * part).sum(2)) for part in (effects.plane, effects.site))
    return replace(
        board,
        plane=effects.plane @ solution.values,
        plane_std=np.where(effects.used_planes[:, None], plane_std, np.nan),
        dot_mm=effects.site @ solution.values,
        dot_std_mm=np.where(effects.used_sites[:, None], dot_std, np.nan),
        corrected=tuple(std),
    )


def _robust_weights(residual: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return Geman and McClure's weights of the rows, alike for both coordinates and both slopes of a dot."""
    square = (residual**2).mean(0)[kind < 2].reshape(3, -1)
    square[1:] = square[1:].mean(0)
    weights = np.ones(len(kind))
    weights[kind < 2] = (1 / (1 + square / OUTLIER**2) ** 2).ravel()
    return weights
