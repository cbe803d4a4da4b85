"""`open_results`: open the vectors of a run, or a store of them, as one dataset that is read lazily."""

from __future__ import annotations

import contextlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from lfpiv.errors import InputError
from lfpiv.results import stores
from lfpiv.results.netcdf import read_field
from lfpiv.results.stacked_files import StackedFiles

CHUNK_BYTES = 8 << 20
"""Largest size of a dask chunk, which holds one variable of at least one pair [byte]."""

CHUNK_PAIRS = 256
"""Largest number of pairs in a dask chunk: each is a file to open."""


def open_results(folder: str | Path, *, pairs: tuple[int, int | None] | None = None) -> xr.Dataset:
    """Open the vectors of all finished pairs in the folder of a run, or in a store that `export_results` wrote.

    A folder is listed, and attributes and axes of at most 100 files are compared, which takes a millisecond each; the
    others are compared when they are read. With dask installed, the variables are dask arrays with chunks along pair.
    Without dask, values are read from the files when they are used. No file of a run stays open.

    Parameters
    ----------
    folder : str or Path
        Output folder of `lfpiv run`, its ``--out``; or ``vectors.zarr`` or ``vectors.nc`` of ``lfpiv export``.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None. Missing pairs are skipped.

    Returns
    -------
    Dataset
        The variables of the vector files (docs/conventions.md) over pair, z, y, x. Coordinate ``pair``: numbers of the
        pairs. Of a time series the first dimension is ``instant``, the number of the first of the two instants, with a
        coordinate ``time`` [s]. Attributes: those that all pairs share. If the run measured the damping by ghosts, the
        variables of `lfpiv.velocity.damping.Damping.unbiased` are added, ``uncertainty`` includes the damping, and the
        attribute ``damping`` states it.

    Raises
    ------
    InputError
        If there are no vectors, a file is not a vector file, two pairs differ in settings or axes, or a store is not
        complete. The message names the files.

    Examples
    --------
    This example writes the files itself. Usually `lfpiv run` has written them.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np, lfpiv
    >>> from lfpiv.results.netcdf import write_vectors
    >>> folder = Path(tempfile.mkdtemp())
    >>> rng = np.random.default_rng(0)
    >>> volume = rng.random((16, 16, 16))
    >>> vectors = lfpiv.correlate(volume, np.roll(volume, 1, axis=2), windows=(8,), dt_s=1e-4, voxel_mm=0.1)
    >>> for pair in (0, 2):
    ...     write_vectors(vectors, folder / "vectors" / f"pair_{pair:04d}.nc", attributes={"pair": pair})
    >>> results = lfpiv.open_results(folder)
    >>> results.u.dims, results.pair.values.tolist()
    (('pair', 'z', 'y', 'x'), [0, 2])
    >>> round(float(np.median(results.u.sel(pair=2))), 1)  # m/s: one voxel of 0.1 mm in 0.1 ms
    1.0
    """
    path = Path(folder)
    if stores.is_store(path):
        return stores.open_store(path, pairs)
    return _stacked(StackedFiles(path, pairs))


def open_readable(folder: str | Path, *, every: bool = False) -> tuple[xr.Dataset, dict[Path, str]]:
    """Open results as `open_results` does, without the files that are damaged or differ from most others.

    Every file is read once with `every`, or where one of those that are compared is wrong.

    Returns
    -------
    results : Dataset
    left_out : dict
        Path of each file that is left out, with the reason.

    Raises
    ------
    InputError
        If no file can be read.
    """
    left_out: dict[Path, str] = {}
    with contextlib.suppress(InputError):
        if not every:
            return open_results(folder), left_out
    if stores.is_store(Path(folder)):
        return open_results(folder), left_out
    return _stacked(StackedFiles(Path(folder), left_out=left_out)), left_out


def _stacked(files: StackedFiles) -> xr.Dataset:
    """Return the variables of many files, which are read lazily."""
    stacks = {name: indexing.LazilyIndexedArray(_Stack(files, name)) for name in files.names}
    results = files.dataset(stacks)
    if importlib.util.find_spec("dask") is None:
        return results
    return results.chunk({files.dimension: min(max(1, CHUNK_BYTES // files.first["u"].nbytes), CHUNK_PAIRS)})


def open_field(folder: str | Path, pair: int) -> xr.Dataset:
    """Open the displacement field of a pair's joint fit, which is finer than its vectors.

    Parameters
    ----------
    folder : str or Path
        Output folder of `lfpiv run`, with ``smart.estimate = "joint"``.
    pair : int
        Number of the pair.

    Returns
    -------
    Dataset
        As `joint_field` returns it.

    Raises
    ------
    InputError
        If the pair has no vectors, or no field: it was not fitted jointly.
    """
    path = StackedFiles(Path(folder), (pair, pair + 1)).path(0)
    field = read_field(path)
    if field is None:
        raise InputError(
            f'{path}: expected the field of a joint fit, found none. Set smart.estimate = "joint" and run again; if it '
            "is set, the report says why this pair was not fitted."
        )
    return field


class _Stack(BackendArray):
    """One variable of many files as a lazy array (pair, z, y, x)."""

    def __init__(self, files: StackedFiles, name: str):
        self.files, self.name = files, name
        self.shape, self.dtype = (len(files), *files.shape), files.first[name].dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> np.ndarray:
        support = indexing.IndexingSupport.OUTER
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, support, self._read))

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        """Return the values at an outer index: each part is an integer, a slice or a list of integers."""
        which, where = key[0], key[1:]
        chosen = np.arange(self.shape[0])[which]
        if np.ndim(chosen) == 0:
            return self._pair(int(chosen), where)
        pairs = [self._pair(int(number), where) for number in chosen]
        return np.stack(pairs) if pairs else _part(np.empty((0, *self.shape[1:]), self.dtype), (slice(None), *where))

    def _pair(self, place: int, where: tuple[Any, ...]) -> np.ndarray:
        return _part(self.files.read(place, [self.name])[0], where)


def _part(values: np.ndarray, where: tuple[Any, ...]) -> np.ndarray:
    """Apply an outer index to an array. It starts with the last axis, because a dropped axis shifts those after it."""
    for axis in reversed(range(values.ndim)):
        values = values[(slice(None),) * axis + (where[axis],)]
    return values
