"""Verify finished results of a run where nothing can be made again."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from lfpiv.errors import DamagedFile
from lfpiv.results import provenance


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
