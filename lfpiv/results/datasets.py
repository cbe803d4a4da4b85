"""Datasets in NetCDF files, whatever they hold: attributes, compression, schema and seal.

A file gets its name when it is complete. So an existing file is a finished result, which a rerun does not repeat.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import plain, replacing, write_bytes
from lfpiv.version import SOURCE, history

SCHEMA_VERSION = 4
"""Version of the files' form."""

FILE = "file"
"""Attribute with the name under which a file was written: a copy under another name is recognised by it."""

CONVENTIONS = "CF-1.11"
"""Conventions that names and attributes follow, as far as they know the quantities: they have no name for a velocity in
a fluid other than air and sea water."""

_DESCRIPTIONS: dict[str, dict[str, Any]] = {
    "z": {"axis": "Z"},
    "y": {"axis": "Y"},
    "x": {"axis": "X"},
    "valid": {
        "standard_name": "quality_flag",
        "flag_values": np.array([0, 1], np.int8),
        "flag_meanings": "replaced measured",
    },
    "masked": {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "fluid masked"},
}  # attributes of the CF conventions, for plotting and geometry tools

_DOUBTS = {
    **dict.fromkeys("uvw", ("valid",)),
    **{f"displacement_{axis}": (f"uncertainty_{axis}", "valid") for axis in "xyz"},
}  # variables that say how well others are known


def read_attributes(path: Path) -> dict[str, Any]:
    """Read the attributes of a finished NetCDF or HDF5 file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFile
        If it is damaged.
    """
    with hdf5.opened(path, values=False) as file:
        found = dict(file.attrs)
    return {key: value.item() if getattr(value, "size", 0) == 1 else value for key, value in found.items()}


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset of any form as NetCDF4, atomically; attributes of other types become JSON.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as scratch, hdf5.written(scratch) as disk:  # it may be larger than the memory
        with h5netcdf.File(disk, "w") as file:
            packed(dataset, {}).dump_to_store(H5NetCDFStore(file))


def packed(dataset: xr.Dataset, attributes: Mapping[str, Any], *, root: bool = True) -> xr.Dataset:
    """Return a dataset with the attributes and the compression that it has in a file; `root` is the file's own group.

    A file states the conventions that it follows, the program that wrote it, and when.
    """
    dataset = dataset.copy()
    own = {"schema_version": SCHEMA_VERSION, **dataset.attrs, **attributes}
    if root:
        own |= {"Conventions": CONVENTIONS, "source": SOURCE, "history": history(str(own.get("history", "")))}
    dataset.attrs = {key: _attribute(value) for key, value in own.items()}
    summed = {"fletcher32": True}
    compressed = {**summed, "zlib": True, "complevel": 1, "shuffle": True}
    for name, item in dataset.variables.items():
        described = {**item.attrs, **_DESCRIPTIONS.get(str(name), {})}
        doubts = [other for other in _DOUBTS.get(str(name), ()) if other in dataset]
        if doubts:
            described["ancillary_variables"] = " ".join(doubts)
        item.attrs = {key: _attribute(value) for key, value in described.items()}
        numbers = item.ndim and item.size and item.dtype.kind in "fiub"
        item.encoding = {} if not numbers else compressed if item.ndim >= 2 else summed
    return dataset


def write_groups(groups: Mapping[str, xr.Dataset], path: Path) -> None:
    """Write datasets as the groups of a NetCDF4 file; "" is its root. It is built in memory: see `write_bytes`."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    content = io.BytesIO()
    with h5netcdf.File(content, "w") as file:
        for group, dataset in groups.items():
            dataset.dump_to_store(H5NetCDFStore(file.create_group(group) if group else file))
    hdf5.seal(content)
    write_bytes(content.getbuffer(), path)


def _attribute(value: Any) -> Any:
    """Return a value as a NetCDF attribute: numbers, lists of numbers and text as they are, all else as JSON."""
    if isinstance(value, (str, int, float, np.number)) and not isinstance(value, bool):
        return value
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) > 0:
        numbers = value if isinstance(value, np.ndarray) else list(value)
        if all(isinstance(item, (int, float, np.number)) and not isinstance(item, bool) for item in numbers):
            return np.asarray(numbers)
    return json.dumps(plain(value))


def read_group(path: Path, group: str | None = None) -> xr.Dataset:
    """Read a group of a NetCDF file into memory, verified; None is its root.

    Raises
    ------
    InputError
        If the file is missing, of another schema or damaged.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    try:
        with hdf5.opened(path) as file:
            require_schema(file.attrs.get("schema_version", 0), path)
            _check_flags(file if group is None else file[group], path)
            with h5netcdf.File(file, "r", decode_vlen_strings=True) as opened:  # the verified file, opened once
                dataset = xr.load_dataset(H5NetCDFStore(opened if group is None else opened[group]))
    except FileNotFoundError:
        raise InputError(
            f"{path}: expected a NetCDF file of a run, found no such file. Run the step that writes it."
        ) from None
    dataset.attrs.pop(hdf5.SEALED, None)
    return dataset


def _check_flags(group: Any, path: Path) -> None:
    """Refuse flags other than 0 and 1, which reading as a dataset would hide."""
    for name, item in group.items():
        if item.attrs.get("dtype") == "bool" and not np.isin(item[()], (0, 1)).all():
            raise DamagedFile(path, f"{name!r} holds values other than 0 and 1")


def require_schema(version: Any, path: Path) -> None:
    """Refuse a file of another schema, or of none."""
    number = np.ravel(version)
    if number.size != 1 or number.dtype.kind not in "iu" or number[0] != SCHEMA_VERSION:
        raise InputError(f"{path}: expected schema version {SCHEMA_VERSION}, found {str(version)[:40]}. Update lfpiv.")
