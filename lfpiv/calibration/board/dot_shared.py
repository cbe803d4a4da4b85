"""Parameters of one camera that its dots share: diameter, blur and bend; and the noise and response of its pixels.

The bend is the part of the rays over the pupil of third order and higher, mostly spherical aberration. Its order is the
lowest after which the dots show no higher terms. One dot measures the shared
parameters poorly, all dots measure them well. Each `DotFit` holds the Gauss-Newton equations of the shared
parameters with the dot's own unknowns eliminated, so the sum of these equations over the dots is the joint fit of all.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from lfpiv.calibration.board.dot_fit import BoardPixels, DotFit, converged, fit_dots
from lfpiv.calibration.board.dot_model import (
    BEND_ORDERS,
    TERMS,
    LensIntegral,
    SharedParameters,
    bends,
    order_of,
    ray_terms,
)
from lfpiv.calibration.board.dots import ExpectedDot
from lfpiv.calibration.board.pupil_zones import INNER
from lfpiv.geometry.optics import spread_over_pupil
from lfpiv.lightfield.decoder import NORMAL_MAD
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

_SAMPLE = 48  # dots that estimate blur, a first diameter and a first bend
_ROUNDS = 8
_CHANGE = 0.005  # smallest change that needs another round [logarithm, pixel^2, pitch]
_LARGEST_CHANGE = 0.25  # of one round, in the same units
_SIZE_PRIOR = (0.3, 0.5)  # standard deviation of the prior on log(diameter) and on blur^2 [pixel^2]
_BEND_PRIOR_PITCHES = 0.5  # standard deviation of the prior on each term of the bend
_NOTABLE = 0.1  # error of the stated diameter that is worth a warning [logarithm]
_CHANCE = 1e-3  # probability that dots without a bend show one by chance
_WORTH = 0.985  # a higher order must lower the typical residual to this part
_OUTLIER_CHI2 = 2.0  # fits with this many times the typical residual are left out
_SHARE = 0.3  # pixels with at least this part of the largest share of a dot measure noise and pixel response
_CALM_SIGMA, _CALM_DEVIATION = 4.0, 0.5  # pixels further off in light or response are left out


def estimate_shared(
    pixels: BoardPixels,
    expected: Sequence[ExpectedDot],
    stated_diameter_mm: float,
    margin_mm: float,
) -> SharedParameters:
    """Fit the shared parameters to a sample of the dots.

    A model dot of the wrong size is fitted in the wrong position where a lens's edge cuts its light. The diameter acts
    at all depths, the blur grows with the slope of the rays, so planes at different depths separate the two. The
    fitted pixels reach `margin_mm` beyond the expected light of a dot.
    """
    chosen = np.unique(np.linspace(0, len(expected) - 1, _SAMPLE).astype(int))
    sample = [expected[k] for k in chosen]
    shared, found = _fit_shared(pixels, sample, stated_diameter_mm, margin_mm)
    none = np.zeros(shared.bend_mm.size, bool)
    bent = _common_bend(found, shared, pixels.decoder.optics.microlens_pitch_mm, none)[1] < _CHANCE
    for order in BEND_ORDERS[1:] if bent else ():
        higher = _higher(pixels, sample, shared, order, found, margin_mm, stated_diameter_mm)
        if higher is None:
            break
        shared, found = higher
    if abs(np.log(shared.diameter_mm / stated_diameter_mm)) > _NOTABLE:
        figures = {"seen_mm": shared.diameter_mm, "stated_mm": stated_diameter_mm}
        warn(log, Warning(code=Code.DOT_WIDTH, figures=figures))
    return shared


def _model(pixels: BoardPixels, shared: SharedParameters) -> LensIntegral:
    return LensIntegral(pixels.decoder.optics, pixels.decoder.lattice, shared)


def _fit_shared(
    pixels: BoardPixels,
    sample: Sequence[ExpectedDot],
    stated_diameter_mm: float,
    margin_mm: float,
) -> tuple[SharedParameters, Sequence[DotFit | None]]:
    """Fit the shared parameters with a bend of third order to some dots."""
    pitch, count = pixels.decoder.optics.microlens_pitch_mm, 2 * bends(BEND_ORDERS[0])
    prior = np.array([*_SIZE_PRIOR, *[_BEND_PRIOR_PITCHES] * count])
    unit = np.array([1, 1, *[pitch] * count])
    at = np.zeros(len(prior))  # log(diameter / stated), blur^2 [pixel^2], bend [pitch]
    found: Sequence[DotFit | None] | None = None
    for _ in range(_ROUNDS):
        found = fit_dots(_model(pixels, _shared(at, stated_diameter_mm, pitch)), pixels, sample, margin_mm, found)
        fits, typical = _typical(found)
        if not fits:
            break
        total = sum(one.pull_information for one in fits) * np.outer(unit, unit) / typical + np.diag(1 / prior**2)
        pull = sum(one.pull for one in fits) * unit / typical - at / prior**2
        change = np.clip(np.linalg.solve(total, pull), -_LARGEST_CHANGE, _LARGEST_CHANGE)
        if at[1] + change[1] < 0:  # no blur: solve for the others only
            free = np.arange(len(at)) != 1
            change[free] = np.linalg.solve(total[free][:, free], pull[free]).clip(-_LARGEST_CHANGE, _LARGEST_CHANGE)
            change[1] = -at[1]
        at = at + change
        if np.abs(change).max() < _CHANGE:
            break
    return _shared(at, stated_diameter_mm, pitch), found or []


def _higher(
    pixels: BoardPixels,
    sample: Sequence[ExpectedDot],
    lower: SharedParameters,
    order: int,
    found: Sequence[DotFit | None],
    margin_mm: float,
    stated_diameter_mm: float,
) -> tuple[SharedParameters, Sequence[DotFit | None]] | None:
    """Fit a bend of a higher order to some dots; None unless they show it beyond chance and fit better with it.

    Diameter and blur stay, because rays that are still bent within a pixel look like blur. Where the dots show the
    order but fit no better, the blur of the lower order may stand for what it lacks. Then the stated diameter without
    blur is tried.
    """
    pitch, typical = pixels.decoder.optics.microlens_pitch_mm, _typical(found)[1]
    known = np.tile(np.arange(bends(order)) < len(lower.bend_mm), 2)
    for start in (lower, replace(lower, diameter_mm=stated_diameter_mm, blur_px=0.0)):
        shared = start.of_order(order)
        fits = fit_dots(_model(pixels, shared), pixels, sample, margin_mm, found)
        bend, chance = _common_bend(fits, shared, pitch, known)
        if not chance < _CHANCE:
            return None
        if best := _stepped(pixels, sample, shared, bend, fits, margin_mm, _WORTH * typical):
            return best
    return None


def _stepped(
    pixels: BoardPixels,
    sample: Sequence[ExpectedDot],
    shared: SharedParameters,
    bend: np.ndarray,
    found: Sequence[DotFit | None],
    margin_mm: float,
    limit: float,
) -> tuple[SharedParameters, Sequence[DotFit | None]] | None:
    """Step towards the bend that dots show as long as their typical residual falls much.

    None unless it falls below a limit.
    """
    pitch, typical, best = pixels.decoder.optics.microlens_pitch_mm, _typical(found)[1], None
    for _ in range(_ROUNDS):
        change = bend - shared.bend_mm
        change *= min(1.0, _LARGEST_CHANGE * pitch / max(_largest(change), 1e-12))
        nearer = replace(shared, bend_mm=shared.bend_mm + change)
        found = fit_dots(_model(pixels, nearer), pixels, sample, margin_mm, follow(found, shared, nearer))
        shared = nearer
        now = _typical(found)[1]
        if now < (typical if best else limit):
            best = shared, found
        if not now < _WORTH * typical:
            break
        typical = now
        bend, _ = _common_bend(found, shared, pitch, np.zeros(bend.size, bool))
    return best


def _shared(at: np.ndarray, stated_diameter_mm: float, pitch: float) -> SharedParameters:
    return SharedParameters(
        diameter_mm=float(stated_diameter_mm * np.exp(at[0])),
        blur_px=float(np.sqrt(at[1])),
        bend_mm=pitch * at[2:].reshape(2, -1).T,
    )


def _typical(fits: Sequence[DotFit | None]) -> tuple[list[DotFit], float]:
    """Return the fits that are not much worse than the typical one, and its mean squared residual."""
    sure = converged(fits)
    typical = float(np.median([fit.reduced_chi2 for fit in sure])) if sure else np.nan
    return [fit for fit in sure if fit.reduced_chi2 <= _OUTLIER_CHI2 * typical], typical


def estimate_bend(shared: SharedParameters, fits: Sequence[DotFit | None], pitch_mm: float) -> SharedParameters:
    """Return the shared parameters with the bend that all dots show; no bend where chance explains it.

    `fits` are the fits of all dots by `shared` and by weak priors.
    """
    bend, chance = _common_bend(fits, shared, pitch_mm, np.zeros(shared.bend_mm.size, bool))
    if chance >= _CHANCE:
        bend = np.zeros_like(bend)
    else:
        text = "aberrations bend rays at the rim of the main lens by %.2g microlens pitches (rms)"
        log.info(text, _edge(bend) / pitch_mm)
    return replace(shared, bend_mm=bend)


def labels_spread(shared: SharedParameters, fits: Sequence[DotFit | None], pitch_mm: float) -> float:
    """Return the mean error of labels that errors of the shared parameters make [mm], within `INNER` of the pupil.

    It is common to all labels, so they do not show it among themselves. The scatter of the dots' pulls, which includes
    errors of their model, gives the errors of the parameters [1]_. `fits` as `estimate_bend` takes them; a bend that
    they do not show has no error.

    References
    ----------
    .. [1] H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50 (1982) 1-25,
       doi:10.2307/1912526.
    """
    sure, typical = _typical(fits)
    if len(sure) < 2:
        return 0.0
    each, own = (shared.bend_mm.size // 2) * bool(shared.bend_mm.any()), slice(TERMS)
    free = 2 + 2 * each
    information = np.stack([fit.pull_information[:free, :free] for fit in sure]) / typical
    pull = np.stack([fit.pull[:free] for fit in sure]) / typical
    prior = np.append(1 / np.square(_SIZE_PRIOR), np.full(2 * each, (_BEND_PRIOR_PITCHES * pitch_mm) ** -2))
    inverse = np.linalg.inv(information.sum(0) + np.diag(prior))
    miss = (pull - information @ (inverse @ pull.sum(0))) @ inverse
    terms = ray_terms(INNER * spread_over_pupil(1.0), 1.0, shared.order)
    following = np.stack([fit.following[:, :free].reshape(2, TERMS, free) for fit in sure])
    moved = terms[:, own] @ following  # of the rays of each dot, shape (dots, 2, rays, free)
    for axis in range(2):
        moved[:, axis, :, 2 + axis * each : 2 + (axis + 1) * each] += terms[:, TERMS : TERMS + each]
    square = np.einsum("darn,nm,darm->", moved, miss.T @ miss, moved) / (len(moved) * len(terms))
    return float(np.sqrt(np.pi / 4 * square * len(sure) / (len(sure) - 1)))


def _common_bend(
    fits: Sequence[DotFit | None], shared: SharedParameters, pitch_mm: float, known: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the bend that dots have in common [mm], and the chance of dots without any but the `known` terms.

    The bends of single dots scatter about the common bend, by model errors too. An F-test compares the common bend with
    that scatter. Without the test the noise would give a perfect lens a bend.
    """
    sure, typical = _typical(fits)
    start = shared.bend_mm.T.ravel()
    if len(sure) < 2:
        return np.zeros_like(shared.bend_mm), 1.0
    information = np.stack([fit.pull_information[2:, 2:] for fit in sure]) / typical
    pull = np.stack([fit.pull[2:] for fit in sure]) / typical + information @ start  # relative to no bend
    prior = np.eye(len(start)) / (_BEND_PRIOR_PITCHES * pitch_mm) ** 2
    total = information.sum(0) + prior
    found = np.linalg.solve(total, pull.sum(0))
    miss = pull - information @ found
    scatter = np.einsum("ka,ka->", miss, np.linalg.solve(information + prior, miss[..., None])[..., 0])
    gain = found @ total @ found
    if known.any():
        less = np.linalg.solve(total[known][:, known], pull.sum(0)[known])
        gain -= less @ pull.sum(0)[known]
    freedom, free = len(start) * (len(sure) - 1), len(start) - known.sum()
    chance = float(stats.f.sf(gain / free / (scatter / freedom), free, freedom))
    return found.reshape(2, -1).T, chance


