"""Displacement fields against the truth, and what their derivatives say: vorticity, divergence, Q-criterion.

Arrays are ordered (z, y, x), components (x, y, z). Equation numbers are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.rig import Grid

PERCENTILES = (50, 75, 90, 95, 99)
"""Percentiles of the displacement error that are reported."""
BELOW_VOXEL = 0.43
"""The paper's bound of Fig. 14(b): it reports the part of the vectors whose error is smaller [voxel]."""

_DIMS = ("z", "y", "x")
_POSITION_TOLERANCE_MM = 1e-4  # coordinates of two vector fields that count as the same


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
    """That bound."""
    bias: tuple[float, float, float]
    """Mean of each component of the error."""
    mean_absolute: tuple[float, float, float]
    """Mean absolute value of each component."""
    rms_component: tuple[float, float, float]
    """Root mean square of each component."""


def displacement_difference(
    vectors: xr.Dataset | np.ndarray, truth: xr.Dataset | np.ndarray, *, where: np.ndarray | None = None
) -> np.ndarray:
    """Measured minus true displacement of each vector; the lengths of the rows are sigma_t, Eq. 15.

    Parameters
    ----------
    vectors : Dataset or ndarray
        From `correlate`; or an array (z, y, x, 3) of displacements (x, y, z) [voxel].
    truth : Dataset or ndarray
        The same for the truth: the correlation of the true particles, as in the paper, or the flow itself, averaged
        over the windows (`lfpiv.flows.window_mean`) and divided by the voxel edge. Datasets on the same window centres.
    where : ndarray of bool, shape (z, y, x), optional
        Vectors that count; default: all, replaced ones included.

    Returns
    -------
    ndarray, shape (vector, 3)
        Differences along (x, y, z) [voxel].

    Raises
    ------
    ValueError
        If shapes or window centres differ, or a vector that counts is not finite.
    """
    fields = [_displacement(vectors, "vectors"), _displacement(truth, "truth")]
    if fields[0].shape != fields[1].shape:
        raise ValueError(f"truth: expected the shape of the vectors, {fields[0].shape}, got {fields[1].shape}.")
    if isinstance(vectors, xr.Dataset) and isinstance(truth, xr.Dataset):
        for axis in _DIMS:
            if np.abs(vectors[axis].values - truth[axis].values).max() > _POSITION_TOLERANCE_MM:
                raise ValueError(f"truth: expected the window centres of the vectors, got others along {axis}.")
    counted = np.ones(fields[0].shape[:3], bool) if where is None else np.asarray(where)
    if counted.shape != fields[0].shape[:3] or counted.dtype != bool:
        raise ValueError(f"where: expected bool of shape {fields[0].shape[:3]}, got {counted.dtype} {counted.shape}.")
    difference: np.ndarray = (fields[0] - fields[1])[counted]
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
    """Errors of a displacement field: mean of sigma_t (Eqs. 15 and 16), its distribution, and errors per axis [voxel].

    Parameters and errors raised are those of `displacement_difference`, and

    below_voxel : float
        Bound [voxel], >= 0: the part of the vectors with a smaller error is reported.
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
    """Empirical cumulative distribution of errors (Fig. 14(b)): the part of the values <= each abscissa.

    Parameters
    ----------
    values : ndarray
        Finite numbers of any shape, at least one.
    at : ndarray, optional
        Abscissae; default: the sorted values, the steps of the distribution.

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


def derivatives(vectors: xr.Dataset | np.ndarray, *, grid: Grid | None = None) -> xr.DataArray:
    """Velocity gradients [1/s] by central differences, one-sided of second order at the border.

    Truncation is of second order in the vector spacing. Nothing is smoothed: noise of the vectors is carried over, by
    1 / (sqrt(2) spacing) of their standard deviation in the interior.

    Parameters
    ----------
    vectors : Dataset or ndarray
        From `correlate`: ``u``, ``v``, ``w`` [m/s] on z, y, x [mm]. Or an array (z, y, x, 3) of velocities (u, v, w)
        [m/s].
    grid : Grid, optional
        Positions of an array's vectors.

    Returns
    -------
    DataArray, dims (component, direction, z, y, x)
        d(component)/d(direction) [1/s]; component: u, v, w, direction: x, y, z. Times dt: voxel per voxel.

    Raises
    ------
    ValueError
        If components or coordinates are missing, values are not finite, or an axis has fewer than 3 vectors.
    """
    if isinstance(vectors, xr.Dataset):
        missing = [name for name in (*_DIMS, "u", "v", "w") if name not in vectors.variables]
        if missing:
            raise ValueError(f"vectors: expected u, v, w on z, y, x, found no {', '.join(missing)}.")
        velocity = np.stack([vectors[name].transpose(*_DIMS).values for name in "uvw"]).astype(float)
        axes = [np.asarray(vectors[axis], float) for axis in _DIMS]
    else:
        velocity = np.moveaxis(_checked_field(vectors, "vectors"), -1, 0)
        if grid is None or velocity.shape[1:] != tuple(grid.shape):
            fault = "no grid" if grid is None else f"a grid of shape {grid.shape}"
            raise ValueError(f"vectors: an array of shape {np.shape(vectors)} needs its vectors' grid, got {fault}.")
        axes = [grid.axis_mm(axis) for axis in range(3)]
    if min(velocity.shape) < 3:
        raise ValueError(f"vectors: expected at least 3 along each axis, got {velocity.shape[1:]} (z, y, x).")
    if not np.isfinite(velocity).all() or any(not (np.diff(axis) > 0).all() for axis in axes):
        raise ValueError("vectors: expected finite velocities on increasing coordinates, found others.")
    gradient = [np.gradient(velocity, 1e-3 * axes[2 - d], axis=3 - d, edge_order=2) for d in range(3)]
    return xr.DataArray(
        np.stack(gradient, axis=1),
        dims=("component", "direction", *_DIMS),
        coords={"component": list("uvw"), "direction": list("xyz")}
        | {name: (name, axis, {"units": "mm"}) for name, axis in zip(_DIMS, axes, strict=True)},
        name="gradient",
        attrs={"units": "1/s", "long_name": "velocity gradient"},
    )


