"""Stores: the vectors of a run packed into one NetCDF file or one Zarr store, for analysis.

Both are chunked alike: `CHUNK_PAIRS` pairs and a part of the volume, so that a series at a point and a whole field both
read few chunks. They are written in blocks of one chunk along the pairs, each vector file read once.
"""

from __future__ import annotations

import errno
import importlib.util
import json
import logging
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import replacing
from lfpiv.progress import StepProgress
from lfpiv.results import datasets, netcdf, store_seal
from lfpiv.results.stacked_files import INSTANT, PAIR, StackedFiles

log = logging.getLogger(__name__)

CHUNK_PAIRS = 64
"""Largest number of pairs or instants in a chunk."""
CHUNK_BYTES = 4 << 20
"""Largest size of a chunk before compression [byte]."""
BLOCK_BYTES = 256 << 20
"""Largest size of all variables of the pairs that are held in memory [byte], if one pair is not larger."""
CHUNK_NUMBERS = 4096
"""Values in a chunk of the coordinates along the pairs."""

FORM = "lfpiv_store"
"""Attribute with the version of the store's layout."""
LAYOUT = 1

COMPLETE, SIGNATURE, CHANGED = "complete", "signature", "file_changed_ns"
"""Attributes of a Zarr store, and its variable with the time of the last change of each vector file [ns]."""


def is_store(path: Path) -> bool:
    """Return whether a path is a NetCDF file or a Zarr store, and not the folder of a run."""
    if path.is_dir():
        return path.suffix == ".zarr" or (path / ".zgroup").is_file() or (path / "zarr.json").is_file()
    return path.suffix == ".nc" and path.is_file()


def open_store(path: Path, pairs: tuple[int, int | None] | None = None) -> xr.Dataset:
    """Open a store lazily: dask arrays with the chunks of the store, or without dask arrays that are read when used.

    Parameters
    ----------
    path : Path
        NetCDF file of `write_netcdf`, or Zarr store of `write_zarr`.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None.

    Raises
    ------
    InputError
        If it is no such store, it is damaged or not complete, or it has none of the pairs.
    """
    try:
        results = _verified(path)
    except Exception as error:  # readers of damaged stores raise whatever they meet
        if isinstance(error, InputError) and not isinstance(error, DamagedFile):
            raise
        text = " ".join((error.reason if isinstance(error, DamagedFile) else str(error)).split())[:300]
        raise InputError(f"{path}: expected a store of `lfpiv export`, found {text}. Export again.") from None
    dimension = INSTANT if INSTANT in results.dims else PAIR
    for name in ("history", FORM, COMPLETE, SIGNATURE, hdf5.SEALED, store_seal.OUTLINE, store_seal.CONTENT):
        results.attrs.pop(name, None)
    if isinstance(edges := results.attrs.get("voxel_mm"), list):
        results.attrs["voxel_mm"] = np.asarray(edges)
    names = [*netcdf.VECTOR_UNITS, *(str(name) for name in results.data_vars if name not in netcdf.VECTOR_UNITS)]
    results = results[names]
    return results if pairs is None else _chosen(results, dimension, pairs, path)


def _verified(path: Path) -> xr.Dataset:
    """Verify a store and open it, with its coordinates in memory."""
    chunks: dict[str, int] | None = None if importlib.util.find_spec("dask") is None else {}
    if path.is_dir():
        _require_zarr()
        stated = store_seal.zarr_metadata(path)["metadata"][".zattrs"]
        _require_form(stated, path)
        if not stated.get(COMPLETE, 1):
            raise InputError(
                f"{path}: expected a complete store, found that of an export that was interrupted or goes on. The same "
                "`lfpiv export` goes on from there."
            )
        store_seal.verify_zarr(path)
        results = xr.open_zarr(path, consolidated=True, chunks=chunks)
    else:
        with hdf5.glanced(path) as file:
            _require_form(file.attrs, path)
        store_seal.verify_netcdf(path)
        results = xr.open_dataset(path, engine="h5netcdf", chunks=chunks)
    results = results.drop_vars(CHANGED, errors="ignore")
    held: xr.Dataset = results.assign_coords({name: values.compute() for name, values in results.coords.items()})
    return held


def _require_form(attributes: Mapping[str, Any], path: Path) -> None:
    if np.ravel(attributes.get(FORM, 0)).tolist() != [LAYOUT]:
        raise InputError(f"{path}: expected a store of `lfpiv export --to zarr` or netcdf, found another file.")


def _chosen(results: xr.Dataset, dimension: str, pairs: tuple[int, int | None], path: Path) -> xr.Dataset:
    start, stop = pairs
    numbers = results[dimension].values
    which = np.flatnonzero((numbers >= start) & (numbers < (math.inf if stop is None else stop)))
    if not which.size:
        wanted, there = f"{start}:{'' if stop is None else stop}", f"{numbers[0]} to {numbers[-1]}"
        raise InputError(f"{path}: expected {dimension}s {wanted}, found {there}.")
    return results.isel({dimension: slice(int(which[0]), int(which[-1]) + 1)})


