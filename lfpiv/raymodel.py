"""Local polynomials of a calibrated mapping in the pupil point: what the weight kernels take instead of the mapping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from lfpiv_kernels.trace import POWERS

if TYPE_CHECKING:
    from lfpiv.camera import CalibratedCamera

RINGS = ((0.0, 1), (0.5, 6), (0.97, 12))
"""Pupil points at which the mapping is evaluated: (radius / pupil radius, points on the ring)."""
CHUNK_POINTS = 100_000
"""Object points per evaluation: bounds the scratch memory."""


def fit_rays(camera: CalibratedCamera, points_mm: np.ndarray, *, degree: int) -> np.ndarray:
    """Fit polynomials of the pupil point to the rays of object points.

    Parameters
    ----------
    camera : CalibratedCamera
        Its ``map_fan(points, pupil)`` is evaluated at the points of `RINGS`.
    points_mm : ndarray, shape (point, 3)
        Object points (x, y, z) [mm].
    degree : {2, 3}
        Degree of the polynomial.

    Returns
    -------
    ndarray, shape (point, 2, 6 or 10), float32
        Coefficients of s and t [mm] in the pupil point [mm], terms as in `POWERS`.
    """
    radius = camera.optics.pupil_radius_mm
    unit = np.array([(r * np.cos(a), r * np.sin(a)) for r, n in RINGS for a in 2 * np.pi * (np.arange(n) + 0.25) / n])
    powers = [power for power in POWERS if sum(power) <= degree]
    terms = np.stack([unit[:, 0] ** a * unit[:, 1] ** b for a, b in powers], axis=1)
    solve = np.linalg.pinv(terms) / np.array([radius ** (a + b) for a, b in powers])[:, None]
    pupil = (unit * radius).astype(np.float32)
    both = np.zeros((len(unit), 2, 2, len(powers)), np.float32)  # one product for s and t: their rays lie side by side
    both[:, 0, 0], both[:, 1, 1] = solve.T, solve.T
    product = both.reshape(2 * len(unit), -1)
    out = np.empty((len(points_mm), 2, len(powers)), np.float32)
    for first in range(0, len(points_mm), CHUNK_POINTS):
        part = points_mm[first : first + CHUNK_POINTS]
        rays = camera.map_fan(part, pupil).reshape(len(part), -1)  # s and t by turns
        middle = rays[:, :2].copy()
        for axis in range(2):  # differences keep single precision where it matters
            rays[:, axis::2] -= middle[:, axis, None]
        out[first : first + len(part)] = (rays @ product).reshape(-1, 2, len(powers))
        out[first : first + len(part), :, 0] += middle
    return out


def ray_models(camera: CalibratedCamera, centres_mm: np.ndarray, voxel_mm: float) -> np.ndarray:
    """Ray models of voxels for the footprint kernels, see ``lfpiv_kernels.raymodel.MODEL_SIZE``.

    The projected edges are differences of the mapping between opposite faces of the voxel.

    Returns
    -------
    ndarray, shape (voxel, 30), float32
    """
    model = np.empty((len(centres_mm), 30), np.float32)
    model[:, :12] = fit_rays(camera, centres_mm, degree=2).reshape(-1, 12)
    for axis in range(3):
        face = np.zeros(3)
        face[axis] = voxel_mm / 2
        edge = fit_rays(camera, centres_mm + face, degree=2) - fit_rays(camera, centres_mm - face, degree=2)
        model[:, 12 + 2 * axis : 14 + 2 * axis] = edge[:, :, 0]
        model[:, 18 + 4 * axis : 22 + 4 * axis] = edge[:, :, 1:3].reshape(-1, 4)
    return _finite(model)


def grid_models(
    camera: CalibratedCamera,
    shape: tuple[int, int, int],
    centres_mm: Callable[[np.ndarray], np.ndarray],
    axes: tuple[int, int, int],
) -> Iterator[np.ndarray]:
    """Ray models of a grid's voxels, plane by plane of its outermost axis.

    The projected edges are half the differences of the mapping between a voxel's neighbours: one fit per voxel instead
    of seven.

    Parameters
    ----------
    camera : CalibratedCamera
        As for `fit_rays`.
    shape : tuple of int
        Voxels along the three axes, outermost first.
    centres_mm : callable
        Takes indices along the three axes, shape (point, 3), also one outside the grid; returns (x, y, z) [mm].
    axes : tuple of int
        Which of x, y, z (0, 1, 2) each axis of the grid is.

    Yields
    ------
    ndarray, shape (voxels of a plane, 30), float32
        See ``lfpiv_kernels.raymodel.MODEL_SIZE``.
    """
    outer, rows, columns = shape
    inner = np.stack(np.meshgrid(np.arange(-1, rows + 1), np.arange(-1, columns + 1), indexing="ij"), -1).reshape(-1, 2)

    def fits(plane: int) -> np.ndarray:
        index = np.column_stack([np.full(len(inner), plane), inner])
        return fit_rays(camera, centres_mm(index), degree=2).reshape(rows + 2, columns + 2, 2, 6)

    before, here = fits(-1), fits(0)
    for plane in range(outer):
        after = fits(plane + 1)
        model = np.empty((rows, columns, 30), np.float32)
        model[..., :12] = here[1:-1, 1:-1].reshape(rows, columns, 12)
        differences = (
            after[1:-1, 1:-1] - before[1:-1, 1:-1],
            here[2:, 1:-1] - here[:-2, 1:-1],
            here[1:-1, 2:] - here[1:-1, :-2],
        )
        for axis, difference in zip(axes, differences, strict=True):
            model[..., 12 + 2 * axis : 14 + 2 * axis] = 0.5 * difference[..., 0]
            model[..., 18 + 4 * axis : 22 + 4 * axis] = 0.5 * difference[..., 1:3].reshape(rows, columns, 4)
        yield _finite(model.reshape(-1, 30))
        before, here = here, after


def _finite(model: np.ndarray) -> np.ndarray:
    """Send a voxel in the lens's own plane far off the sensor."""
    finite: np.ndarray = np.nan_to_num(model, copy=False, nan=1e9, posinf=1e9, neginf=-1e9)
    return finite
