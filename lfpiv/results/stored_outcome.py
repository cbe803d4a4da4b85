"""Outcome of a step of a run as a JSON file: its entries, the stamp that it holds for, and a digest of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from lfpiv import files
from lfpiv.files import writing
from lfpiv.records import RecordError, digest, read_object, read_text, validate
from lfpiv.results import provenance
from lfpiv.results.provenance import Marks, Stamp

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class _Stamped:
    """Entries that every outcome has beside its own."""

    settings_hash: str
    depends_on: str
    digest: str


def read(path: Path, parse: Callable[[dict[str, Any]], T]) -> tuple[T, Marks] | None:
    """Read a stored outcome, whether it fits or not, and its marks; None if the file is missing or damaged.

    The log names a damaged file and the reason.

    Parameters
    ----------
    parse : callable
        Takes the content of the file. Raises RecordError if the outcome's entries have another form.
    """
    try:
        content = read_object(read_text(path))
        stamped = validate(_Stamped, content)
        if stamped.digest != digest(content):
            raise RecordError("its entries are not those that were written: the digest differs")
        read_object(stamped.depends_on)
        return parse(content), Marks(settings_hash=stamped.settings_hash, depends_on=stamped.depends_on)
    except FileNotFoundError:
        return None
    except RecordError as error:
        provenance.reject(path, str(error))
        return None


def write(entries: Mapping[str, Any], stamp: Stamp, path: Path) -> None:
    """Write the entries of an outcome with its stamp and the digest, atomically."""
    content = files.plain({**stamp.attributes, **entries})
    with writing(path):
        files.write_json({**content, "digest": digest(content)}, path)
