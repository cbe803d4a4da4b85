"""Volume self-calibration: the particles tell whether the cameras still stand as they did before the board.

Each camera alone shows every particle, drawn out along its own view. Where two cameras' volumes match best is their
disparity [1]. A camera that was knocked has moved as a rigid body, so six numbers per camera explain the disparities of
the whole volume; what all cameras share cannot be told from a moved volume and stays as the board had it.
Triangulation, which does this for focused images, does not work for light-field images; correlating volumes does.

References
----------
[1] Wieneke, Volume self-calibration for 3D particle image velocimetry, Exp. Fluids 45, 549 (2008).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from lfpiv.camera import Calibration
from lfpiv.rig import Grid
from lfpiv.volume import reconstruct
from lfpiv.weights import Weights, build_weights

log = logging.getLogger(__name__)

ITERATIONS = 10
"""SMART iterations of each camera's own volume: lateral positions are there after a few."""
SMOOTHING_VOXEL = 1.0
"""Standard deviation of the Gaussian that volumes are smoothed by before they are correlated [voxel]."""
SEARCH_VOXEL = 16
"""Largest disparity searched for along each axis [voxel]."""
WINDOW_VOXEL, MOST_WINDOWS = 12, 3
"""Least edge of the windows into which the volume is cut, and how many there are along an axis at most: a rigid
movement needs no more."""
LEAST_OVERLAP = 0.6
"""Least part of a window that must lie within the other volume at a lag."""
FIT_REACH = 2
"""Lags to either side of the highest one that a peak's paraboloid is fitted to."""
SIGNIFICANT = 1.5
"""Least height of a peak over the highest one where one volume is mirrored, which no particle explains."""
PRIOR_MM, PRIOR_RAD = 0.3, 0.02
"""Movements that count as one standard deviation: what the particles do not tell stays near none."""
LEAST_STD_VOXEL, ASSUMED_STD_VOXEL = 0.02, 0.1
"""Least standard deviation of a disparity in its sharpest direction, and the one assumed where too few tell it."""
CONVERGED_VOXEL = 0.05
"""A round that moves cameras against each other by less, as far as their views tell, ends the self-calibration."""
ROUNDS = 4


