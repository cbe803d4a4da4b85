"""Fit the part of the planes' errors that is linear in z: a wrong scale of depth, and shear.

Rays through a scaled or sheared world are straight, too. Only optics can tell it: a camera whose pixels are square, seen
in a sheared world, is no thin lens. So this part is fitted together with thin lenses in free poses. What the lenses do
beyond that has an unknown variance for each camera. Through windows it is large, and then the part remains unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.errors import BoardErrors
from lfpiv.calibration.bundle.dot_rays import DotRays, smooth_terms, thin_lens_rays, without
from lfpiv.calibration.bundle.mixed_model import SIGNIFICANT, NormalEquations
from lfpiv.calibration.thin_lens_model import ThinLensModel

DEPARTURES_MM = np.geomspace(1e-6, 0.1, 21)
"""Coefficients of the cameras' departures from thin lenses among which the search starts [mm]."""
PLAUSIBLE = 3.0
"""Largest linear part that a stage with these errors has [standard deviations]."""
STEP = 1e-6
"""Step of the finite differences of a thin lens, relative to the unit of each parameter."""


def fit_linear_part(
    data: Sequence[DotRays],
    weights: Sequence[np.ndarray],
    board: DotBoard,
    errors: BoardErrors,
    std: Mapping[str, float],
) -> BoardErrors:
    """Add the linear part to the errors of the planes, if the labels show it and it is plausible.

    Parameters
    ----------
    data : sequence of DotRays
        Dots of each camera.
    weights : sequence of ndarray
        Square root of the weights of the chief rays and slopes of each camera [1/mm].
    board : DotBoard
        The board as stated.
    errors : BoardErrors
        Errors without a linear part.
    std : dict
        Standard deviations of the corrected kinds of errors. Kinds without one have no linear part.
    """
    depth = errors.planes_mm - errors.planes_mm[~np.isnan(errors.plane_std[:, 2])].mean()
    reach = float(np.sqrt((depth[~np.isnan(errors.plane_std[:, 2])] ** 2).sum()))
    stage = [std[kind] for kind in ("depth", "shift") if kind in std]
    prior = dict.fromkeys(("depth", "shift"), max(stage) / reach) if stage else {}
    terms = [_terms(part, board, errors, depth) for part in data]
    if not prior or any(smooth is None for smooth, _, _ in terms):
        return errors
    cameras = [f"camera {k}" for k in range(len(data))]
    kind = np.array(
        [name for name, (smooth, _, _) in zip(cameras, terms, strict=True) for _ in range(2 * smooth.shape[1])]
    )
    kind = np.append(kind, ["shift", "shift", "depth"])
    parts = []
    for k, ((smooth, linear, departure), part, root) in enumerate(zip(terms, data, weights, strict=True)):
        matrix = np.zeros((len(departure), len(kind)))
        matrix[:, kind == cameras[k]] = block_diag(smooth, smooth)
        matrix[:, -3:] = linear
        both = np.tile(root, 2)[:, None]
        basis = np.linalg.qr(_lens_terms(part, board, errors) * both)[0]
        parts.append((without(basis, matrix * both), without(basis, departure * both[:, 0])))
    typical = dict.fromkeys(cameras, 1e-3)
    normal = NormalEquations.of(parts, kind, typical | prior)
    alone, together = (_most_likely(normal, cameras, fixed) for fixed in ({}, prior))
    solution = normal.solve(together | prior)
    gain = 2 * (solution.likelihood - normal.solve(alone).likelihood)
    found, variance = solution.values[-3:], solution.covariance.diagonal()[-3:]
    limit = PLAUSIBLE * np.array([prior.get("shift", 0.0), prior.get("shift", 0.0), prior.get("depth", 0.0)])
    print('LIN', alone, together, prior, gain, found, np.sqrt(variance))
    if gain <= SIGNIFICANT or (np.abs(found) > limit).any() or (np.sqrt(variance) > limit / 9).any():
        return errors
    plane, plane_std = errors.plane.copy(), errors.plane_std.copy()
    plane[:, :3] += depth[:, None] * found
    plane_std[:, :3] = np.hypot(plane_std[:, :3], np.abs(depth)[:, None] * np.sqrt(variance))
    return replace(errors, plane=plane, plane_std=plane_std, corrected=(*errors.corrected, "linear"))


def _most_likely(normal: NormalEquations, cameras: Sequence[str], prior: Mapping[str, float]) -> dict[str, float]:
    """Return the most likely standard deviations of the cameras' departures; a scan starts the search."""
    scan = [{**dict.fromkeys(cameras, value), **prior} for value in DEPARTURES_MM]
    best = max(scan, key=lambda std: normal.solve(std).likelihood)
    return normal.best_std({name: best[name] for name in cameras}, prior)


def _terms(
    data: DotRays, board: DotBoard, errors: BoardErrors, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the smooth terms of a camera (3d, terms), the effect of the linear part (6d, 3), and its departure (6d,)."""
    points = errors.points_mm(board, data.dot)
    rays, jacobian, camera_depth = thin_lens_rays(data.lens, points, data.pupil_radius_mm)
    smooth = smooth_terms(data.rays, camera_depth, data.lens)
    linear = jacobian * depth[data.dot // board.size][:, None, None, None]
    flat = linear.transpose(2, 1, 0, 3).reshape(-1, 3)
    return smooth, flat, (data.rays - rays).transpose(2, 1, 0).ravel()


def _lens_terms(data: DotRays, board: DotBoard, errors: BoardErrors) -> np.ndarray:
    """Return the derivatives of a thin lens's rays by its eleven parameters, shape (6d, 11)."""
    points = errors.points_mm(board, data.dot)

    def rays(lens: ThinLensModel) -> np.ndarray:
        flat: np.ndarray = thin_lens_rays(lens, points, data.pupil_radius_mm)[0].transpose(2, 1, 0).ravel()
        return flat

    columns = [(rays(_changed(data.lens, step)) - rays(data.lens)) / STEP for step in STEP * np.eye(11)]
    return np.stack(columns, axis=1)


def _changed(lens: ThinLensModel, change: np.ndarray) -> ThinLensModel:
    """Return a thin lens changed by a rotation, a shift, relative distances and pupil scale, and a shift of its axis."""
    return replace(
        lens,
        rotation=Rotation.from_rotvec(change[:3]).as_matrix() @ lens.rotation,
        offset_mm=lens.offset_mm + change[3:6],
        image_distance_mm=lens.image_distance_mm * (1 + change[6]),
        focal_length_mm=lens.focal_length_mm * (1 + change[7]),
        pupil_scale=lens.pupil_scale * (1 + change[8]),
        array_offset_mm=lens.array_offset_mm + change[9:],
    )
