"""Statistics over pairs: mean and its standard error, RMS, Reynolds stresses, turbulent kinetic energy.

Vectors are datasets as `lfpiv.open_results` opens: ``u``, ``v``, ``w`` [m/s] over pair, or over instant for a time
series, z, y, x [mm]. At each position only vectors that are finite and valid (``valid`` true, or all without such a
flag) are used. A result is NaN where too few vectors remain. Fluctuations are deviations from the mean over the pairs.
They contain the measurement noise: noise of standard deviation s in u adds s^2 to ``uu``. Dask arrays stay lazy, except
in `standard_error`. Of other arrays that are read from files, at most `BLOCK_BYTES` are in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.derived import COMPONENTS, check_velocity

STRESSES = ("uu", "vv", "ww", "uv", "uw", "vw")
"""Components of the Reynolds stress tensor, which is symmetric."""

LARGEST_PART = 0.75
"""Largest part of all products between pairs that enters the summed correlation, nearest pairs first."""

BLOCK_BYTES = 1 << 28
"""Largest size of velocities that are read at once, in double precision [byte], if one pair is not larger."""

DIMENSIONS = ("pair", "instant")
"""Dimensions over which statistics are taken: of image pairs, and of a time series."""

_TRANSFORM_SIZE = 1 << 22  # numbers in one Fourier transform


def mean(vectors: xr.Dataset) -> xr.Dataset:
    """Compute the mean velocity over the pairs.

    Parameters
    ----------
    vectors : Dataset
        ``u``, ``v``, ``w`` [m/s] over pair or instant, z, y, x [mm]; optionally ``valid``.

    Returns
    -------
    Dataset
        ``u``, ``v``, ``w`` [m/s] over z, y, x, which `lfpiv.derived` accepts; ``pairs_counted``: number of pairs used;
        ``valid``: true where at least one pair is used.

    Raises
    ------
    ValueError
        If the dimension pair or instant is missing, or components or coordinates are missing or in another unit.

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
    result, count = _mean(vectors)
    for name, axis in COMPONENTS.items():
        result[name].attrs = {"units": "m/s", "long_name": f"mean velocity along {axis}"}
    result["pairs_counted"] = count.assign_attrs(units="1", long_name="number of pairs that count")
    result["valid"] = (result["pairs_counted"] > 0).assign_attrs(long_name="measured in some pair")
    return _with_axes(result, vectors)


def rms(vectors: xr.Dataset) -> xr.Dataset:
    """Compute the root mean square of the velocity fluctuations over the pairs, with n - 1 as divisor.

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
    """Compute Reynolds stresses over density: covariances of the velocity components, with n - 1 as divisor.

    The stress itself is minus density times the result. Parameters and errors are those of `mean`.

    Returns
    -------
    Dataset
        ``uu``, ``vv``, ``ww``, ``uv``, ``uw``, ``vw`` [m^2/s^2] over z, y, x; NaN where fewer than two pairs are used.

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
    average, count = _mean(vectors)
    freedom = (count - 1).where(count > 1)
    products: dict[str, xr.DataArray] = {}
    for measured, along in _parts(vectors):
        fluctuation = measured - average
        for name in STRESSES:
            part = (fluctuation[name[0]] * fluctuation[name[1]]).sum(along, skipna=True)
            products[name] = products[name] + part if name in products else part
    fields = {}
    for name in STRESSES:
        attributes = {"units": "m^2/s^2", "long_name": f"Reynolds stress over density, mean of {name[0]}' {name[1]}'"}
        fields[name] = (products[name] / freedom).assign_attrs(attributes)
    return _with_axes(xr.Dataset(fields), vectors)


