"""Vectors that standing light spoils: a reflection that both volumes show at the same place pulls them to zero.

Such vectors agree with each other, so the median test does not reject them. Particles at rest are told from standing
light by their brightness: a window of them is as bright as one of particles that move.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation.light import shared_light
from lfpiv_kernels.transfer import Values

MOVING_VOXEL = 1.0
"""Least displacement of vectors that moving particles made [voxel]."""
BRIGHTER = 1.5
"""Least light of a window that stays in place, as a multiple of the median light of windows in which particles move."""
SCATTERS = 4.0
"""Least excess of that light over the median, in robust standard deviations of the light of windows in which particles
move: of few particles to a window, some windows hold several times as many."""
LEAST_MOVING = 0.25
"""Least share of vectors that must move for their light to be a measure."""


def on_standing_light(
    first: Values, second: Values, windows: Windows, field: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Return the vectors whose windows hold more standing light than particles.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
        Intensities of both volumes, without background, not deformed. Each is taken relative to its mean.
    windows : Windows
        Windows of the vectors.
    field : ndarray, shape (z, y, x, 3)
        Displacement [voxel].
    valid : ndarray of bool, shape (z, y, x)
        Vectors that were measured.

    Returns
    -------
    ndarray of bool, shape (z, y, x)
        True where at least `BRIGHTER` times the light of moving particles stays in place, and more than its scatter
        explains. False everywhere if less than `LEAST_MOVING` of the vectors move.
    """
    speed = np.linalg.norm(field, axis=-1)
    moving = valid & (speed >= MOVING_VOXEL)
    none = np.zeros(valid.shape, bool)
    if not valid.any() or moving.sum() < LEAST_MOVING * valid.sum():
        return none
    least, mean = shared_light(first, second)
    staying = windows.means(least)
    light = windows.means(mean)[moving]
    typical = float(np.median(light))
    scatter = float(stats.median_abs_deviation(light, scale="normal"))
    bright: np.ndarray = staying >= max(BRIGHTER * typical, typical + SCATTERS * scatter)
    return valid & bright if typical > 0 else none
