"""Compare the spacing of the dots and the distance of the planes with each other and with the stated optics.

A camera at an angle sees columns of dots by the cosine of its angle, and planes by the sine; rows of dots it sees in
full. So its dots fit a rigid camera only if planes and columns have the scale of the rows. The magnification compares
that scale with the optics.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.bundle.dot_rays import CameraLabels
from lfpiv.calibration.thin_lens_model import OUTLIER, PRIOR, SMALLEST_STD_MM, STEP, moved, robust_minimum
from lfpiv.experiment.experiment import Experiment
from lfpiv.lightfield.decoder import NORMAL_MAD
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

SAMPLES = 2000
"""Labels of a camera that are compared."""
ANAMORPHIC = 0.004
"""Difference between the magnifications along rows and columns that a window may cause, see the notebook."""
CONTRADICTION = 0.025
"""Difference of the planes' scale from 1 above which a warning is due."""
SIGNIFICANT, SURE_BOTH = 3.0, 2.0
"""The same in standard errors: of the planes alone, and where the magnification shows the same."""
EXPLAINED = 0.3
"""Largest residual of a fit with a free scale, relative to one without, if the scale explains the residual."""
FLATTEST = 0.1
"""Least squared sine of a camera's angle to z; others hardly see planes sideways."""
DEEPEST = 0.15
"""Planes closer together by more than this share are the sign of a liquid, see `Code.MEDIUM`."""


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Scales of a board as one or all cameras see them."""

    dots: float
    """Magnification over the stated one, by the spacing of the dots if the optics are as stated."""
    dots_std: float
    planes: float
    """Distance of the planes over the stated one, in units of the true over the stated spacing of the dots."""
    planes_std: float
    explained: bool
    """Whether labels that fit no rigid camera do so with this scale of the planes."""


def check_scales(experiment: Experiment, cameras: Sequence[CameraLabels]) -> None:
    """Log the scales of the board, and warn where they contradict each other."""
    stated = [abs(setup.optics.magnification) for setup in experiment.cameras]
    seen = [
        _scales(camera, magnification)
        for camera, magnification in zip(cameras, stated, strict=True)
        if _tilt(camera) > FLATTEST
    ]
    if not seen:
        return
    found = _mean(seen)
    text = (
        f"dots are {_apart(found.dots, found.dots_std)} than the stated magnification says, and planes are "
        f"{_apart(found.planes, found.planes_std)} than the spacing of the dots says"
    )
    log.info("board: %s", text)
    off = abs(found.planes - 1)
    spacing = abs(found.dots * found.planes - 1) < off / 2  # a wrong spacing explains the magnification, too
    sure = off > SIGNIFICANT * found.planes_std
    sure |= spacing and off > SURE_BOTH * found.planes_std and abs(found.dots - 1) > SIGNIFICANT * found.dots_std
    if found.explained and sure and off > CONTRADICTION and found.planes > 1 - DEEPEST:
        remedy = (
            f"board.spacing_mm = {experiment.board.spacing_mm * found.dots:.4g} would fit both"
            if spacing
            else f"depths of {found.planes:.4g} times board.planes_mm would fit: check the scale of the stage"
        )
        figures = {
            "planes": found.planes - 1,
            "planes_std": found.planes_std,
            "dots": found.dots - 1,
            "dots_std": found.dots_std,
            "found": text,
            "remedy": remedy,
        }
        warn(log, Warning(code=Code.SCALES, figures=figures))


def _apart(scale: float, std: float) -> str:
    """Return a scale and its standard error in words."""
    sense = "further apart" if scale > 1 else "closer together"
    return f"{100 * abs(scale - 1):.1f} % (standard error {100 * std:.1f} %) {sense}"


def _tilt(camera: CameraLabels) -> float:
    """Return the share of the planes' distance that a camera sees sideways, squared."""
    return 1 - float(camera.lens.rotation[2, 2]) ** 2


def _mean(seen: Sequence[Scales]) -> Scales:
    """Return the weighted mean of the cameras; its standard errors hold their scatter, and what windows may cause."""
    means, errors = [], []
    for values, stds in (
        ([one.dots for one in seen], [one.dots_std for one in seen]),
        ([one.planes for one in seen], [one.planes_std for one in seen]),
    ):
        weight = np.array(stds) ** -2.0
        means.append(float(weight @ np.array(values) / weight.sum()))
        scatter = float(weight @ (np.array(values) - means[-1]) ** 2) / max(len(seen) - 1, 1) / len(seen)
        errors.append(math.sqrt(max(scatter, 1.0) * len(seen) / weight.sum()))  # windows are alike for all cameras
    explained = all(one.explained for one in seen)
    return Scales(dots=means[0], dots_std=errors[0], planes=means[1], planes_std=errors[1], explained=explained)


def _scales(camera: CameraLabels, magnification: float) -> Scales:
    """Fit a thin lens and the scale of the planes to the labels of one camera."""
    dots, lens = camera.dots, camera.lens
    chosen = np.unique(np.linspace(0, len(dots.points_mm) - 1, min(len(dots.points_mm), SAMPLES)).astype(int))
    points, pupil, array = dots.points_mm[chosen], dots.pupil_mm[chosen], dots.array_mm[chosen]
    middle, along_z = float(np.median(points[:, 2])), np.array([0.0, 0.0, 1.0])
    prior = np.append(PRIOR, PRIOR[0])

    def residual_of(parameters: np.ndarray) -> np.ndarray:
        scaled = points + parameters[-1] * (points[:, 2:] - middle) * along_z
        return (moved(lens, parameters[:-1])(scaled, pupil) - array).ravel()

    before, parameters = _scatter(residual_of(np.zeros(prior.size))), robust_minimum(residual_of, prior)
    residual = residual_of(parameters)
    after = _scatter(residual)
    weight = 1 / (1 + (residual / (OUTLIER * after)) ** 2) ** 2
    jacobian = np.stack([(residual_of(parameters + step) - residual) / STEP for step in STEP * np.eye(prior.size)], 1)
    gram = (jacobian * weight[:, None]).T @ jacobian + np.diag((after / prior) ** 2)
    shared = len(chosen) / len(np.unique(dots.dot[chosen]))  # labels of a dot share its error
    chance = np.linalg.inv(gram) * shared * after**2

    def magnified(p: np.ndarray) -> float:
        fitted = moved(lens, p[:-1])
        depth = float(fitted.rotation[2] @ -fitted.offset_mm)
        return fitted.image_distance_mm / (fitted.object_distance_mm - depth) / magnification

    seen = magnified(parameters)
    slope = np.array([magnified(parameters + step) - seen for step in STEP * np.eye(prior.size)]) / STEP
    return Scales(
        dots=seen,
        dots_std=math.sqrt(slope @ chance @ slope + ANAMORPHIC**2),
        planes=1 + float(parameters[-1]),
        planes_std=math.sqrt(chance[-1, -1] + (ANAMORPHIC / _tilt(camera)) ** 2),
        explained=after < EXPLAINED * before,
    )


def _scatter(residual: np.ndarray) -> float:
    return max(NORMAL_MAD * float(np.median(np.abs(residual))), SMALLEST_STD_MM)
