"""Trust in HDF5 and NetCDF4 files: `seal` a file when it is complete, `opened` verifies it before it is read.

The seal is a line behind the last byte that HDF5 uses. It holds a digest of all bytes before it, so of every value,
name and attribute. HDF5 ignores what follows its end, and cuts it off when a program changes the file. Verifying reads
the bytes once, in parts, and parses nothing that has not been found whole.

A file without a seal is refused. So is one whose structure no result has (`lfpiv.hdf5_structure`).
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import os
import time
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv.errors import DamagedFile, InputError
from lfpiv.hdf5_structure import check_structure
from lfpiv.records import RecordError, open_regular

if TYPE_CHECKING:
    import h5py

SEALED = "seal"
"""Attribute of the root of a sealed file, which says to readers of other programs what its last line is."""

ALGORITHM = "blake2b-256"

BLOCK_BYTES = 1 << 20
"""Bytes read at once while a digest is computed."""

SETTLED_S = 2.0
"""Age of the last change from which size and times of a file identify its content, as clocks of file systems tick."""

_MARK = f"\nlfpiv {SEALED} 1 {ALGORITHM} ".encode()
_SEAL_BYTES = len(_MARK) + 64 + 1


def options(shape: tuple[int, ...], *, zipped: bool = True) -> dict[str, Any]:
    """Return the options of ``create_dataset`` for an array: a checksum of each chunk, and compression.

    Scalars and empty arrays have no chunks, hence neither.
    """
    if not math.prod(shape) or not shape:
        return {}
    return {"fletcher32": True} | ({"compression": "gzip", "compression_opts": 1} if zipped else {})


class Disk(FileIO):
    """A file for HDF5 to write to. HDF5 crashes the process where a write fails, so failures are kept until `check`.

    Parameters
    ----------
    mode : {"w+", "r+"}
        Make a new file, or change one.
    """

    _error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write all bytes; after a failure do nothing."""
        left = memoryview(content).cast("B")
        size = len(left)
        try:
            while self._error is None and left:
                left = left[super().write(left) :]
        except OSError as error:
            self._error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Change the length; after a failure do nothing."""
        try:
            return super().truncate(size) if self._error is None else size or 0
        except OSError as error:
            self._error = error
            return size or 0

    def check(self) -> None:
        """Raise the first OSError of a write since the file was opened."""
        if self._error is not None:
            raise self._error


@contextlib.contextmanager
def written(path: Path) -> Iterator[Disk]:
    """Yield a new file for HDF5 to write to, and seal it at the end; raise OSError if the file cannot be written."""
    with Disk(path, "w+") as file:
        try:
            yield file
        except Exception:
            file.check()  # what HDF5 makes of a failure follows from it
            raise
        file.check()
    seal(path)


def seal(target: Path | io.BytesIO) -> None:
    """Append the digest of a complete HDF5 file. Remove an older seal.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import h5py

    text = f"{ALGORITHM} of all bytes before the last {_SEAL_BYTES}, which state it"
    with contextlib.ExitStack() as stack:
        content: Any = target if isinstance(target, io.BytesIO) else stack.enter_context(Disk(target, "r+"))
        with h5py.File(content, "r+") as file:
            if file.attrs.get(SEALED) != text:
                file.attrs[SEALED] = text
        end = _end(content)
        content.truncate(end)
        digest = _digest(content, end)
        content.seek(end)
        content.write(_MARK + digest + b"\n")
        if isinstance(content, Disk):
            content.check()


@contextlib.contextmanager
def opened(path: str | Path, *, values: bool = True) -> Iterator[h5py.File]:
    """Verify a file and open it to read.

    A file is verified once by a process, and again after it changed.

    Parameters
    ----------
    values : bool
        Whether arrays are read. If only attributes are, the structure is not checked.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFile
        If it is no regular file, its seal is missing or wrong, its structure is not allowed, or anything fails while it
        is read.
    """
    import h5py

    key = _check_seal(path)
    with _converted(path), h5py.File(path, "r") as file:
        if values and -key not in _known:
            check_structure(file, os.path.getsize(path))
            _remember(-key)
        yield file


