"""`open_results`: open the vectors of all pairs of a run as one dataset that reads its files lazily."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from lfpiv import hdf5
from lfpiv.errors import InputError
from lfpiv.geometry.grid import AXES
from lfpiv.records import read_object
from lfpiv.results import finished, netcdf, provenance

CHUNK_BYTES = 8 << 20
"""Largest size of a dask chunk, which holds one variable of at least one pair [byte]."""

COMMON = ("dt_s", "voxel_mm", "smart", "correlation", "settings")
"""Attributes that must be equal in all pairs."""

_NAME = re.compile(r"pair_(\d+)\.nc")


def open_results(folder: str | Path, *, pairs: tuple[int, int | None] | None = None) -> xr.Dataset:
    """Open the vectors of all finished pairs in the folder of a run.

    This reads only attributes and axes of each file, in about a millisecond. A file is verified (docs/conventions.md)
    when its values are read for the first time. With dask installed, the variables
    are dask arrays with chunks along pair. Without dask, values are read from the files when they are used. No file
    stays open.

    Parameters
    ----------
    folder : str or Path
        Output folder of `lfpiv run`, its ``--out``.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None. Missing pairs are skipped.

    Returns
    -------
    Dataset
        The variables of the vector files (docs/conventions.md) over pair, z, y, x. Coordinate ``pair``: numbers of the
        pairs. Attributes: those that all pairs share.

    Raises
    ------
    InputError
        If there are no vectors, a file is not a vector file, or two pairs differ in settings or axes. The message names
        both files.

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
    files = _files(Path(folder), pairs)
    numbers, paths = list(files), list(files.values())
    first = netcdf.read_vectors(paths[0])
    reference = _read_signature(paths[0])
    for path in paths[1:]:
        _check_equal(_read_signature(path), reference)
    shape = tuple(first.sizes[axis] for axis in AXES)
    variables = {}
    for name in dict.fromkeys([*netcdf.VECTOR_UNITS, *map(str, first.data_vars)]):
        if first[name].dims != AXES:
            continue
        stack = _Stack(paths, name, (len(paths), *shape), first[name].dtype)
        variables[name] = xr.Variable(("pair", *AXES), indexing.LazilyIndexedArray(stack), first[name].attrs)
    place = {"pair": ("pair", np.array(numbers), {"long_name": "number of the image pair", "units": "1"})}
    shared = {key: first.attrs[key] for key in ("title", "experiment", *COMMON) if key in first.attrs}
    results = xr.Dataset(variables, {**place, **{axis: first[axis] for axis in AXES}}, shared)
    if importlib.util.find_spec("dask") is None:
        return results
    return results.chunk(pair=max(1, CHUNK_BYTES // first["u"].nbytes))


def _files(folder: Path, pairs: tuple[int, int | None] | None) -> dict[int, Path]:
    """Return the vector files of the chosen pairs in the folder, by number and in order."""
    vectors = folder / "vectors"
    if not vectors.is_dir():
        what = "no such folder" if not folder.exists() else "a file" if folder.is_file() else "no vectors in it"
        raise InputError(f"{folder}: expected the folder of a finished run (its --out), found {what}.")
    found = {int(match[1]): path for path in vectors.iterdir() if (match := _NAME.fullmatch(path.name))}
    start, stop = (0, None) if pairs is None else pairs
    text = "" if pairs is None else f"{start}:{'' if stop is None else stop}"
    if start < 0 or (stop is not None and stop <= start):
        raise InputError(f"pairs: expected A:B with 0 <= A < B, found {text}.")
    chosen = {number: found[number] for number in sorted(found) if number >= start and (stop is None or number < stop)}
    if not chosen:
        there = f"pairs {min(found)} to {max(found)}" if found else "none"
        raise InputError(f"{vectors}: expected finished pairs {text}, found {there}.")
    return chosen


@dataclass(frozen=True, kw_only=True)
class _Signature:
    """Properties of a vector file that all pairs must share."""

    path: Path
    attributes: dict[str, Any]
    """Attributes of `COMMON`, and as JSON everything that the vectors depend on except the images."""
    axes: dict[str, np.ndarray]
    """Vector positions along z, y, x [mm]."""
    names: set[str]
    """Names of the variables."""


def _read_signature(path: Path) -> _Signature:
    """Read the signature of a file without its values."""
    with hdf5.glanced(path) as file:
        netcdf.require_schema(file.attrs.get("schema_version", 0), path)
        provenance.require_name(path, file.attrs)
        attributes = {key: file.attrs[key] for key in COMMON if key in file.attrs}
        depends_on = read_object(file.attrs.get("depends_on", "{}"))
        axes = {axis: file[axis][...] for axis in AXES}
        names = set(file) - {*AXES, netcdf.RECONSTRUCTION}
    attributes |= {key: json.dumps(value, sort_keys=True) for key, value in depends_on.items() if key != "images"}
    return _Signature(path=path, attributes=attributes, axes=axes, names=names)


def _check_equal(signature: _Signature, reference: _Signature) -> None:
    """Refuse a file whose settings, axes or variables differ from those of the reference."""
    for key in {**reference.attributes, **signature.attributes}:
        expected, found = reference.attributes.get(key, ""), signature.attributes.get(key, "")
        if not np.array_equal(expected, found):
            raise _unequal(signature, reference, _difference(key, expected, found))
    for axis in AXES:
        if not np.array_equal(signature.axes[axis], reference.axes[axis]):
            raise _unequal(signature, reference, f"other vector positions along {axis}")
    if signature.names != reference.names:
        differing = ", ".join(sorted(signature.names ^ reference.names))
        raise _unequal(signature, reference, f"other variables: {differing}")


def _unequal(signature: _Signature, reference: _Signature, found: str) -> InputError:
    return InputError(
        f"{signature.path}: expected vectors made as those of {reference.path}, found {found}. "
        "Run `lfpiv run` on all pairs again, or choose pairs that belong together."
    )


def _difference(key: str, expected: Any, found: Any) -> str:
    """Describe the difference of an attribute: the first setting of a JSON object that differs, or the value."""
    try:
        one, other = json.loads(expected), json.loads(found)
        name = next(name for name in {**one, **other} if one.get(name) != other.get(name))
        return f"{key}.{name} = {json.dumps(other.get(name))} instead of {json.dumps(one.get(name))}"
    except (TypeError, ValueError, AttributeError, StopIteration):
        one, other = (np.ravel(value).tolist() for value in (expected, found))
        return f"{key} = {', '.join(map(str, other)) or 'none'} instead of {', '.join(map(str, one)) or 'none'}"


class _Stack(BackendArray):
    """One variable of many files as a lazy array (pair, z, y, x)."""

    def __init__(self, paths: Sequence[Path], name: str, shape: tuple[int, ...], dtype: np.dtype):
        self.paths = tuple(str(path) for path in paths)
        self.name, self.shape, self.dtype = name, shape, np.dtype(dtype)

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

    def _pair(self, number: int, where: tuple[Any, ...]) -> np.ndarray:
        path = self.paths[number]
        finished.require_vectors(Path(path))
        with hdf5.opened(path) as file:
            values = file[self.name][...]
        if values.shape != self.shape[1:]:
            raise InputError(f"{path}: expected {self.name} of shape {self.shape[1:]}, found {values.shape}.")
        return np.asarray(_part(values, where), self.dtype)


def _part(values: np.ndarray, where: tuple[Any, ...]) -> np.ndarray:
    """Apply an outer index to an array. It starts with the last axis, because a dropped axis shifts those after it."""
    for axis in reversed(range(values.ndim)):
        values = values[(slice(None),) * axis + (where[axis],)]
    return values
