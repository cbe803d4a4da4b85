"""Damping of displacement fluctuations by ghosts: its estimate from simulated pairs, and vectors without it.

Ghosts move with the mean of the particles on the lines of sight that cross in them [1]_. They pull the displacement of
a window towards the mean of the volume. The slope S of measured on true fluctuations is below 1 for that reason. With
pairs of known displacement X that were measured as F, it is the regression ``F - <F> = S (X - <X>)`` of each axis, and
``<F> - <X>`` is the offset. Vectors without damping are ``<f> + (f - <f>) / S - offset``.

References
----------
.. [1] G. E. Elsinga, J. Westerweel, F. Scarano, M. Novara, "On the velocity of ghost particles and the bias errors in
   Tomographic-PIV", Exp. Fluids 50 (2011) 825-838, doi:10.1007/s00348-010-0930-0.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.records import RecordError, validate
from lfpiv.velocity.likeness import UNKNOWN, Likeness, compare, octants, usable
from lfpiv.velocity.systematic import DAMPING, without_ghosts
from lfpiv.velocity.validation import fill

SIGNIFICANT = 2.0
"""Least distance of a slope from 1, and of an offset from 0, that is corrected [standard error]."""
LEAST_FLUCTUATION = 0.1
"""Least root mean square of a component's fluctuations whose slope is corrected [voxel]. Smaller ones are mostly
errors, which a correction would amplify."""
SLOPES = (0.5, 1.2)
"""Slopes that are corrected. Below, errors would be amplified more than the flow is restored."""
LARGEST_ERROR = 0.1
"""Largest standard error of a slope that is corrected, as a share of the slope."""
LEAST_WINDOWS = 8
"""Least number of valid windows of all simulated pairs."""
LARGEST_LOSS = 1.1
"""Largest expected error of corrected vectors over that of raw ones. Division by the slope amplifies random errors."""
LEAST_PAIRS = 4
"""Least number of simulated pairs whose scatter gives a standard error."""
COVERED = 0.95
"""Share of the errors that two standard deviations should cover."""

UNBIASED = {"x": "u_unbiased", "y": "v_unbiased", "z": "w_unbiased"}
"""Axis -> variable of its velocity without damping."""
_DERIVED = ("uncertainty", "displacement_unbiased", "uncertainty_unbiased")
ATTRIBUTE = "damping"
"""Attribute of vectors with the damping that was taken off, as JSON."""


@dataclass(frozen=True, kw_only=True)
class AxisDamping:
    """Damping of one component of the displacement."""

    slope: float
    """Slope of measured on true fluctuations."""
    slope_error: float
    """Its standard error, with the doubt that simulated pairs unlike the recorded ones raise."""
    offset: float
    """Mean of measured minus true displacement [voxel]."""
    offset_error: float
    """Its standard error [voxel]."""
    fluctuation: float
    """Root mean square of the simulated fluctuations [voxel]."""
    uncertainty_factor: float
    """Factor by which the standard deviations of the correlation statistics are too small."""
    scatter: float = 0.0
    """Root mean square of the simulated errors that slope and offset leave [voxel]."""
    alike: bool = True
    """Whether simulated pairs are not harder to measure than recorded ones; else nothing is corrected."""

    @property
    def applied(self) -> bool:
        """Whether the slope differs from 1 significantly, so that vectors are corrected."""
        known = self.alike and self.slope_error <= LARGEST_ERROR * self.slope
        significant = known and abs(self.slope - 1) > SIGNIFICANT * self.slope_error and not self.amplifies
        return significant and self.fluctuation >= LEAST_FLUCTUATION and SLOPES[0] <= self.slope <= SLOPES[1]

    @property
    def amplifies(self) -> bool:
        """Whether the correction would amplify random errors by clearly more than it takes off."""
        raw = np.hypot(self.scatter, (1 - self.slope) * self.fluctuation)
        corrected = np.hypot(self.scatter, self.slope_error * self.fluctuation / self.slope) / self.slope
        return bool(corrected > LARGEST_LOSS * raw)

    @property
    def used_slope(self) -> float:
        """Slope of the correction; 1 if none is applied."""
        return self.slope if self.applied else 1.0

    @property
    def used_offset(self) -> float:
        """Offset of the correction [voxel]; 0 if none is applied."""
        return self.offset if self.alike and abs(self.offset) > SIGNIFICANT * self.offset_error else 0.0

    @property
    def pull(self) -> float:
        """Standard deviation of the damping of a raw vector, as a share of its distance from the mean."""
        if not SLOPES[0] <= self.slope <= SLOPES[1] or self.fluctuation < LEAST_FLUCTUATION:
            return DAMPING
        return float(np.hypot(1 / self.slope - 1, self.slope_error / self.slope**2))

    @property
    def pull_left(self) -> float:
        """The same of a vector without damping."""
        return self.slope_error / self.slope**2 if self.applied else self.pull


@dataclass(frozen=True, kw_only=True)
class Damping:
    """Damping of the three components, from simulated pairs."""

    axes: Mapping[str, AxisDamping]
    """x, y, z -> damping of that component."""
    simulated: int
    """Number of simulated pairs."""
    likeness: Likeness | None = None
    """What tells simulated from recorded pairs; None if they were not compared."""

    derived = frozenset(["uncertainty", *UNBIASED.values()] + [f"{name}_{axis}" for name in _DERIVED for axis in AXES])
    """Variables that `unbiased` adds or changes."""
    sources = frozenset(
        ["valid", "uncertainty"] + [f"{name}_{axis}" for name in ("displacement", "uncertainty") for axis in AXES]
    )
    """Variables that `unbiased` needs."""

    def to_json(self) -> dict[str, Any]:
        """Return the form that files and summaries store."""
        axes = {name: {**asdict(axis), "applied": axis.applied} for name, axis in self.axes.items()}
        likeness = None if self.likeness is None else asdict(self.likeness)
        return {"axes": axes, "simulated": self.simulated, "likeness": likeness}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Damping:
        """Read the form that a file stores.

        Raises
        ------
        RecordError
            If it has another form.
        """
        found = validate(_Stored, stored)
        if set(found.axes) != set(AXES):
            raise RecordError(f"expected the axes x, y, z, found {', '.join(found.axes)}")
        return cls(axes=found.axes, simulated=found.simulated, likeness=found.likeness)

    def unbiased(self, vectors: xr.Dataset) -> xr.Dataset:
        """Return vectors with displacements and velocities without damping beside the raw ones.

        Parameters
        ----------
        vectors : Dataset
            From `lfpiv.correlate`, of the rig and the flow that the damping was measured for.

        Returns
        -------
        Dataset
            With ``displacement_unbiased_x``, ``_y``, ``_z`` [voxel], ``u_unbiased``, ``v_unbiased``, ``w_unbiased``
            [m/s] and ``uncertainty_unbiased_x``, ``_y``, ``_z`` [voxel], which includes the standard errors of slope
            and offset. ``uncertainty`` and its components, of the raw vectors, include the damping. The attribute
            ``damping`` has the figures as JSON.
        """
        if ATTRIBUTE in vectors.attrs:
            return vectors
        valid = vectors["valid"].values
        changed: dict[str, xr.DataArray] = {}
        for axis in AXES:
            raw = vectors[f"displacement_{axis}"]
            distance, mean = _from_mean(raw.values, valid)
            changed |= self._corrected(vectors, axis, distance, mean) | self._uncertainties(vectors, axis, distance)
        squares = sum(np.square(changed[f"uncertainty_{axis}"].values.astype(float)) for axis in AXES)
        whole = vectors["uncertainty"]
        changed["uncertainty"] = whole.copy(data=np.sqrt(squares).astype(whole.dtype))
        return vectors.assign(changed).assign_attrs({ATTRIBUTE: json.dumps(self.to_json())})

    def _corrected(self, vectors: xr.Dataset, axis: str, distance: np.ndarray, mean: float) -> dict[str, xr.DataArray]:
        """Return displacement and velocity of an axis without damping."""
        found, raw = self.axes[axis], vectors[f"displacement_{axis}"]
        displacement = mean + distance / found.used_slope - found.used_offset
        metres = float(np.asarray(vectors.attrs["voxel_mm"])[AXES.index(axis)]) * 1e-3 / float(vectors.attrs["dt_s"])
        of_voxels, of_metres = (
            {"units": units, "long_name": f"{quantity} along {axis}, the damping by ghosts taken off"}
            for quantity, units in (("displacement", "voxel"), ("velocity", "m/s"))
        )
        return {
            f"displacement_unbiased_{axis}": raw.copy(data=displacement.astype(raw.dtype)).assign_attrs(of_voxels),
            UNBIASED[axis]: raw.copy(data=(displacement * metres).astype(raw.dtype)).assign_attrs(of_metres),
        }

    def _uncertainties(self, vectors: xr.Dataset, axis: str, distance: np.ndarray) -> dict[str, xr.DataArray]:
        """Return the standard deviations of an axis, of raw vectors and of those without damping."""
        found, stated = self.axes[axis], vectors[f"uncertainty_{axis}"]
        own = np.square(found.uncertainty_factor) * without_ghosts(stated.values, distance)
        offset = np.hypot(found.offset, found.offset_error)
        raw = np.sqrt(own + (found.pull * distance) ** 2 + offset**2)
        left = found.offset_error if found.used_offset else offset
        unbiased = np.sqrt(own / found.used_slope**2 + (found.pull_left * distance) ** 2 + left**2)
        text = f"standard deviation of the displacement along {axis}"
        of_raw = {"long_name": f"{text}: correlation statistics, unexplained light and the measured damping by ghosts"}
        of_unbiased = {"long_name": f"{text} without damping, with the standard error of the damping"}
        return {
            f"uncertainty_{axis}": stated.copy(data=raw.astype(stated.dtype)).assign_attrs(of_raw),
            f"uncertainty_unbiased_{axis}": stated.copy(data=unbiased.astype(stated.dtype)).assign_attrs(of_unbiased),
        }


@dataclass(frozen=True, kw_only=True)
class _Stored:
    axes: dict[str, AxisDamping]
    simulated: int
    likeness: Likeness | None = None


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


def displacement(vectors: xr.Dataset) -> np.ndarray:
    """Return the displacement along (z, y, x) [voxel], filled where it is masked, shape (z, y, x, 3)."""
    found = np.stack([vectors[f"displacement_{axis}"].values for axis in AXES], axis=-1).astype(float)
    return fill(found, np.isfinite(found).all(-1))


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
    doubt = 0.0 if likeness is None else likeness.doubt * abs(slope - 1)
    rests = np.concatenate([error - offset - (slope - 1) * away for pair in parts for away, _, error in pair])
    return AxisDamping(
        slope=slope,
        slope_error=float(np.hypot(slope_error, doubt)),
        offset=offset,
        offset_error=offset_error,
        fluctuation=float(fluctuation),
        uncertainty_factor=max(float(np.quantile(errors, COVERED)) / 2, 1.0),
        scatter=float(np.sqrt(np.mean(rests**2))),
        alike=likeness is None or not likeness.harder,
    )


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
    variance = without_ghosts(pair.vectors[f"uncertainty_{axis}"].values, distance)
    known = used & (variance > 0)  # none after a single pass
    return np.abs(rest[known]) / np.sqrt(variance[known]) if known.any() else np.full(1, 2.0)


def _from_mean(values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the distance of displacements from their mean over the valid vectors, and this mean."""
    known = valid if valid.any() else np.isfinite(values)
    mean = float(values[known].mean()) if known.any() else 0.0
    return values - mean, mean
