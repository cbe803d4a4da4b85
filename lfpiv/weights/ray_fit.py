"""Ray models: polynomials of the pupil point that approximate a calibrated mapping near a voxel.

The weight kernels take them in place of the mapping. Input: a camera and voxel centres [mm]. Output: coefficients of
the point (s, t) on the microlens array [mm], and those of the voxel's projected edges.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from lfpiv_kernels.rays.count import POWERS
from lfpiv_kernels.weights.ray_model import MODEL_SIZE

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

RINGS = ((0.0, 1), (0.5, 6), (0.97, 12))
"""Pupil points at which the mapping is evaluated: (radius / pupil radius, number of points on the ring)."""
CHUNK_POINTS = 100_000
"""Object points per evaluation: limits the scratch memory."""
STEPS = (8, 4, 2, 1)
"""Distances between fits on a grid that are tried, widest first [voxel]."""
PROBES = 256
"""Number of random voxels in which interpolated fits are compared with direct ones."""
BENT_PITCH = 0.01
"""Departure of rays from second order in the pupil point above which third order follows them [microlens pitch]."""
NEAR_PITCH = 3e-4
"""Largest difference between interpolated and direct rays [microlens pitch]."""


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
    pupil, product = _fan(camera.optics.pupil_radius_mm, degree)
    out = np.empty((len(points_mm), 2, product.shape[1] // 2), np.float32)
    for first in range(0, len(points_mm), CHUNK_POINTS):
        part = points_mm[first : first + CHUNK_POINTS]
        rays = camera.map_fan(part, pupil).reshape(len(part), -1)  # s and t alternate
        middle = rays[:, :2].copy()
        for axis in range(2):  # fit differences: float32 loses digits in large values
            rays[:, axis::2] -= middle[:, axis, None]
        out[first : first + len(part)] = (rays @ product).reshape(-1, *out.shape[1:])
        out[first : first + len(part), :, 0] += middle
    return out


@functools.cache
def _fan(radius_mm: float, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pupil points of a fit [mm], and the matrix from their s and t in turns to the coefficients."""
    unit = np.array([(r * np.cos(a), r * np.sin(a)) for r, n in RINGS for a in 2 * np.pi * (np.arange(n) + 0.25) / n])
    powers = [power for power in POWERS if sum(power) <= degree]
    terms = np.stack([unit[:, 0] ** a * unit[:, 1] ** b for a, b in powers], axis=1)
    solve = np.linalg.pinv(terms) / np.array([radius_mm ** (a + b) for a, b in powers])[:, None]
    both = np.zeros((len(unit), 2, 2, len(powers)), np.float32)  # one matrix product for s and t
    both[:, 0, 0], both[:, 1, 1] = solve.T, solve.T
    return (unit * radius_mm).astype(np.float32), both.reshape(2 * len(unit), -1)


def degree_of(camera: CalibratedCamera, points_mm: np.ndarray, form: str) -> int:
    """Return the degree of polynomials of the pupil point that weights in a form need: 2 or 3.

    Profiles take rays as straight over what a lens sees. The best straight ones follow from the second order.
    """
    if form == "profiles":
        return 2
    return 3 if form == "count" or bent_pitch(camera, points_mm, 2) > BENT_PITCH else 2


def bent_pitch(camera: CalibratedCamera, points_mm: np.ndarray, degree: int) -> float:
    """Return the largest departure of rays at the pupil's edge from polynomials of a degree [microlens pitch]."""
    angle = np.arange(0, 2 * np.pi, np.pi / 8)
    u, v = camera.optics.pupil_radius_mm * np.array([np.cos(angle), np.sin(angle)])
    rays = camera.map_fan(points_mm, np.stack([u, v], axis=1).astype(np.float32))
    terms = np.stack([u**a * v**b for a, b in POWERS if a + b <= degree])
    off = rays - (fit_rays(camera, points_mm, degree=degree) @ terms).swapaxes(1, 2)
    return float(np.nan_to_num(np.hypot(off[..., 0], off[..., 1])).max(initial=0.0) / camera.lattice.pitch_mm)


def ray_models(camera: CalibratedCamera, centres_mm: np.ndarray, voxel_mm: float, form: str = "pixels") -> np.ndarray:
    """Return ray models of single voxels, shape (voxel, 38), float32; see `grid_models`.

    The projected edges are differences of the mapping between opposite faces of the voxel. `form` as in
    `grid_models`.
    """
    degree = degree_of(camera, centres_mm, form)
    faces = np.concatenate([np.zeros((1, 3)), -np.eye(3), np.eye(3)])[:, None] * voxel_mm / 2
    points = (centres_mm + faces).reshape(-1, 3)
    fits = fit_rays(camera, points, degree=degree)
    fits = fits.reshape(len(faces), len(centres_mm), *fits.shape[1:])
    model = np.zeros((len(centres_mm), MODEL_SIZE), np.float32)
    _set_rays(model, fits[0])
    for axis in range(3):
        edge = fits[4 + axis] - fits[1 + axis]
        model[:, 12 + 2 * axis : 14 + 2 * axis] = edge[:, :, 0]
        model[:, 18 + 4 * axis : 22 + 4 * axis] = edge[:, :, 1:3].reshape(-1, 4)
    return _finite(model)


