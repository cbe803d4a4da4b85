"""Check the path patterns of an experiment file, such as ``run/{camera}/{pair:04d}{frame}.tif``.

A pattern may name its fields and the width of a number. Other formats, attributes and conversions are refused.
"""

from __future__ import annotations

import os
import re
import string
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lfpiv.errors import InputError
from lfpiv.settings import bounds

SHOWN_CHARACTERS = 80
"""Most characters of a path pattern in a message."""

WIDEST_FIELD = 20
"""Largest width of a number in a path pattern, as in ``{pair:04d}`` [character]."""

NUMBER_FORMAT = re.compile("(0?([1-9]|1[0-9]|20))?d?")
"""Format of a number in a path pattern; widths up to `WIDEST_FIELD`."""

LONGEST_PATH_BYTES = 4095
"""Longest path that file systems take, folder included [byte]."""


def check_pattern(path: Path, key: str, pattern: str, fields: Mapping[str, Any], *, optional: bool = False) -> None:
    """Refuse a path pattern with unknown fields, or with one path for several images unless fields are `optional`."""
    known, shown = ", ".join("{" + name + "}" for name in fields), _shortened(repr(pattern))
    try:
        parts = [part for part in string.Formatter().parse(pattern) if part[1] is not None]
    except ValueError as error:
        raise InputError(f"{path}: {key}: expected a path with {known}, found {shown} ({error}).") from None
    used = {str(name) for _, name, _, _ in parts}
    if used - set(fields):
        unknown = _shortened(min(used - set(fields)))
        raise InputError(f"{path}: {key}: expected only {known}, found {{{unknown}}} in {shown}.")
    for _, name, width, conversion in parts:
        wrong = _wrong_format(str(name), width or "", conversion or "", is_number=isinstance(fields[str(name)], range))
        if wrong is not None:
            raise InputError(f"{path}: {key}: {wrong}")
    for name, values in fields.items():
        if len(values) > 1 and name not in used and not optional:
            raise InputError(
                f"{path}: {key}: expected {{{name}}} in the path, since there are {len(values)}, found {shown}."
            )
    longest = {
        name: values[-1] if isinstance(values, range) else max(values, key=lambda text: len(text.encode()))
        for name, values in fields.items()
    }
    check_length(path, key, pattern.format(**longest))


def _wrong_format(name: str, width: str, conversion: str, *, is_number: bool) -> str | None:
    """Say which format a field may have instead of its own; None if that is right."""
    if not conversion and (NUMBER_FORMAT.fullmatch(width) if is_number else not width):
        return None
    allowed = f"{{{name}}}" + (f", or {{{name}:04d}} with a width up to {WIDEST_FIELD}" if is_number else "")
    found = _shortened(name + (f"!{conversion}" if conversion else "") + (f":{width}" if width else ""))
    return f"expected {allowed}, found {{{found}}}."


def check_length(path: Path, key: str, name: str) -> None:
    """Refuse the path of an image that is longer than file systems take."""
    longest = max(len(os.fsencode(part)) for part in name.split("/"))
    if longest > bounds.LONGEST_PART_BYTES:
        raise InputError(
            f"{path}: {key}: expected names of files and folders of at most {bounds.LONGEST_PART_BYTES} bytes, found "
            f"one of {longest} bytes. Shorten it."
        )
    if len(os.fsencode(path.parent / name)) > LONGEST_PATH_BYTES:
        raise InputError(f"{path}: {key}: expected a path of at most {LONGEST_PATH_BYTES} bytes. Use shorter names.")


def _shortened(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 3] + "..."
