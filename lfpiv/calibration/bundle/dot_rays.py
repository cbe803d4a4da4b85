"""Rays of the dots of one camera: measured, of a thin lens, and the smooth departure of a real camera from it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.thin_lens_model import ThinLensModel

ORDERS = (4, 3, 2, 1)
"""Orders in (s, t) of the cameras' smooth departure, best first."""
DOTS_PER_TERM = 6
"""Least number of dots for each term of the departure of chief rays. Fewer dots lower the order."""
LEAST_DOTS = 24
"""Least number of dots of a camera."""
LEAST_LABELS = 10
"""Least number of labels of a dot."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class DotRays:
    """Dots of one camera: the ray model of each, linear in the pupil point."""

    lens: ThinLensModel
    pupil_radius_mm: float
    pitch_mm: float
    dot: np.ndarray  # numbers of the dots, (d,)
    rays: np.ndarray  # position of the chief ray, slopes along u and v to the pupil's edge [mm], (d, 3, 2)
    variance: np.ndarray  # relative variance of the chief ray and of the slopes, (d, 2)

    @classmethod
    def from_labels(cls, camera: CameraLabels) -> DotRays:
        """Fit a quadratic of the pupil point to the labels of each dot, and cubic terms that all dots share."""
        dots, radius = camera.dots, camera.pupil_radius_mm
        number, count = np.unique(dots.dot, return_counts=True)
        enough = count >= LEAST_LABELS
        labels_of = np.split(np.argsort(dots.dot, kind="stable"), np.cumsum(count)[:-1])
        parts = [labels for labels, chosen in zip(labels_of, enough, strict=True) if chosen]
        terms = _pupil_terms(dots.pupil_mm / radius)
        bases = [np.linalg.qr(terms[part, :6]) for part in parts]
        beyond = [orthogonal_part(basis.Q, np.hstack([terms[part, 6:], dots.array_mm[part]]))
                  for part, basis in zip(parts, bases, strict=True)]  # fmt: skip
        stacked = np.concatenate([np.empty((0, terms.shape[1] - 4)), *beyond])
        shared = np.linalg.lstsq(stacked[:, :-2], stacked[:, -2:], rcond=None)[0]
        rays, variance = np.empty((len(parts), 3, 2)), np.empty((len(parts), 2))
        for k, (part, basis) in enumerate(zip(parts, bases, strict=True)):
            inverse = np.linalg.pinv(basis.R)
            quadratic = dots.array_mm[part] - terms[part, 6:] @ shared
            rays[k] = (inverse @ (basis.Q.T @ quadratic))[:3]
            spread = (inverse**2).sum(1) * len(part) * np.mean(dots.std_mm[part] ** 2)
            variance[k] = spread[0], spread[1:3].mean()
        variance = (1 + variance / np.median(variance, axis=0)) / 2 if len(parts) else variance
        return cls(
            lens=camera.lens, pupil_radius_mm=radius, pitch_mm=camera.pitch_mm,
            dot=number[enough], rays=rays, variance=variance,
        )  # fmt: skip

    def of_planes(self, planes: np.ndarray, board: DotBoard) -> DotRays:
        """Return the dots of some planes, given as bool, shape (plane,)."""
        here = planes[self.dot // board.size]
        return replace(self, dot=self.dot[here], rays=self.rays[here], variance=self.variance[here])


def _pupil_terms(pupil: np.ndarray) -> np.ndarray:
    """Return the ten terms of a cubic of the pupil point, in rising order."""
    u, v = pupil.T
    return np.stack([u**0, u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)


def orthogonal_part(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the part of columns that is orthogonal to a basis."""
    return columns - basis @ (basis.T @ columns)


def thin_lens_rays(lens: ThinLensModel, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def smooth_terms(rays: np.ndarray, depth: np.ndarray, lens: ThinLensModel) -> np.ndarray | None:
    """Return the columns of the camera's smooth departure, shape (3d, terms); None for too few dots.

    The terms are s^i t^j u^k v^l and the same times the depth, all times the magnification. Slopes are the total
    derivative by u or v, for (s, t) moves with (u, v) along the rays of a dot.
    """
    chief = rays[:, 0]
    if len(chief) < LEAST_DOTS:
        return None
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
