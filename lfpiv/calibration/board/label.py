"""Label the rays of detected dots by the dot model integrated over the microlenses."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv.calibration.board.detect import FEWEST_DOTS, Detection, DotBoard
from lfpiv.calibration.board.dot_model import (
    FEWEST_PIXELS,
    TERMS,
    DotFit,
    DotPixels,
    LensIntegral,
    lens_offset_mm,
    ray_terms,
    slope_of,
)
from lfpiv.calibration.board.dot_shared import Shared, settle, update_bend
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.errors import InputError
from lfpiv.lightfield.decoder import LightFieldDecoder, disc_fraction

log = logging.getLogger(__name__)

_FIT_COVERAGE = 0.9  # pixels cut by the edge of a microimage are left out of a fit,
_BESIDE_COVERAGE = 0.01  # and those that the next microimage reaches
_MARGIN_PITCHES = (0.5, 0.25)  # pixels this far beyond a dot's support are fitted too, first and second round
_PRIOR_PITCHES = (0.5, 0.3, 0.1)  # first round: loose prior on position, slope and curvature over the pupil [pitch]
_FLOOR_PITCHES = (0.02, 0.01, 0.005)  # second round: never tighter than this, so that light decides where it can
_OUTLIER_CHI2 = 6.0  # fits this many times worse than the typical one are no dots,
_OUTLIER_MISFIT = 0.1  # if they also leave this part of a dot's light unexplained
_OUTLIER_LIGHT = 3.0  # dots this many times fainter or brighter than the typical dot of their plane are none
_OUTLIER_SIGMA = 6.0  # dots this far off the smooth mapping, in units of its scatter, are none
_OUTLIER_PITCHES = 0.15  # but closer than this no dot is taken for an outlier
_NOISE_SHARE = 0.3  # pixels that see at least this part of a dot tell noise and pixel response
_VIEWS = 37  # pupil points at which a dot's rays are labelled
_NORMAL_MAD = 1.4826
_TUKEY = 4.685

_ORDER = np.array([0, 1, 1, 2, 2, 2])  # order in the pupil of each term of the ray model


@dataclass(frozen=True, eq=False, kw_only=True)
class Labels:
    """Labelled rays and measured dots of one camera; fields as in `lfpiv.calibration.board.board.BoardDots`."""

    pupil_mm: np.ndarray
    array_mm: np.ndarray
    std_mm: np.ndarray
    dot: np.ndarray
    rejected_dot: np.ndarray
    measured_dot: np.ndarray
    chief_mm: np.ndarray
    slope: np.ndarray
    reduced_chi2: np.ndarray
    response_share: float
    diameter_mm: float
    blur_px: float


def label_by_integral(
    signals: Sequence[np.ndarray], noise: float, decoder: LightFieldDecoder, board: DotBoard, detection: Detection
) -> Labels:
    """Fit every dot to its raw pixels, twice.

    The first round is nearly free. It tells how smoothly the ray models change over the board and its planes, the noise
    of the images and how much of the white image's scatter is pixel response. The second round starts every dot, the
    undetected ones too, from the smooth mapping, which also decides what a dot's own light leaves open: a focused dot
    that lies within one lens tells its position only to a part of a lens.
    """
    optics = decoder.optics
    pitch, radius = optics.microlens_pitch_mm, optics.pupil_radius_mm
    rounds = _Rounds(signals, decoder, board, detection)

    dot = detection.dot
    points = board.of_dots_mm(dot)
    mean = _pose_terms(detection.pose, points, radius)
    mean[:, 0] = detection.chief_mm
    loose = np.tile(1 / (np.take(_PRIOR_PITCHES, _ORDER) * pitch) ** 2, 2)
    response = decoder.coverage * decoder.smooth_gain * np.float32(decoder.white_counts)
    margin = _MARGIN_PITCHES[0] * pitch

    def fit(model: LensIntegral, chosen: np.ndarray) -> list[DotFit | None]:
        return rounds.run(model, response, dot[chosen], mean[chosen], np.tile(loose, (len(chosen), 1)), margin)[0]

    shared = settle(fit, len(dot), decoder, board.diameter_mm, noise)
    model = shared.model(decoder, noise, decoder.counts_per_photon)
    fits, taken = rounds.run(model, response, dot, mean, np.tile(loose, (len(dot), 1)), margin)
    shared, fits = update_bend(shared, fits, pitch)

    photon, share = _noise_and_response(fits, taken, decoder)
    model = shared.model(decoder, noise, photon)
    response = decoder.coverage * decoder.shrunk_gain(share) * np.float32(decoder.white_counts)

    good = [k for k, fit in enumerate(fits) if fit is not None and fit.converged]
    sure = [fit for fit in fits if fit is not None and fit.converged]
    if len(good) < min(FEWEST_DOTS, board.size):
        raise InputError(
            f"board: {len(dot)} blobs look like dots, but only {len(good)} of them fit a dot of diameter "
            f"{board.diameter_mm:g} mm. Check the board images and [board]."
        )
    slopes = np.array([np.trace(slope_of(fit.coefficients, radius)) / 2 for fit in sure])
    chief = np.array([fit.coefficients[0] for fit in sure])
    rounds.pose = pose = detection.pose.fitted(points[good], chief, optics, slopes)
    candidates = _candidates(detection, board)
    wanted = board.of_dots_mm(candidates)
    change = np.stack([fit.coefficients for fit in sure]) - _pose_terms(pose, points[good], radius)
    spread = np.stack([_spread(fit) for fit in sure])
    smooth, scatter = _smooth(points[good], change, spread, wanted, board)
    mean = _pose_terms(pose, wanted, radius) + smooth
    floor = np.take(_FLOOR_PITCHES, _ORDER)[:, None] * pitch
    sigma = np.hypot(scatter, floor)
    information = (1 / sigma**2).transpose(0, 2, 1).reshape(len(candidates), -1)
    fits, _ = rounds.run(model, response, candidates, mean, information, _MARGIN_PITCHES[1] * pitch)

    trusted = _trusted(fits, candidates // board.size, mean, sigma, pitch, detection.sign)
    return _integral_labels(fits, candidates, trusted, np.isin(candidates, dot) & ~trusted, decoder, share, shared)


def _candidates(detection: Detection, board: DotBoard) -> np.ndarray:
    """Numbers of the dots worth a fit: the detected ones and, in planes that show the board, all others in the field.

    In a plane without dots, such as a blank image, fits from a good guess would find some in its noise.
    """
    seen = np.bincount(detection.dot // board.size, minlength=len(detection.in_field))
    shown = (seen > 0) & (seen >= np.minimum(FEWEST_DOTS, detection.in_field.sum(1)))
    in_field = np.flatnonzero((detection.in_field & shown[:, None]).ravel())
    return np.union1d(detection.dot[shown[detection.dot // board.size]], in_field)


class _Rounds:
    """What both rounds of fits share."""

    def __init__(
        self, signals: Sequence[np.ndarray], decoder: LightFieldDecoder, board: DotBoard, detection: Detection
    ):
        self.signals, self.decoder, self.board, self.sign = signals, decoder, board, detection.sign
        self.pose = detection.pose
        optics = decoder.optics
        to_px = optics.sensor_per_pupil / optics.pixel_mm
        alone, _ = disc_fraction(decoder.pupil_mm * np.float32(to_px), optics.pupil_radius_mm * to_px)
        beside = ndimage.maximum_filter(decoder.coverage - alone, 3)  # blur takes light one pixel further
        self.usable = (alone > _FIT_COVERAGE) & (beside < _BESIDE_COVERAGE) & (decoder.gain > 0)

    def run(
        self,
        model: LensIntegral,
        response: np.ndarray,
        dots: np.ndarray,
        mean: np.ndarray,
        information: np.ndarray,
        margin_mm: float,
    ) -> tuple[list[DotFit | None], list[np.ndarray]]:
        """Fit dots; returns the fits, None where a dot has too few pixels, and where their pixels lie on the sensor."""
        points = self.board.of_dots_mm(dots)
        jacobians, tilts = self.pose.board_jacobian(points, model.pupil_radius_mm)
        chief = self.pose.rays(points)[0]
        steps = [s for s in itertools.product((-1, 0, 1), repeat=2) if any(s)]
        around = np.stack(
            [self.pose.rays(points + self.board.spacing_mm * np.array([*s, 0]))[0] for s in steps], axis=1
        )
        fits, taken = [], []
        for k, dot in enumerate(dots):
            where = self._pixels(model, mean[k], jacobians[k], around[k] - chief[k], margin_mm)
            where = where[~np.isnan(self.signals[dot // self.board.size][tuple(where.T)])]
            fit = None
            if len(where) >= FEWEST_PIXELS:
                at = (where[:, 0], where[:, 1])
                pixels = DotPixels(
                    signal=self.signals[dot // self.board.size][at].astype(float),
                    response=response[at].astype(float),
                    pupil_mm=self.decoder.pupil_mm[at].astype(float),
                    lens_mm=self.decoder.lattice.centres_mm(self.decoder.lens_index[at]),
                )
                fit = model.fit(pixels, jacobians[k], tilts[k], mean[k], np.diag(information[k]), self.sign)
            fits.append(fit)
            taken.append(where)
        return fits, taken

    def _pixels(
        self,
        model: LensIntegral,
        theta: np.ndarray,
        board_jacobian: np.ndarray,
        neighbours_mm: np.ndarray,
        margin_mm: float,
    ) -> np.ndarray:
        """Rows and columns of the usable pixels that may see a dot and none of its neighbours, shape (n, 2)."""
        decoder, optics = self.decoder, self.decoder.optics
        slope = slope_of(theta, model.pupil_radius_mm)
        support = model.support_mm(board_jacobian, theta)
        bent = np.vstack([theta, model.bend_mm])
        reach = support + margin_mm + np.abs(bent[1:]).sum(0) + optics.microlens_pitch_mm
        corners = optics.sensor_px((theta[0] + [-reach, reach]) * (1 + optics.sensor_per_pupil))
        low = np.maximum(np.floor(corners[0]), 0).astype(int)
        high = np.maximum(np.ceil(corners[1]) + 1, low).astype(int)
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        row, column = np.nonzero(self.usable[window])
        at = (row + low[1], column + low[0])
        lens = decoder.lattice.centres_mm(decoder.lens_index[at])
        terms = ray_terms(decoder.pupil_mm[at], model.pupil_radius_mm)
        offset, _ = lens_offset_mm(terms, bent, lens, model.pupil_radius_mm)
        away = np.abs(offset)
        take = (away[:, 0] < support[0] + margin_mm) & (away[:, 1] < support[1] + margin_mm)
        inverse = np.linalg.inv(np.eye(2) - slope)
        for neighbour in neighbours_mm @ inverse.T:
            if (np.abs(neighbour) < 2 * support + margin_mm).all():
                take &= (np.abs(offset - neighbour) > support).any(1)
        chosen: np.ndarray = np.stack(at, axis=1)[take]
        return chosen


def _pose_terms(pose: CameraPose, points: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """Ray models of the pose, shape (n, TERMS, 2) [mm]."""
    chief, slope = pose.rays(points)
    theta = np.zeros((len(points), TERMS, 2))
    theta[:, 0] = chief
    theta[:, 1, 0] = theta[:, 2, 1] = slope * pupil_radius_mm
    return theta


def _spread(fit: DotFit) -> np.ndarray:
    """Return the standard errors of the ray model [mm], wider where the fit is poor, (TERMS, 2)."""
    error: np.ndarray = np.sqrt(np.diag(fit.covariance) * max(fit.reduced_chi2, 1))
    return error.reshape(2, TERMS).T


def _noise_and_response(
    fits: Sequence[DotFit | None], taken: Sequence[np.ndarray], decoder: LightFieldDecoder
) -> tuple[float, float]:
    """Shot noise of the images [counts], and the part of the white image's scatter that is pixel response.

    Where a dot is bright, light over fit minus 1 follows white over smooth white minus 1 for true response, and does
    not for noise of the white image; the slope between the two is the best weight for that scatter.
    """
    deviations, lights, misses = [], [], []
    for fit, where in zip(fits, taken, strict=True):
        if fit is None or not fit.converged:
            continue
        at = tuple(where[fit.share > _NOISE_SHARE].T)
        smooth = decoder.smooth_gain[at]
        light = (fit.base + fit.amplitude * fit.share[fit.share > _NOISE_SHARE]) * smooth
        light = light * decoder.coverage[at] * decoder.white_counts
        use = (smooth > 0) & (light > 0)
        lights.append(light[use])
        misses.append(fit.misfit[fit.share > _NOISE_SHARE][use])
        deviations.append((decoder.gain[at] / np.maximum(smooth, 1e-3) - 1)[use])
    if not lights:
        return decoder.counts_per_photon, 1.0
    deviation, expected, miss = (np.concatenate(part).astype(float) for part in (deviations, lights, misses))
    relative = miss / expected
    limit = 4 * _NORMAL_MAD * np.median(np.abs(relative))
    calm = (np.abs(relative) < limit) & (np.abs(deviation) < 0.5)
    share = float(np.clip((deviation * relative)[calm].sum() / max((deviation**2)[calm].sum(), 1e-12), 0, 1))
    left = (miss - share * deviation * expected) ** 2 / expected
    return max(float(np.median(left)) * _NORMAL_MAD**2, 1e-3), share


def _smooth(
    points: np.ndarray, change: np.ndarray, spread: np.ndarray, wanted: np.ndarray, board: DotBoard
) -> tuple[np.ndarray, np.ndarray]:
    """Robust polynomial in (x, y, z), at most cubic, through each coefficient of the ray models.

    Returns its values at `wanted`, (n, TERMS, 2), and its standard deviation there: the scatter of the dots about it
    beyond their own errors, and its own error.
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
    values, sigma = np.empty((len(wanted), TERMS, 2)), np.empty((len(wanted), TERMS, 2))
    for term, axis in itertools.product(range(TERMS), range(2)):
        y, variance, scatter2 = change[:, term, axis], spread[:, term, axis] ** 2, 0.0
        robust = np.ones(len(y))
        for _ in range(15):
            weight = robust / (variance + scatter2 + 1e-16)
            root = np.sqrt(weight)[:, None]
            coefficients = np.linalg.lstsq(have * root, y * root[:, 0], rcond=None)[0]
            residual = y - have @ coefficients
            sharp = variance <= np.median(variance)
            typical = (_NORMAL_MAD * np.median(np.abs(residual[sharp]))) ** 2
            scatter2 = max(typical - np.median(variance[sharp]), 0.0)
            ratio = np.abs(residual) / (_TUKEY * np.sqrt(variance + max(scatter2, 0.1 * typical) + 1e-16))
            robust = np.where(ratio < 1, (1 - np.minimum(ratio, 1) ** 2) ** 2, 0) + 1e-9
        inverse = np.linalg.pinv(have.T @ (have * weight[:, None]))
        values[:, term, axis] = want @ coefficients
        sigma[:, term, axis] = np.sqrt(scatter2 + np.einsum("na,ab,nb->n", want, inverse, want))
    return values, sigma


