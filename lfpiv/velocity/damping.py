"""Damping of displacement fluctuations by ghosts, and vectors without it.

Ghosts move with the mean of the particles on the lines of sight that cross in them [1]_. They pull the displacement of
a window towards the mean of the volume. The slope S of measured on true fluctuations is below 1 for that reason. With
pairs of known displacement X that were measured as F, it is the regression ``F - <F> = S (X - <X>)`` of each axis, and
``<F> - <X>`` is the offset.

Division of fluctuations by S would restore them, but also amplify errors of all wavelengths. So what is missing is
taken from those modes of a field that hold the flow: ``f + (1 - S) / T (W f) - offset``, where W multiplies modes by
the coherence of measured and true ones, as a Wiener filter [2]_ does, and T is the slope of ``W F`` on X. So the slope
of vectors without damping is 1, as that of ``f / S``, with smaller errors.

References
----------
.. [1] G. E. Elsinga, J. Westerweel, F. Scarano, M. Novara, "On the velocity of ghost particles and the bias errors in
   Tomographic-PIV", Exp. Fluids 50 (2011) 825-838, doi:10.1007/s00348-010-0930-0.
.. [2] N. Wiener, "Extrapolation, Interpolation, and Smoothing of Stationary Time Series", Wiley, 1949, chapter 3.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.records import RecordError, validate
from lfpiv.velocity.likeness import Likeness
from lfpiv.velocity.modes import weighted
from lfpiv.velocity.systematic import DAMPING, variance_without_ghosts

SIGNIFICANT = 2.0
"""Least distance of a slope from 1, and of an offset from 0, that is corrected [standard error]."""
LEAST_FLUCTUATION = 0.1
"""Least root mean square of a component's fluctuations whose slope is corrected [voxel]. Smaller ones are mostly
errors, which a correction would amplify."""
SLOPES = (0.5, 1.2)
"""Slopes that are corrected. Below, errors would be amplified more than the flow is restored."""
LARGEST_ERROR = 0.1
"""Largest standard error of a slope that is corrected, as a share of the slope."""
LARGEST_LOSS = 1.1
"""Largest expected error of corrected vectors over the error of raw vectors. Division by the slope amplifies random
errors."""

UNBIASED = {"x": "u_unbiased", "y": "v_unbiased", "z": "w_unbiased"}
"""Axis -> variable of its velocity without damping."""
_DERIVED = ("uncertainty", "displacement_unbiased", "uncertainty_unbiased")
_SHOWN = ("applied", "raw_error", "unbiased_error")
"""Properties of an axis that files and summaries state beside its values."""
ATTRIBUTE = "damping"
"""Attribute of vectors with the damping that was taken off, as JSON."""


@dataclass(frozen=True, kw_only=True)
class AxisDamping:
    """Damping of one component of the displacement."""

    slope: float
    """Slope of measured on true fluctuations in recorded pairs."""
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
    coherence: tuple[float, ...] = ()
    """Coherence of measured and true modes of each shell (`lfpiv.velocity.modes`); empty: 1 for all."""
    coherent_slope: float | None = None
    """Slope of the coherent part of measured fluctuations on true ones; None: `slope`."""
    scatter_unbiased: float | None = None
    """Root mean square of the simulated errors of vectors without damping [voxel]; None: `scatter` over `slope`."""
    alike: bool = True
    """Whether simulated pairs are not harder to measure than recorded ones; else nothing is corrected."""

    def to_json(self) -> dict[str, Any]:
        """Return what files and summaries store."""
        return asdict(self) | {"coherence": list(self.coherence)} | {name: getattr(self, name) for name in _SHOWN}

    @property
    def applied(self) -> bool:
        """Whether vectors are corrected."""
        return self.alike and self.significant and not self.amplifies

    @property
    def significant(self) -> bool:
        """Whether the slope is known, and differs from 1 significantly."""
        known = self.slope_error <= LARGEST_ERROR * self.slope and SLOPES[0] <= self.slope <= SLOPES[1]
        return known and self.fluctuation >= LEAST_FLUCTUATION and abs(self.slope - 1) > SIGNIFICANT * self.slope_error

    @property
    def amplifies(self) -> bool:
        """Whether the correction would amplify random errors by clearly more than it takes off."""
        return self.unbiased_error > LARGEST_LOSS * self.raw_error

    @property
    def raw_error(self) -> float:
        """Expected root mean square error of raw vectors, without the offset [voxel]."""
        return float(np.hypot(self.scatter, (1 - self.slope) * self.fluctuation))

    @property
    def unbiased_error(self) -> float:
        """The same of vectors without damping, had it been taken off, with the standard error of the slope."""
        return float(np.hypot(self.noise_gain * self.scatter, self.slope_error / self.slope * self.fluctuation))

    @property
    def noise_gain(self) -> float:
        """Random errors of vectors without damping over random errors of raw vectors."""
        if self.scatter_unbiased is None or not self.scatter > 0:
            return 1 / self.slope
        return self.scatter_unbiased / self.scatter

    @property
    def used_gain(self) -> float:
        """`noise_gain` of the correction; 1 if none is applied."""
        return self.noise_gain if self.applied else 1.0

    def missing(self, displacement: np.ndarray, used: np.ndarray | None = None) -> np.ndarray:
        """Return the fluctuations that damping took, shape (z, y, x) [voxel].

        Parameters
        ----------
        displacement : ndarray, shape (z, y, x)
            Measured displacement, finite [voxel].
        used : ndarray of bool, shape (z, y, x), optional
            Vectors whose mean is that of the flow; default: all.
        """
        if self.coherence:
            return (1 - self.slope) / (self.coherent_slope or self.slope) * weighted(displacement, self.coherence)
        mean = displacement.mean() if used is None or not used.any() else displacement[used].mean()
        return (1 / self.slope - 1) * (displacement - mean)

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
        axes = {name: axis.to_json() for name, axis in self.axes.items()}
        likeness = None if self.likeness is None else asdict(self.likeness)
        return {"axes": axes, "simulated": self.simulated, "likeness": likeness}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Damping:
        """Read the form that a file stores; raise RecordError if it has another form."""
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
        valid, fields = vectors["valid"].values, displacement(vectors)
        changed: dict[str, xr.DataArray] = {}
        for axis in AXES:
            raw = vectors[f"displacement_{axis}"]
            found, distance = self.axes[axis], _from_mean(raw.values, valid)
            missing = found.missing(fields[..., AXES.index(axis)], valid) if found.applied else 0.0
            changed |= self._corrected(vectors, axis, raw.values + missing - found.used_offset)
            changed |= self._uncertainties(vectors, axis, distance)
        squares = sum(np.square(changed[f"uncertainty_{axis}"].values.astype(float)) for axis in AXES)
        whole = vectors["uncertainty"]
        changed["uncertainty"] = whole.copy(data=np.sqrt(squares).astype(whole.dtype))
        return vectors.assign(changed).assign_attrs({ATTRIBUTE: json.dumps(self.to_json())})

    def _corrected(self, vectors: xr.Dataset, axis: str, displacement: np.ndarray) -> dict[str, xr.DataArray]:
        """Return displacement and velocity of an axis without damping."""
        raw = vectors[f"displacement_{axis}"]
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
        own = np.square(found.uncertainty_factor) * variance_without_ghosts(stated.values, distance)
        offset = np.hypot(found.offset, found.offset_error)
        raw = np.sqrt(own + (found.pull * distance) ** 2 + offset**2)
        left = found.offset_error if found.used_offset else offset
        unbiased = np.sqrt(own * found.used_gain**2 + (found.pull_left * distance) ** 2 + left**2)
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


def _from_mean(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the distance of displacements from their mean over the valid vectors."""
    known = valid if valid.any() else np.isfinite(values)
    return values - (float(values[known].mean()) if known.any() else 0.0)


def displacement(vectors: xr.Dataset) -> np.ndarray:
    """Return the displacement along (z, y, x) [voxel], filled where it is masked, shape (z, y, x, 3)."""
    from lfpiv.velocity.validation import fill  # imports Warp, which readers of results need not

    found = np.stack([vectors[f"displacement_{axis}"].values for axis in AXES], axis=-1).astype(float)
    return fill(found, np.isfinite(found).all(-1))
