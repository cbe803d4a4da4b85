"""The output folder of a run: where its files lie, and that they can be written."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

from lfpiv.errors import InputError

FRAME_NAMES = "ab"
"""Names of the two frames in output files, whatever the images call them."""


@dataclass(frozen=True)
class Folder:
    """Where a run keeps its files."""

    path: Path

    @property
    def calibration(self) -> Path:
        """The calibration of all cameras."""
        return self.path / "calibration.h5"

    @property
    def summary(self) -> Path:
        """Machine-readable figures of the run."""
        return self.path / "summary.json"

    @property
    def report(self) -> Path:
        """The page for people."""
        return self.path / "report.html"

    def vectors(self, pair: int) -> Path:
        """Vectors of one pair."""
        return self.path / "vectors" / f"pair_{pair:04d}.nc"

    def volume(self, pair: int, frame: int) -> Path:
        """Volume of one frame (0 or 1) of a pair."""
        return self.path / "volumes" / f"pair_{pair:04d}_{FRAME_NAMES[frame]}.nc"


def make_writable(path: Path) -> list[Path]:
    """Make a folder and check that it can be written; return the folders made, innermost first."""
    made = []
    try:
        for parent in (path, *path.parents):
            if parent.exists():
                break
            made.append(parent)
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".write-test-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()
        raise InputError(
            f"{path}: expected an output folder that can be written, found: {(error.strerror or str(error)).lower()}. "
            "Choose another one with --out."
        ) from None
    folder = Folder(path)
    for place in (folder.vectors(0).parent, folder.volume(0, 0).parent):
        if place.exists() and not place.is_dir():
            raise InputError(
                f"{place}: expected a folder for results, found a file. Remove it or choose another --out."
            )
    for place in (folder.calibration, folder.summary, folder.report):
        if place.is_dir():
            raise InputError(
                f"{place}: expected a place for a file, found a folder. Remove it or choose another --out."
            )
    return made
