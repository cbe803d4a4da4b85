"""Statistics over pairs: mean, its standard error, RMS, Reynolds stresses, turbulent kinetic energy.

Vectors are datasets as `lfpiv.open_results` opens them: ``u``, ``v``, ``w`` [m/s] over pair, z, y, x [mm]. Place by
place, those vectors count that are valid (``valid`` true, or all where there is no such flag) and finite; where fewer
count than a figure needs, it is NaN. Fluctuations are taken from the mean over the pairs. They hold the measurement's
noise with the flow's own: noise of standard deviation s in u adds s^2 to ``uu``.
Where the vectors are dask arrays, nothing but `standard_error` computes before it is asked to.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.derived import COMPONENTS, check_velocity

STRESSES = ("uu", "vv", "ww", "uv", "uw", "vw")
"""Components of the Reynolds stress tensor, which is symmetric."""

LARGEST_PART = 0.75
"""Largest part of all pairs of pairs whose correlation is summed up: those farther apart are too few to tell it."""

_TRANSFORM_SIZE = 1 << 22  # numbers that are transformed at once


def mean(vectors: xr.Dataset) -> xr.Dataset:
    """Mean velocity over the pairs.

    Parameters
    ----------
    vectors : Dataset
        ``u``, ``v``, ``w`` [m/s] over pair, z, y, x [mm]; optionally ``valid``.

    Returns
    -------
    Dataset
        ``u``, ``v``, ``w`` [m/s] over z, y, x: vectors again, so `lfpiv.derived` takes them; ``pairs_counted``;
        ``valid``: whether any pair counts.

    Raises
    ------
    ValueError
        If there is no dimension pair, or components or coordinates are missing or in another unit.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import statistics
    >>> axes = {"pair": [0, 1, 2], "z": [0.0], "y": [0.0], "x": [0.0, 1.0]}  # mm
    >>> u = xr.DataArray([[1.0, 5.0], [2.0, 9.0], [3.0, 7.0]], {"pair": axes["pair"], "x": axes["x"]})
    >>> u = u.expand_dims(z=[0.0], y=[0.0]).transpose("pair", "z", "y", "x")
    >>> vectors = xr.Dataset({"u": u, "v": 0 * u, "w": 0 * u, "valid": u != 9})
    >>> average = statistics.mean(vectors)
    >>> average.u.values.tolist(), average.pairs_counted.values.tolist()
    ([[[2.0, 6.0]]], [[[3, 2]]])
    """
    measured = _measured(vectors)
    result = _mean(measured)
    for name, axis in COMPONENTS.items():
        result[name].attrs = {"units": "m/s", "long_name": f"mean velocity along {axis}"}
    result["pairs_counted"] = _count(measured).assign_attrs(units="1", long_name="number of pairs that count")
    result["valid"] = (result["pairs_counted"] > 0).assign_attrs(long_name="measured in some pair")
    return _with_axes(result, vectors)


def rms(vectors: xr.Dataset) -> xr.Dataset:
    """Root mean square of the velocity's fluctuations about its mean over the pairs, divided by n - 1.

    Parameters and errors are those of `mean`.

    Returns
    -------
    Dataset
        ``u_rms``, ``v_rms``, ``w_rms`` [m/s] over z, y, x.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import statistics
    >>> axes = {"pair": np.arange(3), "z": [0.0], "y": [0.0], "x": [0.0]}  # mm
    >>> u = xr.DataArray(np.reshape([1.0, 2.0, 3.0], (3, 1, 1, 1)), axes)
    >>> statistics.rms(xr.Dataset({"u": u, "v": 2 * u, "w": 0 * u})).v_rms.item()
    2.0
    """
    stresses = reynolds_stresses(vectors)
    fields = {}
    for name, axis in COMPONENTS.items():
        attributes = {"units": "m/s", "long_name": f"RMS of the velocity fluctuations along {axis}"}
        fields[f"{name}_rms"] = (stresses[name + name] ** 0.5).assign_attrs(attributes)
    return _with_axes(xr.Dataset(fields), vectors)


def reynolds_stresses(vectors: xr.Dataset) -> xr.Dataset:
    """Reynolds stresses over density: covariances of the velocity components over the pairs, divided by n - 1.

    The stress itself is minus density times these. Parameters and errors are those of `mean`.

    Returns
    -------
    Dataset
        ``uu``, ``vv``, ``ww``, ``uv``, ``uw``, ``vw`` [m^2/s^2] over z, y, x; NaN where fewer than two pairs count.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import statistics
    >>> axes = {"pair": np.arange(3), "z": [0.0], "y": [0.0], "x": [0.0]}  # mm
    >>> u = xr.DataArray(np.reshape([1.0, 2.0, 3.0], (3, 1, 1, 1)), axes)
    >>> stresses = statistics.reynolds_stresses(xr.Dataset({"u": u, "v": -2 * u, "w": 0 * u}))
    >>> stresses.uv.item(), stresses.uv.attrs["units"]
    (-2.0, 'm^2/s^2')
    """
    measured = _measured(vectors)
    fluctuation = measured - _mean(measured)
    freedom = _count(measured) - 1
    freedom = freedom.where(freedom > 0)
    fields = {}
    for name in STRESSES:
        products = (fluctuation[name[0]] * fluctuation[name[1]]).sum("pair", skipna=True)
        attributes = {"units": "m^2/s^2", "long_name": f"Reynolds stress over density, mean of {name[0]}' {name[1]}'"}
        fields[name] = (products / freedom).assign_attrs(attributes)
    return _with_axes(xr.Dataset(fields), vectors)


def turbulent_kinetic_energy(vectors: xr.Dataset) -> xr.DataArray:
    """Turbulent kinetic energy per mass, (uu + vv + ww) / 2 of `reynolds_stresses`.

    Parameters and errors are those of `mean`.

    Returns
    -------
    DataArray
        ``turbulent_kinetic_energy`` [m^2/s^2] over z, y, x.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import statistics
    >>> axes = {"pair": np.arange(3), "z": [0.0], "y": [0.0], "x": [0.0]}  # mm
    >>> u = xr.DataArray(np.reshape([1.0, 2.0, 3.0], (3, 1, 1, 1)), axes)
    >>> statistics.turbulent_kinetic_energy(xr.Dataset({"u": u, "v": u, "w": 0 * u})).item()
    1.0
    """
    stresses = reynolds_stresses(vectors)
    energy = (stresses["uu"] + stresses["vv"] + stresses["ww"]) / 2
    energy.attrs = {"units": "m^2/s^2", "long_name": "turbulent kinetic energy per mass"}
    return energy.rename("turbulent_kinetic_energy")


def standard_error(vectors: xr.Dataset) -> xr.Dataset:
    """Estimate the standard error of the mean velocity: few of many correlated pairs are independent.

    The variance of the mean of n correlated pairs is V = sigma^2 (1 + 2 sum (n_k / n) rho_k) / n, n_k the number of
    pairs k apart. Their products about the mean of the pairs themselves, averaged over the volume, each lack that V
    [2]_, which is added: the sum is linear in V and solved for it. It goes up to where the correlation is not positive,
    and counts none as higher than one before [1]_.

    A series not much longer than its correlation hides it. With rho_k = rho^k the error comes out as 0.9 to 1.1 of the
    true one for rho = 0.5 and 10 pairs or more, and for rho = 0.8 and 50; as 0.8 to 0.9 for rho = 0.8 and 20 pairs, 0.7
    for 10. Of independent pairs it is 1.0 where the flow differs from place to place; where all vectors move as one,
    1.2 for 10 pairs and 1.1 for 50. One component of all pairs is held in memory.

    Parameters and errors are those of `mean`.

    Returns
    -------
    Dataset
        ``standard_error_u``, ``_v``, ``_w`` [m/s] over z, y, x, NaN where fewer than two pairs count. Their attribute
        ``pairs_per_independent`` is that bracket.

    References
    ----------
    .. [1] C. J. Geyer, "Practical Markov chain Monte Carlo", Statist. Sci. 7 (1992) 473-483: initial positive and
       monotone sequences.
    .. [2] F. H. C. Marriott, J. A. Pope, "Bias in the estimation of autocorrelations", Biometrika 41 (1954) 390-402,
       doi:10.1093/biomet/41.3-4.390.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from lfpiv import statistics
    >>> axes = {"pair": np.arange(4), "z": [0.0], "y": [0.0], "x": [0.0]}  # mm
    >>> u = xr.DataArray(np.reshape([1.0, -1.0, 1.0, -1.0], (4, 1, 1, 1)), axes)
    >>> error = statistics.standard_error(xr.Dataset({"u": u, "v": u, "w": u})).standard_error_u
    >>> round(error.item(), 4), error.attrs["pairs_per_independent"]  # sqrt(4 / 3 / 4)
    (0.5774, 1.0)
    """
    measured, fields = _measured(vectors), {}
    order = np.asarray(vectors["pair"]) if "pair" in vectors.coords else np.arange(vectors.sizes["pair"])
    if order.dtype.kind not in "iu" or len(np.unique(order)) < len(order):
        raise ValueError("vectors: expected whole numbers as coordinate pair, each once, found others.")
    for name, axis in COMPONENTS.items():
        series = measured[name].transpose("pair", ...).compute()
        count = series.count("pair")
        shared, factor = _correlated(series.values, order)
        error = (series.std("pair", ddof=1) * np.sqrt(factor / count.where(count > 1))).where(count > 1)
        error.attrs = {
            "units": "m/s",
            "long_name": f"standard error of the mean velocity along {axis}",
            "pairs_per_independent": shared,
        }
        fields[f"standard_error_{name}"] = error
    return _with_axes(xr.Dataset(fields), vectors)


def _measured(vectors: xr.Dataset) -> xr.Dataset:
    """Velocities in double precision, NaN where they do not count."""
    check_velocity(vectors)
    short = [name for name in COMPONENTS if "pair" not in vectors[name].dims]
    if short:
        raise ValueError(
            f"vectors: expected {short[0]} over pair, z, y, x, found it over {vectors[short[0]].dims}. "
            "Open all pairs of a run with `lfpiv.open_results`."
        )
    velocity = vectors[list(COMPONENTS)].astype(float)
    velocity = velocity.drop_vars([name for name in velocity.coords if name not in velocity.dims])
    counts = (velocity["u"] + velocity["v"] + velocity["w"]).notnull()
    if "valid" in vectors:
        counts = counts & vectors["valid"].astype(bool).drop_vars("valid", errors="ignore")
    return velocity.where(counts)


def _count(measured: xr.Dataset) -> xr.DataArray:
    return measured["u"].count("pair")


def _mean(measured: xr.Dataset) -> xr.Dataset:
    count = _count(measured)
    return measured.sum("pair", skipna=True) / count.where(count > 0)


def _with_axes(result: xr.Dataset, vectors: xr.Dataset) -> xr.Dataset:
    """Give a result the axes of the vectors with their units; no attributes of theirs."""
    result = result.assign_coords({axis: vectors[axis] for axis in AXES})
    result.attrs = {}
    return result


def _correlated(series: np.ndarray, order: np.ndarray) -> tuple[float, float]:
    """Sum up the correlation over all pairs of pairs, 1 + 2 sum (n_k / n) rho_k, n_k of them k apart.

    Parameters
    ----------
    series : ndarray, shape (pair, ...)
        One component, NaN where it does not count.
    order : ndarray of int, shape (pair,)
        Numbers of the pairs; gaps are pairs that are missing.

    Returns
    -------
    pairs_per_independent : float
        That sum.
    factor : float
        n times the variance of a mean over the variance seen about it: the sum, and what is not seen.
    """
    flat = series.reshape(len(series), -1)
    place = order - order.min()
    length = int(place.max()) + 1
    step = max(1, _TRANSFORM_SIZE // length)
    products, pairs, places = np.zeros(length), np.zeros(length), 0
    for start in range(0, flat.shape[1], step):
        part = flat[:, start : start + step]
        counts = np.isfinite(part)
        counts &= counts.sum(0) > 1
        means = np.where(counts, part, 0).sum(0) / np.maximum(counts.sum(0), 1)
        products += _sums_apart(np.where(counts, part - means, 0), place, length)
        pairs += _sums_apart(counts, place, length)
        places += int(counts.any(0).sum())
    if not products[0] > 0:
        return 1.0, 1.0
    occurs = pairs > 0.5  # distances that there are, not hidden by gaps
    seen = np.minimum.accumulate(products[occurs] / pairs[occurs])
    share = 2 * pairs[occurs] / pairs[0]
    share[0] = 1
    count = pairs[0] / places
    farthest = np.flatnonzero(share.cumsum() <= LARGEST_PART * count)[-1] + 1
    lost = seen[0] / (count - 1)
    for _ in range(2):  # the variance of the mean tells where the correlation ends, and that tells it better
        ends = np.flatnonzero(seen[:farthest] + lost <= 0)
        stop = ends[0] if len(ends) else farthest
        lost = (share * seen)[:stop].sum() / (count - share[:stop].sum())
    total = (share * (seen + lost))[:stop].sum() / (seen[0] + lost)
    return float(total), float(total * (seen[0] + lost) * (count - 1) / (count * seen[0]))


def _sums_apart(values: np.ndarray, place: np.ndarray, length: int) -> np.ndarray:
    """Sum the products of values 0, 1, ... `length` - 1 apart along the first axis, over everything else."""
    spread = np.zeros((length, values.shape[1]))
    spread[place] = values
    power = np.abs(np.fft.rfft(spread, 2 * length, axis=0)) ** 2  # twice as long: ends do not meet
    sums: np.ndarray = np.fft.irfft(power.sum(1))[:length]
    return sums
