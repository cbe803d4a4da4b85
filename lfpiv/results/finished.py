"""Decide whether a stored result of a pair can be used instead of making it again.

The seal of a file vouches for its values. Files of earlier versions have none: their values are read and checked.
What cannot be used is named in the log with the reason.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.geometry.grid import Grid
from lfpiv.results import netcdf, provenance
from lfpiv.results.provenance import Marks

_checked: set[int] = set()
"""Keys of files without a seal whose values this process has checked."""


def vectors_marks(path: Path, grid: Grid | None = None) -> Marks | None:
    """Return the marks of the vectors of a pair; None if they are missing, damaged or those of another pair."""
    marks = provenance.read_marks(path)
    if marks is None or marks.sealed or _is_checked(path):
        return marks
    try:
        netcdf.read_vectors(path, grid=grid)
    except InputError as error:
        refuse(path, error)
        return None
    _remember(path)
    return marks


def volume_marks(path: Path, grid: Grid | None = None, frame: str | None = None) -> Marks | None:
    """Return the marks of a volume; None if it is missing, damaged, of another pair, or of a frame of another name."""
    marks = provenance.read_marks(path)
    if marks is None or marks.sealed or _is_checked(path):
        return marks
    if frame is not None and marks.frame not in ("", frame):
        refuse(path, DamagedFile(path, f"it is the volume of frame {marks.frame!r}, not of {frame!r}"))
        return None
    try:
        if not netcdf.read_volume(path, grid=grid).values.any():
            raise DamagedFile(path, "all its intensities are 0")
    except InputError as error:
        refuse(path, error)
        return None
    _remember(path)
    return marks


def require(paths: Iterable[Path]) -> None:
    """Verify files where nothing can be made again; those that are missing are left out.

    Raises
    ------
    DamagedFile
        If one is damaged or written under another name.
    """
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            try:
                provenance.require_marks(path)
            except DamagedFile as error:
                raise DamagedFile(path, error.reason, "Run `lfpiv run`, which makes it again") from None


def require_vectors(path: Path) -> None:
    """Verify the vectors of a pair once per process.

    Raises
    ------
    InputError
        If they are missing, damaged or those of another pair.
    """
    if not provenance.require_marks(path).sealed and not _is_checked(path):
        netcdf.read_vectors(path)
        _remember(path)


def refuse(path: Path, error: InputError) -> None:
    """Log that a file is not used, with the reason."""
    provenance.reject(path, error.reason if isinstance(error, DamagedFile) else str(error))


def _is_checked(path: Path) -> bool:
    return hdf5.file_key(path) in _checked


def _remember(path: Path) -> None:
    if key := hdf5.file_key(path):
        _checked.add(key)
