"""Fit the errors of the board jointly to the labels of all cameras.

A stage puts planes some hundredths of a millimetre from where they are said to be, and a board may be tilted or
inaccurately printed. A network that follows such errors bends between the planes, and cameras agree on wrong depths.

What tells the board from the lens: rays are straight in the fluid. So the departure of a real camera from a thin lens,
as a displacement on the array, is a(s, t, u, v) + z b(s, t, u, v) with smooth a and b, linear in the depth z along the
camera's axis for given (s, t, u, v), apart from the magnification. Errors of planes and dots do not have this form. The
fit is a linear mixed model ([1]_): free coefficients of a and b for each camera, and errors of the board as random
effects, with one variance for each kind of error. A kind that does not raise the likelihood significantly has variance
0, so that its errors are 0.

No camera can tell a moved, scaled or sheared world. So shifts have no part that is constant or linear in z, rotations
no constant part, and errors of dots no part that is constant or linear in x and y.

References
----------
.. [1] H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
       58, 545-554 (1971).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.board.errors import COMPONENTS, KINDS, BoardErrors
from lfpiv.calibration.thin_lens_model import ThinLensModel
from lfpiv.lightfield.decoder import NORMAL_MAD

FIRST_STD = {"depth": 0.05, "shift": 0.05, "tilt": 0.005, "rotation": 0.005, "dots": 0.005}
"""Standard deviation of each kind of error from which the fit starts [mm or rad]."""
STD_RANGE = (1e-4, 1e2)
"""Range of a fitted standard deviation, relative to `FIRST_STD`."""
FIRST_NOISE_MM = 1e-4
"""Noise of chief rays and slopes from which the fit starts [mm]. So small that the errors of the board start free."""
RANK_TOLERANCE = 1e-9
"""Singular value below which the dots do not determine a combination of smooth terms, relative to the largest one."""
LEAST_FREEDOM = 0.1
"""Least share of a row that is taken for its freedom."""
SIGNIFICANT = 10.8
"""Twice the gain of the logarithmic likelihood by a kind of error that chance exceeds once in 1,000 boards."""
OUTLIER = 4.0
"""Residual that has a quarter of the full weight [robust standard deviations]."""
PASSES, ROUNDS = 2, 6
"""Linearisations about the corrected positions, and rounds of weights in each."""
ORDERS = (4, 3, 2, 1)
"""Orders in (s, t) of the cameras' smooth departure, best first."""
DOTS_PER_TERM = 6
"""Least number of dots for each term of the departure of chief rays. Fewer dots lower the order."""
PLANE_ERROR_PITCH = 0.002
"""Error that a camera's labels of one plane share, of chief rays and of slopes to the pupil's edge [pitch]."""
LEAST_LABELS = 10
"""Least number of labels of a dot."""
BELIEVED = 0.5
"""Error of a plane above which its image is taken for another plane's, and not used [distance of the planes]."""
LEAST_PLANES = 3
"""Least number of planes. Two planes show no error that a sheared world does not show."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraLabels:
    """Labels of one camera, and the thin lens fitted to them."""

    dots: BoardDots
    """Labels with their dots."""
    lens: ThinLensModel
    """Thin lens fitted to the labels."""
    pupil_radius_mm: float
    """Radius of the main lens's pupil [mm]."""
    pitch_mm: float
    """Microlens pitch [mm]."""


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
    data = [_CameraData.from_labels(camera) for camera in cameras]
    believed = np.full(len(board.planes_mm), True)
    limit = BELIEVED * float(np.median(np.diff(np.sort(board.planes_mm)))) if len(believed) > 1 else 0.0
    while True:
        found = _fit_planes([part.of_planes(believed, board) for part in data], board)
        wrong = (np.abs(found.plane[:, :3]) > limit).any(1)
        if not wrong.any():
            return found
        believed &= ~wrong


