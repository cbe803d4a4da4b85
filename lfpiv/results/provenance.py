"""Stamps: settings and images that a finished file depends on, stored inside it with other marks.

A later run compares the stamp of a file with the stamp of the present experiment (`lfpiv.results.stamps`). It repeats
the work if they differ, and names the differences.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lfpiv import files, hdf5, warn
from lfpiv.errors import DamagedFile
from lfpiv.records import RecordError, read_json, read_object, validate
from lfpiv.results.image_identity import Images
from lfpiv.warn import Warning

log = logging.getLogger(__name__)

IMAGES, IMAGES_BESIDE, MASK_FILES = "images", "images_beside", "mask_files"
"""Parts of a stamp: the images of a result, and those of the instants beside it on which it depends. Where frames have
masks of their own, also the masks of all these."""
OF_PAIR = (IMAGES, IMAGES_BESIDE, MASK_FILES)
"""Parts of a stamp that differ from pair to pair of a run."""


@dataclass(frozen=True, kw_only=True)
class Marks:
    """Stamp, figures and warnings that a finished file stores."""

    settings_hash: str = ""
    """Hash of its stamp."""
    depends_on: str = ""
    """Parts of its stamp, as JSON."""
    figures: Mapping[str, Any] | None = None
    """Figures for the summary; None in files without."""
    warnings: tuple[Warning, ...] = ()
    """Warnings about the images it was made from."""

    @property
    def images(self) -> list[tuple[str, str]]:
        """Path and digest of each image that the result was made from, as far as they are known."""
        try:
            stored = read_object(self.depends_on).get(IMAGES)
        except RecordError:
            return []
        entries = stored if isinstance(stored, list) else []
        return [(str(one[0]), str(one[-1])) for one in entries if isinstance(one, list) and len(one) > 3 and one[-1]]


@dataclass(frozen=True)
class Stamp:
    """The parts that a result depends on."""

    parts: Mapping[str, Any]
    """Name -> settings, a hash, or images; None for missing images."""

    @cached_property
    def hash(self) -> str:
        """Short hash of all parts; of images, of their paths."""
        return files.settings_hash(
            **{name: part.names if isinstance(part, Images) else part for name, part in self.parts.items()}
        )

    @property
    def attributes(self) -> dict[str, str]:
        """Attributes that a file stores; reads the images for their digests."""
        parts = {name: part.stored() if isinstance(part, Images) else part for name, part in self.parts.items()}
        return {"settings_hash": self.hash, "depends_on": json.dumps(files.plain(parts))}

    def changes(self, marks: Marks) -> list[str]:
        """Return the names of the parts that changed since a file was made; empty if the file still fits.

        Missing images count as unchanged, because raw data may be deleted.
        """
        has_images = any(isinstance(part, Images) for part in self.parts.values())
        if marks.settings_hash == self.hash and not has_images:
            return []
        try:
            before = read_object(marks.depends_on)
        except RecordError:
            return ["settings or images"]
        found = []
        for name in {**before, **self.parts}:
            old, new = before.get(name), self.parts.get(name)
            if isinstance(new, Images):
                found += [] if new.agree(old) else [name]
                continue
            new = files.plain(new)
            if old == new or (name in (IMAGES, IMAGES_BESIDE) and new is None):
                continue
            if isinstance(old, dict) and isinstance(new, dict):
                gone = {IMAGES} if new.get("images", ()) is None else set()
                found += [f"{name}.{key}" for key in {**old, **new} if old.get(key) != new.get(key) and key not in gone]
            else:
                found.append(name)
        return found

    def fits(self, marks: Marks | None) -> bool:
        """Return whether there is a file and nothing it depends on changed."""
        return marks is not None and not self.changes(marks)


def read_marks(path: Path) -> Marks | None:
    """Read the marks of a finished NetCDF or HDF5 file, verified; None if it is missing or damaged.

    The log names a damaged file and the reason.
    """
    try:
        return require_marks(path)
    except FileNotFoundError:
        return None
    except DamagedFile as error:
        reject(path, error.reason)
        return None


def require_marks(path: Path) -> Marks:
    """Read the marks of a finished file, verified.

    Raises
    ------
    FileNotFoundError
        If it is missing.
    DamagedFile
        If its bytes are not those that were written, it is a copy of another file, or its marks have another form.
    """
    names = ("settings_hash", "depends_on", "figures", "warnings")
    with hdf5.opened(path, values=False) as file:
        found = {name: _text(file.attrs[name], name) for name in names if name in file.attrs}
        require_name(path, file.attrs)
    try:
        if found.get("depends_on"):
            read_object(found["depends_on"])
        return Marks(
            settings_hash=found.get("settings_hash", ""),
            depends_on=found.get("depends_on", ""),
            figures=read_object(found["figures"]) if "figures" in found else None,
            warnings=stored_warnings(found),
        )
    except RecordError as error:
        raise DamagedFile(path, f"its attributes have another form: {error}") from None


_rejected: ContextVar[set[tuple[Path, str]] | None] = ContextVar("_rejected", default=None)


@contextlib.contextmanager
def rejected_once() -> Iterator[None]:
    """Log within this block only once that a file is not used: a run reads some of them twice."""
    token = _rejected.set(set())
    try:
        yield
    finally:
        _rejected.reset(token)


def reject(path: Path, reason: str) -> None:
    """Log that a file is not used, with the reason."""
    told = _rejected.get()
    if told is None or (path, reason) not in told:
        log.warning("%s: damaged or foreign, not used: %s", path, reason)
    if told is not None:
        told.add((path, reason))


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise RecordError(f"expected text in {name!r}, found {type(value).__name__}")
    return value


def require_name(path: Path, attributes: Mapping[str, Any]) -> None:
    """Raise DamagedFile for a file that was written under another name, such as another pair's."""
    if (named := attributes.get("file", path.name)) != path.name:
        raise DamagedFile(path, f"it is {str(named)[:80]} under another name")


def background_content(path: Path) -> str | None:
    """Return the hash of the light in a stored background, whether it fits or not; None if it subtracts nothing."""
    marks = read_marks(path)
    content = None if marks is None or marks.figures is None else marks.figures.get("content")
    return content if isinstance(content, str) else None


def background_figures(path: Path) -> tuple[Mapping[str, Mapping[str, float | None]], tuple[Warning, ...]]:
    """Return the figures of each camera and the warnings of a stored background; empty ones if there is none."""
    marks = read_marks(path)
    if marks is None or marks.figures is None:
        return {}, ()
    try:
        return validate(dict[str, dict[str, float | None]], marks.figures.get("cameras")), marks.warnings
    except RecordError as error:
        reject(path, f"its figures have another form: {error}")
        return {}, marks.warnings


def stored_warnings(attributes: Mapping[str, Any]) -> tuple[Warning, ...]:
    """Read the warnings in the attributes of a file; raise RecordError if they are no list of warnings."""
    return warn.from_list(read_json(attributes.get("warnings", "[]")))
