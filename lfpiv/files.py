"""Write files atomically: each is written under a temporary name and renamed. Convert values to JSON."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.errors import InputError, StorageError
from lfpiv.version import history

MIB = 1 << 20


def size_text(size: int) -> str:
    """Return a size [byte] as text, in the largest unit of which it has at least one.

    Examples
    --------
    >>> from lfpiv.files import size_text
    >>> size_text(3 << 29), size_text(700), size_text(5 << 50)
    ('1.5 GiB', '700 bytes', '5120.0 TiB')
    """
    for unit, power in (("TiB", 40), ("GiB", 30), ("MiB", 20), ("KiB", 10)):
        if size >= 1 << power:
            return f"{size / (1 << power):.1f} {unit}"
    return f"{size} bytes"


def scratch_path(path: Path) -> Path:
    """Return the unique path of a file or folder beside `path` while this process writes it."""
    path = Path(os.path.abspath(path))  # "." has no name
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}.tmp")


@functools.cache
def _machine() -> str:
    """Return a short name of the processes that share their numbers with this one: machine and, on Linux, container."""
    space = ""
    with contextlib.suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    return hashlib.blake2b(f"{platform.node()} {space}".encode(), digest_size=4).hexdigest()


def remove_leftovers(folder: Path, pattern: str = ".*.tmp") -> None:
    """Remove what killed processes of this machine left half-written in a folder."""
    for path in folder.glob(pattern):
        match = re.search(r"\.([0-9a-f]{8})-(\d{1,9})-[0-9a-f]{8}\.tmp$", path.name)
        if match is None or match[1] != _machine() or _is_alive(int(match[2])):
            continue
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a scratch path in the folder of `path`; rename it to `path` at the end, remove it on any failure.

    The scratch path is unique, so two processes may write the same file. `remove_leftovers` finds the files of killed
    processes.
    """
    scratch = scratch_path(path)
    try:
        yield scratch
        with scratch.open("rb") as file:
            os.fsync(file.fileno())  # a power failure must not leave the name without its bytes
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def require_empty(folder: Path) -> None:
    """Raise InputError unless a folder is empty or absent."""
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: expected an empty or absent folder to write to, found files. Name another folder.")


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a scratch path beside `path` for a new folder; rename it to `path`, which must not exist, at the end."""
    scratch = scratch_path(path)
    try:
        yield scratch
        os.replace(scratch, path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextlib.contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside `path`, and remove it at the end; `remove_leftovers` does so for killed processes."""
    scratch = scratch_path(path)
    scratch.mkdir()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write_bytes(content: bytes | memoryview, path: Path) -> None:
    """Write a file atomically. HDF5 files too: HDF5 itself crashes the process if the disk becomes full."""
    with replacing(path) as scratch:
        scratch.write_bytes(content)


def write_text(text: str, path: Path) -> None:
    """Write a text file atomically."""
    with replacing(path) as scratch:
        scratch.write_text(text, "utf-8")


def write_json(value: Any, path: Path) -> None:
    """Write a JSON file atomically; NaN and infinity become null."""
    write_text(json.dumps(plain(value), indent=2, allow_nan=False) + "\n", path)


def state_origin(path: Path) -> None:
    """Insert a comment with program and time after the declaration of an XML file, also one with binary data."""
    head, end, rest = path.read_bytes().partition(b"?>")
    if end:
        path.write_bytes(head + end + f"\n<!-- {history()} -->".encode() + rest)


def plain(value: Any) -> Any:
    """Convert arrays, NumPy numbers, tuples, paths and non-finite numbers to types that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def settings_hash(**parts: Any) -> str:
    """Return a short hash of everything a result depends on; the order of keys does not matter."""
    text = json.dumps(plain(parts), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an OSError while a result is written into a StorageError that says how to continue."""
    try:
        yield
    except StorageError:
        raise
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        if error.errno == errno.EFBIG:
            reason += " for this file system, or for the limit of this session (ulimit -f)"
        if isinstance(error, FileNotFoundError) and not path.parent.exists():
            raise StorageError(
                f"{path}: cannot be written: its folder was removed or renamed meanwhile, with what it held. Put it "
                "back, or run the command again."
            ) from error
        free = ""
        with contextlib.suppress(OSError):
            free = f", {shutil.disk_usage(path.parent).free / MIB:,.0f} MiB free there"
        raise StorageError(
            f"{path}: cannot be written: {reason}{free}. Finished results are complete. Solve this, and the same "
            "command goes on from there."
        ) from error