def _trusted(
    fits: Sequence[DotFit | None], plane: np.ndarray, mean: np.ndarray, sigma: np.ndarray, pitch: float, sign: int
) -> np.ndarray:
    """Which fits are dots: converged, as good, as bright and as well placed as the others."""
    fitted = np.array([fit is not None and fit.converged and len(fit.pupil_mm) >= FEWEST_PIXELS for fit in fits])
    if not fitted.any():
        return fitted
    chi2 = np.array([fit.reduced_chi2 if fit else np.inf for fit in fits])
    light = np.array([sign * fit.amplitude if fit else 0.0 for fit in fits])
    misfit = np.array([fit.relative_misfit if fit else np.inf for fit in fits])
    fitted &= (chi2 < _OUTLIER_CHI2 * max(np.median(chi2[fitted]), 1)) | (misfit < _OUTLIER_MISFIT)
    for p in np.unique(plane):
        typical = np.median(light[(plane == p) & fitted]) if ((plane == p) & fitted).any() else np.inf
        fitted &= (plane != p) | ((light > typical / _OUTLIER_LIGHT) & (light < typical * _OUTLIER_LIGHT))
    for k, fit in enumerate(fits):
        if fit is None or not fitted[k]:
            continue
        miss = np.abs(fit.coefficients[0] - mean[k, 0])
        fitted[k] = (miss < np.maximum(_OUTLIER_SIGMA * sigma[k, 0], _OUTLIER_PITCHES * pitch)).all()
    return fitted