def write_netcdf(
    files: StackedFiles, path: Path, attributes: Mapping[str, Any], interval_s: float | None, progress: StepProgress
) -> None:
    """Write a stack of vector files into one NetCDF4 file, atomically, with one block in memory.

    `interval_s` is the time between image pairs [s]; None if it is not known. `progress` gets the finished fraction.

    Raises
    ------
    OSError
        If the disk has less space than the next block takes uncompressed: HDF5 does not survive a disk that fills up.
    """
    import h5netcdf

    pairs, tile = _layout(files)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as scratch:
        for first, after in _blocks(0, len(files), pairs):
            progress(first / len(files))
            block = _with_times(files.block(first, after), interval_s)
            _require_space(block.nbytes, path)
            if first == 0:
                packed = datasets.packed(block, {**attributes, FORM: LAYOUT})
                for variable in packed.variables.values():
                    if variable.dims and variable.dims[0] == files.dimension:
                        chunks = (pairs, *tile) if variable.ndim > 1 else (CHUNK_NUMBERS,)
                        variable.encoding |= {"chunksizes": chunks, "fletcher32": True}
                packed.to_netcdf(scratch, engine="h5netcdf", unlimited_dims=[files.dimension])
                continue
            with h5netcdf.File(scratch, "a") as file:
                file.resize_dimension(files.dimension, after)
                for name, variable in block.variables.items():
                    if files.dimension in variable.dims:
                        target = file.variables[str(name)]
                        target[first:after] = variable.values.astype(target.dtype)
        hdf5.seal(scratch)
    progress(1.0)


def write_zarr(
    files: StackedFiles, path: Path, attributes: Mapping[str, Any], interval_s: float | None, progress: StepProgress
) -> None:
    """Write a stack of vector files into a Zarr store of format 2, or add to the store what is new.

    Pairs are written from the first one on that is new or whose file changed. The consolidated metadata name only what
    is written completely, and say whether all is; so a store whose export was killed is not taken for complete, and the
    next export goes on. A store of other settings is written anew.

    Parameters are those of `write_netcdf`.

    Raises
    ------
    InputError
        If zarr is not installed, or another folder is in the way.
    OSError
        If the disk is full.
    """
    _require_zarr()
    import zarr

    pairs, tile = _layout(files)
    identity = json.dumps([files.signature, interval_s, pairs, tile])
    changed = files.changed_ns()
    start = _kept(path, identity, files, changed)
    own = {**attributes, FORM: LAYOUT, SIGNATURE: identity, COMPLETE: 0}
    if start is None:
        shutil.rmtree(path, ignore_errors=True)
        start = 0
    elif start == len(files) and _attributes_of(path).get(COMPLETE):
        log.info("%s: has all %d %ss", path, len(files), files.dimension)
        progress(1.0)
        return
    else:
        log.info("%s: has %d of %d %ss, the others are added", path, start, len(files), files.dimension)
        _resize(zarr, path, files.dimension, start, complete=0)
    for first, after in _blocks(start, len(files), pairs):
        progress(first / len(files))
        block = _with_times(files.block(first, after), interval_s)
        block = block.assign_coords({CHANGED: (files.dimension, changed[first:after])})
        if first == 0 and not (path / ".zgroup").exists():
            _create(block, path, own, files.dimension, (pairs, *tile))
        _resize(zarr, path, files.dimension, after, complete=0, block=block, first=first)
    _resize(zarr, path, files.dimension, len(files), complete=1)
    _seal(zarr, path)
    progress(1.0)


def _seal(zarr: Any, path: Path) -> None:
    """State the digests of a complete Zarr store in its metadata."""
    choice = {"use_consolidated": False} if _is_plural(zarr) else {}
    zarr.open_group(str(path), mode="r+", **choice).attrs.update(store_seal.zarr_digests(path))
    zarr.consolidate_metadata(str(path))


