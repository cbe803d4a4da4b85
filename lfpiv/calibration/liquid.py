"""A camera that looks obliquely through the plane surface of a liquid: no thin lens in air sees a board like that.

Rays are bent at the surface, planes look closer together than they are, and dots are astigmatic. The mapping is trained
on the labels whatever bends the rays. But what the labels say of pose, aperture and order of the planes is judged with
the surface: a thin lens, the height of the surface, its normal and the refractive index are fitted to the labels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.board.hypotheses import ALIKE_DEG, Mistake, turn_deg
from lfpiv.calibration.thin_lens_model import PRIOR, ThinLensModel, fit_thin_lens, moved, robust_minimum
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv_kernels.rendering.real_optics import apparent_points, pack_plates

SAMPLES = 400
"""Labels that the surface is fitted to."""
UNEXPLAINED_PITCH = 0.1
"""Median residual of the thin lens above which a surface is looked for [microlens pitch]."""
EXPLAINED = 0.08
"""Largest residual behind the surface, relative to the thin lens in air, if the surface explains the labels."""
FIRST_INDEX, FIRST_HEIGHT_MM = 1.33, 60.0
"""Refractive index, and height of the surface above the board, from which the fit starts."""
LEAST_INDEX, MOST_INDEX = 1.05, 1.8
"""Least and largest refractive index of a liquid: planes stated too far apart in water look as in 2.3."""
CLEAR = 0.5
"""Least height of the surface above the dots, relative to their depth: a wrong stage looks like a surface on them."""
TILT = 0.03
"""Prior standard deviation of the slopes of the surface against planes of constant z."""
LOST_MM = 1e3
"""Residual of rays that pass no surface [mm]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LiquidSurface:
    """A camera in air above a liquid in which the board stands."""

    lens: ThinLensModel
    """The camera in air."""
    index: float
    """Refractive index of the liquid."""
    height_mm: float
    """Height z of the surface at x = y = 0 [mm]."""
    slope: np.ndarray
    """Normal of the surface along x and y, relative to z, shape (2,)."""
    residual_pitch: float = np.nan
    """Median distance of the labels from the fit [microlens pitch]."""

    def __call__(self, points: np.ndarray, pupil: np.ndarray) -> np.ndarray:
        """Trace rays as `ThinLensModel` does; raise ValueError where a ray grazes the surface."""
        lens = self.lens
        upright = np.array([[*self.slope, 1.0]]) @ lens.rotation.T
        on_surface = (np.array([[0.0, 0.0, self.height_mm]]) - lens.offset_mm) @ lens.rotation.T
        plates = pack_plates(
            upright, on_surface, np.zeros(1), np.ones(1), np.array([self.index]),
            object_distance_mm=lens.object_distance_mm,
        )  # fmt: skip
        local, at = (points - lens.offset_mm) @ lens.rotation.T, lens.pupil_scale * pupil
        seen = apparent_points(local, at, lens.object_distance_mm, plates)
        return lens.onto_array(seen, pupil)


def liquid_surface(dots: BoardDots, lens: ThinLensModel, optics: Optics) -> LiquidSurface | None:
    """Return the surface of a liquid that explains labels which the thin lens fitted to them does not; None without."""
    chosen = np.unique(np.linspace(0, len(dots.points_mm) - 1, min(len(dots.points_mm), SAMPLES)).astype(int))
    points, pupil, array = dots.points_mm[chosen], dots.pupil_mm[chosen], dots.array_mm[chosen]
    limit = median_distance(lens(points, pupil) - array) / optics.microlens_pitch_mm
    if limit <= UNEXPLAINED_PITCH:
        return None
    top = float(points[:, 2].max())

    def surface(p: np.ndarray) -> LiquidSurface:
        height = top + FIRST_HEIGHT_MM * float(np.exp(np.clip(30 * p[12], -10, 5)))
        return LiquidSurface(
            lens=moved(lens, p[:11]), index=FIRST_INDEX + 10 * float(p[11]), height_mm=height, slope=p[13:15]
        )

    def residual_of(p: np.ndarray) -> np.ndarray:
        try:
            with np.errstate(all="ignore"):
                rest = surface(p)(points, pupil) - array
        except ValueError:
            rest = np.full(array.shape, LOST_MM)
        return np.where(np.isfinite(rest), rest, LOST_MM).ravel()

    found = robust_minimum(residual_of, np.concatenate([PRIOR, [PRIOR[0], PRIOR[0], TILT, TILT]]))
    residual = median_distance(residual_of(found).reshape(-1, 2)) / optics.microlens_pitch_mm
    seen = replace(surface(found), residual_pitch=residual)
    clear = seen.height_mm - top > CLEAR * float(np.ptp(points[:, 2]))
    explains = residual <= min(UNEXPLAINED_PITCH, EXPLAINED * limit)
    return seen if explains and clear and LEAST_INDEX <= seen.index <= MOST_INDEX else None


def mistake_in_liquid(
    dots_of: Callable[[Mistake], BoardDots | None], tried: Iterable[Mistake], stated: Orientation, optics: Optics
) -> Mistake | None:
    """Return the first mistake with which the surface of a liquid explains the dots of a camera; None without one.

    `dots_of` measures the dots as they are if a mistake was made; None where it finds none.
    """
    for mistake in tried:
        dots = dots_of(mistake)
        if dots is None:
            continue
        try:
            lens = fit_thin_lens(dots.points_mm, dots.pupil_mm, dots.array_mm, optics)
        except ValueError:  # labels of a mirror image
            continue
        surface, rotation = liquid_surface(dots, lens, optics), mistake.orientation(stated).rotation
        if surface is not None and turn_deg(surface.lens.rotation, rotation) < ALIKE_DEG:
            return mistake
    return None


def median_distance(residual: np.ndarray) -> float:
    """Return the median length of vectors (n, 2)."""
    return float(np.median(np.hypot(*residual.T)))
