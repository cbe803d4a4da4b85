"""Stores: the vectors of a run packed into one NetCDF file or one Zarr store, for analysis.

Both are chunked alike: `CHUNK_PAIRS` pairs and a part of the volume, so that a series at a point and a whole field both
read few chunks. They are written in blocks of one chunk along the pairs, each vector file read once. Each export writes
all pairs: that takes a thousandth of the time in which they were computed.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import math
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.experiment.pair_range import pair_range
from lfpiv.files import replacing, replacing_folder
from lfpiv.progress import StepProgress
from lfpiv.results import datasets, netcdf, store_seal
from lfpiv.results.stacked_files import INSTANT, PAIR, StackedFiles

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

OLDEST = {"zarr": (3, 1), "xarray": (2025, 6)}
"""Oldest versions of the packages that write and read Zarr stores."""


def is_store(path: Path) -> bool:
    """Return whether a path is a NetCDF file or a Zarr store, and not the folder of a run."""
    if path.is_dir():
        return path.suffix == ".zarr" or (path / store_seal.METADATA).is_file()
    return path.suffix == ".nc" and path.is_file()


def open_store(path: Path, pairs: tuple[int, int | None] | None) -> xr.Dataset:
    """Open a store lazily: dask arrays with the chunks of the store, or without dask arrays that are read when used.

    Parameters
    ----------
    path : Path
        NetCDF file of `write_netcdf`, or Zarr store of `write_zarr`.
    pairs : tuple or None
        (A, B): only pairs A to B - 1; B may be None. None: all pairs.

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
    for name in ("history", FORM, hdf5.SEALED, store_seal.OUTLINE, store_seal.CONTENT):
        results.attrs.pop(name, None)
    for name in ("voxel_mm", "error_correlation_voxel"):
        if isinstance(lengths := results.attrs.get(name), list):
            results.attrs[name] = np.asarray(lengths)
    names = [*netcdf.VECTOR_UNITS, *(str(name) for name in results.data_vars if name not in netcdf.VECTOR_UNITS)]
    results = results[names]
    return results if pairs is None else _chosen(results, dimension, pairs, path)


def _verified(path: Path) -> xr.Dataset:
    """Verify a store and open it, with its coordinates in memory."""
    chunks: dict[str, int] | None = None if importlib.util.find_spec("dask") is None else {}
    if path.is_dir():
        _require_zarr()
        _require_form(store_seal.zarr_attributes(path), path)
        store_seal.check_zarr(path)
        store_seal.verify_zarr(path)
        results = xr.open_zarr(path, consolidated=False, chunks=chunks, zarr_format=3)
    else:
        with hdf5.glanced(path) as file:
            _require_form(file.attrs, path)
        store_seal.verify_netcdf(path)
        results = xr.open_dataset(path, engine="h5netcdf", chunks=chunks)
    return results.assign_coords({name: values.compute() for name, values in results.coords.items()})


def _require_form(attributes: Mapping[str, Any], path: Path) -> None:
    if np.ravel(attributes.get(FORM, 0)).tolist() != [LAYOUT]:
        raise InputError(f"{path}: expected a store of `lfpiv export --to zarr` or netcdf, found another file.")


def _chosen(results: xr.Dataset, dimension: str, pairs: tuple[int, int | None], path: Path) -> xr.Dataset:
    start, stop = pair_range(pairs)
    numbers = results[dimension].values
    which = np.flatnonzero((numbers >= start) & (numbers < (math.inf if stop is None else stop)))
    if not which.size:
        wanted, found = f"{start}:{'' if stop is None else stop}", f"{numbers[0]} to {numbers[-1]}"
        raise InputError(f"{path}: expected {dimension}s {wanted}, found {found}.")
    return results.isel({dimension: slice(int(which[0]), int(which[-1]) + 1)})


