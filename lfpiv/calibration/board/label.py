"""Label the rays of the detected dots by the dot model integrated over the microlenses.

Every dot is fitted to its raw pixels twice. The first round has weak priors. It measures the shared parameters, the
noise and response of the pixels, and the variation of the ray models over the board and its planes. The second round
takes this smooth variation as its prior, for all dots in the field. The prior matters for focused dots: the light of a
dot within one lens does not show where in the lens the dot lies.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lfpiv.calibration.board.dot_fit import FEWEST_PIXELS, BoardPixels, DotFit, converged, fit_dots
from lfpiv.calibration.board.dot_model import TERMS, LensIntegral, ray_terms, slope_of
from lfpiv.calibration.board.dot_shared import (
    estimate_bend,
    estimate_diameter,
    estimate_pixels,
    estimate_shared,
    follow,
    labels_spread,
)
from lfpiv.calibration.board.dots import FEWEST_DOTS, Detection, DotBoard, Labels, expect_dots
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.calibration.board.pupil_zones import left_over, shared_error
from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import NORMAL_MAD, LightFieldDecoder

_MARGIN_PITCHES = (0.5, 0.25)  # pixels this far beyond a dot's light are fitted too, first and second round
_PRIOR_PITCHES = (0.5, 0.3, 0.1)  # prior of the first round on position, slope and curvature over the pupil
_FLOOR_PITCHES = (0.02, 0.01, 0.005)  # least standard deviation of the second round's prior on them
_OUTLIER_CHI2, _OUTLIER_MISFIT = 6.0, 0.1  # a fit is no dot above both: times the typical residual, share of the light
_OUTLIER_LIGHT = 3.0  # a dot is at most this many times fainter or brighter than the typical dot of its plane
_OUTLIER_SIGMA, _OUTLIER_PITCHES = 6.0, 0.15  # a dot is less than one of them off its expected position
_LABELS = 37  # pupil points per dot
_SEEN_PIXELS = 1.5  # a label lies at most this far from a pixel that saw the dot
_PLANE_DOTS = 9  # least number of dots of a plane that gets its own displacement beside the smooth departure
_PLANE_SIGMA = 5.0  # a plane is displaced if its median departure is this many standard errors
_PLANE_WEIGHT = 1e-2  # scale of these terms: where both can describe a departure, the smooth one does
_TUKEY = 4.685  # residual without weight in Tukey's biweight [standard deviations]
_ROBUST_ROUNDS = 15

_ORDER = np.array([0, 1, 1, 2, 2, 2])  # order in the pupil of each term of the ray model


def label_by_integral(signals: Signals, decoder: LightFieldDecoder, board: DotBoard, detection: Detection) -> Labels:
    """Fit every dot to its raw pixels and sample its rays.

    Raises
    ------
    InputError
        If fewer detected blobs than make a board look like dots.
    """
    optics, pitch = decoder.optics, decoder.optics.microlens_pitch_mm
    pixels = BoardPixels.from_decoder(signals, detection.sign, decoder)
    theta = _pose_terms(detection.pose, board.of_dots_mm(detection.dot), optics.pupil_radius_mm)
    theta[:, 0] = detection.chief_mm
    sigma = np.broadcast_to((np.take(_PRIOR_PITCHES, _ORDER) * pitch)[:, None], theta.shape)
    expected = expect_dots(detection.pose, board, optics, detection.dot, theta, sigma)
    margin = _MARGIN_PITCHES[0] * pitch
    shared = estimate_shared(pixels, expected, board.diameter_mm, margin)
    fits = fit_dots(LensIntegral(optics, decoder.lattice, shared), pixels, expected, margin)
    bent = estimate_bend(shared, fits, pitch)
    spread_mm = labels_spread(bent, fits, pitch)
    fits = follow(fits, shared, bent)

    pixels = estimate_pixels(pixels, fits)
    prior = _predict(fits, detection, board, optics)
    expected = expect_dots(prior.pose, board, optics, prior.dot, prior.theta, prior.sigma)
    model = LensIntegral(optics, decoder.lattice, bent)
    fits = fit_dots(model, pixels, expected, _MARGIN_PITCHES[1] * pitch)
    resized = estimate_diameter(bent, fits)
    fits, model = follow(fits, bent, resized), LensIntegral(optics, decoder.lattice, resized)
    trusted = _trusted(fits, prior, board, pitch, detection.sign)
    rejected = prior.dot[np.isin(prior.dot, detection.dot) & ~trusted]
    measured = {int(dot): fit for dot, fit, sure in zip(prior.dot, fits, trusted, strict=True) if sure and fit}
    labels = _sample(measured, rejected, model, pixels.response_share)
    return replace(labels, shared_error_mm=float(np.hypot(labels.shared_error_mm, spread_mm)))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Prediction:
    """Ray models of all dots in the field, as the first round predicts them."""

    pose: CameraPose
    dot: np.ndarray  # numbers of the dots, (d,)
    theta: np.ndarray  # ray models [mm], (d, TERMS, 2)
    sigma: np.ndarray  # their standard deviations [mm], (d, TERMS, 2)


def _predict(fits: Sequence[DotFit | None], detection: Detection, board: DotBoard, optics: Optics) -> _Prediction:
    """Predict the ray models of the dots by a pose and a smooth departure from it, both fitted to the first round."""
    pitch, radius = optics.microlens_pitch_mm, optics.pupil_radius_mm
    good = [k for k, fit in enumerate(fits) if fit is not None and fit.converged]
    sure = converged(fits)
    if len(sure) < min(FEWEST_DOTS, board.size):
        raise InputError(
            f"board: {len(fits)} blobs look like dots, but only {len(sure)} of them fit a dot of diameter "
            f"{board.diameter_mm:g} mm. Check the board images and [board]."
        )
    points = board.of_dots_mm(detection.dot)[good]
    theta = np.stack([fit.coefficients for fit in sure])
    slopes = np.array([np.trace(slope_of(fit.coefficients, radius)) / 2 for fit in sure])
    pose = detection.pose.fitted(points, theta[:, 0], optics, slopes)
    dots = _candidates(detection, board)
    wanted = board.of_dots_mm(dots)
    spread = np.stack([_spread(fit) for fit in sure])
    floor = np.take(_FLOOR_PITCHES, _ORDER)[:, None] * pitch
    smooth, scatter = _smooth(points, theta - _pose_terms(pose, points, radius), spread, wanted, board, floor[0, 0])
    expected = _pose_terms(pose, wanted, radius) + smooth
    return _Prediction(pose=pose, dot=dots, theta=expected, sigma=np.hypot(scatter, floor))


def _candidates(detection: Detection, board: DotBoard) -> np.ndarray:
    """Return the numbers of the detected dots and, in planes that show the board, of all others in the field.

    Planes without dots, such as a blank image, are left out: a fit from a good guess would find dots in their noise.
    """
    seen = np.bincount(detection.dot // board.size, minlength=len(detection.in_field))
    shown = (seen > 0) & (seen >= np.minimum(FEWEST_DOTS, detection.in_field.sum(1)))
    in_field = np.flatnonzero((detection.in_field & shown[:, None]).ravel())
    return np.union1d(detection.dot[shown[detection.dot // board.size]], in_field)


def _pose_terms(pose: CameraPose, points: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """Return the ray models of a pose, shape (n, TERMS, 2) [mm]."""
    chief, slope = pose.rays(points)
    theta = np.zeros((len(points), TERMS, 2))
    theta[:, 0] = chief
    theta[:, 1, 0] = theta[:, 2, 1] = slope * pupil_radius_mm
    return theta


def _spread(fit: DotFit) -> np.ndarray:
    """Return the standard errors of the ray model [mm], wider where the fit is poor, shape (TERMS, 2)."""
    error: np.ndarray = np.sqrt(np.diag(fit.covariance) * max(fit.reduced_chi2, 1))
    return error.reshape(2, TERMS).T


def _smooth(
    points: np.ndarray, change: np.ndarray, spread: np.ndarray, wanted: np.ndarray, board: DotBoard, floor_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a robust polynomial in (x, y, z), at most cubic, to each coefficient of the ray models.

    If planes do not stand where they are said to, each plane has a displacement and a tilt of its own beside it.
    `floor_mm` is the departure of a plane that does not matter [mm]. Return its values at `wanted`, (n, TERMS, 2), and
    their standard deviations: the scatter of the dots about it beyond their own errors, and the polynomial's own error.
    """
    limits = [min(3, board.dots[0] - 1), min(3, board.dots[1] - 1), min(3, len(np.unique(points[:, 2])) - 1)]
    powers = [p for p in itertools.product(range(4), repeat=3) if sum(p) <= 3 and np.all(np.array(p) <= limits)]
    for degree in (3, 2, 1, 0):
        powers = [p for p in powers if sum(p) <= degree]
        if len(points) >= 3 * len(powers):
            break
    centre, half = points.mean(0), np.maximum(np.ptp(points, axis=0) / 2, 1e-9)

    def design(where: np.ndarray) -> np.ndarray:
        scaled = (where - centre) / half
        return np.stack([np.prod(scaled ** np.array(p), axis=1) for p in powers], axis=1)

    have, want = design(points), design(wanted)
    displaced = _displaced_planes(points, have, change[:, 0], spread[:, 0], floor_mm)
    have, want = (
        np.hstack([terms, _plane_terms((where - centre) / half, where[:, 2], displaced)])
        for terms, where in ((have, points), (want, wanted))
    )
    values, sigma = np.empty((len(wanted), TERMS, 2)), np.empty((len(wanted), TERMS, 2))
    for term, axis in itertools.product(range(TERMS), range(2)):
        fitted = _robust_fit(have, want, change[:, term, axis], spread[:, term, axis] ** 2)
        values[:, term, axis], sigma[:, term, axis] = fitted
    return values, sigma


