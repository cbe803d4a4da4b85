"""`estimate_damping`: the damping of fluctuations and the offset of each component, from simulated pairs.

Simulated pairs are never quite as hard to measure as recorded ones: a field from vectors lacks what windows do not
show. The same ghosts make the random errors that correlation statistics state and the damping. So the damping of
recorded pairs, 1 - S, is the simulated damping times the ratio of their random deviations, as a ratio estimator [1]_
takes it from what is known of both. The standard error holds the whole change once more.

References
----------
.. [1] W. G. Cochran, "Sampling Techniques", 3rd edition, Wiley, 1977, chapter 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.damping import AxisDamping, Damping, displacement
from lfpiv.velocity.likeness import UNKNOWN, Likeness, compare, octants, usable
from lfpiv.velocity.modes import coherences, weighted
from lfpiv.velocity.systematic import variance_without_ghosts

LEAST_WINDOWS = 8
"""Least number of valid windows of all simulated pairs."""
LEAST_PAIRS = 4
"""Least number of simulated pairs whose scatter gives a standard error."""
COVERED = 0.95
"""Share of the errors that two standard deviations should cover."""


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """A simulated pair: what moved its particles, and what was measured."""

    vectors: xr.Dataset
    """From `lfpiv.correlate`."""
    imposed: np.ndarray
    """Means over the windows of the displacement along (z, y, x) [voxel], shape (z, y, x, 3)."""

    @property
    def used(self) -> np.ndarray:
        """True where all of a window is fluid that can be measured, shape (z, y, x).

        Vectors that validation replaced count: the correction of all vectors is one.
        """
        return usable(self.vectors)


def estimate_damping(pairs: Sequence[Simulated], recorded: Sequence[xr.Dataset] = ()) -> Damping:
    """Estimate the damping from simulated pairs, and compare them with vectors of recorded ones.

    Standard errors are those of a jackknife over octants of all pairs, or over pairs if these scatter more.
    Neighbouring vectors share half of their windows and are not independent.

    Raises
    ------
    ValueError
        If fewer than `LEAST_WINDOWS` windows of all pairs are valid.
    """
    if sum(int((pair.used & pair.vectors["valid"].values).sum()) for pair in pairs) < LEAST_WINDOWS:
        raise ValueError("simulated pairs: hardly any vector is valid, so that the damping cannot be measured.")
    likeness = compare(recorded, [pair.vectors for pair in pairs])
    axes = {axis: _of_axis(pairs, axis, likeness) for axis in AXES[::-1]}
    return Damping(axes=axes, simulated=len(pairs), likeness=likeness)


def _of_axis(pairs: Sequence[Simulated], axis: str, likeness: Likeness | None) -> AxisDamping:
    """Regress measured on imposed displacements of one axis."""
    pairs = [pair for pair in pairs if pair.used.any()]
    parts = [list(_parts(pair, axis)) for pair in pairs]
    sums = [[((away**2).sum(), (away * moved).sum()) for away, moved, _ in pair] for pair in parts]
    slope, slope_error = _ratio(sums, empty=1.0)
    shifts = [[(len(away), (error - (slope - 1) * away).sum()) for away, _, error in pair] for pair in parts]
    offset, offset_error = _ratio(shifts, empty=0.0)
    errors = np.concatenate([_scaled_errors(pair, axis, slope, offset) for pair in pairs])
    squares = sum(below for pair in sums for below, _ in pair)
    fluctuation = np.sqrt(squares / sum(len(away) for pair in parts for away, _, _ in pair))
    rests = np.concatenate([error - offset - (slope - 1) * away for pair in parts for away, _, error in pair])
    found = AxisDamping(
        slope=slope,
        slope_error=slope_error,
        offset=offset,
        offset_error=offset_error,
        fluctuation=float(fluctuation),
        uncertainty_factor=max(float(np.quantile(errors, COVERED)) / 2, 1.0),
        scatter=float(np.sqrt(np.mean(rests**2))),
        alike=likeness is None or not likeness.harder,
    )
    found = _with_coherence(found, pairs, axis)
    return found if likeness is None else _of_recorded(found, likeness)


def _of_recorded(found: AxisDamping, likeness: Likeness) -> AxisDamping:
    """Return the damping of recorded pairs, given the simulated damping and the ratio of their random errors."""
    ratio, taken = likeness.errors_ratio, 1 - found.slope
    slope = 1 - ratio * taken
    if not slope > 0:
        return replace(found, slope_error=UNKNOWN)
    restored = ratio * found.slope / slope  # what is added to vectors, over what was added to simulated ones
    gain = 1 + (found.noise_gain - 1) * restored
    return replace(
        found,
        slope=slope,
        slope_error=float(np.hypot(ratio * found.slope_error, likeness.doubt * taken)),
        scatter=ratio * found.scatter,
        scatter_unbiased=ratio * gain * found.scatter,
        coherent_slope=None if found.coherent_slope is None else found.coherent_slope * slope / found.slope,
    )


def _with_coherence(found: AxisDamping, pairs: Sequence[Simulated], axis: str) -> AxisDamping:
    """Add the coherence of modes, and the errors that taking off the damping leaves in simulated pairs."""
    number = AXES.index(axis)
    fields = [(pair.imposed[..., number], displacement(pair.vectors)[..., number], pair.used) for pair in pairs]
    coherence = coherences([(exact, measured) for exact, measured, _ in fields])
    above = below = 0.0
    for exact, measured, used in fields:
        away = exact[used] - exact[used].mean()
        above, below = above + float(away @ weighted(measured, coherence)[used]), below + float(away @ away)
    if not above > 0:
        return found
    found = replace(found, coherence=coherence, coherent_slope=above / below)
    errors = [(measured + found.missing(measured) - exact)[used] - found.offset for exact, measured, used in fields]
    return replace(found, scatter_unbiased=float(np.sqrt(np.mean(np.concatenate(errors) ** 2))))


def _parts(pair: Simulated, axis: str) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield imposed and measured displacements from their means, and errors, of each octant of a pair [voxel]."""
    used, exact = pair.used, pair.imposed[..., AXES.index(axis)]
    found = pair.vectors[f"displacement_{axis}"].values.astype(float)
    away, moved = exact - exact[used].mean(), found - found[used].mean()
    for octant in octants(used.shape):
        if (some := used & octant).any():
            yield away[some], moved[some], (found - exact)[some]


