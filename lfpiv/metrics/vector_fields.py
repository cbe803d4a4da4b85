"""Errors of displacement fields against the truth, and their distribution.

Arrays are ordered (z, y, x), components (x, y, z). Equation numbers are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import POSITION_TOLERANCE_MM

PERCENTILES = (50, 75, 90, 95, 99)
"""Reported percentiles of the displacement error."""
BELOW_VOXEL = 0.43
"""Bound of Fig. 14(b) [voxel]: the paper reports the part of the vectors with a smaller error."""


@dataclass(frozen=True, kw_only=True)
class DisplacementError:
    """Statistics of displacement errors [voxel]; tuples are per component (x, y, z). See `displacement_error`."""

    count: int
    """Number of vectors."""
    mean: float
    """Mean length of the error vectors, Eq. 16."""
    rms: float
    """Root mean square of those lengths."""
    median: float
    """Median of those lengths."""
    percentiles: dict[int, float]
    """Percentiles of those lengths."""
    below: float
    """Part of the vectors whose error is shorter than `below_voxel`."""
    below_voxel: float
    """Bound of `below`."""
    bias: tuple[float, float, float]
    """Mean of each component of the error."""
    mean_absolute: tuple[float, float, float]
    """Mean absolute value of each component."""
    rms_component: tuple[float, float, float]
    """Root mean square of each component."""


def displacement_difference(
    vectors: xr.Dataset | np.ndarray, truth: xr.Dataset | np.ndarray, *, where: np.ndarray | None = None
) -> np.ndarray:
    """Compute measured minus true displacement of each vector. The lengths of the rows are sigma_t, Eq. 15.

    Parameters
    ----------
    vectors : Dataset or ndarray
        From `correlate`; or an array (z, y, x, 3) of displacements (x, y, z) [voxel].
    truth : Dataset or ndarray
        The same for the truth: the correlation of the true particles, as in the paper, or the flow itself, averaged
        over the windows (`lfpiv.simulation.flows.window_mean`) and divided by the voxel edge. Two datasets must have
        the same window centres.
    where : ndarray of bool, shape (z, y, x), optional
        Vectors to compare. Default: all, including replaced ones.

    Returns
    -------
    ndarray, shape (vector, 3)
        Differences along (x, y, z) [voxel].

    Raises
    ------
    ValueError
        If shapes or window centres differ, or a compared vector is not finite.
    """
    fields = [_displacement(vectors, "vectors"), _displacement(truth, "truth")]
    if fields[0].shape != fields[1].shape:
        raise ValueError(f"truth: expected the shape of the vectors, {fields[0].shape}, got {fields[1].shape}.")
    if isinstance(vectors, xr.Dataset) and isinstance(truth, xr.Dataset):
        for axis in AXES:
            if np.abs(vectors[axis].values - truth[axis].values).max() > POSITION_TOLERANCE_MM:
                raise ValueError(f"truth: expected the window centres of the vectors, got others along {axis}.")
    selected = np.ones(fields[0].shape[:3], bool) if where is None else np.asarray(where)
    if selected.shape != fields[0].shape[:3] or selected.dtype != bool:
        raise ValueError(f"where: expected bool of shape {fields[0].shape[:3]}, got {selected.dtype} {selected.shape}.")
    difference: np.ndarray = (fields[0] - fields[1])[selected]
    bad = len(difference) - int(np.isfinite(difference).all(1).sum())
    if bad or not len(difference):
        found = f"{bad} that are not" if bad else "no vector"
        raise ValueError(f"vectors, truth: expected finite displacements, found {found}. Choose others by `where`.")
    return difference


def displacement_error(
    vectors: xr.Dataset | np.ndarray,
    truth: xr.Dataset | np.ndarray,
    *,
    where: np.ndarray | None = None,
    below_voxel: float = BELOW_VOXEL,
) -> DisplacementError:
    """Compute statistics of the displacement error: mean sigma_t (Eqs. 15 and 16), distribution, and errors per axis.

    Parameters and errors raised are those of `displacement_difference`, and

    below_voxel : float
        Bound [voxel], >= 0, of the errors counted in `DisplacementError.below`.
    """
    if not (np.isfinite(below_voxel) and below_voxel >= 0):
        raise ValueError(f"below_voxel: expected a number >= 0, got {below_voxel!r}.")
    difference = displacement_difference(vectors, truth, where=where)
    length = np.linalg.norm(difference, axis=1)
    return DisplacementError(
        count=len(length),
        mean=float(length.mean()),
        rms=float(np.sqrt((length**2).mean())),
        median=float(np.median(length)),
        percentiles={p: float(np.percentile(length, p)) for p in PERCENTILES},
        below=float((length < below_voxel).mean()),
        below_voxel=below_voxel,
        bias=tuple(difference.mean(0).tolist()),
        mean_absolute=tuple(np.abs(difference).mean(0).tolist()),
        rms_component=tuple(np.sqrt((difference**2).mean(0)).tolist()),
    )


def empirical_cdf(values: np.ndarray, at: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Compute the empirical cumulative distribution (Fig. 14(b)): the part of the values <= each abscissa.

    Parameters
    ----------
    values : ndarray
        Finite numbers of any shape, at least one.
    at : ndarray, optional
        Abscissae. Default: the sorted values.

    Returns
    -------
    tuple of ndarray
        Abscissae and parts, 0 to 1.
    """
    ordered = np.sort(np.asarray(values, float), axis=None)
    if not len(ordered) or not np.isfinite(ordered).all():
        raise ValueError(f"values: expected finite numbers, at least one, got {len(ordered)} with NaN or none at all.")
    at = ordered if at is None else np.asarray(at, float)
    return at, np.searchsorted(ordered, at, side="right") / len(ordered)


def _displacement(vectors: xr.Dataset | np.ndarray, name: str) -> np.ndarray:
    """Return displacements as an array (z, y, x, 3), components (x, y, z) [voxel]."""
    if not isinstance(vectors, xr.Dataset):
        return _checked_field(vectors, name)
    missing = [f"displacement_{axis}" for axis in "xyz" if f"displacement_{axis}" not in vectors]
    if missing:
        raise ValueError(
            f"{name}: expected displacement_x, _y and _z as `correlate` gives them, found no {missing[0]}."
        )
    return np.stack([vectors[f"displacement_{axis}"].transpose(*AXES).values for axis in "xyz"], -1).astype(float)


def _checked_field(field: np.ndarray, name: str) -> np.ndarray:
    field = np.asarray(field)
    if field.ndim != 4 or field.shape[3] != 3 or field.dtype.kind not in "fiu":
        raise ValueError(
            f"{name}: expected a Dataset or numbers of shape (z, y, x, 3), got {field.dtype} {field.shape}."
        )
    return field.astype(float)
