"""Fields derived from vectors: velocity gradient, vorticity, divergence, Q-criterion, strain rate.

Vectors are datasets as `lfpiv.correlate` returns or `lfpiv.open_results` opens: ``u``, ``v``, ``w`` [m/s] over z, y, x
[mm], with any further dimensions such as ``pair``. Dask arrays stay lazy.

Derivatives are second-order differences, central inside and one-sided at the border. Nothing is smoothed. Replaced
vectors (``valid`` false) are used. The coordinate ``valid`` of a derived field is true where the vector and all its
neighbours in the differences were measured: ``field.where(field.valid)`` depends on measured vectors only. NaN spreads
to the neighbours. Uncorrelated noise of standard deviation s in the vectors gives derivatives a noise of 0.7 s/h inside
and 2.5 s/h at the border, with h the spacing. Windows that overlap have correlated noise, which lowers both.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES

LEAST_VECTORS = 3
"""Least number of vectors along an axis for derivatives."""

COMPONENTS = {"u": "x", "v": "y", "w": "z"}
"""Velocity components and the axes they point along."""

_PER_MILLIMETRE = 1e3  # a velocity [m/s] over a length [mm], in 1/s


def velocity_gradient(vectors: xr.Dataset) -> xr.DataArray:
    """Compute the velocity gradient tensor.

    Parameters
    ----------
    vectors : Dataset
        ``u``, ``v``, ``w`` [m/s] over z, y, x [mm], at least 3 vectors along each; optionally ``valid``.

    Returns
    -------
    DataArray, dims (component, direction, ..., z, y, x)
        d(component)/d(direction) [1/s] for components u, v, w and directions x, y, z. Multiplied by ``dt_s`` it is in
        voxel per voxel. Coordinate ``valid``: true where all vectors in the differences were measured.

    Raises
    ------
    ValueError
        If a component or a coordinate is missing or in another unit, or an axis has fewer than 3 vectors.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import derived
    >>> z, y, x = xr.broadcast(*(xr.DataArray(np.arange(4.0), [(axis, np.arange(4.0))]) for axis in "zyx"))  # mm
    >>> shear = xr.Dataset({"u": 0.002 * y, "v": 0 * x, "w": 0 * x})  # m/s: shear of 2 m/s per m
    >>> gradient = derived.velocity_gradient(shear)
    >>> gradient.dims, gradient.attrs["units"]
    (('component', 'direction', 'z', 'y', 'x'), '1/s')
    >>> gradient.isel(z=1, y=2, x=3).values.round(6).tolist()
    [[0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    _check(vectors)
    rows = [
        xr.concat([_derivative(vectors, name, axis) for axis in "xyz"], "direction", coords="minimal")
        for name in COMPONENTS
    ]
    tensor = xr.concat(rows, "component", coords="minimal")
    tensor = tensor.assign_coords(component=list(COMPONENTS), direction=list("xyz"))
    return _field(tensor, _places(vectors), "velocity_gradient", "1/s", "velocity gradient")


def vorticity(vectors: xr.Dataset) -> xr.Dataset:
    """Compute the vorticity, the curl of the velocity.

    Parameters and errors are those of `velocity_gradient`.

    Returns
    -------
    Dataset
        ``vorticity_x``, ``vorticity_y``, ``vorticity_z`` and ``vorticity_magnitude`` [1/s], coordinate ``valid``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import derived
    >>> z, y, x = xr.broadcast(*(xr.DataArray(np.arange(4.0), [(axis, np.arange(4.0))]) for axis in "zyx"))  # mm
    >>> rotation = xr.Dataset({"u": -0.003 * y, "v": 0.003 * x, "w": 0 * x})  # m/s: rotation by 3 rad/s
    >>> curl = derived.vorticity(rotation)
    >>> float(curl.vorticity_z.mean().round(6)), curl.vorticity_z.attrs["units"]
    (6.0, '1/s')
    """
    _check(vectors)
    fields, places = {}, _places(vectors)
    for axis, (plus, minus) in {"x": ("wy", "vz"), "y": ("uz", "wx"), "z": ("vx", "uy")}.items():
        field = _derivative(vectors, *plus) - _derivative(vectors, *minus)
        fields[f"vorticity_{axis}"] = _field(field, places, f"vorticity_{axis}", "1/s", f"vorticity along {axis}")
    size = _total(field**2 for field in fields.values()) ** 0.5
    fields["vorticity_magnitude"] = _field(size, places, "vorticity_magnitude", "1/s", "magnitude of the vorticity")
    return xr.Dataset(fields)


def divergence(vectors: xr.Dataset) -> xr.DataArray:
    """Compute the divergence of the velocity. In incompressible flow it is zero, so any other value is an error.

    Parameters and errors are those of `velocity_gradient`.

    Returns
    -------
    DataArray
        ``divergence`` [1/s], coordinate ``valid``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import derived
    >>> z, y, x = xr.broadcast(*(xr.DataArray(np.arange(4.0), [(axis, np.arange(4.0))]) for axis in "zyx"))  # mm
    >>> sink = xr.Dataset({"u": 0.001 * x, "v": 0.002 * y, "w": -0.004 * z})  # m/s
    >>> float(derived.divergence(sink).mean().round(6))  # 1/s
    -1.0
    """
    _check(vectors)
    total = _total(_derivative(vectors, name, axis) for name, axis in COMPONENTS.items())
    return _field(total, _places(vectors), "divergence", "1/s", "divergence of the velocity")


def q_criterion(vectors: xr.Dataset) -> xr.DataArray:
    """Compute the Q-criterion, (||Omega||^2 - ||S||^2) / 2, which is positive inside vortices.

    Omega and S are the antisymmetric and the symmetric part of the velocity gradient. The trace is not removed: in a
    field with divergence, Q follows Hunt's definition and is not the second invariant. Parameters and errors are those
    of `velocity_gradient`.

    Returns
    -------
    DataArray
        ``q_criterion`` [1/s^2], coordinate ``valid``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import derived
    >>> z, y, x = xr.broadcast(*(xr.DataArray(np.arange(4.0), [(axis, np.arange(4.0))]) for axis in "zyx"))  # mm
    >>> rotation = xr.Dataset({"u": -0.003 * y, "v": 0.003 * x, "w": 0 * x})  # m/s: rotation by 3 rad/s
    >>> q = derived.q_criterion(rotation)
    >>> float(q.mean().round(6)), q.attrs["units"]
    (9.0, '1/s^2')
    """
    _check(vectors)
    # (||Omega||^2 - ||S||^2) / 2 = -sum_ij g_ij g_ji / 2
    squares = _total(_derivative(vectors, name, axis) ** 2 for name, axis in COMPONENTS.items())
    mixed = _total(_derivative(vectors, *one) * _derivative(vectors, *two) for one, two in _MIRRORED)
    return _field(-squares / 2 - mixed, _places(vectors), "q_criterion", "1/s^2", "Q-criterion")


def strain_rate(vectors: xr.Dataset) -> xr.Dataset:
    """Compute the strain-rate tensor S, the symmetric part of the velocity gradient.

    Parameters and errors are those of `velocity_gradient`.

    Returns
    -------
    Dataset
        ``strain_xx``, ``_yy``, ``_zz``, ``_xy``, ``_xz``, ``_yz`` [1/s], S_xy = (du/dy + dv/dx)/2, and
        ``strain_rate_magnitude`` [1/s] = sqrt(2 S:S); coordinate ``valid``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import derived
    >>> z, y, x = xr.broadcast(*(xr.DataArray(np.arange(4.0), [(axis, np.arange(4.0))]) for axis in "zyx"))  # mm
    >>> shear = xr.Dataset({"u": 0.002 * y, "v": 0 * x, "w": 0 * x})  # m/s: shear of 2 m/s per m
    >>> strain = derived.strain_rate(shear)
    >>> float(strain.strain_xy.mean().round(6)), float(strain.strain_rate_magnitude.mean().round(6))
    (1.0, 2.0)
    """
    _check(vectors)
    parts = {axis + axis: _derivative(vectors, name, axis) for name, axis in COMPONENTS.items()}
    for one, two in _MIRRORED:
        pair = COMPONENTS[one[0]] + one[1]
        parts[pair] = (_derivative(vectors, *one) + _derivative(vectors, *two)) / 2
    squares = _total(part**2 * (1 if pair[0] == pair[1] else 2) for pair, part in parts.items())
    places = _places(vectors)
    fields = {
        f"strain_{pair}": _field(part, places, f"strain_{pair}", "1/s", f"strain rate {pair}")
        for pair, part in parts.items()
    }
    name, text = "strain_rate_magnitude", "magnitude of the strain rate, sqrt(2 S:S)"
    fields[name] = _field((2 * squares) ** 0.5, places, name, "1/s", text)
    return xr.Dataset(fields)


_MIRRORED = (("uy", "vx"), ("uz", "wx"), ("vz", "wy"))  # off-diagonal derivatives and their mirror images


def _derivative(vectors: xr.Dataset, component: str, axis: str) -> xr.DataArray:
    """Differentiate a component along an axis [1/s]."""
    velocity = vectors[component].drop_vars("valid", errors="ignore").astype(float)
    return velocity.differentiate(axis, edge_order=2) * _PER_MILLIMETRE


def _total(parts: Iterable[xr.DataArray]) -> xr.DataArray:
    return functools.reduce(operator.add, parts)


def _places(vectors: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the coordinates of a derived field: the axes of the vectors, and ``valid``."""
    axes = {axis: vectors[axis] for axis in AXES}
    if "valid" not in vectors:
        return axes
    measured = vectors["valid"].astype(bool)
    gaps = xr.zeros_like(measured, float).where(measured)  # NaN spreads exactly as far as the differences reach
    for axis in AXES:
        measured = measured & gaps.differentiate(axis, edge_order=2).notnull()
    text = "the vector and all its neighbours in the differences were measured"
    return axes | {"valid": measured.assign_attrs(long_name=text)}


def _field(values: xr.DataArray, places: Mapping[str, xr.DataArray], name: str, units: str, text: str) -> xr.DataArray:
    """Return a derived field with its axes last, and with coordinates, name and unit."""
    field = values.assign_coords(places).transpose(..., *AXES).rename(name)
    field.attrs = {"units": units, "long_name": text}
    return field


def _check(vectors: xr.Dataset) -> None:
    """Raise ValueError if vectors cannot be differentiated."""
    check_velocity(vectors)
    for axis in AXES:
        if vectors.sizes[axis] < LEAST_VECTORS:
            raise ValueError(f"vectors: expected at least {LEAST_VECTORS} along {axis}, found {vectors.sizes[axis]}.")
        steps = np.diff(np.asarray(vectors[axis], float))
        if not ((steps > 0).all() or (steps < 0).all()):
            raise ValueError(f"vectors: expected coordinates {axis} that rise or fall throughout, found others.")


def check_velocity(vectors: xr.Dataset) -> None:
    """Check that a dataset holds velocities u, v, w [m/s] over z, y, x [mm].

    Raises
    ------
    ValueError
        If it is not a Dataset, or a component or coordinate is missing or has another unit or other dimensions.
    """
    if not isinstance(vectors, xr.Dataset):
        raise ValueError(
            f"vectors: expected a Dataset as `lfpiv.correlate` returns or `lfpiv.open_results` opens, got "
            f"{type(vectors).__name__}."
        )
    missing = [name for name in (*COMPONENTS, *AXES) if name not in vectors.variables]
    if missing:
        raise ValueError(f"vectors: expected u, v, w over z, y, x, found no {', '.join(missing)}.")
    for name, unit in {**dict.fromkeys(COMPONENTS, "m/s"), **dict.fromkeys(AXES, "mm")}.items():
        found = vectors[name].attrs.get("units", unit)
        if found != unit:
            raise ValueError(f"vectors: expected {name} in {unit}, found {found!r}. Convert it first.")
    for name in COMPONENTS:
        if not set(AXES) <= set(vectors[name].dims):
            raise ValueError(f"vectors: expected {name} over z, y, x, found it over {vectors[name].dims}.")