def _set_rays(model: np.ndarray, fits: np.ndarray) -> None:
    """Write coefficients (..., 2, 6 or 10) into ray models (..., 38) of zeros."""
    model[..., :12] = fits[..., :6].reshape(*fits.shape[:-2], 12)
    if fits.shape[-1] > 6:
        model[..., 30:] = fits[..., 6:].reshape(*fits.shape[:-2], 8)


def grid_models(
    camera: CalibratedCamera,
    shape: tuple[int, int, int],
    centres_mm: Callable[[np.ndarray], np.ndarray],
    axes: tuple[int, int, int],
    form: str = "pixels",
) -> Iterator[np.ndarray]:
    """Yield ray models of a grid's voxels, plane by plane of its outermost axis.

    The mapping varies little over several voxels. So it is fitted at every n-th voxel only, n the widest of `STEPS`
    that is accurate enough, and the fits are interpolated by cubic splines. The projected edges are half the
    differences between a voxel's neighbours.

    Parameters
    ----------
    camera : CalibratedCamera
        As for `fit_rays`.
    shape : tuple of int
        Voxels along the three axes, outermost first.
    centres_mm : callable
        Takes indices along the three axes, shape (point, 3), that may be fractional and one voxel outside the grid.
        Returns (x, y, z) [mm].
    axes : tuple of int
        World axis (x, y, z: 0, 1, 2) of each axis of the grid.
    form : {"profiles", "pixels", "count"}, optional
        Form of the weights, which decides the degree of the polynomials in the pupil point; "count" takes third order.

    Yields
    ------
    ndarray, shape (voxels of a plane, 38), float32
        See ``lfpiv_kernels.weights.ray_model.MODEL_SIZE``.
    """
    outer, rows, columns = shape
    fits, along = _interpolated(camera, shape, centres_mm, form)
    terms = fits.shape[-1]

    def plane_fits(plane: int) -> np.ndarray:
        plane_nodes = along[0][plane + 1] @ fits.reshape(len(fits), -1)
        row_fits = along[1] @ plane_nodes.reshape(fits.shape[1], -1)
        every: np.ndarray = along[2] @ row_fits.reshape(rows + 2, fits.shape[2], -1)
        return every.reshape(rows + 2, columns + 2, 2, terms // 2)

    before, here = plane_fits(-1), plane_fits(0)
    for plane in range(outer):
        after = plane_fits(plane + 1)
        model = np.zeros((rows, columns, MODEL_SIZE), np.float32)
        _set_rays(model, here[1:-1, 1:-1])
        differences = (
            after[1:-1, 1:-1] - before[1:-1, 1:-1],
            here[2:, 1:-1] - here[:-2, 1:-1],
            here[1:-1, 2:] - here[1:-1, :-2],
        )
        for axis, difference in zip(axes, differences, strict=True):
            edge, slope = 12 + 2 * axis, 18 + 4 * axis
            model[..., edge : edge + 2] = 0.5 * difference[..., 0]
            model[..., slope : slope + 4] = 0.5 * difference[..., 1:3].reshape(rows, columns, 4)
        yield model.reshape(rows * columns, -1)
        before, here = here, after


def _interpolated(
    camera: CalibratedCamera,
    shape: tuple[int, int, int],
    centres_mm: Callable[[np.ndarray], np.ndarray],
    form: str,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Fit at the nodes of a coarser grid, shape (nodes, nodes, nodes, 12 or 20), and return the interpolation matrices.

    There is one matrix per axis, shape (voxels + 2, nodes), float32. Its rows are one voxel before the grid, those of
    the grid, and one voxel behind it.
    """
    rng = np.random.default_rng(0)
    probes = np.column_stack([rng.integers(0, n, PROBES) for n in shape])
    degree = degree_of(camera, centres_mm(probes), form)
    scale = camera.optics.pupil_radius_mm ** np.array([sum(power) for power in POWERS if sum(power) <= degree])
    expected = _finite(fit_rays(camera, centres_mm(probes), degree=degree)) * scale
    for step in STEPS:
        counts = [math.ceil((n + 1) / step) + 1 for n in shape]
        nodes = [np.linspace(-1, n, count) for n, count in zip(shape, counts, strict=True)]
        points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        fits = _finite(fit_rays(camera, centres_mm(points), degree=degree)).reshape(*counts, 2 * len(scale))
        along = [_spline_matrix(at, n) for at, n in zip(nodes, shape, strict=True)]
        if step == 1:
            break
        weights = [matrix[probe + 1] for matrix, probe in zip(along, probes.T, strict=True)]
        found = np.einsum("pa,pb,pc,abcf->pf", *weights, fits, optimize=True).reshape(PROBES, 2, -1) * scale
        error = np.abs(found - expected).sum(-1).max() / camera.lattice.pitch_mm
        if error < NEAR_PITCH:
            break
    return fits, along


def _spline_matrix(nodes: np.ndarray, voxels: int) -> np.ndarray:
    """Return the matrix that interpolates values at nodes to -1, 0, ..., `voxels`."""
    wanted = np.arange(-1, voxels + 1)
    if len(nodes) == len(wanted):
        return np.eye(len(nodes), dtype=np.float32)
    return CubicSpline(nodes, np.eye(len(nodes)))(wanted).astype(np.float32)


def _finite(model: np.ndarray) -> np.ndarray:
    """Replace infinite coefficients, of a voxel in the lens's plane, by a point far off the sensor."""
    return np.nan_to_num(model, copy=False, nan=1e9, posinf=1e9, neginf=-1e9)