def write_netcdf(
    files: StackedFiles, path: Path, attributes: Mapping[str, Any], interval_s: float | None, progress: StepProgress
) -> None:
    """Write a stack of vector files into one NetCDF4 file, atomically, with one block in memory.

    `interval_s` is the time between image pairs [s]; None if it is not known. `progress` gets the finished fraction.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    pairs, tile = _layout(files)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as scratch, hdf5.written(scratch) as disk, h5netcdf.File(disk, "w") as file:
        for first, after in _blocks(len(files), pairs):
            progress(first / len(files))
            block = _with_times(files.block(first, after), interval_s)
            if first == 0:
                packed = datasets.packed(block, {**attributes, FORM: LAYOUT})
                for variable in packed.variables.values():
                    if variable.dims and variable.dims[0] == files.dimension:
                        chunks = (pairs, *tile) if variable.ndim > 1 else (CHUNK_NUMBERS,)
                        variable.encoding |= {"chunksizes": chunks, "fletcher32": True}
                packed.dump_to_store(H5NetCDFStore(file), unlimited_dims=[files.dimension])
            else:
                file.resize_dimension(files.dimension, after)
                for name, variable in block.variables.items():
                    if files.dimension in variable.dims:
                        target = file.variables[str(name)]
                        target[first:after] = variable.values.astype(target.dtype)
            file.flush()
            disk.check()
    progress(1.0)


def write_zarr(
    files: StackedFiles, path: Path, attributes: Mapping[str, Any], interval_s: float | None, progress: StepProgress
) -> None:
    """Write a stack of vector files into a Zarr store of format 3, which appears when it is complete.

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

    _require_store(path)
    pairs, tile = _layout(files)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing_folder(path) as scratch:
        for first, after in _blocks(len(files), pairs):
            progress(first / len(files))
            packed = datasets.packed(_with_times(files.block(first, after), interval_s), {**attributes, FORM: LAYOUT})
            packed.attrs = _listed(packed.attrs)
            for variable in packed.variables.values():
                variable.attrs, variable.encoding = _listed(variable.attrs), {}
            if first == 0:
                encoding = _encoding(packed, files.dimension, (pairs, *tile))
                packed.to_zarr(scratch, mode="w", consolidated=False, encoding=encoding, zarr_format=3)
            else:
                packed.to_zarr(scratch, append_dim=files.dimension, consolidated=False, zarr_format=3)
        with warnings.catch_warnings():  # that consolidated metadata are not yet in the specification
            warnings.simplefilter("ignore")
            group = zarr.consolidate_metadata(str(scratch), zarr_format=3)
            group.attrs.update(store_seal.zarr_digests(scratch))
        shutil.rmtree(path, ignore_errors=True)
    progress(1.0)


def _listed(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes as JSON has them."""
    return {str(name): np.asarray(value).tolist() for name, value in attributes.items()}


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


def _blocks(total: int, length: int) -> Iterator[tuple[int, int]]:
    """Yield first and end of blocks."""
    return ((first, min(first + length, total)) for first in range(0, total, length))


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


def _require_zarr() -> None:
    for package, oldest in OLDEST.items():
        try:
            found = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found = "none"
        if tuple(map(int, re.findall(r"\d+", found)[:2])) < oldest:
            raise InputError(
                f"{package}: expected the package {package} {'.'.join(map(str, oldest))} or newer, which needs Python "
                f"3.11, for Zarr stores, found {found}. `pip install 'lfpiv[zarr]'`, or export to netcdf."
            )


def _require_store(path: Path) -> None:
    """Refuse a folder that is no Zarr store of an export."""
    own: Mapping[str, Any] = {}
    if path.exists():
        with contextlib.suppress(DamagedFile):
            own = store_seal.zarr_attributes(path)
        if FORM not in own and any(path.iterdir()):
            raise InputError(
                f"{path}: expected a place for a Zarr store, found another folder. Remove it, or use --out."
            )


def _encoding(packed: xr.Dataset, dimension: str, chunks: tuple[int, ...]) -> dict[str, dict[str, Any]]:
    """Return chunks and codecs of the arrays of a store."""
    from zarr.codecs import BloscCodec, Crc32cCodec

    codecs = BloscCodec(cname="zstd", clevel=1, shuffle="shuffle"), Crc32cCodec()
    encoding: dict[str, dict[str, Any]] = {str(name): {"compressors": codecs} for name in packed.variables}
    for name, variable in packed.variables.items():
        if dimension in variable.dims:
            encoding[str(name)]["chunks"] = chunks if variable.ndim > 1 else (CHUNK_NUMBERS,)
    return encoding