@dataclass(frozen=True, kw_only=True)
class Movement:
    """How a camera moved since its calibration, as a rigid movement of the points that it sees.

    What lies at x it sees where its mapping has ``rotation (x - centre) + centre + shift``.
    """

    shift_mm: np.ndarray
    """Along x, y, z, shape (3,) [mm]."""
    rotation_rad: np.ndarray
    """Rotation vector about `centre_mm`, shape (3,) [rad]."""
    centre_mm: np.ndarray
    """Centre of the volume, shape (3,) [mm]."""
    std: np.ndarray
    """Standard errors of shift [mm] and rotation [rad], shape (6,)."""

    @property
    def affine(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation matrix R and shift t [mm] of the same movement as ``R x + t``."""
        rotation = Rotation.from_rotvec(self.rotation_rad).as_matrix()
        return rotation, self.centre_mm + self.shift_mm - rotation @ self.centre_mm

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Move points (n, 3) [mm]."""
        rotation, shift = self.affine
        moved: np.ndarray = points_mm @ rotation.T + shift
        return moved

    @classmethod
    def none(cls, grid: Grid) -> Movement:
        """Return that of a camera that stands still."""
        return cls(shift_mm=np.zeros(3), rotation_rad=np.zeros(3), centre_mm=_centre_mm(grid), std=np.zeros(6))

    def after(self, step: Movement) -> Movement:
        """Return the movement that begins with a step and goes on with this one."""
        outer, inner = (Rotation.from_rotvec(one.rotation_rad) for one in (self, step))
        shift = self(step(self.centre_mm[None]))[0] - self.centre_mm
        return replace(self, shift_mm=shift, rotation_rad=(outer * inner).as_rotvec())


@dataclass(frozen=True, kw_only=True)
class Disparity:
    """Disparity of two cameras in one part of the volume."""

    cameras: tuple[str, str]
    centre_mm: np.ndarray
    """Centre of the part, shape (3,) [mm]."""
    shift_mm: np.ndarray
    """Where the second camera shows what the first one shows at 0, shape (3,) [mm]."""
    sharpness: np.ndarray
    """Curvature of the peak over its height, shape (3, 3) [1/mm^2]: large where the views cross, small along both."""
    peak: float
    """Correlation coefficient."""
    rival: float
    """Highest coefficient with one volume mirrored."""

    @cached_property
    def weight(self) -> np.ndarray:
        """What a direction counts for, at most 1, shape (3, 3).

        The error of a peak grows with its width, and faster: along the views particles disturb each other's.
        """
        relative = self.sharpness / np.linalg.eigvalsh(self.sharpness)[-1]
        weight: np.ndarray = relative @ relative
        return weight

    def told_mm(self, shift_mm: np.ndarray) -> float:
        """Length of the part of a shift that the views tell [mm]."""
        return float(np.sqrt(shift_mm @ self.weight @ shift_mm))


@dataclass(frozen=True, kw_only=True)
class SelfCalibration:
    """What particles tell of a calibration, and the calibration that explains them."""

    calibration: Calibration
    """Corrected."""
    movements: dict[str, Movement]
    """Camera name -> how it moved; the mean of all cameras is none."""
    before: tuple[Disparity, ...]
    """Disparities with the calibration as it was."""
    after: tuple[Disparity, ...]
    """Disparities with the corrected one."""
    rounds: int
    """Corrections made one after the other."""


def self_calibrate(calibration: Calibration, grid: Grid, images: Sequence[Mapping[str, np.ndarray]]) -> SelfCalibration:
    """Correct a calibration for movements of its cameras, by images of particles.

    Parameters
    ----------
    calibration : Calibration
        Of two cameras or more.
    grid : Grid
        The volume.
    images : sequence of dict
        Particle images of some instants, camera name -> image (rows, columns), background removed.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    ValueError
        If there are fewer than two cameras, no images, or no disparity can be told from them.
    """
    if len(calibration.cameras) < 2 or not images:
        raise ValueError(
            f"calibration, images: expected two cameras or more and images, got {len(calibration.cameras)} cameras and "
            f"images of {len(images)} instants."
        )
    corrected = calibration
    movements = {name: Movement.none(grid) for name in calibration.cameras}
    found = []
    for _ in range(ROUNDS + 1):
        found.append(disparities(build_weights(corrected, grid), images))
        steps = fit_movements(found[-1], list(movements), grid)
        if len(found) > ROUNDS or explained_mm(found[-1], steps, grid) < CONVERGED_VOXEL * grid.voxel_mm:
            break
        movements = {name: movements[name].after(step) for name, step in steps.items()}
        corrected = Calibration(
            {name: calibration.cameras[name].moved(*move.affine) for name, move in movements.items()}
        )
    return SelfCalibration(
        calibration=corrected,
        movements={name: replace(move, std=steps[name].std) for name, move in movements.items()},
        before=found[0],
        after=found[-1],
        rounds=len(found) - 1,
    )


def disparities(weights: Weights, images: Sequence[Mapping[str, np.ndarray]]) -> tuple[Disparity, ...]:
    """Measure the disparities of all pairs of cameras in the parts of a volume, but for those that nothing tells.

    Parameters
    ----------
    weights : Weights
        Of two cameras or more.
    images : sequence of dict
        Particle images of some instants, camera name -> image (rows, columns), background removed.

    Raises
    ------
    ValueError
        If no part of the volume shows the same particles in any two cameras.
    """
    names, grid = list(weights.cameras), weights.grid
    alone: dict[str, list[np.ndarray]] = {}
    for name in names:
        one = weights.of_camera(name)
        volumes = (reconstruct(one, {name: instant[name]}, ITERATIONS).values for instant in images)
        alone[name] = [gaussian_filter(volume, SMOOTHING_VOXEL, mode="constant") for volume in volumes]
    found = []
    for first, second in combinations(names, 2):
        for window in _windows(grid):
            disparity = _disparity(alone[first], alone[second], window, grid, (first, second))
            if disparity is not None:
                found.append(disparity)
    if not found:
        raise ValueError(
            "images: expected particles that two cameras show within "
            f"{SEARCH_VOXEL} voxels of each other, found none: the cameras moved by more, the images are not of the "
            "same instant, or hold too few particles."
        )
    return tuple(found)


def fit_movements(found: Sequence[Disparity], cameras: Sequence[str], grid: Grid) -> dict[str, Movement]:
    """Find the rigid movements of cameras that explain disparities, by weighted least squares.

    A disparity is the difference of two cameras' movements; its weight is its peak's sharpness, so directions that the
    views do not tell hardly count, and its scale is what the fit leaves over. Where no disparity tells movements, they
    are held near none by `PRIOR_MM` and `PRIOR_RAD`; so the mean of all cameras, which none tells, is none.
    """
    rows = [_row(one, cameras, grid) for one in found]
    count = len(cameras)
    information, pull = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    for one, row in zip(found, rows, strict=True):
        information += row.T @ one.weight @ row
        pull += row.T @ one.weight @ one.shift_mm
    prior = np.diag(np.tile(np.repeat([PRIOR_MM**-2.0, PRIOR_RAD**-2.0], 3), count))
    free = 3 * len(found) - 6 * (count - 1)
    variance = ((LEAST_STD_VOXEL if free > 0 else ASSUMED_STD_VOXEL) * grid.voxel_mm) ** 2
    for _ in range(2):  # the first solution tells the variance
        covariance = np.linalg.inv(information / variance + prior)
        values = covariance @ pull / variance
        left = [one.told_mm(one.shift_mm - row @ values) ** 2 for one, row in zip(found, rows, strict=True)]
        variance = max(variance, sum(left) / max(free, 1))
    apart = np.kron(np.eye(count) - 1 / count, np.eye(6))  # errors of what all cameras share: none, by definition
    std = np.sqrt(np.diag(apart @ covariance @ apart.T)).reshape(-1, 6)
    centre = _centre_mm(grid)
    return {
        name: Movement(shift_mm=value[:3], rotation_rad=value[3:], centre_mm=centre, std=std[number])
        for number, (name, value) in enumerate(zip(cameras, values.reshape(-1, 6), strict=True))
    }


def explained_mm(found: Sequence[Disparity], movements: Mapping[str, Movement], grid: Grid) -> float:
    """Return the root mean square of the disparities that movements explain, as far as the views tell [mm]."""
    values = np.concatenate([np.append(move.shift_mm, move.rotation_rad) for move in movements.values()])
    told = [one.told_mm(_row(one, list(movements), grid) @ values) for one in found]
    return float(np.sqrt(np.mean(np.square(told))))


def _row(disparity: Disparity, cameras: Sequence[str], grid: Grid) -> np.ndarray:
    """Disparity as a linear function of all cameras' shifts and rotations, shape (3, 6 cameras)."""
    x, y, z = disparity.centre_mm - _centre_mm(grid)
    movement = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
    row = np.zeros((3, 6 * len(cameras)))
    for name, sign in zip(disparity.cameras, (-1, 1), strict=True):
        at = 6 * cameras.index(name)
        row[:, at : at + 6] = sign * movement
    return row


def _centre_mm(grid: Grid) -> np.ndarray:
    return np.array([grid.axis_mm(axis)[[0, -1]].mean() for axis in (2, 1, 0)])


def _windows(grid: Grid) -> list[tuple[slice, ...]]:
    """Parts of the volume, (z, y, x)."""
    counts = [int(np.clip(edge // WINDOW_VOXEL, 1, MOST_WINDOWS)) for edge in grid.shape]
    edges = [np.linspace(0, edge, count + 1).astype(int) for edge, count in zip(grid.shape, counts, strict=True)]
    return [
        tuple(slice(int(edge[i]), int(edge[i + 1])) for edge, i in zip(edges, place, strict=True))
        for place in np.ndindex(*counts)
    ]


def _disparity(
    first: Sequence[np.ndarray],
    second: Sequence[np.ndarray],
    window: tuple[slice, ...],
    grid: Grid,
    cameras: tuple[str, str],
) -> Disparity | None:
    """Disparity of two cameras' volumes in a window; None where no peak tells it."""
    coefficient = _coefficients(first, second, window)
    mirrored = _coefficients(first, [volume[:, ::-1] for volume in second], _mirror(window, grid.shape[1]))
    place = np.unravel_index(int(np.nanargmax(coefficient)), coefficient.shape)
    peak, rival = float(coefficient[place]), float(np.nanmax(mirrored))
    if not peak >= SIGNIFICANT * rival or any(not 0 < i < 2 * SEARCH_VOXEL for i in place):
        return None
    middle = np.clip(place, FIT_REACH, 2 * SEARCH_VOXEL - FIT_REACH)
    around = coefficient[tuple(slice(i - FIT_REACH, i + FIT_REACH + 1) for i in middle)]
    steps = np.indices(around.shape).reshape(3, -1) - FIT_REACH
    z, y, x = steps
    design = np.stack([np.ones(steps.shape[1]), z, y, x, z * z, y * y, x * x, z * y, z * x, y * x], axis=1)
    _, *slope, zz, yy, xx, zy, zx, yx = np.linalg.lstsq(design, around.ravel(), rcond=None)[0]
    curvature = -np.array([[2 * xx, yx, zx], [yx, 2 * yy, zy], [zx, zy, 2 * zz]])  # order x, y, z from here on
    if not np.linalg.eigvalsh(curvature)[0] > 0:
        return None
    offset = np.linalg.solve(curvature, slope[::-1])
    lag = middle[::-1] - SEARCH_VOXEL + np.clip(offset, -FIT_REACH, FIT_REACH)
    corner = [grid.axis_mm(axis)[part.start : part.stop] for axis, part in enumerate(window)]
    return Disparity(
        cameras=cameras,
        centre_mm=np.array([values.mean() for values in reversed(corner)]),
        shift_mm=lag * grid.voxel_mm,
        sharpness=curvature / peak / grid.voxel_mm**2,
        peak=peak,
        rival=rival,
    )


def _mirror(window: tuple[slice, ...], edge: int) -> tuple[slice, ...]:
    """Window on the same voxels of a volume that is mirrored along y."""
    z, y, x = window
    return z, slice(edge - y.stop, edge - y.start), x


def _coefficients(first: Sequence[np.ndarray], second: Sequence[np.ndarray], window: tuple[slice, ...]) -> np.ndarray:
    """Correlation coefficient of a window of some volumes with others at every lag, shape (z, y, x).

    Outside the volume nothing is known: each lag counts the voxels only that both know (masked normalised
    cross-correlation, Padfield 2012).
    """
    reach = SEARCH_VOXEL
    inner = tuple(part.stop - part.start for part in window)
    shape = [scipy.fft.next_fast_len(n + 2 * reach, real=True) for n in inner]

    def around(volume: np.ndarray) -> np.ndarray:
        out = np.zeros([n + 2 * reach for n in inner])
        low = [max(part.start - reach, 0) for part in window]
        high = [min(part.stop + reach, n) for part, n in zip(window, volume.shape, strict=True)]
        at = [a - (part.start - reach) for a, part in zip(low, window, strict=True)]
        to = tuple(slice(p, p + b - a) for p, a, b in zip(at, low, high, strict=True))
        out[to] = volume[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        return out

    def spectrum(values: np.ndarray) -> np.ndarray:
        transformed: np.ndarray = scipy.fft.rfftn(values, shape)
        return transformed

    def summed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        lags: np.ndarray = scipy.fft.irfftn(a.conj() * b, shape)
        return lags[tuple(slice(0, 2 * reach + 1) for _ in shape)]

    whole, known = spectrum(np.ones(inner)), spectrum(around(np.ones(second[0].shape)))
    count = np.maximum(summed(whole, known), 1.0)
    products, spread, other = (np.zeros(count.shape) for _ in range(3))
    for one, two in zip(first, second, strict=True):
        a = one[window].astype(float)
        b = around(two)
        a, b = a / max(a.std(), np.finfo(float).tiny), b / max(b.std(), np.finfo(float).tiny)
        a_, b_ = spectrum(a), spectrum(b)
        sum_a, sum_b = summed(a_, known), summed(whole, b_)
        products += summed(a_, b_) - sum_a * sum_b / count
        spread += summed(spectrum(a * a), known) - sum_a**2 / count
        other += summed(whole, spectrum(b * b)) - sum_b**2 / count
    scale = np.sqrt(np.maximum(spread, 0) * np.maximum(other, 0))
    enough = (count >= LEAST_OVERLAP * count.max()) & (scale > 1e-9 * scale.max())
    coefficient: np.ndarray = np.divide(products, scale, out=np.zeros_like(scale), where=enough)
    return coefficient
