"""Volume self-calibration: correct a calibration for cameras that moved since the board was recorded [1]_.

Input: a calibration, the grid, and particle images of some instants. Rigid movements, six numbers per camera, are
fitted to the disparities of the cameras (`lfpiv.selfcalibration.disparity`). The mean movement of all cameras is set to
zero: it cannot be distinguished from a moved volume. Output: the corrected calibration, the movements and their
standard errors. Focused images allow triangulation instead; light-field images do not.

.. [1] B. Wieneke, "Volume self-calibration for 3D particle image velocimetry", Exp. Fluids 45 (2008) 549-556,
   doi:10.1007/s00348-008-0521-5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lfpiv.calibration.camera import Calibration
from lfpiv.geometry.grid import Grid
from lfpiv.progress import StepProgress, part_of
from lfpiv.selfcalibration.disparity import SEARCH_VOXEL, Disparity, disparities, unlinked
from lfpiv.weights.operator import build_weights

PRIOR_MM, PRIOR_RAD = 0.3, 0.02
"""Standard deviations of the prior: shift [mm] and rotation [rad]."""
LEAST_STD_VOXEL, ASSUMED_STD_VOXEL = 0.02, 0.1
"""Least standard deviation of a disparity in its sharpest direction, and the one assumed if too few are known
[voxel]."""
CONVERGED_VOXEL = 0.05
"""Observable movement of the cameras against each other below which the self-calibration ends [voxel]."""
ROUNDS = 4
"""Largest number of corrections."""
FITS = 10
"""Number of reweighted solutions of a fit."""
OUTLIER = 2.0
"""Residual at which a disparity's weight is a quarter, as a multiple of 1.5 times the median residual."""


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
class SelfCalibration:
    """Corrected calibration, and the disparities before and after."""

    calibration: Calibration
    """The corrected calibration."""
    movements: dict[str, Movement]
    """Camera name -> its movement; the mean of all cameras is zero."""
    before: tuple[Disparity, ...]
    """Disparities with the original calibration."""
    after: tuple[Disparity, ...]
    """Disparities with the corrected calibration."""
    apart_mm: tuple[float, ...]
    """Root mean square of the explained disparities [mm], see `explained_mm`: before, and after each correction."""


def self_calibrate(
    calibration: Calibration,
    grid: Grid,
    images: Sequence[Mapping[str, np.ndarray]],
    *,
    progress: StepProgress | None = None,
) -> SelfCalibration:
    """Correct a calibration for movements of its cameras, using images of particles.

    Parameters
    ----------
    calibration : Calibration
        Calibration of two or more cameras.
    grid : Grid
        The volume.
    images : sequence of dict
        Particle images of some instants, camera name -> image (rows, columns), background removed.
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
    corrected = calibration
    movements = {name: Movement.none(grid) for name in calibration.cameras}
    found, apart = [], list[float]()
    for number in range(ROUNDS + 1):
        part = None if progress is None else part_of(progress, number / (ROUNDS + 1), (number + 1) / (ROUNDS + 1))
        found.append(disparities(build_weights(corrected, grid), images, part))
        lost = unlinked(found[-1], movements)
        if lost:
            raise ValueError(
                f"images: expected particles that {' and '.join(lost)} and another camera show within {SEARCH_VOXEL} "
                "voxels of each other, found none: it moved by more, its images are of other instants, or show too few."
            )
        steps = fit_movements(found[-1], list(movements), grid)
        apart.append(explained_mm(found[-1], steps, grid))
        if len(found) > ROUNDS or apart[-1] < CONVERGED_VOXEL * grid.voxel_mm:
            break
        movements = {name: movements[name].after(step) for name, step in steps.items()}
        moved = {name: calibration.cameras[name].moved(*move.affine) for name, move in movements.items()}
        corrected = replace(calibration, cameras=moved)
    return SelfCalibration(
        calibration=corrected,
        movements={name: replace(move, std=steps[name].std) for name, move in movements.items()},
        before=found[0],
        after=found[-1],
        apart_mm=tuple(apart),
    )


def fit_movements(found: Sequence[Disparity], cameras: Sequence[str], grid: Grid) -> dict[str, Movement]:
    """Fit the rigid movements of cameras that explain disparities, by reweighted least squares.

    A disparity is the difference of two cameras' movements. Its weight is its `Disparity.weight` over the variance of
    the residuals. Outliers get less weight (Geman and McClure). A weak prior holds movements without an effect on
    disparities near zero, among them the mean of all cameras.
    """
    rows = [_row(one, cameras, grid) for one in found]
    count, least = len(cameras), LEAST_STD_VOXEL * grid.voxel_mm
    prior = np.diag(np.tile(np.repeat([PRIOR_MM**-2.0, PRIOR_RAD**-2.0], 3), count))
    variance, trust = (ASSUMED_STD_VOXEL * grid.voxel_mm) ** 2, np.ones(len(found))
    for _ in range(FITS):  # each solution gives the variance, and the weights of outliers
        information, pull = prior.copy(), np.zeros(6 * count)
        for one, row, part in zip(found, rows, trust / variance, strict=True):
            information += part * row.T @ one.weight @ row
            pull += part * row.T @ one.weight @ one.shift_mm
        covariance = np.linalg.inv(information)
        values = covariance @ pull
        residual = np.array(
            [one.observable_mm(one.shift_mm - row @ values) for one, row in zip(found, rows, strict=True)]
        )
        scale = max(1.5 * float(np.median(residual)), least)
        trust = (1 + (residual / (OUTLIER * scale)) ** 2) ** -2.0
        free = 3 * trust.sum() - 6 * (count - 1)
        if free > 0:
            variance = max(float(trust @ residual**2) / free, least**2)
    relative = np.kron(np.eye(count) - 1 / count, np.eye(6))  # the mean of all cameras is zero by definition
    std = np.sqrt(np.diag(relative @ covariance @ relative.T)).reshape(-1, 6)
    return {
        name: Movement(shift_mm=value[:3], rotation_rad=value[3:], centre_mm=grid.centre_mm, std=std[number])
        for number, (name, value) in enumerate(zip(cameras, values.reshape(-1, 6), strict=True))
    }


def explained_mm(found: Sequence[Disparity], movements: Mapping[str, Movement], grid: Grid) -> float:
    """Return the root mean square of the observable disparities that movements explain [mm]."""
    values = np.concatenate([np.append(move.shift_mm, move.rotation_rad) for move in movements.values()])
    explained = [one.observable_mm(_row(one, list(movements), grid) @ values) for one in found]
    return float(np.sqrt(np.mean(np.square(explained))))


def _row(disparity: Disparity, cameras: Sequence[str], grid: Grid) -> np.ndarray:
    """Return the matrix from all cameras' shifts and rotations to a disparity, shape (3, 6 cameras)."""
    x, y, z = disparity.centre_mm - grid.centre_mm
    movement = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
    row = np.zeros((3, 6 * len(cameras)))
    for name, sign in zip(disparity.cameras, (-1, 1), strict=True):
        at = 6 * cameras.index(name)
        row[:, at : at + 6] = sign * movement
    return row
