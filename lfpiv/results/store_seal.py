"""Trust in stores: their form is checked before zarr opens them; a complete store is sealed, and verified.

A NetCDF store has the seal of `lfpiv.hdf5`. A Zarr store has two digests in its consolidated metadata: of all bytes of
all files, and of everything but the values of the variables. The first is checked for stores of up to
`WHOLE_BYTES`, the second for larger ones, whose chunks have checksums of their own.

Digests have no key: whoever can write the folder can make them. Codecs of numcodecs can run code that a chunk holds. So
only numbers behind the filters and the compressor that `lfpiv export` uses are opened, whatever the digests say.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
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

LARGEST_CHUNK = 64 << 20
"""Largest chunk, and largest coordinate, of a Zarr store [byte]."""

FILTERS, COMPRESSORS = ("shuffle",), ("zstd",)
"""Codecs of numcodecs that a Zarr store may state."""

_METADATA, _ATTRIBUTES, _ARRAY, _GROUP = ".zmetadata", ".zattrs", ".zarray", ".zgroup"
_OWN = (_METADATA, _ATTRIBUTES)  # hold the digests
_NAMES = re.compile(r"\.(zgroup|zattrs|zmetadata)|\w+(/(\.zarray|\.zattrs|\d+(\.\d+)*))?")
_NUMBERS = re.compile(r"[<|](b1|[iu][1248]|f[248])")
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
    return _read(path, _ATTRIBUTES)


def _read(path: Path, name: str) -> dict[str, Any]:
    try:
        return read_object(read_text(path / name))
    except (FileNotFoundError, RecordError) as error:
        raise DamagedFile(path, f"{name}: {error}") from None


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


def check_zarr(path: Path) -> None:
    """Check the form of a Zarr store, complete or not. No codec runs.

    Raises
    ------
    DamagedFile
        If it holds other files, or states another type, filter, compressor or size than `lfpiv export` writes.
    """
    known = zarr_metadata(path)["metadata"]
    for place, folders, names in os.walk(path):
        for name in [*folders, *names]:
            relative = Path(place, name).relative_to(path).as_posix()
            if not _NAMES.fullmatch(relative) or Path(place, name).is_symlink():
                raise DamagedFile(path, f"{relative} is no part of such a store")
            if name in (_ATTRIBUTES, _GROUP):
                _read(path, relative)
        if _ARRAY in names:
            relative = f"{Path(place).name}/{_ARRAY}"
            if relative not in known:
                raise DamagedFile(path, f"its metadata do not name {relative}")
            _check_array(path, relative, _read(path, relative))
    for relative in known:
        if relative.endswith(_ARRAY):
            _check_array(path, relative, known[relative])
        elif not relative.endswith((_GROUP, _ATTRIBUTES)):
            raise DamagedFile(path, f"its metadata name {relative}")


def _check_array(path: Path, name: str, form: Any) -> None:
    """Refuse the metadata of an array that `lfpiv export` does not write."""
    form = form if isinstance(form, dict) else {}
    filters, compressor = form.get("filters") or [], form.get("compressor") or {}
    codecs = [*filters, compressor] if isinstance(filters, list) else [None]
    if not all(isinstance(codec, dict) for codec in codecs):
        raise DamagedFile(path, f"{name}: its codecs have another form")
    for codec, allowed in [*((one, FILTERS) for one in filters), (compressor, (*COMPRESSORS, None))]:
        if (found := codec.get("id")) not in allowed:
            raise DamagedFile(path, f"{name}: expected the codec {allowed[0]}, found {str(found)[:40]!r}")
    kind, shape, chunks = form.get("dtype"), form.get("shape"), form.get("chunks")
    if form.get("zarr_format") != 2 or not isinstance(kind, str) or not _NUMBERS.fullmatch(kind):
        raise DamagedFile(path, f"{name}: expected numbers in format 2, found {str(kind)[:40]!r}")
    lengths = [length for one in (shape, chunks) for length in (one if isinstance(one, list) else [None])]
    if not all(type(length) is int and length >= 0 for length in lengths) or len(shape) != len(chunks):
        raise DamagedFile(path, f"{name}: its shape or chunks are no lengths")
    if math.prod(chunks if len(shape) > 1 else map(max, shape, chunks)) * int(kind[2:]) > LARGEST_CHUNK:
        raise DamagedFile(path, f"{name}: expected at most {LARGEST_CHUNK} bytes at once, found {shape} in {chunks}")


def verify_zarr(path: Path) -> None:
    """Verify a complete Zarr store, whose form was checked.

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
