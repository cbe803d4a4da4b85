"""Volume self-calibration: correct a calibration for cameras that moved since the board was recorded [1]_.

Input: a calibration, the grid, and particle images of some instants. Rigid movements, six numbers per camera, are
fitted to the disparities of the cameras (`lfpiv.selfcalibration.disparity`). The mean movement of all cameras is set to
zero: it cannot be distinguished from a moved volume. Only what exceeds its standard error clearly is corrected. Output:
the corrected calibration, the movements and their standard errors. Focused images allow triangulation instead;
light-field images do not.

.. [1] B. Wieneke, "Volume self-calibration for 3D particle image velocimetry", Exp. Fluids 45 (2008) 549-556,
   doi:10.1007/s00348-008-0521-5.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats
from scipy.spatial.transform import Rotation

from lfpiv.calibration.camera import Calibration
from lfpiv.geometry.grid import Grid
from lfpiv.progress import StepProgress, part_of
from lfpiv.selfcalibration.disparity import SEARCH_VOXEL, Disparity, disparities, unlinked
from lfpiv.weights.operator import build_weights

PRIOR_MM, PRIOR_RAD = 0.3, 0.02
"""Standard deviations of the prior: shift [mm] and rotation [rad]."""
LEAST_STD_VOXEL, ASSUMED_STD_VOXEL, ASSUMED_WEIGHT = 0.02, 0.2, 3.0
"""Least standard deviation of a disparity in its sharpest direction, the one assumed before it is measured [voxel], and
the number of disparities that the assumption counts for."""
CONVERGED_VOXEL = 0.05
"""Observable movement of the cameras against each other below which the self-calibration ends [voxel]."""
ROUNDS = 4
"""Largest number of corrections."""
FITS = 10
"""Number of reweighted solutions of a fit."""
CHANCE = 0.00135
"""Probability of an insignificant movement: that of three standard errors if these were known exactly."""
MOST_SIGMAS = 5.0
"""Largest limit of an insignificant movement [standard errors]: part of the variance is assumed, not estimated."""
LOWERED_SIGMAS = 3.0
"""Least decrease of a significant distance by which a correction counts [standard errors]."""
LEAST_VARIANCE = 1e-9
"""Least variance of a movement of the cameras against each other, as a share of the largest one."""
LEFT_OUT = 8
"""Largest number of groups of disparities that are left out in turn."""
OUTLIER = 2.0
"""Residual at which a disparity's weight is a quarter, as a multiple of 1.5 times the median residual."""
LIKE = 0.5
"""Least share of the movements shown by all images together in the movements that a part of them shows alone."""
AGREEING = 2
"""Least number of parts that agree on cameras that moved: chance peaks differ from part to part."""