def _displaced_planes(
    points: np.ndarray, have: np.ndarray, chief: np.ndarray, spread: np.ndarray, floor_mm: float
) -> np.ndarray:
    """Return the depths of the planes that get their own terms: none unless a plane departs from the smooth fit."""
    departure = np.empty_like(chief)
    for axis in range(2):
        departure[:, axis] = chief[:, axis] - _robust_fit(have, have, chief[:, axis], spread[:, axis] ** 2)[0]
    depths, count = np.unique(points[:, 2], return_counts=True)
    enough = depths[count >= _PLANE_DOTS]
    for depth in enough:
        here = departure[points[:, 2] == depth]
        median = np.median(here, axis=0)
        error = np.sqrt(np.pi / 2 / len(here)) * NORMAL_MAD * np.median(np.abs(here - median), axis=0)
        if (np.abs(median) > np.maximum(floor_mm, _PLANE_SIGMA * error)).any():
            return enough
    return enough[:0]


def _plane_terms(scaled: np.ndarray, depth: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return the columns 1, x, y of each of the planes, zero for dots of other planes, shape (n, 3 planes)."""
    columns = np.hstack([np.ones((len(scaled), 1)), scaled[:, :2]])
    terms: np.ndarray = (_PLANE_WEIGHT * columns[:, None] * (depth[:, None] == planes)[..., None]).reshape(
        len(scaled), -1
    )
    return terms


def _robust_fit(
    have: np.ndarray, want: np.ndarray, y: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit y = have @ c with Tukey's weights, given variances and an unknown scatter beside them; predict at `want`."""
    scatter2, robust = 0.0, np.ones(len(y))
    sharp = variance <= np.median(variance)
    for _ in range(_ROBUST_ROUNDS):
        weight = robust / (variance + scatter2 + 1e-16)
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(have * root, y * root[:, 0], rcond=None)[0]
        residual = y - have @ coefficients
        typical = (NORMAL_MAD * np.median(np.abs(residual[sharp]))) ** 2
        scatter2 = max(typical - np.median(variance[sharp]), 0.0)
        ratio = np.abs(residual) / (_TUKEY * np.sqrt(variance + max(scatter2, 0.1 * typical) + 1e-16))
        robust = np.where(ratio < 1, (1 - np.minimum(ratio, 1) ** 2) ** 2, 0) + 1e-9
    inverse = np.linalg.pinv(have.T @ (have * weight[:, None]))
    return want @ coefficients, np.sqrt(scatter2 + np.einsum("na,ab,nb->n", want, inverse, want))


def _trusted(fits: Sequence[DotFit | None], prior: _Prediction, board: DotBoard, pitch: float, sign: int) -> np.ndarray:
    """Return which fits are dots: converged, and as good, as bright and as well placed as the others."""
    fitted = np.array([fit is not None and fit.converged and len(fit.seen_pupil_mm) >= FEWEST_PIXELS for fit in fits])
    if not fitted.any():
        return fitted
    chi2 = np.array([fit.reduced_chi2 if fit else np.inf for fit in fits])
    light = np.array([sign * fit.amplitude if fit else 0.0 for fit in fits])
    misfit = np.array([fit.relative_misfit if fit else np.inf for fit in fits])
    fitted &= (chi2 < _OUTLIER_CHI2 * max(np.median(chi2[fitted]), 1)) | (misfit < _OUTLIER_MISFIT)
    plane = prior.dot // board.size
    for p in np.unique(plane):
        typical = np.median(light[(plane == p) & fitted]) if ((plane == p) & fitted).any() else np.inf
        fitted &= (plane != p) | ((light > typical / _OUTLIER_LIGHT) & (light < typical * _OUTLIER_LIGHT))
    chief = np.array([fit.coefficients[0] if fit else (np.inf, np.inf) for fit in fits])
    limit = np.maximum(_OUTLIER_SIGMA * prior.sigma[:, 0], _OUTLIER_PITCHES * pitch)
    placed: np.ndarray = fitted & (np.abs(chief - prior.theta[:, 0]) < limit).all(1)
    return placed


def _spiral(dot: int, radius_mm: float) -> np.ndarray:
    """Return pupil points spread evenly to the edge, other ones for each dot, shape (_LABELS, 2) [mm]."""
    golden = (np.sqrt(5) - 1) / 2
    number = np.arange(_LABELS) + dot * golden % 1
    angle = 2 * np.pi * (number * golden + dot * np.sqrt(2))
    distance = radius_mm * np.sqrt(number / _LABELS)
    points: np.ndarray = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return points


def _sample(measured: dict[int, DotFit], rejected: np.ndarray, model: LensIntegral, response_share: float) -> Labels:
    """Sample the fitted ray models, by dot number, at pupil points near which each dot was seen."""
    radius = model.optics.pupil_radius_mm
    near, pitch = (_SEEN_PIXELS * model.optics.pupil_pixel_mm) ** 2, model.optics.microlens_pitch_mm
    pupil, array, std = [np.empty((0, 2))], [np.empty((0, 2))], [np.empty(0)]
    for dot, fit in measured.items():
        points = _spiral(dot, radius)
        points = points[(((points[:, None] - fit.seen_pupil_mm[None]) ** 2).sum(-1) < near).any(1)]
        terms = ray_terms(points, radius, model.shared.order)
        covariance = fit.covariance[:TERMS, :TERMS] + fit.covariance[TERMS:, TERMS:]
        variance = np.einsum("va,ab,vb->v", terms[:, :TERMS], covariance, terms[:, :TERMS]) / 2
        pupil.append(points)
        array.append(model.rays_mm(terms, fit.coefficients))
        std.append(np.sqrt(variance * max(fit.reduced_chi2, 1)))
    numbers, fits = np.array(list(measured), int), list(measured.values())
    chief = np.array([fit.coefficients[0] for fit in fits]).reshape(-1, 2)
    beside = left_over(fits, chief, pitch)
    return Labels(
        pupil_mm=np.concatenate(pupil),
        array_mm=np.concatenate(array),
        std_mm=np.concatenate(std),
        dot=np.repeat(numbers, np.array([len(part) for part in std[1:]], int)),
        rejected_dot=rejected,
        measured_dot=numbers,
        chief_mm=chief,
        slope=np.array([slope_of(fit.coefficients, radius) for fit in fits]).reshape(-1, 2, 2),
        reduced_chi2=np.array([fit.reduced_chi2 for fit in fits]),
        response_share=response_share,
        diameter_mm=model.shared.diameter_mm,
        blur_px=model.shared.blur_px,
        left_over_mm=beside,
        shared_error_mm=shared_error(fits, beside, pitch),
    )
