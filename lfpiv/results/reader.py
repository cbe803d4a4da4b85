"""`open_results`: the vectors of all pairs of a run as one dataset that reads from the files what is asked for."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from lfpiv.errors import InputError
from lfpiv.geometry.grid import AXES
from lfpiv.results import netcdf

CHUNK_BYTES = 8 << 20
"""With dask a chunk holds as many pairs of one variable as fit into this many bytes, at least one."""

COMMON = ("dt_s", "voxel_mm", "smart", "correlation", "settings")
"""Attributes that must be equal in all pairs, with all that is stamped on the files but the images of each."""

_NAME = re.compile(r"pair_(\d+)\.nc")


def open_results(folder: str | Path, *, pairs: tuple[int, int | None] | None = None) -> xr.Dataset:
    """Open the vectors of all finished pairs in the folder of a run.

    Of every file only the attributes and the axes are read, about a millisecond each; values when they are asked for.
    With dask installed the variables are dask arrays, chunked along pair; without it they are read from the files when
    they are used, whole or in part. No file is kept open.

    Parameters
    ----------
    folder : str or Path
        What `lfpiv run` got as ``--out``.
    pairs : tuple, optional
        (A, B): pairs A to B - 1 only; B may be None. Missing numbers in between are left out.

    Returns
    -------
    Dataset
        The variables of the vector files (docs/conventions.md) over pair, z, y, x. Coordinate ``pair``: numbers of the
        pairs. Attributes: what all pairs share.

    Raises
    ------
    InputError
        If there are no vectors, a file is no vector file, or two pairs were made with different settings or on
        different axes: the message names both files.

    Examples
    --------
    Here the files are written first, which `lfpiv run` does otherwise:

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
    reference = _Signature(paths[0])
    for path in paths[1:]:
        reference.compare(path)
    shape = tuple(first.sizes[axis] for axis in AXES)
    variables = {}
    for name in dict.fromkeys([*netcdf.VECTOR_UNITS, *map(str, first.data_vars)]):
        if first[name].dims != AXES:
            continue
        stack = _Stack(paths, name, (len(paths), *shape), first[name].dtype)
        variables[name] = xr.Variable(("pair", *AXES), indexing.LazilyIndexedArray(stack), first[name].attrs)
    place = {"pair": ("pair", np.array(numbers), {"long_name": "number of the image pair", "units": "1"})}
    kept = {key: first.attrs[key] for key in ("title", "experiment", *COMMON) if key in first.attrs}
    results = xr.Dataset(variables, {**place, **{axis: first[axis] for axis in AXES}}, kept)
    if importlib.util.find_spec("dask") is None:
        return results
    return results.chunk(pair=max(1, CHUNK_BYTES // first["u"].nbytes))


def _files(folder: Path, pairs: tuple[int, int | None] | None) -> dict[int, Path]:
    """Vector files in the folder by the number of their pair, in order."""
    vectors = folder / "vectors"
    if not vectors.is_dir():
        what = "no such folder" if not folder.exists() else "a file" if folder.is_file() else "no vectors in it"
        raise InputError(f"{folder}: expected the folder of a finished run (its --out), found {what}.")
    found = {int(match[1]): path for path in vectors.iterdir() if (match := _NAME.fullmatch(path.name))}
    start, stop = (0, None) if pairs is None else pairs
    if start < 0 or (stop is not None and stop <= start):
        raise InputError(f"pairs: expected A:B with 0 <= A < B, found {start}:{'' if stop is None else stop}.")
    chosen = {number: found[number] for number in sorted(found) if number >= start and (stop is None or number < stop)}
    if not chosen:
        there = f"pairs {min(found)} to {max(found)}" if found else "none"
        raise InputError(f"{vectors}: expected finished pairs {'' if pairs is None else _text(pairs)}, found {there}.")
    return chosen


def _text(pairs: tuple[int, int | None]) -> str:
    return f"{pairs[0]}:{'' if pairs[1] is None else pairs[1]}"


class _Signature:
    """What all pairs must share: settings, axes, the shape of the variables. Read without decoding the file."""

    def __init__(self, path: Path):
        self.path = path
        self.attributes, self.axes, self.names = _read_signature(path)

    def compare(self, path: Path) -> None:
        """Refuse a file whose settings, axes or variables differ from the first one's."""
        attributes, axes, names = _read_signature(path)
        for key in {**self.attributes, **attributes}:
            expected, found = self.attributes.get(key, ""), attributes.get(key, "")
            if not np.array_equal(expected, found):
                raise self._refusal(path, _difference(key, expected, found))
        for axis in AXES:
            if not np.array_equal(axes[axis], self.axes[axis]):
                raise self._refusal(path, f"other vector positions along {axis}")
        if names != self.names:
            raise self._refusal(path, f"other variables: {', '.join(sorted(names ^ self.names))}")

    def _refusal(self, path: Path, found: str) -> InputError:
        return InputError(
            f"{path}: expected vectors made as those of {self.path}, found {found}. "
            "Run `lfpiv run` on all pairs again, or choose pairs that belong together."
        )


def _read_signature(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray], set[str]]:
    try:
        with h5py.File(path, "r") as file:
            version = int(np.ravel(file.attrs.get("schema_version", 0))[0])
            attributes = {key: file.attrs[key] for key in COMMON if key in file.attrs}
            stamp = json.loads(file.attrs.get("depends_on", "{}"))
            axes = {axis: file[axis][...] for axis in AXES}
            names = set(file) - {*AXES, netcdf.RECONSTRUCTION}
    except (OSError, KeyError, ValueError) as error:
        raise InputError(_unreadable(path, error)) from None
    attributes |= {key: json.dumps(value, sort_keys=True) for key, value in stamp.items() if key != "images"}
    if not 1 <= version <= netcdf.SCHEMA_VERSION:
        raise InputError(
            f"{path}: expected schema version 1 to {netcdf.SCHEMA_VERSION}, found {version}. Update lfpiv."
        )
    return attributes, axes, names


def _unreadable(path: Path, error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{path}: expected the vectors of a pair, found a damaged file ({text}). Remove it and run again."


def _difference(key: str, expected: Any, found: Any) -> str:
    """Name what differs in an attribute: a setting of a JSON object, or the value itself."""
    try:
        one, other = json.loads(expected), json.loads(found)
        name = next(name for name in {**one, **other} if one.get(name) != other.get(name))
        return f"{key}.{name} = {json.dumps(other.get(name))} instead of {json.dumps(one.get(name))}"
    except (TypeError, ValueError, AttributeError, StopIteration):
        one, other = (np.ravel(value).tolist() for value in (expected, found))
        return f"{key} = {', '.join(map(str, other)) or 'none'} instead of {', '.join(map(str, one)) or 'none'}"


class _Stack(BackendArray):
    """One variable of many files as an array (pair, z, y, x); an element is read when it is asked for."""

    def __init__(self, paths: Sequence[Path], name: str, shape: tuple[int, ...], dtype: np.dtype):
        self.paths = tuple(str(path) for path in paths)
        self.name, self.shape, self.dtype = name, shape, np.dtype(dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> np.ndarray:
        support = indexing.IndexingSupport.OUTER
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, support, self._read))

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        """Values at an outer index: each part an integer, a slice or a list of integers."""
        which, where = key[0], key[1:]
        chosen = np.arange(self.shape[0])[which]
        if np.ndim(chosen) == 0:
            return self._pair(int(chosen), where)
        pairs = [self._pair(int(number), where) for number in chosen]
        return np.stack(pairs) if pairs else _part(np.empty((0, *self.shape[1:]), self.dtype), (slice(None), *where))

    def _pair(self, number: int, where: tuple[Any, ...]) -> np.ndarray:
        path = self.paths[number]
        try:
            with h5py.File(path, "r") as file:
                values = file[self.name][...]
        except (OSError, KeyError) as error:
            raise InputError(_unreadable(Path(path), error)) from None
        if values.shape != self.shape[1:]:
            raise InputError(f"{path}: expected {self.name} of shape {self.shape[1:]}, found {values.shape}.")
        return np.asarray(_part(values, where), self.dtype)


def _part(values: np.ndarray, where: tuple[Any, ...]) -> np.ndarray:
    """Take an outer index of an array, from the last axis on, so that a dropped axis moves no other."""
    for axis in reversed(range(values.ndim)):
        values = values[(slice(None),) * axis + (where[axis],)]
    return values