def _layout(files: StackedFiles) -> tuple[int, tuple[int, ...]]:
    """Return the chunks of the variables: pairs, and vectors along z, y, x."""
    of_all = math.prod(files.shape) * sum(files.first[name].dtype.itemsize for name in files.names)
    largest = max(files.first[name].dtype.itemsize for name in files.names)
    pairs = int(min(max(BLOCK_BYTES // of_all, 1), CHUNK_PAIRS))
    tile = list(files.shape)
    while pairs * math.prod(tile) * largest > CHUNK_BYTES and max(tile) > 1:
        axis = int(np.argmax(tile))
        tile[axis] = -(-tile[axis] // 2)
    return pairs, tuple(tile)


def _blocks(start: int, total: int, length: int) -> Iterator[tuple[int, int]]:
    """Yield first and end of blocks that end where chunks end."""
    while start < total:
        after = min((start // length + 1) * length, total)
        yield start, after
        start = after


def _with_times(block: xr.Dataset, interval_s: float | None) -> xr.Dataset:
    if interval_s is None or PAIR not in block.dims:
        return block
    return block.assign_coords(time=(PAIR, block[PAIR].values * interval_s, PAIR_TIME_ATTRIBUTES))


PAIR_TIME_ATTRIBUTES = {
    "units": "s",
    "standard_name": "time",
    "axis": "T",
    "long_name": "first frame of the pair after that of pair 0",
}
"""Attributes of the times of image pairs."""


def _require_space(need: int, path: Path) -> None:
    if need > shutil.disk_usage(path.parent).free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _require_zarr() -> None:
    if importlib.util.find_spec("zarr") is None:
        raise InputError("zarr: expected the package zarr for Zarr stores, found none. `pip install 'lfpiv[zarr]'`.")


def _attributes_of(path: Path) -> dict[str, Any]:
    """Return the attributes of a Zarr store as its consolidated metadata state them; empty without."""
    try:
        return dict(store_seal.zarr_metadata(path)["metadata"][".zattrs"])
    except DamagedFile:
        return {}


def _kept(path: Path, identity: str, files: StackedFiles, changed: np.ndarray) -> int | None:
    """Return how many of the files a store already has, from the first on; None if it must be written anew."""
    if not path.exists():
        return None
    own = _attributes_of(path) or _plain_attributes(path)
    if FORM not in own and any(path.iterdir()):
        raise InputError(f"{path}: expected a place for a Zarr store, found another folder. Remove it, or use --out.")
    if own.get(FORM) != LAYOUT or own.get(SIGNATURE) != identity:
        return None
    try:
        if own.get(COMPLETE):
            store_seal.verify_zarr(path)
    except DamagedFile as error:
        log.warning("%s: damaged, written anew: %s", path, error.reason)
        return None
    try:
        with xr.open_zarr(path, consolidated=True, chunks=None) as stored:
            numbers, times = stored[files.dimension].values, stored[CHANGED].values
    except (OSError, ValueError, KeyError):
        return None
    both = min(len(numbers), len(files))
    same = (numbers[:both] == np.array(files.numbers)[:both]) & (times[:both] == changed[:both])
    return int(both if same.all() else same.argmin())


def _plain_attributes(path: Path) -> dict[str, Any]:
    try:
        return store_seal.zarr_attributes(path)
    except DamagedFile:
        return {}


def _create(
    block: xr.Dataset, path: Path, attributes: Mapping[str, Any], dimension: str, chunks: tuple[int, ...]
) -> None:
    """Create the arrays of a store, empty along the pairs."""
    import zarr
    from numcodecs import Shuffle, Zstd  # type: ignore[import-untyped]

    packed = datasets.packed(block.isel({dimension: slice(0, 0)}), attributes)
    packed.attrs = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in packed.attrs.items()}
    encoding: dict[str, dict[str, Any]] = {}
    plural = _is_plural(zarr)
    for name, variable in packed.variables.items():
        variable.attrs = {key: np.asarray(value).tolist() for key, value in variable.attrs.items()}
        variable.encoding = {}
        if dimension in variable.dims:
            code = Zstd(level=1, checksum=True)
            size = 1 if variable.dtype == bool else variable.dtype.itemsize
            encoding[str(name)] = {
                "chunks": chunks if variable.ndim > 1 else (CHUNK_NUMBERS,),
                "filters": [Shuffle(size)] if size > 1 else None,
                **({"compressors": (code,)} if plural else {"compressor": code}),
            }
    version: Any = {"zarr_format": 2} if plural else {"zarr_version": 2}
    packed.to_zarr(path, mode="w", consolidated=False, encoding=encoding, **version)


def _resize(
    zarr: Any,
    path: Path,
    dimension: str,
    length: int,
    *,
    complete: int,
    block: xr.Dataset | None = None,
    first: int = 0,
) -> None:
    """Set the length of all arrays along the pairs, write a block from `first` on, and consolidate the metadata."""
    choice = {"use_consolidated": False} if _is_plural(zarr) else {}
    group = zarr.open_group(str(path), mode="r+", **choice)
    group.attrs[COMPLETE] = complete
    for name, array in group.arrays():
        if dimension in array.attrs["_ARRAY_DIMENSIONS"]:
            if array.shape[0] != length:
                array.resize((length, *array.shape[1:]))
            if block is not None:
                array = group[name]
                array[first:length] = block[name].values.astype(array.dtype)
    zarr.consolidate_metadata(str(path))


def _is_plural(zarr: Any) -> bool:
    """Return whether this is zarr 3 or newer, which has other names for some arguments."""
    return int(zarr.__version__.split(".")[0]) >= 3