def estimate_diameter(shared: SharedParameters, fits: Sequence[DotFit | None]) -> SharedParameters:
    """Return the shared parameters with the diameter that all dots show.

    `fits` are the fits of all dots by `shared`. One Gauss-Newton step finds the diameter. Blur and bend stay: fitted
    along with the diameter, the blur takes what the bend cannot describe.
    """
    sure, _ = _typical(fits)
    change = sum(fit.pull[0] for fit in sure) / max(sum(fit.pull_information[0, 0] for fit in sure), 1e-12)
    change = np.clip(change, -_LARGEST_CHANGE, _LARGEST_CHANGE)
    return replace(shared, diameter_mm=float(shared.diameter_mm * np.exp(change)))


def follow(fits: Sequence[DotFit | None], before: SharedParameters, after: SharedParameters) -> list[DotFit | None]:
    """Return the fits by the shared parameters `before` as they would be by those `after`, to first order."""
    size = [np.log(after.diameter_mm / before.diameter_mm), after.blur_px**2 - before.blur_px**2]
    change = np.append(size, (after.bend_mm - before.bend_mm).T.ravel())
    return [
        fit and replace(fit, coefficients=fit.coefficients + (fit.following @ change).reshape(2, TERMS).T)
        for fit in fits
    ]


def _largest(bend: np.ndarray) -> float:
    """Return the largest displacement of a ray by a bend over the pupil."""
    order = order_of(bend)
    rays = ray_terms(spread_over_pupil(1.0), 1.0, order)[:, TERMS:] @ bend
    return float(np.linalg.norm(rays, axis=1).max())


