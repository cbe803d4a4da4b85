"""Trust in stores: a store is sealed when it is complete, and verified before it is opened.

A NetCDF store has the seal of `lfpiv.hdf5`. A Zarr store has two digests in its consolidated metadata: one of all bytes
of all files, and one of everything but the values of the variables. The first is checked for stores of up to
`WHOLE_BYTES`, the second for larger ones, whose chunks have checksums of their own.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lfpiv import hdf5
from lfpiv.errors import DamagedFile
from lfpiv.records import RecordError, open_regular, read_object, read_text

WHOLE_BYTES = 4 << 30
"""Largest store of which all bytes are read when it is opened [byte]; 1 GiB takes about a second."""

OUTLINE, CONTENT = "outline_digest", "content_digest"
"""Attributes of a Zarr store: digest of names, sizes, metadata and axes, and digest of all bytes."""

_METADATA, _ATTRIBUTES = ".zmetadata", ".zattrs"
_OWN = (_METADATA, _ATTRIBUTES)  # hold the digests
_FIELD_CHUNK_DOTS = 3  # a chunk of a variable over pair, z, y, x is named as 0.0.0.0


def verify_netcdf(path: Path) -> None:
    """Verify a NetCDF store.

    Raises
    ------
    DamagedFile
        If its bytes are not those that were written, as far as they are read.
    """
    if os.path.getsize(path) <= WHOLE_BYTES:
        hdf5.verify(path)
    else:
        with hdf5.glanced(path) as file:
            hdf5.check_structure(file, os.path.getsize(path))
    if not hdf5.is_sealed(path):
        raise DamagedFile(path, "it has no seal: it is cut off, or another program wrote it")


def zarr_metadata(path: Path) -> dict[str, Any]:
    """Read the consolidated metadata of a Zarr store.

    Raises
    ------
    DamagedFile
        If they are missing or have another form.
    """
    try:
        found = read_object(read_text(path / _METADATA))
        if not isinstance(found.get("metadata"), dict) or not isinstance(found["metadata"].get(".zattrs"), dict):
            raise RecordError("its metadata have another form")
    except (FileNotFoundError, RecordError) as error:
        reason = "it has no consolidated metadata" if isinstance(error, FileNotFoundError) else str(error)
        raise DamagedFile(path, reason) from None
    return found


def zarr_attributes(path: Path) -> dict[str, Any]:
    """Read the attributes of a Zarr store as it states them beside the consolidated metadata.

    Raises
    ------
    DamagedFile
        If they are missing or have another form.
    """
    try:
        return read_object(read_text(path / _ATTRIBUTES))
    except (FileNotFoundError, RecordError) as error:
        raise DamagedFile(path, f"{_ATTRIBUTES}: {error}") from None


def zarr_digests(path: Path, *, whole: bool = True) -> dict[str, str]:
    """Return the attributes that seal a complete Zarr store.

    Parameters
    ----------
    path : Path
    whole : bool
        Read the values of the variables too; otherwise only the outline is returned.

    Raises
    ------
    DamagedFile
        If a file in it cannot be read or is no regular file.
    """
    outline, content = (hashlib.blake2b(digest_size=32) for _ in range(2))
    metadata = _without_digests(zarr_metadata(path))
    outline.update(json.dumps(metadata, sort_keys=True).encode())
    for name, size in _files(path):
        head = f"{name}\0{size}\0".encode()
        outline.update(head)
        content.update(head)
        if (is_field := Path(name).name.count(".") >= _FIELD_CHUNK_DOTS) and not whole:
            continue
        for block in _blocks(path / name):
            content.update(block)
            if not is_field:
                outline.update(block)
    content.update(outline.digest())
    return {OUTLINE: outline.hexdigest()} | ({CONTENT: content.hexdigest()} if whole else {})


def verify_zarr(path: Path) -> None:
    """Verify a complete Zarr store.

    Raises
    ------
    DamagedFile
        If its files are not those that were written, as far as they are read.
    """
    stated = zarr_metadata(path)["metadata"][".zattrs"]
    if zarr_attributes(path) != stated:  # readers take the attributes from either
        raise DamagedFile(path, "its attributes are not those of its consolidated metadata")
    whole = sum(size for _, size in _files(path)) <= WHOLE_BYTES
    if any(stated.get(name) != found for name, found in zarr_digests(path, whole=whole).items()):
        raise DamagedFile(path, "its files are not those that were written: the digest differs")


def _without_digests(metadata: Mapping[str, Any]) -> dict[str, Any]:
    known = metadata["metadata"]
    attributes = {name: value for name, value in known[".zattrs"].items() if name not in (OUTLINE, CONTENT)}
    return {**metadata, "metadata": {**known, ".zattrs": attributes}}


def _files(path: Path) -> Iterator[tuple[str, int]]:
    """Yield name and size [byte] of the files of a store in order, without those that hold the digests."""
    for folder, folders, names in os.walk(path):
        folders.sort()
        for name in sorted(names):
            file = Path(folder, name)
            status = file.lstat()
            if not stat.S_ISREG(status.st_mode):
                raise DamagedFile(path, f"{name} is no regular file")
            if (relative := file.relative_to(path).as_posix()) not in _OWN:
                yield relative, status.st_size


def _blocks(path: Path) -> Iterator[bytes]:
    try:
        with open_regular(path) as file:
            while block := file.read(hdf5.BLOCK_BYTES):
                yield block
    except (OSError, RecordError) as error:
        raise DamagedFile(path, str(error)) from None