def _fit_planes(data: Sequence[_CameraData], board: DotBoard) -> BoardErrors:
    """Fit the errors of the board, linearised about the positions that are corrected so far."""
    found = _no_errors(board)
    effects = _Effects.of(board, np.concatenate([part.dot for part in data]))
    if effects is None:
        return found
    values = np.zeros(effects.size)
    for _ in range(PASSES):
        systems = [_System.of(part, effects, board, found, values) for part in data]
        known = [system for system in systems if system is not None]
        if not known:
            break
        effects, values, found = _fit_effects(known, effects, found)
        if not found.corrected:
            break
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
class _CameraData:
    """Dots of one camera: the ray model of each, linear in the pupil point."""

    lens: ThinLensModel
    pupil_radius_mm: float
    pitch_mm: float
    dot: np.ndarray  # numbers of the dots, (d,)
    rays: np.ndarray  # position of the chief ray, slopes along u and v to the pupil's edge [mm], (d, 3, 2)
    variance: np.ndarray  # relative variance of the chief ray and of the slopes, (d, 2)

    @classmethod
    def from_labels(cls, camera: CameraLabels) -> _CameraData:
        """Fit a quadratic of the pupil point to the labels of each dot, and cubic terms that all dots share."""
        dots, radius = camera.dots, camera.pupil_radius_mm
        number, first, count = np.unique(dots.dot, return_index=True, return_counts=True)
        enough = count >= LEAST_LABELS
        parts = [slice(start, start + n) for start, n in zip(first[enough], count[enough], strict=True)]
        terms = _pupil_terms(dots.pupil_mm / radius)
        bases = [np.linalg.qr(terms[part, :6]) for part in parts]
        beyond = [_without(basis.Q, np.hstack([terms[part, 6:], dots.array_mm[part]]))
                  for part, basis in zip(parts, bases, strict=True)]  # fmt: skip
        stacked = np.concatenate([np.empty((0, terms.shape[1] - 4)), *beyond])
        shared = np.linalg.lstsq(stacked[:, :-2], stacked[:, -2:], rcond=None)[0]
        rays, variance = np.empty((len(parts), 3, 2)), np.empty((len(parts), 2))
        for k, (part, basis) in enumerate(zip(parts, bases, strict=True)):
            inverse = np.linalg.pinv(basis.R)
            quadratic = dots.array_mm[part] - terms[part, 6:] @ shared
            rays[k] = (inverse @ (basis.Q.T @ quadratic))[:3]
            spread = (inverse**2).sum(1) * (part.stop - part.start) * np.mean(dots.std_mm[part] ** 2)
            variance[k] = spread[0], spread[1:3].mean()
        variance = (1 + variance / np.median(variance, axis=0)) / 2 if len(parts) else variance
        return cls(
            lens=camera.lens, pupil_radius_mm=radius, pitch_mm=camera.pitch_mm,
            dot=number[enough], rays=rays, variance=variance,
        )  # fmt: skip

    def of_planes(self, planes: np.ndarray, board: DotBoard) -> _CameraData:
        """Return the dots of some planes, given as bool, shape (plane,)."""
        here = planes[self.dot // board.size]
        return replace(self, dot=self.dot[here], rays=self.rays[here], variance=self.variance[here])


def _pupil_terms(pupil: np.ndarray) -> np.ndarray:
    """Return the ten terms of a cubic of the pupil point, in rising order."""
    u, v = pupil.T
    return np.stack([u**0, u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)


def _without(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the part of columns that is orthogonal to a basis."""
    rest: np.ndarray = columns - basis @ (basis.T @ columns)
    return rest


@dataclass(frozen=True, kw_only=True, eq=False)
class _Effects:
    """Unknown errors of the board: coefficients of bases without what a moved or sheared world shows as well."""

    kind: np.ndarray  # number of each unknown's kind in `KINDS`, (size,)
    plane: np.ndarray  # errors of the planes per unknown, (plane, 6, size)
    site: np.ndarray  # errors of the dots along x and y per unknown [mm], (site, 2, size)
    used_planes: np.ndarray  # planes with dots, (plane,), bool
    used_sites: np.ndarray  # sites with dots, (site,), bool

    @property
    def size(self) -> int:
        return len(self.kind)

    @classmethod
    def of(cls, board: DotBoard, dot: np.ndarray) -> _Effects | None:
        """Return the unknowns that the dots can show; None if there are too few planes."""
        planes, sites = (np.unique(part) for part in np.divmod(dot, board.size))
        if len(planes) < LEAST_PLANES:
            return None
        depth = np.array(board.planes_mm, float)[planes]
        line = np.stack([np.ones(len(planes)), depth - depth.mean()], axis=1)
        shifts, rotations = _complement(line), _complement(line[:, :1])
        place = board.points_mm(0)[sites, :2]
        scatter = _complement(np.hstack([np.ones((len(sites), 1)), place]))
        bases = [(c, kind, shifts if c < 3 else rotations) for kind, part in COMPONENTS.items() for c in part]
        bases.sort(key=lambda entry: KINDS.index(entry[1]))
        size = sum(basis.shape[1] for _, _, basis in bases) + 2 * scatter.shape[1]
        plane, site = np.zeros((len(board.planes_mm), 6, size)), np.zeros((board.size, 2, size))
        kinds: list[int] = []
        for component, kind, basis in bases:
            plane[planes, component, len(kinds) : len(kinds) + basis.shape[1]] = basis
            kinds += [KINDS.index(kind)] * basis.shape[1]
        for axis in range(2):
            site[sites, axis, len(kinds) : len(kinds) + scatter.shape[1]] = scatter
            kinds += [KINDS.index("dots")] * scatter.shape[1]
        return cls(
            kind=np.array(kinds), plane=plane, site=site,
            used_planes=np.isin(np.arange(len(plane)), planes), used_sites=np.isin(np.arange(len(site)), sites),
        )  # fmt: skip

    def as_most_planes(self, values: np.ndarray, depth: np.ndarray) -> _Effects:
        """Return the unknowns with the moved world chosen in which most planes stand where they are stated to be.

        Least squares would move the world towards a single plane that is far off.
        """
        plane = self.plane.copy()
        used = self.used_planes
        for component in range(6):
            line = np.stack([np.ones(used.sum()), depth[used]], axis=1)[:, : 2 if component < 3 else 1]
            basis = self.plane[used, component]
            error = rest = basis @ values
            share = np.zeros((line.shape[1], len(error)))
            for _ in range(ROUNDS):
                typical = max(float(np.median(np.abs(rest))), np.finfo(float).tiny)
                weighted = line / np.maximum(np.abs(rest) / typical, 1)[:, None]
                share = np.linalg.solve(weighted.T @ line, weighted.T)
                rest = error - line @ (share @ error)
            plane[used, component] = basis - line @ (share @ basis)
        return replace(self, plane=plane)

    def displacement(self, board: DotBoard, dot: np.ndarray) -> np.ndarray:
        """Return the displacement of dots per unknown [mm], shape (n, 3, size)."""
        plane, site = np.divmod(dot, board.size)
        x, y = board.points_mm(0)[site, :2, None].transpose(1, 0, 2)
        error = self.plane[plane]
        moved = error[:, :3].copy()
        moved[:, :2] += self.site[site]
        moved[:, 0] -= error[:, 5] * y
        moved[:, 1] += error[:, 5] * x
        moved[:, 2] += error[:, 3] * y - error[:, 4] * x
        return moved


def _complement(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the vectors orthogonal to columns."""
    left, strength, _ = np.linalg.svd(columns)
    rank = int((strength > 1e-9 * strength[0]).sum())
    rest: np.ndarray = left[:, rank:]
    return rest


@dataclass(frozen=True, kw_only=True, eq=False)
class _System:
    """Linear equations of one camera: departure from the thin lens = smooth terms + errors of the board + noise.

    Rows are the chief rays of all dots and their slopes along u and v. An error that the camera's labels of one plane
    share has a column in `smooth` and a row of its own, which states that it is 0 within `PLANE_ERROR_PITCH`.
    """

    smooth: np.ndarray  # (3d + 3 planes, terms + 3 planes)
    effects: np.ndarray  # for s and t, (2, 3d + 3 planes, size)
    departure: np.ndarray  # for s and t [mm], (2, 3d + 3 planes)
    variance: np.ndarray  # variance of the rows, relative to the noise's where there is one, (3d + 3 planes,)
    kind: np.ndarray  # 0 for chief rays, 1 for slopes, 2 for the statements, (3d + 3 planes,)

    @classmethod
    def of(
        cls, data: _CameraData, effects: _Effects, board: DotBoard, found: BoardErrors, values: np.ndarray
    ) -> _System | None:
        """Linearise about the positions that are corrected by `values`; None if there are too few dots."""
        count = len(data.dot)
        points = found.points_mm(board, data.dot)
        rays, jacobian, depth = _thin_lens_rays(data.lens, points, data.pupil_radius_mm)
        smooth = _smooth_terms(data.rays, depth, data.lens)
        if smooth is None:
            return None
        moved = np.einsum("dkaj,djp->akdp", jacobian, effects.displacement(board, data.dot)).reshape(2, 3 * count, -1)
        departure = (data.rays - rays).transpose(2, 1, 0).reshape(2, -1) + moved @ values
        planes, plane = np.unique(data.dot // board.size, return_inverse=True)
        stated = 3 * len(planes)
        shared = np.kron(np.eye(3), np.eye(len(planes))[plane])
        return cls(
            smooth=np.block([[smooth, shared], [np.zeros((stated, smooth.shape[1])), np.eye(stated)]]),
            effects=np.pad(moved, ((0, 0), (0, stated), (0, 0))),
            departure=np.pad(departure, ((0, 0), (0, stated))),
            variance=np.append(
                data.variance[:, [0, 1, 1]].T.ravel(), np.full(stated, (PLANE_ERROR_PITCH * data.pitch_mm) ** 2)
            ),
            kind=np.repeat([0, 1, 2], [count, 2 * count, stated]),
        )


def _thin_lens_rays(
    lens: ThinLensModel, points: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return chief rays and slopes of a thin lens (d, 3, 2), their derivative by the point (d, 3, 2, 3), the depth."""
    local = (points - lens.offset_mm) @ lens.rotation.T
    magnification = lens.image_distance_mm / (lens.object_distance_mm - local[:, 2])
    rise = (magnification**2 / lens.image_distance_mm)[:, None] * lens.rotation[2]  # of the magnification, (d, 3)
    gain = lens.pupil_scale * (1 - lens.image_distance_mm / lens.focal_length_mm + magnification)
    rays, jacobian = np.zeros((len(points), 3, 2)), np.zeros((len(points), 3, 2, 3))
    rays[:, 0] = lens.array_offset_mm - magnification[:, None] * local[:, :2]
    rays[:, 1, 0] = rays[:, 2, 1] = gain * radius
    jacobian[:, 0] = -magnification[:, None, None] * lens.rotation[:2] - local[:, :2, None] * rise[:, None]
    jacobian[:, 1, 0] = jacobian[:, 2, 1] = lens.pupil_scale * radius * rise
    return rays, jacobian, local[:, 2]


def _smooth_terms(rays: np.ndarray, depth: np.ndarray, lens: ThinLensModel) -> np.ndarray | None:
    """Return the columns of the camera's smooth departure, shape (3d, terms); None for too few dots.

    The terms are s^i t^j u^k v^l and the same times the depth, all times the magnification. Slopes are the total
    derivative by u or v, for (s, t) moves with (u, v) along the rays of a dot.
    """
    chief = rays[:, 0]
    half = np.maximum(np.ptp(chief, axis=0) / 2, 1e-9)
    place, slope = (chief - chief.min(0)) / half - 1, rays[:, 1:] / half
    z = (depth - depth.mean()) / max(float(np.ptp(depth)) / 2, 1e-9)
    magnification = lens.object_distance_mm / (lens.object_distance_mm - depth)
    for order in ORDERS:
        powers = [_powers(order - lower, order - lower - 2) for lower in range(2)]
        if DOTS_PER_TERM * sum(p[2] == p[3] == 0 for part in powers for p in part) > len(rays):
            continue
        columns = []
        for part, factor in zip(powers, (magnification, magnification * z), strict=True):
            columns += [(_term(place, slope, power) * factor).ravel() for power in part]
        return np.stack(columns, axis=1)
    return None


def _powers(order: int, slope_order: int) -> list[tuple[int, int, int, int]]:
    """Return powers of (s, t, u, v): of chief rays up to `order`, of slopes up to `slope_order`, at least 0."""
    places = [(i, j) for i, j in itertools.product(range(order + 1), repeat=2) if i + j <= order]
    slopes = [(i, j) for i, j in places if i + j <= max(slope_order, 0)]
    return [(i, j, 0, 0) for i, j in places] + [(i, j, k, 1 - k) for i, j in slopes for k in (1, 0)]


def _term(place: np.ndarray, slope: np.ndarray, power: tuple[int, int, int, int]) -> np.ndarray:
    """Return a term at the chief rays and its derivatives along u and v, shape (3, d)."""
    (s, t), (i, j, k, _) = place.T, power
    value = s**i * t**j
    rows = np.zeros((3, len(place)))
    if power[2] == power[3] == 0:
        by_place = np.stack([i * s ** max(i - 1, 0) * t**j, j * s**i * t ** max(j - 1, 0)], axis=1)
        rows[0] = value
        rows[1:] = np.einsum("dka,da->kd", slope, by_place)
    else:
        rows[1 if k else 2] = value
    return rows


@dataclass(frozen=True, kw_only=True, eq=False)
class _Weighted:
    """Equations of one camera with weights, after the smooth terms are eliminated."""

    root: np.ndarray  # square root of the weights [1/mm], (rows,)
    basis: np.ndarray  # orthonormal basis of the weighted smooth terms, (rows, terms)
    effects: np.ndarray  # (2, rows, size)
    departure: np.ndarray  # (2, rows)

    @classmethod
    def of(cls, system: _System, noise: np.ndarray, robust: np.ndarray) -> _Weighted:
        """Weight by the noise of each kind of row [mm], and by the robust weights of the rows."""
        root = np.sqrt(robust / system.variance) / noise[system.kind]
        left, strength, _ = np.linalg.svd(system.smooth * root[:, None], full_matrices=False)
        basis = left[:, strength > RANK_TOLERANCE * strength[0]]
        return cls(
            root=root,
            basis=basis,
            effects=np.stack([_without(basis, part * root[:, None]) for part in system.effects]),
            departure=np.stack([_without(basis, part * root) for part in system.departure]),
        )

    def residual(self, values: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Return the residuals in standard deviations, freed of the part that the unknowns take, shape (2, rows)."""
        taken = (self.basis**2).sum(1) + ((self.effects @ covariance) * self.effects).sum(2)
        rest = self.departure - self.effects @ values
        scaled: np.ndarray = rest / np.sqrt(np.maximum(1 - taken, LEAST_FREEDOM))
        return scaled


@dataclass(frozen=True, kw_only=True, eq=False)
class _Normal:
    """Normal equations of the errors of the board, and kinds of errors in them."""

    gram: np.ndarray  # (size, size)
    right: np.ndarray  # (size,)
    kind: np.ndarray  # number of each unknown's kind, (size,)

    @classmethod
    def of(cls, weighted: Sequence[_Weighted], kind: np.ndarray) -> _Normal:
        gram = sum((part.T @ part for camera in weighted for part in camera.effects), np.zeros((len(kind), len(kind))))
        right = sum(
            (part.T @ y for camera in weighted for part, y in zip(camera.effects, camera.departure, strict=True)),
            np.zeros(len(kind)),
        )
        return cls(gram=gram, right=right, kind=kind)

    def solve(self, std: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the errors given the standard deviations of some kinds, their covariance, and the log likelihood.

        Errors of other kinds are 0. The log likelihood is relative to that of a board without errors.
        """
        prior = np.array([std.get(kind, 0.0) for kind in KINDS])[self.kind]
        has = prior > 0
        values, covariance = np.zeros(len(prior)), np.zeros((len(prior), len(prior)))
        if not has.any():
            return values, covariance, 0.0
        scale, right = prior[has], self.right[has] * prior[has]
        matrix = self.gram[np.ix_(has, has)] * np.outer(scale, scale) + np.eye(len(scale))
        factor = cho_factor(matrix)
        values[has] = scale * cho_solve(factor, right)
        covariance[np.ix_(has, has)] = cho_solve(factor, np.eye(len(scale))) * np.outer(scale, scale)
        likelihood = right @ cho_solve(factor, right) / 2 - np.log(factor[0].diagonal()).sum()
        return values, covariance, float(likelihood)

    def best_std(self, start: Mapping[str, float]) -> dict[str, float]:
        """Return the standard deviations of the kinds in `start` that are most likely."""
        kinds = list(start)
        if not kinds:
            return {}
        unit = np.array([FIRST_STD[kind] for kind in kinds])

        members = [self.kind == KINDS.index(kind) for kind in kinds]

        def cost(logarithm: np.ndarray) -> tuple[float, np.ndarray]:
            std = unit * np.exp(logarithm)
            values, covariance, likelihood = self.solve(dict(zip(kinds, std, strict=True)))
            second = values**2 + covariance.diagonal()
            gradient = [second[of].sum() / s**2 - of.sum() for of, s in zip(members, std, strict=True)]
            return -likelihood, -np.array(gradient)

        first = np.clip(np.log(np.array(list(start.values())) / unit), *np.log(STD_RANGE))
        limits = [tuple(np.log(STD_RANGE))] * len(kinds)
        best = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=limits)
        return {kind: float(value) for kind, value in zip(kinds, unit * np.exp(best.x), strict=True)}

    def significant_std(self, std: Mapping[str, float]) -> dict[str, float]:
        """Leave out kinds one by one, the least likely first, until all are significant."""
        std = dict(std)
        while std:
            whole = self.solve(std)[2]
            gain = {kind: 2 * (whole - self.solve({k: v for k, v in std.items() if k != kind})[2]) for kind in std}
            weakest = min(gain, key=gain.__getitem__)
            if gain[weakest] > SIGNIFICANT:
                break
            del std[weakest]
            std = self.best_std(std)
        return std


def _fit_effects(
    systems: Sequence[_System], effects: _Effects, board: BoardErrors
) -> tuple[_Effects, np.ndarray, BoardErrors]:
    """Fit the errors of the board with robust weights, and keep the kinds of errors that are significant."""
    noise = [np.array([FIRST_NOISE_MM, FIRST_NOISE_MM, 1.0]) for _ in systems]
    robust = [np.ones(len(system.variance)) for system in systems]
    std: dict[str, float] = dict(FIRST_STD)
    for _ in range(ROUNDS):
        weighted = [_Weighted.of(*camera) for camera in zip(systems, noise, robust, strict=True)]
        normal = _Normal.of(weighted, effects.kind)
        std = normal.best_std(std)
        values, covariance, _ = normal.solve(std)
        for k, (system, camera) in enumerate(zip(systems, weighted, strict=True)):
            residual = np.abs(camera.residual(values, covariance)) / np.sqrt(robust[k])
            scatter = [NORMAL_MAD * float(np.median(residual[:, system.kind == kind])) for kind in range(2)]
            scale = np.array([*scatter, 1.0])
            noise[k] = noise[k] * scale
            robust[k] = _robust_weights(residual / scale[system.kind], system.kind)
    kept = normal.significant_std(std)
    values, covariance, _ = normal.solve(kept)
    _, known, _ = normal.solve(FIRST_STD)  # of kinds that are not corrected: what the labels could show
    corrected = np.isin(effects.kind, [KINDS.index(kind) for kind in kept])
    known[np.ix_(corrected, corrected)] = covariance[np.ix_(corrected, corrected)]
    effects = effects.as_most_planes(values, board.planes_mm)
    plane_std, dot_std = (np.sqrt(((part @ known) * part).sum(2)) for part in (effects.plane, effects.site))
    return (
        effects,
        values,
        replace(
            board,
            plane=effects.plane @ values,
            plane_std=np.where(effects.used_planes[:, None], plane_std, np.nan),
            dot_mm=effects.site @ values,
            dot_std_mm=np.where(effects.used_sites[:, None], dot_std, np.nan),
            corrected=tuple(kept),
        ),
    )


def _robust_weights(residual: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return Geman and McClure's weights of the rows, alike for both coordinates and both slopes of a dot."""
    square = (residual**2).mean(0)[kind < 2].reshape(3, -1)
    square[1:] = square[1:].mean(0)
    weights = np.ones(len(kind))
    weights[kind < 2] = (1 / (1 + square / OUTLIER**2) ** 2).ravel()
    return weights
