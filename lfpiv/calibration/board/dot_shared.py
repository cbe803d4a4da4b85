"""What all dots of a camera share: their diameter, the blur of its pixels, and the bend of its rays.

The bend is what the rays do beyond the second order of the pupil point: spherical aberration above all, which is cubic.
It hardly changes over a board, and one dot tells it coarsely or not at all, like the other two; all dots together tell
them well. Each fit of a dot hands on what it says about them with its own ray model fitted along
(`lfpiv.calibration.board.dot_model.DotFit`), so that sums over the dots are the Gauss-Newton equations of one joint fit of everything: a
bordered system, solved by elimination.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from lfpiv.calibration.board.dot_model import BENDS, TERMS, DotFit, LensIntegral, ray_terms
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

_SAMPLE = 48  # dots that tell the diameter, the blur and a first bend
_ROUNDS = 8
_CHANGE = 0.005  # they are settled when they change by less than this: a part, pixel^2, pitches
_STEP = 0.25  # and change at most by this in one round
_SIZE_PRIOR = (0.3, 0.5)  # how far a diameter is off (logarithm), and how large the square of a blur is [pixel^2]
_BEND_PRIOR_PITCHES = 0.5  # how large a term of the bend is
_NOTABLE = 0.1  # a diameter this far off is worth a warning
_CHANCE = 1e-3  # a bend is taken for one where dots without it would show as much this rarely
_OUTLIER_CHI2 = 2.0  # fits this many times worse than the typical one have no say


@dataclass(frozen=True, eq=False, kw_only=True)
class Shared:
    """What all dots of one camera share."""

    diameter_mm: float
    """Diameter of the dots as they look [mm]."""
    blur_px: float
    """Blur of the sensor and the microlenses, standard deviation [pixel]."""
    bend_mm: np.ndarray
    """Ray model beyond the second order of the pupil point [mm], shape (BENDS, 2)."""

    def model(self, decoder: LightFieldDecoder, noise: float, counts_per_photon: float) -> LensIntegral:
        """Dot model of a camera with these."""
        return LensIntegral(decoder, self.diameter_mm, self.blur_px, self.bend_mm, noise, counts_per_photon)


def settle(
    fit: Callable[[LensIntegral, np.ndarray], Sequence[DotFit | None]],
    dots: int,
    decoder: LightFieldDecoder,
    nominal_diameter_mm: float,
    noise: float,
) -> Shared:
    """Find what a sample of the dots fits best.

    A dot drawn too large or too small is fitted in the wrong place wherever its light is cut by a lens's edge. The
    diameter matters everywhere, the blur grows with the slope of the rays; so focus tells the two apart.

    Parameters
    ----------
    fit : callable
        Fits the chosen ones of the dots.
    dots : int
        Number of dots to choose from.
    decoder : LightFieldDecoder
        The camera's decoder.
    nominal_diameter_mm : float
        Diameter the user states [mm].
    noise : float
        Read-out noise [counts].
    """
    chosen = np.unique(np.linspace(0, dots - 1, _SAMPLE).astype(int))
    pitch = decoder.optics.microlens_pitch_mm
    prior = np.array([*_SIZE_PRIOR, *[_BEND_PRIOR_PITCHES] * (2 * BENDS)])
    unit = np.array([1, 1, *[pitch] * (2 * BENDS)])
    at = np.zeros(len(prior))  # log(diameter / nominal), blur^2 [pixel^2], bend [pitch]
    for _ in range(_ROUNDS):
        model = _shared(at, nominal_diameter_mm, pitch).model(decoder, noise, decoder.counts_per_photon)
        fits, typical = _alike(fit(model, chosen))
        if not fits:
            break
        total = sum(one.pull_information for one in fits) * np.outer(unit, unit) / typical + np.diag(1 / prior**2)
        pull = sum(one.pull for one in fits) * unit / typical - at / prior**2
        change = np.clip(np.linalg.solve(total, pull), -_STEP, _STEP)
        if at[1] + change[1] < 0:  # no blur: the others alone
            free = np.arange(len(at)) != 1
            change[free] = np.clip(np.linalg.solve(total[free][:, free], pull[free]), -_STEP, _STEP)
            change[1] = -at[1]
        at = at + change
        if np.abs(change).max() < _CHANGE:
            break
    if abs(at[0]) > _NOTABLE:
        seen = nominal_diameter_mm * np.exp(at[0])
        figures = {"seen_mm": float(seen), "stated_mm": nominal_diameter_mm}
        warn(log, Warning(code=Code.DOT_WIDTH, figures=figures))
    return _shared(at, nominal_diameter_mm, pitch)


def _shared(at: np.ndarray, nominal_diameter_mm: float, pitch: float) -> Shared:
    return Shared(
        diameter_mm=float(nominal_diameter_mm * np.exp(at[0])),
        blur_px=float(np.sqrt(at[1])),
        bend_mm=pitch * at[2:].reshape(2, BENDS).T,
    )


def _alike(fits: Sequence[DotFit | None]) -> tuple[list[DotFit], float]:
    """Return the fits that are as good as the typical one, and its mean squared residual."""
    sure = [fit for fit in fits if fit is not None and fit.converged]
    typical = float(np.median([fit.reduced_chi2 for fit in sure])) if sure else np.nan
    return [fit for fit in sure if fit.reduced_chi2 <= _OUTLIER_CHI2 * typical], typical


def update_bend(shared: Shared, fits: Sequence[DotFit | None], pitch_mm: float) -> tuple[Shared, list[DotFit | None]]:
    """Find the bend that all dots together show, none where chance explains it, and take their ray models along.

    The dots' bends scatter about the common one; an F-test of the common bend against that scatter, which model errors
    widen too, tells whether there is any. Without it a perfect lens would get a bend made of noise.

    Parameters
    ----------
    shared : Shared
        What the dots were fitted with.
    fits : sequence of DotFit or None
        Fits of all dots, by priors that leave the decision to the dots' light.
    pitch_mm : float
        Microlens pitch [mm].

    Returns
    -------
    shared : Shared
        With the new bend.
    fits : list of DotFit or None
        With the coefficients that belong to it, to first order.
    """
    sure, typical = _alike(fits)
    start = shared.bend_mm.T.ravel()
    bend = np.zeros_like(start)
    if len(sure) > 1:
        information = np.stack([fit.pull_information[2:, 2:] for fit in sure]) / typical
        pull = np.stack([fit.pull[2:] for fit in sure]) / typical + information @ start  # as seen from no bend
        prior = np.eye(len(start)) / (_BEND_PRIOR_PITCHES * pitch_mm) ** 2
        total = information.sum(0) + prior
        found = np.linalg.solve(total, pull.sum(0))
        miss = pull - information @ found
        scatter = np.einsum("ka,ka->", miss, np.linalg.solve(information + prior, miss[..., None])[..., 0])
        freedom = len(start) * (len(sure) - 1)
        ratio = found @ total @ found / len(start) / (scatter / freedom)
        chance = float(stats.f.sf(ratio, len(start), freedom))
        if chance < _CHANCE:
            bend = found
            log.info("rays bent beyond the second order of the pupil: %.3f pitch at its edge", _edge(bend) / pitch_mm)
    moved = [
        fit
        and replace(
            fit,
            coefficients=fit.coefficients + (fit.following[:, 2:] @ (bend - start)).reshape(2, TERMS).T,
        )
        for fit in fits
    ]
    return replace(shared, bend_mm=bend.reshape(2, BENDS).T), moved


def _edge(bend: np.ndarray) -> float:
    """Root mean square of a bend over the pupil's edge, where it is largest [mm]."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    edge = ray_terms(np.stack([np.cos(angle), np.sin(angle)], 1), 1.0)[:, TERMS:]
    return float(np.sqrt(((edge @ bend.reshape(2, BENDS).T) ** 2).sum(1).mean()))