def _ratio(sums: Sequence[Sequence[tuple[float, float]]], *, empty: float) -> tuple[float, float]:
    """Return the ratio of summed numerators to denominators of the octants of each pair, and its standard error.

    The octants of a pair share its mean, so that a jackknife over whole pairs gives the larger error where there are
    enough of them.
    """
    ratio, error = _jackknife(np.array([part for pair in sums for part in pair], float), empty=empty)
    if len(sums) >= LEAST_PAIRS:
        error = max(error, _jackknife(np.array([np.sum(pair, axis=0) for pair in sums]), empty=empty)[1])
    return ratio, error


def _jackknife(sums: np.ndarray, *, empty: float) -> tuple[float, float]:
    """Return the ratio of summed numerators to denominators, and its standard error over the parts.

    Parameters
    ----------
    sums : ndarray, shape (part, 2)
        Denominator and numerator of each part.
    empty : float
        Ratio where the denominators are 0.
    """
    below, above = sums.sum(0)
    if not below > 0:
        return empty, UNKNOWN
    rest = sums.sum(0) - sums
    if len(sums) < 2 or not (rest[:, 0] > 0).all():
        return float(above / below), UNKNOWN
    without_one = rest[:, 1] / rest[:, 0]
    return float(above / below), float(np.sqrt((len(sums) - 1) * without_one.var()))


def _scaled_errors(pair: Simulated, axis: str, slope: float, offset: float) -> np.ndarray:
    """Return what the line leaves of the errors of a pair, over the stated standard deviations without ghosts."""
    used, exact = pair.used, pair.imposed[..., AXES.index(axis)]
    found = pair.vectors[f"displacement_{axis}"].values.astype(float)
    mean = exact[used].mean()
    used = used & pair.vectors["valid"].values  # others state no deviation
    rest = found - offset - mean - slope * (exact - mean)
    distance = found - (found[used].mean() if used.any() else 0.0)
    variance = variance_without_ghosts(pair.vectors[f"uncertainty_{axis}"].values, distance)
    known = used & (variance > 0)  # none after a single pass
    return np.abs(rest[known]) / np.sqrt(variance[known]) if known.any() else np.full(1, 2.0)
