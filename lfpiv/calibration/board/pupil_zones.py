"""Measure on raw pixels what the form of the dots' ray models leaves over, by zone of the pupil and part of the field.

A form that cannot follow the rays of a lens is fitted as well as it can be, and dots that were held back from the
training are described by the same form. So no comparison of labels shows what it lacks; the pixels do. In each zone
rays may be displaced from the form. The pull of a dot's pixels on these displacements, with the dot's own unknowns
eliminated, is summed over the dots of a part of the field: this is the displacement that they have in common.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from lfpiv.calibration.board.dot_fit import DotFit
from lfpiv.calibration.board.dot_model import ZONES, zone_middles, zone_shares

PARTS = 4
"""Parts of the field: quadrants about the middle of the measured dots."""
INNER = 0.9
"""Part of the pupil's radius within which the error of a mapping is stated. Beyond it lies what the edge cuts off."""

_FEWEST = 8  # dots of a part
_PRIOR_PITCHES = 0.2  # standard deviation of the prior on a displacement
_CLEAR = 1.0  # least displacement of rings that is told, rms over the zones [standard error]
_LEAST_PITCHES = 0.01  # least displacement that is told: what is cut off at the edge of a pupil displaces less
_ROUNDING = 1e-6  # least variance of an error, as a share of the largest
_LEAST_SHARE = 1e-10  # least variance of displacements that is tried, as a share of the prior's: a millionth of a pitch


def left_over(fits: Sequence[DotFit], chief_mm: np.ndarray, pitch_mm: float) -> np.ndarray:
    """Return how far rays lie beside the ray models of their dots, by part of the field and zone of the pupil.

    Parameters
    ----------
    fits : sequence of DotFit
        Fits of the measured dots.
    chief_mm : ndarray, shape (n, 2)
        Their chief rays on the array [mm].
    pitch_mm : float
        Microlens pitch [mm].

    Returns
    -------
    ndarray, shape (PARTS, ZONES, 2)
        Mean displacement of the rays [mm]. All are zero unless the rings of a part, or of the whole field, are together
        displaced by more than their errors, and a zone by more than what hardly matters. A ring's displacement is the
        median of its zones: a lens bends rays all around, while the pupil's edge cuts the pixels of single zones. What
        grows linearly over the pupil does not count: it is the place of dots, as on a board that was knocked.
    """
    found = np.zeros((PARTS, ZONES, 2))
    if len(fits) < _FEWEST:
        return found
    pull, information = _equations(fits)
    right, up = (chief_mm > np.median(chief_mm, axis=0)).T
    parts = [np.flatnonzero(right + 2 * up == part) for part in range(PARTS)]
    clear = False
    for part, here in enumerate([*parts, np.arange(len(fits))]):  # the last one is the whole field, judged as well
        if len(here) < _FEWEST:
            continue
        mean, scatter, noise = _displacement(pull[here], information[here], pitch_mm)
        error = np.sqrt(np.maximum(np.diag(scatter), np.diag(noise)))
        size, limit = (np.linalg.norm(one.reshape(2, ZONES), axis=0) for one in (mean, error))
        bent = np.linalg.norm(_without_line(mean.reshape(2, ZONES).T / limit[:, None], limit), axis=1)
        sure = float(np.sqrt(np.mean(_of_rings(bent) ** 2))) > _CLEAR
        clear |= sure and bool(size.max() > _LEAST_PITCHES * pitch_mm)
        if part < PARTS:
            found[part] = mean.reshape(2, ZONES).T
    return found if clear else np.zeros_like(found)


def _without_line(displacement: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return displacements [error], shape (ZONES, 2), less what is linear over the pupil."""
    terms = np.column_stack([np.ones(ZONES), zone_middles()]) / error[:, None]
    found: np.ndarray = displacement - terms @ np.linalg.lstsq(terms, displacement, rcond=None)[0]
    return found


def _of_rings(values: np.ndarray) -> np.ndarray:
    """Return, for each zone, the median of the zones that are as far from the pupil's middle, shape (ZONES,)."""
    ring = np.unique(np.linalg.norm(zone_middles(), axis=1).round(6), return_inverse=True)[1]
    return np.array([np.median(values[ring == one]) for one in ring])


def shared_error(fits: Sequence[DotFit], left_over_mm: np.ndarray, pitch_mm: float) -> float:
    """Return the mean displacement of rays beside the ray models of all dots [mm], within `INNER` of the pupil.

    Unlike `left_over` it is a best estimate, not a proof. Displacements of the zones over the whole field are taken as
    normal about zero, of the most likely variance beside their errors [1]_. Where `left_over` is sure, its
    displacements count, by part of the field.

    References
    ----------
    .. [1] R. J. Hardy, S. G. Thompson, "A likelihood approach to meta-analysis with random effects", Statist. Med. 15
       (1996) 619-629, doi:10.1002/(SICI)1097-0258(19960330)15:6<619::AID-SIM188>3.0.CO;2-A.
    """
    inner = np.linalg.norm(zone_middles(), axis=1) < INNER
    if left_over_mm.any():
        shares = zone_shares()[inner] / zone_shares()[inner].sum()
        return float((np.linalg.norm(left_over_mm[:, inner], axis=-1) @ shares).mean())
    if len(fits) < _FEWEST:
        return 0.0
    mean, scatter, _ = _displacement(*_equations(fits), pitch_mm)
    inner = np.tile(inner, 2)
    variance, axes = np.linalg.eigh(scatter[inner][:, inner])
    variance, square = np.maximum(variance, _ROUNDING * variance[-1]), (axes.T @ mean[inner]) ** 2

    def deviance(log_variance: float) -> float:
        total = math.exp(log_variance) + variance
        return float((np.log(total) + square / total).sum())

    largest = 2 * math.log(_PRIOR_PITCHES * pitch_mm)
    found = minimize_scalar(deviance, bounds=(largest + math.log(_LEAST_SHARE), largest), method="bounded")
    return math.sqrt(math.pi / 2 * math.exp(found.x))


def _equations(fits: Sequence[DotFit]) -> tuple[np.ndarray, np.ndarray]:
    """Return pull and information of the zones of each dot."""
    pull, information = (
        np.stack([getattr(fit, name) for fit in fits]).astype(float) for name in ("zone_pull", "zone_information")
    )
    return pull, information


def _displacement(
    pull: np.ndarray, information: np.ndarray, pitch_mm: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the displacement that dots have in common, shape (2 ZONES,) [mm], and two covariances of it [mm^2].

    The first is the scatter of the dots, which includes errors of their model. The second is what their pixels' noise
    makes of it: a zone that few dots light scatters too little.
    """
    inverse = np.linalg.inv(information.sum(0) + np.eye(2 * ZONES) / (_PRIOR_PITCHES * pitch_mm) ** 2)
    mean = inverse @ pull.sum(0)
    each = (pull - information @ mean) @ inverse
    return mean, each.T @ each * len(pull) / (len(pull) - 1), inverse


def worst(displacement_mm: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Return the largest displacement [mm], mean of the parts of the field, and its zone's middle [pupil radii]."""
    size = np.linalg.norm(displacement_mm, axis=-1).mean(0)
    u, v = zone_middles()[size.argmax()].tolist()
    return float(size.max()), (u, v)