def turbulent_kinetic_energy(vectors: xr.Dataset) -> xr.DataArray:
    """Compute the turbulent kinetic energy per mass, (uu + vv + ww) / 2 of `reynolds_stresses`.

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
    """Estimate the standard error of the mean velocity, allowing for correlation between successive pairs.

    The variance of the mean of n correlated pairs is V = sigma^2 (1 + 2 sum (n_k / n) rho_k) / n, with n_k the number
    of products between pairs k apart and rho_k their correlation. Products are averaged over the volume. Because they
    are taken about the mean of the same pairs, each is too small by V [2]_; V is added, and the linear equation solved
    for it. The sum ends where the correlation is no longer positive, and no term exceeds the one before [1]_.

    The estimate is too small for series that are not much longer than their correlation (docs/notebook/velocity.md).
    At most `BLOCK_BYTES` are in memory: all pairs at some of the positions. So files of single pairs are read several
    times if all do not fit; a store of ``lfpiv export`` is read once.

    Parameters and errors are those of `mean`.

    Returns
    -------
    Dataset
        ``standard_error_u``, ``_v``, ``_w`` [m/s] over z, y, x, NaN where fewer than two pairs are used. Their
        attribute ``pairs_per_independent`` is the factor in parentheses above.

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
    along = _dimension(vectors)
    order = np.asarray(vectors[along]) if along in vectors.coords else np.arange(vectors.sizes[along])
    if order.dtype.kind not in "iu" or len(np.unique(order)) < len(order):
        raise ValueError(f"vectors: expected whole numbers as coordinate {along}, each once, found others.")
    fields = {}
    sums = {name: _Autocovariance(order - order.min()) for name in COMPONENTS}
    field = xr.zeros_like(vectors["u"].isel({along: 0}, drop=True), float).transpose(*AXES).compute()
    scatter = {name: field.copy() for name in COMPONENTS}
    for rows in _rows(vectors):
        measured = _measured(vectors.isel(rows)).compute()
        for name in COMPONENTS:
            series = measured[name].transpose(along, *AXES)
            sums[name].add(series.values)
            count = series.count(along)
            scatter[name][rows] = (series.std(along, ddof=1) / np.sqrt(count.where(count > 1))).where(count > 1)
    for name, axis in COMPONENTS.items():
        shared, factor = _correlated(sums[name])
        error = scatter[name] * np.sqrt(factor)
        error.attrs = {
            "units": "m/s",
            "long_name": f"standard error of the mean velocity along {axis}",
            "pairs_per_independent": shared,
        }
        fields[f"standard_error_{name}"] = error
    return _with_axes(xr.Dataset(fields), vectors)


def _dimension(vectors: xr.Dataset) -> str:
    """Return the dimension over the pairs or instants."""
    check_velocity(vectors)
    found = [name for name in DIMENSIONS if name in vectors["u"].dims]
    if len(found) != 1 or not all(found[0] in vectors[name].dims for name in COMPONENTS):
        expected = set(found[:1] or DIMENSIONS)
        short = next((name for name in COMPONENTS if not expected & set(vectors[name].dims)), "u")
        raise ValueError(
            f"vectors: expected {short} over pair, z, y, x, or over instant, found it over {vectors[short].dims}. "
            "Open all pairs of a run with `lfpiv.open_results`."
        )
    return found[0]


def _measured(vectors: xr.Dataset) -> xr.Dataset:
    """Return velocities in double precision, NaN where they are not used."""
    velocity = vectors[list(COMPONENTS)].astype(float)
    velocity = velocity.drop_vars([name for name in velocity.coords if name not in velocity.dims])
    used = (velocity["u"] + velocity["v"] + velocity["w"]).notnull()
    if "valid" in vectors:
        flags = vectors["valid"].astype(bool)
        used = used & flags.drop_vars([name for name in flags.coords if name not in flags.dims])
    return velocity.where(used)