def _edge(bend_mm: np.ndarray) -> float:
    """Return the root mean square of a bend over the pupil's edge [mm]."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    order = order_of(bend_mm)
    edge = ray_terms(np.stack([np.cos(angle), np.sin(angle)], 1), 1.0, order)[:, TERMS:]
    return float(np.sqrt(((edge @ bend_mm) ** 2).sum(1).mean()))


def estimate_pixels(pixels: BoardPixels, fits: Sequence[DotFit | None]) -> BoardPixels:
    """Return the pixels with the shot noise, and the response share of the white image's scatter, of fitted dots.

    For true response, light over fit minus 1 equals white over smooth white minus 1. For noise of the white image the
    two are independent. The slope of the first over the second is the share.
    """
    decoder = pixels.decoder
    deviations, lights, misses = [], [], []
    for fit in converged(fits):
        chosen = fit.share > _SHARE * fit.share.max()  # saturated pixels are not fitted, so none may see the whole dot
        at = tuple(fit.pixel[chosen].T)
        smooth = decoder.smooth_gain[at]
        light = (fit.base + fit.amplitude * fit.share[chosen]) * smooth
        light = light * decoder.coverage[at] * decoder.white_counts
        use = (smooth > 0) & (light > 0)
        lights.append(light[use])
        misses.append(fit.misfit[chosen][use])
        deviations.append((decoder.gain[at] / np.maximum(smooth, 1e-3) - 1)[use])
    if not lights:
        return pixels.measured(1.0, decoder.counts_per_photon)
    deviation, expected, miss = (np.concatenate(part).astype(float) for part in (deviations, lights, misses))
    relative = miss / expected
    limit = _CALM_SIGMA * NORMAL_MAD * np.median(np.abs(relative))
    calm = (np.abs(relative) < limit) & (np.abs(deviation) < _CALM_DEVIATION)
    share = float(np.clip((deviation * relative)[calm].sum() / max((deviation**2)[calm].sum(), 1e-12), 0, 1))
    left = (miss - share * deviation * expected) ** 2 / expected
    return pixels.measured(share, max(float(np.median(left)) * NORMAL_MAD**2, 1e-3))