def _views(dot: int, radius_mm: float) -> np.ndarray:
    """Pupil points spread evenly to the edge, others for each dot, so that a network sees them all, (VIEWS, 2) [mm]."""
    golden = (np.sqrt(5) - 1) / 2
    number = np.arange(_VIEWS) + dot * golden % 1
    angle = 2 * np.pi * (number * golden + dot * np.sqrt(2))
    distance = radius_mm * np.sqrt(number / _VIEWS)
    points: np.ndarray = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return points


def _integral_labels(
    fits: Sequence[DotFit | None],
    dots: np.ndarray,
    trusted: np.ndarray,
    rejected: np.ndarray,
    decoder: LightFieldDecoder,
    share: float,
    shared: Shared,
) -> Labels:
    """Sample the fitted ray models at pupil points near which each dot was seen."""
    optics = decoder.optics
    near = (1.5 * optics.pupil_pixel_mm) ** 2
    pupil, array, std, owner = [], [], [], []
    kept = [(dot, fit) for dot, fit, sure in zip(dots, fits, trusted, strict=True) if sure and fit is not None]
    for dot, fit in kept:
        views = _views(int(dot), optics.pupil_radius_mm)
        terms = ray_terms(views, optics.pupil_radius_mm)
        seen = (((views[:, None] - fit.pupil_mm[None]) ** 2).sum(-1) < near).any(1)
        covariance = fit.covariance[:TERMS, :TERMS] + fit.covariance[TERMS:, TERMS:]
        own = terms[seen, :TERMS]
        variance = np.einsum("va,ab,vb->v", own, covariance, own) / 2
        pupil.append(views[seen])
        array.append(terms[seen] @ np.vstack([fit.coefficients, shared.bend_mm]))
        std.append(np.sqrt(variance * max(fit.reduced_chi2, 1)))
        owner.append(np.full(seen.sum(), dot))
    return Labels(
        pupil_mm=np.concatenate(pupil) if pupil else np.empty((0, 2)),
        array_mm=np.concatenate(array) if array else np.empty((0, 2)),
        std_mm=np.concatenate(std) if std else np.empty(0),
        dot=np.concatenate(owner) if owner else np.empty(0, int),
        rejected_dot=dots[rejected],
        measured_dot=dots[trusted],
        chief_mm=np.array([fit.coefficients[0] for _, fit in kept]).reshape(-1, 2),
        slope=np.array([slope_of(fit.coefficients, optics.pupil_radius_mm) for _, fit in kept]).reshape(-1, 2, 2),
        reduced_chi2=np.array([fit.reduced_chi2 for _, fit in kept]),
        response_share=share,
        diameter_mm=shared.diameter_mm,
        blur_px=shared.blur_px,
    )