def _parts(vectors: xr.Dataset) -> Iterator[tuple[xr.Dataset, str]]:
    """Yield parts of the pairs as `_measured` returns them, with their dimension. Dask arrays are one part."""
    along = _dimension(vectors)
    total = vectors.sizes[along]
    each = sum(vectors[name].size for name in COMPONENTS) * 8 // max(total, 1)
    length = total if vectors.chunks else max(BLOCK_BYTES // max(each, 1), 1)
    for start in range(0, total, length) if total > length else (0,):
        yield _measured(vectors.isel({along: slice(start, start + length)})), along


def _rows(vectors: xr.Dataset) -> Iterator[dict[str, slice]]:
    """Yield indices of parts of the positions along z and y, of which all pairs fit into a block."""
    layers, rows = vectors.sizes["z"], vectors.sizes["y"]
    row = sum(vectors[name].size for name in COMPONENTS) * 8 // (layers * rows)
    most = max(BLOCK_BYTES // max(row, 1), 1)  # rows of vectors along x
    high, wide = max(most // rows, 1), min(most, rows)
    for z in range(0, layers, high):
        for y in range(0, rows, wide):
            yield {"z": slice(z, z + high), "y": slice(y, y + wide)}


def _mean(vectors: xr.Dataset) -> tuple[xr.Dataset, xr.DataArray]:
    """Return the mean velocity and the number of pairs that are used at each position."""
    total: xr.Dataset | None = None
    count: xr.DataArray | None = None
    for measured, along in _parts(vectors):
        part, used = measured.sum(along, skipna=True), measured["u"].count(along)
        total = part if total is None else total + part
        count = used if count is None else count + used
    assert total is not None and count is not None
    return total / count.where(count > 0), count


def _with_axes(result: xr.Dataset, vectors: xr.Dataset) -> xr.Dataset:
    """Return a result with the axes of the vectors and their units, without attributes."""
    result = result.assign_coords({axis: vectors[axis] for axis in AXES})
    result.attrs = {}
    return result


class _Autocovariance:
    """Sums of products of deviations from the mean over pairs 0, 1, ... apart and over all positions."""

    def __init__(self, place: np.ndarray):
        self.place, length = place, int(place.max()) + 1
        self.products, self.pairs = np.zeros(length), np.zeros(length)
        """Sums, and the number of products in each."""
        self.positions = 0
        """Positions with at least two pairs."""

    def add(self, series: np.ndarray) -> None:
        """Add one component (pair, ...) at some positions, NaN where it is not used."""
        series, length = series.reshape(len(series), -1), len(self.products)
        step = max(1, _TRANSFORM_SIZE // length)
        for start in range(0, series.shape[1], step):
            part = series[:, start : start + step]
            used = np.isfinite(part)
            used &= used.sum(0) > 1
            means = np.where(used, part, 0).sum(0) / np.maximum(used.sum(0), 1)
            self.products += _lagged_sums(np.where(used, part - means, 0), self.place, length)
            self.pairs += _lagged_sums(used, self.place, length)
            self.positions += int(used.any(0).sum())


def _correlated(found: _Autocovariance) -> tuple[float, float]:
    """Return 1 + 2 sum (n_k / n) rho_k, and n times the variance of the mean over the observed variance about it."""
    products, pairs, positions = found.products, found.pairs, found.positions
    if not products[0] > 0:
        return 1.0, 1.0
    occurs = pairs > 0.5  # distances that the gaps do not remove
    observed = np.minimum.accumulate(products[occurs] / pairs[occurs])
    share = 2 * pairs[occurs] / pairs[0]
    share[0] = 1
    count = pairs[0] / positions
    farthest = np.flatnonzero(share.cumsum() <= LARGEST_PART * count)[-1] + 1
    mean_variance = observed[0] / (count - 1)
    for _ in range(2):  # the variance of the mean and the end of the correlation depend on each other
        ends = np.flatnonzero(observed[:farthest] + mean_variance <= 0)
        stop = ends[0] if len(ends) else farthest
        mean_variance = (share * observed)[:stop].sum() / (count - share[:stop].sum())
    variance = observed[0] + mean_variance
    total = (share * (observed + mean_variance))[:stop].sum() / variance
    return float(total), float(total * variance * (count - 1) / (count * observed[0]))


def _lagged_sums(values: np.ndarray, place: np.ndarray, length: int) -> np.ndarray:
    """Sum the products of values 0, 1, ... `length` - 1 apart along the first axis, over all positions."""
    spread = np.zeros((length, values.shape[1]))
    spread[place] = values
    power = np.abs(np.fft.rfft(spread, 2 * length, axis=0)) ** 2  # padding to twice the length avoids wrap-around
    return np.fft.irfft(power.sum(1))[:length]