@dataclass(frozen=True, kw_only=True)
class Movement:
    """Movement of a camera since its calibration, expressed as a rigid movement of the points that it sees.

    The camera sees a point x where its mapping has ``rotation (x - centre) + centre + shift``.
    """

    shift_mm: np.ndarray
    """Shift along x, y, z, shape (3,) [mm]."""
    rotation_rad: np.ndarray
    """Rotation vector about `centre_mm`, shape (3,) [rad]."""
    centre_mm: np.ndarray
    """Centre of the volume, shape (3,) [mm]."""
    std: np.ndarray
    """Standard errors of shift [mm] and rotation [rad], shape (6,)."""

    @property
    def affine(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation matrix R and shift t [mm] of the same movement, ``R x + t``."""
        rotation = Rotation.from_rotvec(self.rotation_rad).as_matrix()
        return rotation, self.centre_mm + self.shift_mm - rotation @ self.centre_mm

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Move points (n, 3) [mm]."""
        rotation, shift = self.affine
        moved: np.ndarray = points_mm @ rotation.T + shift
        return moved

    @classmethod
    def none(cls, grid: Grid) -> Movement:
        """Return the movement of a camera that did not move."""
        return cls(shift_mm=np.zeros(3), rotation_rad=np.zeros(3), centre_mm=grid.centre_mm, std=np.zeros(6))

    def after(self, step: Movement) -> Movement:
        """Return the movement that applies `step` first, then this one."""
        outer, inner = (Rotation.from_rotvec(one.rotation_rad) for one in (self, step))
        shift = self(step(self.centre_mm[None]))[0] - self.centre_mm
        return replace(self, shift_mm=shift, rotation_rad=(outer * inner).as_rotvec())


@dataclass(frozen=True, kw_only=True)
class Separation:
    """Observable distance at which the cameras show the same particles, root mean square over the volume."""

    mm: float
    """Distance without the part that its own errors make [mm]."""
    std_mm: float
    """Standard error [mm]."""
    sigmas: float
    """Least significant distance [standard errors]: 3, and more if they were estimated from few disparities."""

    @property
    def significant(self) -> bool:
        """Whether errors of the disparities hardly explain the distance."""
        return self.mm > self.sigmas * self.std_mm

    def differs_from(self, limit_mm: float) -> bool:
        """Return whether the distance is clearly above or clearly below a limit."""
        return abs(self.mm - limit_mm) > self.sigmas * self.std_mm


@dataclass(frozen=True, kw_only=True)
class MovementFit:
    """Rigid movements of all cameras that explain disparities, from `fit_movements`."""

    cameras: tuple[str, ...]
    centre_mm: np.ndarray
    """Centre of the volume, shape (3,) [mm]."""
    values: np.ndarray
    """Shift [mm] and rotation vector of each camera, shape (6 cameras,)."""
    covariance: np.ndarray
    """Covariance of `values`, those of all cameras against their mean."""
    observed: np.ndarray
    """Mean over the disparities of the matrix whose quadratic form with `values` is the squared observable distance."""
    freedom: float
    """Degrees of freedom of the covariance's scale."""
    scatter_mm: float = 0.0
    """Standard error of the observable distance by fits without some of the disparities [mm]."""

    @property
    def separation(self) -> Separation:
        """Observable distance of the cameras that the movements explain."""
        square = float(self.values @ self.observed @ self.values)
        by_errors = float(np.trace(self.observed @ self.covariance))
        slope = self.observed @ self.values
        spread = float(slope @ self.covariance @ slope)
        std = np.sqrt(spread / square) if square > by_errors else np.sqrt(by_errors)
        std_mm = max(float(std), self.scatter_mm)
        return Separation(mm=float(np.sqrt(max(square - by_errors, 0.0))), std_mm=std_mm, sigmas=self.sigmas)

    @property
    def sigmas(self) -> float:
        """Least significant movement [standard errors]."""
        return min(float(scipy.stats.t.isf(CHANCE, self.freedom)), MOST_SIGMAS)

    @property
    def movements(self) -> dict[str, Movement]:
        """Camera name -> its movement."""
        std = np.sqrt(np.diag(self.covariance)).reshape(-1, 6)
        return {
            name: Movement(shift_mm=value[:3], rotation_rad=value[3:], centre_mm=self.centre_mm, std=std[number])
            for number, (name, value) in enumerate(zip(self.cameras, self.values.reshape(-1, 6), strict=True))
        }

    def significant_directions(self, reach_mm: float) -> np.ndarray:
        """Return the projection onto those movements that exceed their standard errors, shape (6 cameras, 6 cameras).

        Movements are judged along the principal axes of the covariance, rotations counted by the distance that they
        move a point at `reach_mm` from the centre.
        """
        scale = np.tile(np.repeat([1.0, reach_mm], 3), len(self.cameras))
        variance, axes = np.linalg.eigh(self.covariance * np.outer(scale, scale))
        along = axes.T @ (scale * self.values)
        kept = along**2 > self.sigmas**2 * np.maximum(variance, 0)
        kept &= variance > LEAST_VARIANCE * variance[-1]  # the mean movement has none
        projection: np.ndarray = (axes[:, kept] @ axes[:, kept].T) * scale / scale[:, None]
        return projection

    def projected(self, projection: np.ndarray) -> MovementFit:
        """Return the movements after a projection, shape (6 cameras, 6 cameras)."""
        return replace(self, values=projection @ self.values)

    def since(self, other: MovementFit) -> MovementFit:
        """Return these movements less the movements of another fit, to other images."""
        return replace(
            self,
            values=self.values - other.values,
            covariance=self.covariance + other.covariance,
            observed=(self.observed + other.observed) / 2,
            freedom=min(self.freedom, other.freedom),
            scatter_mm=float(np.hypot(self.scatter_mm, other.scatter_mm)),
        )

    def share_in(self, other: MovementFit) -> float:
        """Return how much of these movements another fit shows: 1 if they are equal, -1 if opposite."""
        along = self.observed @ self.values
        return float(along @ other.values / (along @ self.values))

    def agrees_with(self, parts: Iterable[MovementFit]) -> bool:
        """Return whether several fits, each to a part of the images alone, show about these movements."""
        return sum(self.share_in(one) > LIKE for one in parts) >= AGREEING

    @property
    def explained_mm(self) -> float:
        """Observable distance of the cameras, with the part that errors make [mm]."""
        return float(np.sqrt(self.values @ self.observed @ self.values))


class Verdict(enum.Enum):
    """Outcome of a self-calibration."""

    UNMOVED = "cameras did not move"
    CORRECTED = "corrected"
    NOT_LOWERED = "no correction brings the cameras significantly nearer to each other"
    NOTHING_IN_COMMON = "no images show the same particles in all cameras"


@dataclass(frozen=True, kw_only=True)
class SelfCalibration:
    """Corrected calibration, and the disparities before and after."""

    calibration: Calibration
    """The corrected calibration; the given one if the cameras did not move or no correction helps."""
    movements: dict[str, Movement]
    """Camera name -> its movement; the mean of all cameras is zero."""
    verdict: Verdict
    before: tuple[Disparity, ...]
    """Disparities with the original calibration."""
    after: tuple[Disparity, ...]
    """Disparities with the calibration of the result."""
    apart: tuple[Separation, ...]
    """Distances of the cameras: before, and after each correction."""


def self_calibrate(
    calibration: Calibration,
    grid: Grid,
    images: Sequence[Mapping[str, np.ndarray]],
    *,
    progress: StepProgress | None = None,
) -> SelfCalibration:
    """Correct a calibration for movements of its cameras, using images of particles.

    The calibration stays as it is if no movement is significant, or if no correction lowers the distance of the cameras
    significantly.

    Parameters
    ----------
    calibration : Calibration
        Calibration of two or more cameras.
    grid : Grid
        The volume.
    images : sequence of dict
        Particle images of some instants, camera name -> image (rows, columns), background removed; see
        `lfpiv.selfcalibration.disparity.without_still_light`.
    progress : callable, optional
        Called with the finished fraction of the largest number of rounds.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    ValueError
        If there are fewer than two cameras, no images, or a camera shows no particle that another one shows.
    """
    if len(calibration.cameras) < 2 or not images:
        raise ValueError(
            f"calibration, images: expected two cameras or more and images, got {len(calibration.cameras)} cameras and "
            f"images of {len(images)} instants."
        )
    corrected, still = calibration, {name: Movement.none(grid) for name in calibration.cameras}
    movements, found, fits = still, list[tuple[Disparity, ...]](), list[MovementFit]()
    reach_mm = float(np.linalg.norm(np.array(grid.shape)) * grid.voxel_mm / 4)
    for number in range(ROUNDS + 1):
        part = None if progress is None else part_of(progress, number / (ROUNDS + 1), (number + 1) / (ROUNDS + 1))
        found.append(disparities(build_weights(corrected, grid), images, part))
        lost = unlinked(found[-1], movements)
        if lost:
            raise ValueError(
                f"images: expected particles that {' and '.join(lost)} and another camera show within {SEARCH_VOXEL} "
                "voxels of each other, found none: it moved by more, its images are of other instants, or show too few."
            )
        fits.append(fit_movements(found[-1], list(movements), grid))
        if number == 0:  # later rounds refine what is significant in the first one
            shown = fits[0].significant_directions(reach_mm) if fits[0].separation.significant else 0 * fits[0].observed
        step = fits[-1].projected(shown)
        if len(found) > ROUNDS or step.explained_mm < CONVERGED_VOXEL * grid.voxel_mm:
            break
        steps = step.movements
        movements = {name: movements[name].after(step) for name, step in steps.items()}
        moved = {name: calibration.cameras[name].moved(*move.affine) for name, move in movements.items()}
        corrected = replace(calibration, cameras=moved)
    verdict = _verdict([fit.separation for fit in fits])
    if verdict is not Verdict.CORRECTED:
        corrected, movements = calibration, still
    std = fits[-1].movements
    return SelfCalibration(
        calibration=corrected,
        movements={name: replace(move, std=std[name].std) for name, move in movements.items()},
        verdict=verdict,
        before=found[0],
        after=found[-1] if verdict is Verdict.CORRECTED else found[0],
        apart=tuple(fit.separation for fit in fits),
    )


def _verdict(apart: Sequence[Separation]) -> Verdict:
    """Judge corrections by the distances of the cameras before and after each of them."""
    if len(apart) == 1:
        return Verdict.UNMOVED
    before, after = apart[0], apart[-1]
    error = np.hypot(before.std_mm, after.std_mm)
    lowered = before.mm - after.mm > LOWERED_SIGMAS * error and after.mm < before.mm / 2
    return Verdict.CORRECTED if lowered else Verdict.NOT_LOWERED


def fit_movements(found: Sequence[Disparity], cameras: Sequence[str], grid: Grid) -> MovementFit:
    """Fit the rigid movements of cameras that explain disparities, by reweighted least squares.

    A disparity is the difference of two cameras' movements. Its weight is its `Disparity.weight` over the variance of
    the residuals. Outliers get less weight (Geman and McClure). A weak prior holds movements without an effect on
    disparities near zero, among them the mean of all cameras.

    Residuals say nothing of a movement that one disparity alone shows. So the standard error of the distance is at
    least what the jackknife gives, which leaves out disparities in turn.
    """
    whole = _fitted(found, cameras, grid)
    groups = min(len(found), LEFT_OUT)
    if groups < 2:
        return whole
    kept = ([one for number, one in enumerate(found) if number % groups != left] for left in range(groups))
    mm = np.array([_fitted(some, cameras, grid).explained_mm for some in kept])
    return replace(whole, scatter_mm=float(np.sqrt((groups - 1) * mm.var())))


def _fitted(found: Sequence[Disparity], cameras: Sequence[str], grid: Grid) -> MovementFit:
    """Fit as `fit_movements` does, without the jackknife."""
    rows = [_row(one, cameras, grid) for one in found]
    count, least = len(cameras), LEAST_STD_VOXEL * grid.voxel_mm
    prior = np.diag(np.tile(np.repeat([PRIOR_MM**-2.0, PRIOR_RAD**-2.0], 3), count))
    assumed = (ASSUMED_STD_VOXEL * grid.voxel_mm) ** 2
    variance, trust = assumed, np.ones(len(found))
    for _ in range(FITS):  # each solution gives the variance, and the weights of outliers
        information, right_side = np.zeros_like(prior), np.zeros(6 * count)
        for one, row, part in zip(found, rows, trust / variance, strict=True):
            information += part * row.T @ one.weight @ row
            right_side += part * row.T @ one.weight @ one.shift_mm
        covariance = np.linalg.inv(information + prior)
        values = covariance @ right_side
        residual = np.array(
            [one.observable_mm(one.shift_mm - row @ values) for one, row in zip(found, rows, strict=True)]
        )
        scale = max(1.5 * float(np.median(residual)), least)
        trust = (1 + (residual / (OUTLIER * scale)) ** 2) ** -2.0
        known = sum(part * float(np.trace(one.weight)) for one, part in zip(found, trust, strict=True))
        fitted = float(np.trace(covariance @ information))  # movements that disparities determine, without the prior's
        squares = float(trust @ residual**2) + ASSUMED_WEIGHT * assumed
        freedom = max(known - fitted, 0.0) + ASSUMED_WEIGHT
        variance = max(squares / freedom, least**2)
    relative = np.kron(np.eye(count) - 1 / count, np.eye(6))  # the mean of all cameras is zero by definition
    observed = sum(row.T @ one.weight @ row for one, row in zip(found, rows, strict=True)) / len(found)
    return MovementFit(
        cameras=tuple(cameras),
        centre_mm=grid.centre_mm,
        values=values,
        covariance=relative @ covariance @ relative.T,
        observed=np.asarray(observed),
        freedom=freedom,
    )


def _row(disparity: Disparity, cameras: Sequence[str], grid: Grid) -> np.ndarray:
    """Return the matrix from all cameras' shifts and rotations to a disparity, shape (3, 6 cameras)."""
    x, y, z = disparity.centre_mm - grid.centre_mm
    movement = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
    row = np.zeros((3, 6 * len(cameras)))
    for name, sign in zip(disparity.cameras, (-1, 1), strict=True):
        at = 6 * cameras.index(name)
        row[:, at : at + 6] = sign * movement
    return row
