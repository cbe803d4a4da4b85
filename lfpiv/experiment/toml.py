"""Read TOML files into frozen models; messages name the key, what was expected and what was found."""

from __future__ import annotations

import codecs
import os
import re
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lfpiv.errors import InputError
from lfpiv.experiment import problems, toml_mistakes

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Model = TypeVar("Model", bound=BaseModel)

LARGEST_BYTES = 1 << 18
"""Largest size of a file [byte]; a thousand solids take a third of it."""
DEEPEST = 16
"""Largest depth of nested tables and lists."""
LARGEST_WHOLE = 2**63
"""Magnitude from which on a whole number is refused, as by TOML itself."""

_PART = r"""(?:(?<![\w-])[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*"""
_DOTTED = re.compile(f"(?:{_PART}){{{DEEPEST}}}")
"""A key of very many parts, for which the parser takes quadratic time."""


def read_toml(path: Path, model: type[Model]) -> Model:
    """Read a TOML file into a model.

    Parameters
    ----------
    model : type
        A pydantic model that forbids unknown keys.

    Returns
    -------
    model
        The validated instance.

    Raises
    ------
    InputError
        If the file cannot be read, is not TOML, or does not fit the model. The message explains the first problem,
        names all missing keys, and the keys of the other problems.
    """
    return validated(parse(read_text(path), path), path, model)


def validated(values: Mapping[str, Any], path: Path, model: type[Model]) -> Model:
    """Return the values of a file as a model; `path` names the file in messages. Raise InputError as `read_toml`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{path}: {problems.explain(error, model, values)}") from None


def read_text(path: Path) -> str:
    """Read a small text file in UTF-8; raise InputError for anything else, such as a pipe, a device or an image."""
    content = _read_bytes(path)
    if b"\0" in content and content[:2] not in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        found = "bytes of value 0, as UTF-16 text or an image has"
        raise InputError(f"{path}: expected a TOML text file in UTF-8, found {found}. Save it as UTF-8.")
    try:
        return content.decode("utf-8-sig")  # editors on Windows may write a byte order mark
    except UnicodeDecodeError as error:
        if error.object[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            found = "UTF-16"
        else:
            line = error.object[: error.start].count(b"\n")
            shown = problems.short(error.object.splitlines()[line].decode("utf-8", "replace").strip())
            byte = f"the byte {error.object[error.start]:#04x} in line {line + 1}"
            found = f"{byte}, as Latin-1 text or an image has, `{shown}`"
        raise InputError(f"{path}: expected a TOML text file in UTF-8, found {found}. Save it as UTF-8.") from None


def _read_bytes(path: Path) -> bytes:
    try:
        file = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe without a writer must not block
    except FileNotFoundError:
        raise InputError(f"{path}: expected a TOML file, found no such file. Check the path.") from None
    except (OSError, ValueError) as error:  # ValueError: a path with NUL or characters that cannot be encoded
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: the file cannot be read ({reason}). Check path and permissions.") from None
    try:
        about = os.fstat(file)
        if stat.S_ISDIR(about.st_mode):
            raise InputError(f"{path}: expected a TOML file, found a folder. Name the .toml file in it.")
        if not stat.S_ISREG(about.st_mode):
            raise InputError(f"{path}: expected a TOML file, found a pipe, a socket or a device. Name a regular file.")
        with open(file, "rb", closefd=False) as opened:
            content = opened.read(LARGEST_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: the file cannot be read ({error.strerror}). Check its permissions.") from None
    finally:
        os.close(file)
    if len(content) > LARGEST_BYTES:
        size = max(about.st_size, len(content)) / 1024
        raise InputError(
            f"{path}: expected a TOML file of at most {LARGEST_BYTES // 1024} KiB, found {size:,.0f} KiB. Is it "
            "another file?"
        )
    return content


def parse(text: str, path: Path) -> dict[str, Any]:
    """Parse TOML; `path` names the file in messages. Raise InputError for mistakes, deep nesting and huge numbers."""
    deep = f"{path}: expected tables and lists nested at most {DEEPEST} deep, found more. Remove brackets or dots."
    if _DOTTED.search(text):
        raise InputError(deep)
    try:
        values = tomllib.loads(text if text.endswith("\n") else text + "\n")  # places in the last line are exact
    except RecursionError:
        raise InputError(deep) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: {toml_mistakes.explain(text, error)}") from None
    except ValueError:  # Python refuses to convert some thousand digits
        raise InputError(f"{path}: expected whole numbers below 2^63, found one of thousands of digits.") from None
    level: list[Any] = [values]
    for _ in range(DEEPEST + 1):
        level = [one for value in level for one in (value.values() if isinstance(value, dict) else value)]
        if any(isinstance(value, int) and abs(value) >= LARGEST_WHOLE for value in level):
            raise InputError(f"{path}: expected whole numbers below 2^63, found a larger one.")
        level = [value for value in level if isinstance(value, (dict, list))]
    if level:
        raise InputError(deep)
    return values