def vorticity(vectors: xr.Dataset | np.ndarray, *, grid: Grid | None = None) -> xr.Dataset:
    """Vorticity, the curl of the velocity [1/s]; arguments and errors as in `derivatives`.

    Returns
    -------
    Dataset
        ``vorticity_x``, ``_y``, ``_z`` and their ``magnitude`` on the vectors' z, y, x. Times dt: voxel per voxel, the
        unit of the paper's iso-surface (Fig. 13, 0.12).
    """
    g = derivatives(vectors, grid=grid)
    curl = {}
    for axis, (one, two) in {"x": ("wy", "vz"), "y": ("uz", "wx"), "z": ("vx", "uy")}.items():
        curl[f"vorticity_{axis}"] = _of(g, *one) - _of(g, *two)
    curl["magnitude"] = sum(part**2 for part in curl.values()) ** 0.5
    names = {name: f"vorticity along {name[-1]}" for name in curl} | {"magnitude": "magnitude of the vorticity"}
    return xr.Dataset({name: part.assign_attrs(units="1/s", long_name=names[name]) for name, part in curl.items()})


def divergence(vectors: xr.Dataset | np.ndarray, *, grid: Grid | None = None) -> xr.DataArray:
    """Divergence of the velocity [1/s], zero in incompressible flow; arguments and errors as in `derivatives`."""
    g = derivatives(vectors, grid=grid)
    total = _of(g, "u", "x") + _of(g, "v", "y") + _of(g, "w", "z")
    return total.rename("divergence").assign_attrs(units="1/s", long_name="divergence of the velocity")


def q_criterion(vectors: xr.Dataset | np.ndarray, *, grid: Grid | None = None) -> xr.DataArray:
    """Q-criterion (||Omega||^2 - ||S||^2) / 2 [1/s^2], Omega and S the antisymmetric and symmetric gradient.

    Positive where rotation outweighs strain: inside vortices. Arguments and errors as in `derivatives`.
    """
    g = derivatives(vectors, grid=grid)
    # (||Omega||^2 - ||S||^2) / 2 = -sum_ij g_ij g_ji / 2
    q = -(g.values * g.values.swapaxes(0, 1)).sum((0, 1)) / 2
    return _of(g, "u", "x").copy(data=q).rename("q_criterion").assign_attrs(units="1/s^2", long_name="Q-criterion")


def _of(gradient: xr.DataArray, component: str, direction: str) -> xr.DataArray:
    return gradient.sel(component=component, direction=direction, drop=True)


def _displacement(vectors: xr.Dataset | np.ndarray, name: str) -> np.ndarray:
    """Displacements (z, y, x, 3), components (x, y, z) [voxel]."""
    if not isinstance(vectors, xr.Dataset):
        return _checked_field(vectors, name)
    missing = [f"displacement_{axis}" for axis in "xyz" if f"displacement_{axis}" not in vectors]
    if missing:
        raise ValueError(
            f"{name}: expected displacement_x, _y and _z as `correlate` gives them, found no {missing[0]}."
        )
    return np.stack([vectors[f"displacement_{axis}"].transpose(*_DIMS).values for axis in "xyz"], -1).astype(float)


def _checked_field(field: np.ndarray, name: str) -> np.ndarray:
    field = np.asarray(field)
    if field.ndim != 4 or field.shape[3] != 3 or field.dtype.kind not in "fiu":
        raise ValueError(
            f"{name}: expected a Dataset or numbers of shape (z, y, x, 3), got {field.dtype} {field.shape}."
        )
    return field.astype(float)
