"""Trust in stores: their form is checked before zarr opens them; they are sealed, and verified.

A NetCDF store has the seal of `lfpiv.hdf5`. A Zarr store has two digests in its attributes: of all bytes of all files,
and of everything but the values of the variables. The first is checked for stores of up to `WHOLE_BYTES`, the second
for larger ones, whose chunks have checksums of their own.

Digests have no key: whoever can write the folder can make them. Codecs can run code that a chunk holds. So only numbers
behind the codecs that `lfpiv export` uses are opened, whatever the digests say.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import NonNegativeInt, PositiveInt, StringConstraints

from lfpiv import hdf5
from lfpiv.errors import DamagedFile
from lfpiv.hdf5_structure import check_structure
from lfpiv.records import RecordError, open_regular, read_object, read_text, validate

WHOLE_BYTES = 4 << 30
"""Largest store of which all bytes are read when it is opened [byte]; 1 GiB takes about a second."""

OUTLINE, CONTENT = "outline_digest", "content_digest"
"""Attributes of a Zarr store: digest of names, sizes, metadata and axes, and digest of all bytes."""

LARGEST_CHUNK = 64 << 20
"""Largest chunk, and largest coordinate, of a Zarr store [byte]."""

METADATA = "zarr.json"
Form = TypeVar("Form")
_NAMES = re.compile(r"zarr\.json|\w+/(zarr\.json|c(/\d+)*)")
_AXIS_CHUNK = "axis/c/0".count("/")  # a chunk of a variable over pair, z, y, x is deeper


@dataclass(frozen=True, kw_only=True)
class _Group:
    """Metadata of a store."""

    attributes: dict[str, Any]
    zarr_format: Literal[3]
    node_type: Literal["group"]


@dataclass(frozen=True)
class _Codec:
    name: Literal["bytes", "blosc", "crc32c"]


@dataclass(frozen=True)
class _Chunks:
    chunk_shape: list[PositiveInt]


@dataclass(frozen=True)
class _Grid:
    name: Literal["regular"]
    configuration: _Chunks


@dataclass(frozen=True, kw_only=True)
class _Array:
    """Metadata of an array that `lfpiv export` writes."""

    shape: list[NonNegativeInt]
    data_type: Annotated[str, StringConstraints(pattern=r"^(bool|u?int(8|16|32|64)|float(16|32|64))$")]
    chunk_grid: _Grid
    codecs: list[_Codec]
    zarr_format: Literal[3]
    node_type: Literal["array"]
    storage_transformers: tuple[()] = ()


def verify_netcdf(path: Path) -> None:
    """Verify a NetCDF store; raise DamagedFile if bytes that are read are not those that were written."""
    if os.path.getsize(path) <= WHOLE_BYTES:
        hdf5.verify(path)
    else:
        with hdf5.glanced(path) as file:
            check_structure(file, os.path.getsize(path))


def zarr_attributes(path: Path) -> dict[str, Any]:
    """Read the attributes of a Zarr store; raise DamagedFile if they are missing or have another form."""
    return _read(path, METADATA, _Group).attributes


def check_zarr(path: Path) -> None:
    """Check the form of a Zarr store. No codec runs.

    Raises
    ------
    DamagedFile
        If it holds other files, or states another type, codec or size than `lfpiv export` writes.
    """
    _read(path, METADATA, _Group)
    for name, _ in _files(path):
        if not _NAMES.fullmatch(name):
            raise DamagedFile(path, f"{name} is no part of such a store")
        if name.endswith(f"/{METADATA}"):
            form = _read(path, name, _Array)
            shape, chunks = form.shape, form.chunk_grid.configuration.chunk_shape
            if len(shape) != len(chunks):
                raise DamagedFile(path, f"{name}: its shape and chunks have other dimensions")
            at_once = math.prod(chunks if len(shape) > 1 else map(max, shape, chunks))
            if at_once * np.dtype(form.data_type).itemsize > LARGEST_CHUNK:
                raise DamagedFile(path, f"{name}: expected at most {LARGEST_CHUNK} bytes at once, found {shape}")


def verify_zarr(path: Path) -> None:
    """Verify a Zarr store, whose form was checked; raise DamagedFile if files that are read are not as written."""
    stated = zarr_attributes(path)
    whole = sum(size for _, size in _files(path)) <= WHOLE_BYTES
    if any(stated.get(name) != found for name, found in zarr_digests(path, whole=whole).items()):
        raise DamagedFile(path, "its files are not those that were written: the digest differs")


def zarr_digests(path: Path, *, whole: bool = True) -> dict[str, str]:
    """Return the attributes that seal a Zarr store.

    Parameters
    ----------
    whole : bool
        Read the values of the variables too; otherwise only the outline is returned.

    Raises
    ------
    DamagedFile
        If a file in it cannot be read or is no regular file.
    """
    outline, content = (hashlib.blake2b(digest_size=32) for _ in range(2))
    stated = {name: value for name, value in zarr_attributes(path).items() if name not in (OUTLINE, CONTENT)}
    outline.update(json.dumps(stated, sort_keys=True).encode())
    for name, size in _files(path):
        if name == METADATA:  # holds the digests
            continue
        head = f"{name}\0{size}\0".encode()
        outline.update(head)
        content.update(head)
        if (is_field := name.count("/") > _AXIS_CHUNK) and not whole:
            continue
        for block in _blocks(path / name):
            content.update(block)
            if not is_field:
                outline.update(block)
    content.update(outline.digest())
    return {OUTLINE: outline.hexdigest()} | ({CONTENT: content.hexdigest()} if whole else {})


def _read(path: Path, name: str, form: type[Form]) -> Form:
    try:
        return validate(form, read_object(read_text(path / name)))
    except (FileNotFoundError, RecordError) as error:
        raise DamagedFile(path, f"{name}: {error}") from None


def _files(path: Path) -> Iterator[tuple[str, int]]:
    """Yield name and size [byte] of the files of a store in order."""
    for folder, folders, names in os.walk(path):
        folders.sort()
        for name in sorted([*names, *(one for one in folders if Path(folder, one).is_symlink())]):
            file = Path(folder, name)
            status = file.lstat()
            if not stat.S_ISREG(status.st_mode):
                raise DamagedFile(path, f"{name} is no regular file")
            yield file.relative_to(path).as_posix(), status.st_size


def _blocks(path: Path) -> Iterator[bytes]:
    try:
        with open_regular(path) as file:
            while block := file.read(hdf5.BLOCK_BYTES):
                yield block
    except (OSError, RecordError) as error:
        raise DamagedFile(path, str(error)) from None