@contextlib.contextmanager
def glanced(path: str | Path) -> Iterator[h5py.File]:
    """Open a file to read attributes and axes, without computing its digest: for thousands of files.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFile
        If it is no regular file, it has no seal, or anything fails while it is read.
    """
    import h5py

    with _regular(path) as content:
        _require_seal(content, path)
    with _converted(path), h5py.File(path, "r") as file:
        yield file


@contextlib.contextmanager
def _converted(path: str | Path) -> Iterator[None]:
    """Convert whatever h5py and readers make of damaged bytes."""
    try:
        yield
    except (FileNotFoundError, InputError):
        raise
    except Exception as error:
        raise DamagedFile(path, f"{type(error).__name__}: {error}") from None


def verify(path: str | Path) -> None:
    """Verify a file as `opened` does."""
    with opened(path):
        pass


def netcdf_engine(path: Path) -> str:
    """Return xarray's engine for a NetCDF file. h5netcdf prints a traceback on files that h5py cannot open.

    Raises
    ------
    OSError
        If it is an HDF5 file that cannot be opened.
    """
    import h5py

    if not h5py.is_hdf5(path):
        return "scipy"
    h5py.File(path, "r").close()
    return "h5netcdf"


# -- the seal ----------------------------------------------------------------------------------------------------------


def _regular(path: str | Path) -> FileIO:
    try:
        return open_regular(path)
    except RecordError as error:
        raise DamagedFile(path, str(error)) from None


def _check_seal(path: str | Path) -> int:
    """Check that the bytes of a file are those of its seal; return the key to remember it."""
    with _regular(path) as file:
        status = os.fstat(file.fileno())
        key = _key(path, status)
        try:
            stated = _require_seal(file, path)
            if key not in _known and _digest(file, status.st_size - _SEAL_BYTES) != stated:
                raise DamagedFile(path, "its bytes are not those that were written: the digest differs")
        except OSError as error:
            raise DamagedFile(path, (error.strerror or str(error)).lower()) from None
    _remember(key)
    return key


def _stated(file: Any) -> bytes | None:
    """Return the digest that the seal of a file states; None without a seal."""
    size = file.seek(0, os.SEEK_END)
    if size < _SEAL_BYTES:
        return None
    file.seek(size - _SEAL_BYTES)
    found = file.read(_SEAL_BYTES)
    return found[len(_MARK) : -1] if found[: len(_MARK)] == _MARK and found[-1:] == b"\n" else None


def _require_seal(file: FileIO, path: str | Path) -> bytes:
    """Return the digest that the seal of a file states; refuse a file without a seal."""
    if (stated := _stated(file)) is None:
        raise DamagedFile(path, "it has no seal: it is cut off, or another program wrote or changed it")
    return stated


def _end(file: Any) -> int:
    """Return the number of bytes without a seal."""
    sealed = _stated(file) is not None
    return int(file.seek(0, os.SEEK_END)) - (_SEAL_BYTES if sealed else 0)


def _digest(file: Any, end: int) -> bytes:
    digest = hashlib.blake2b(digest_size=32)
    file.seek(0)
    while end > 0 and (block := file.read(min(BLOCK_BYTES, end))):
        digest.update(block)
        end -= len(block)
    return digest.hexdigest().encode()


# -- once per process --------------------------------------------------------------------------------------------------

MOST_KNOWN = 50_000
"""Largest number of keys that are kept; a file whose key was dropped is verified again."""

_known: set[int] = set()
"""Keys of files with the right seal, and negative keys of files with the right structure."""


def _key(path: str | Path, status: os.stat_result) -> int:
    """Return a number above 0 that changes with the file; 0 if it changed so recently that its times may not show it.

    A number for each file keeps 100,000 of them in a few MiB.
    """
    if not time.time() - max(status.st_mtime, status.st_ctime) > SETTLED_S:
        return 0
    times = status.st_mtime_ns, status.st_ctime_ns
    return abs(hash((os.fspath(path), status.st_dev, status.st_ino, status.st_size, *times)))


def _remember(key: int) -> None:
    if len(_known) >= MOST_KNOWN:
        _known.clear()
    if key:
        _known.add(key)
