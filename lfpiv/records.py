"""Read stored records strictly: JSON of a file or an attribute, as the dataclass that was written.

pydantic checks the text against the types of the dataclass: a missing entry, null or text for a number, and nesting
without end are a `RecordError` with a short reason. Entries that a dataclass does not have are left out, so records of
later versions can be read.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Mapping
from functools import lru_cache
from io import FileIO
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


class RecordError(ValueError):
    """A stored record of another form than expected; the message says where and why."""


def read_text(path: Path) -> str:
    """Read a text file; refuse at once what is no regular file, such as a pipe.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordError
        If it is no regular file, cannot be read, or is not UTF-8.
    """
    with open_regular(path) as file:
        try:
            return file.read().decode("utf-8")
        except OSError as error:
            raise RecordError((error.strerror or str(error)).lower()) from None
        except UnicodeDecodeError:
            raise RecordError("it is no text") from None


def open_regular(path: str | Path) -> FileIO:
    """Open a regular file to read bytes, unbuffered; a pipe, a device or a folder is refused without waiting for it.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordError
        If it is no regular file, or cannot be opened.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        if os.path.islink(path):
            raise RecordError("it is a link to a file that does not exist") from None
        raise
    except OSError as error:
        raise RecordError((error.strerror or str(error)).lower()) from None
    if stat.S_ISREG(os.fstat(number).st_mode):
        return FileIO(number)
    os.close(number)
    raise RecordError("it is no regular file")


def read_json(text: str | bytes) -> Any:
    """Read JSON text; a name that stands twice in one object is refused.

    Raises
    ------
    RecordError
        If it is no JSON, or nested deeper than Python can read.
    """
    if not isinstance(text, (str, bytes)):
        raise RecordError(f"expected JSON text, found {type(text).__name__}")
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise RecordError("it is nested too deep") from None
    except ValueError as error:
        raise RecordError(str(error)) from None


def read_object(text: str | bytes) -> dict[str, Any]:
    """Read JSON text that holds an object; raise RecordError if it is something else."""
    found = read_json(text)
    if not isinstance(found, dict):
        raise RecordError(f"expected a JSON object, found {_short(found)}")
    return found


def validate(kind: type[T], stored: Any) -> T:
    """Return what JSON holds as a value of a type: a dataclass, or a list or mapping of some.

    Parameters
    ----------
    stored : object
        From `read_json`.

    Raises
    ------
    RecordError
        The message names the first entry that does not fit.
    """
    from pydantic import ValidationError

    try:
        text = json.dumps(stored)
        return _adapter(kind).validate_json(text, strict=True)  # type: ignore[arg-type]  # a type is hashable
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(map(str, first["loc"]))
        other = "" if first["type"] == "missing" else f", found {_short(first['input'])}"
        raise RecordError(f"{place + ': ' if place else ''}{first['msg'][:120]}{other}") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise RecordError(f"no JSON: {str(error)[:120]}") from None


def digest(content: Mapping[str, Any]) -> str:
    """Return the digest of the entries of a JSON object beside ``"digest"``; their order does not matter."""
    entries = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.blake2b(json.dumps(entries, sort_keys=True).encode(), digest_size=16).hexdigest()


@lru_cache(maxsize=64)
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise RecordError("a name stands twice in one object")
    return found


def _short(value: Any) -> str:
    text = repr(value) if isinstance(value, (str, int, float, bool, type(None))) else f"a {type(value).__name__}"
    return text if len(text) <= 60 else f"{text[:57]}..."
