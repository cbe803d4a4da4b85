"""Measure on raw pixels what the form of the dots' ray models leaves over, by zone of the pupil and part of the field.

A form that cannot follow the rays of a lens is fitted as well as it can be, and dots that were held back from the
training are described by the same form. So no comparison of labels shows what it lacks; the pixels do. In each zone
rays may be displaced from the form. The pull of a dot's pixels on these displacements, with the dot's own unknowns
eliminated, is summed over the dots of a part of the field: this is the displacement that they have in common.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfpiv.calibration.board.dot_fit import DotFit
from lfpiv.calibration.board.dot_model import ZONES, zone_middles, zone_shares

PARTS = 4
"""Parts of the field: quadrants about the middle of the measured dots."""

_FEWEST = 8  # dots of a part
_PRIOR_PITCHES = 0.2  # standard deviation of the prior on a displacement
_SIGMA = 5.0  # least displacement, in standard errors, that is told
_LEAST_PITCHES = 0.01  # least displacement that is told: what is cut off at the edge of a pupil displaces less


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
        Mean displacement of the rays [mm]; all zero unless one is beyond its error and beyond what hardly matters.
    """
    found = np.zeros((PARTS, ZONES, 2))
    right, up = (chief_mm > np.median(chief_mm, axis=0)).T if len(chief_mm) else np.zeros((2, 0), bool)
    clear = False
    for part in range(PARTS):
        here = [fit for fit, at in zip(fits, right + 2 * up, strict=True) if at == part]
        if len(here) < _FEWEST:
            continue
        pull = np.stack([fit.zone_pull for fit in here]).astype(float)
        information = np.stack([fit.zone_information for fit in here]).astype(float)
        inverse = np.linalg.inv(information.sum(0) + np.eye(2 * ZONES) / (_PRIOR_PITCHES * pitch_mm) ** 2)
        mean = inverse @ pull.sum(0)
        miss = (pull - information @ mean) @ inverse  # of single dots, which includes their model errors
        error = np.sqrt((miss**2).sum(0) * len(here) / (len(here) - 1))
        size, limit = (np.linalg.norm(one.reshape(2, ZONES), axis=0) for one in (mean, error))
        clear |= bool(np.any(size > np.maximum(_SIGMA * limit, _LEAST_PITCHES * pitch_mm)))
        found[part] = mean.reshape(2, ZONES).T
    return found if clear else np.zeros_like(found)


def mean_size(displacement_mm: np.ndarray) -> float:
    """Return the mean displacement over the pupil and the parts of the field [mm] of `left_over`'s result."""
    return float((np.linalg.norm(displacement_mm, axis=-1) @ zone_shares()).mean())


def worst(displacement_mm: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Return the largest displacement [mm], mean of the parts of the field, and its zone's middle [pupil radii]."""
    size = np.linalg.norm(displacement_mm, axis=-1).mean(0)
    u, v = zone_middles()[size.argmax()].tolist()
    return float(size.max()), (u, v)
