"""Read TOML files into frozen models; messages name the key, what was expected and what was found."""

from __future__ import annotations

import codecs
import difflib
import os
import re
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lfpiv.errors import InputError

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
SHOWN_KEYS = 5
"""Largest number of further keys that a message names."""
SHOWN_NAME = 60
"""Most characters of a key, a name or a value in a message."""

_PART = r"""(?:(?<![\w-])[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*"""
_DOTTED = re.compile(f"(?:{_PART}){{{DEEPEST}}}")
"""A key of very many parts, for which the parser takes quadratic time."""

_UNITS = {"mm": " mm", "um": " um", "s": " s", "deg": " degrees", "px": " pixels", "gib": " GiB", "voxel": " voxels"}
"""Units in messages by the end of a key."""


def read_toml(path: Path, model: type[Model]) -> Model:
    """Read a TOML file into a model.

    Parameters
    ----------
    path : Path
        The file.
    model : type
        A pydantic model that forbids unknown keys.

    Returns
    -------
    model
        The validated instance.

    Raises
    ------
    InputError
        If the file cannot be read, is not TOML, or does not fit the model. The message explains the first problem and
        names the keys of the others.
    """
    return validated(parse(read_text(path), path), path, model)


def validated(values: Mapping[str, Any], path: Path, model: type[Model]) -> Model:
    """Return the values of a file as a model; `path` names the file in messages. Raise InputError as `read_toml`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{path}: {_explain(error, model, values)}") from None


def read_text(path: Path) -> str:
    """Read a small text file in UTF-8; raise InputError for anything else, such as a pipe, a device or an image."""
    content = _read_bytes(path)
    try:
        return content.decode("utf-8-sig")  # editors on Windows may write a byte order mark
    except UnicodeDecodeError as error:
        if error.object[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            found = "UTF-16"
        else:
            line = error.object[: error.start].count(b"\n") + 1
            found = f"the byte {error.object[error.start]:#04x} in line {line}, as Latin-1 text or an image has"
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
        values = tomllib.loads(text)
    except RecursionError:
        raise InputError(deep) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: expected TOML, found a mistake: {error}.") from None
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


def _explain(error: ValidationError, model: type[BaseModel], values: Mapping[str, Any]) -> str:
    # Unknown keys first: a misspelt key is often also reported as missing.
    problems = sorted(error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden")
    keys = list(dict.fromkeys(_key(problem["loc"], values) for problem in problems))
    more = ""
    if len(keys) > 1:
        others = len(keys) - 1 - SHOWN_KEYS
        more = f" Also look at: {', '.join(keys[1 : SHOWN_KEYS + 1])}{f' and {others} more' if others > 0 else ''}."
    return f"{keys[0]}: {_expectation(problems[0], model)}{more}"


def _key(location: tuple[int | str, ...], values: Any) -> str:
    """Return the name of a location: ``camera 'cam1', f_number``, ``smart.iterations`` or ``volume.size_mm[2]``."""
    key = ""
    for part in location:
        if isinstance(values, Mapping) and values.get("kind") == part and part not in values:
            continue  # pydantic's tag for one form of a union, which is not a key of the file
        if isinstance(part, str) and isinstance(values, Mapping):
            shown = _short(part)
            key += shown if not key or key.endswith(", ") else f".{shown}"
            values = values.get(part)
        elif isinstance(part, int) and isinstance(values, list):
            values = values[part] if part < len(values) else None
            name = values.get("name") if isinstance(values, Mapping) else None
            key += f" {_short(name)!r}, " if isinstance(name, str) else f"[{part}]"
        # else: pydantic's tag for one form of a union, which is not a key of the file
    return key.rstrip(", ")


def _expectation(problem: Mapping[str, Any], model: type[BaseModel]) -> str:
    kind, context, found = problem["type"], problem.get("ctx", {}), problem.get("input")
    if kind == "extra_forbidden":
        return f"unknown key. {_nearest(problem['loc'], model)}"
    if kind == "missing" and isinstance(found, (list, tuple)):
        return f"expected more values, found only {_show(found)}."
    if kind == "missing":
        return "this key is missing. Add it."
    if kind == "value_error":
        return f"expected {context['error']}, found {_show(found)}."
    expected = {
        "float_type": "a number",
        "int_type": "a whole number",
        "int_from_float": "a whole number",
        "bool_type": "true or false",
        "string_type": "text in quotes",
        "tuple_type": "a list in brackets",
        "model_type": "a table",
        "finite_number": "a finite number",
        "greater_than": f"a number above {_bound(problem, 'gt')}",
        "greater_than_equal": f"{_bound(problem, 'ge')} or more",
        "less_than": f"a number below {_bound(problem, 'lt')}",
        "less_than_equal": f"{_bound(problem, 'le')} or less",
        "literal_error": f"one of {str(context.get('expected')).replace(' or ', ', ')}",
        "too_short": f"at least {context.get('min_length')} value(s)",
        "too_long": f"at most {context.get('max_length')} value(s)",
        "string_too_short": "text that is not empty",
        "string_too_long": f"at most {context.get('max_length')} characters",
        "string_pattern_mismatch": "a name of letters, digits, '_', '-' and '.'",
    }.get(kind, problem["msg"][:1].lower() + problem["msg"][1:])
    least = context.get("ge", 0)
    if isinstance(least, float) and least > 0 and isinstance(found, (int, float)) and found <= 0:
        expected = "a number above 0"
    quoted = isinstance(found, str) and kind in ("float_type", "int_type", "bool_type")
    return f"expected {expected}, found {_show(found)}.{' Write it without quotes.' if quoted else ''}"


def _bound(problem: Mapping[str, Any], name: str) -> str:
    """Return a bound of a number with its unit, which the key names at its end."""
    value = problem.get("ctx", {}).get(name)
    if not isinstance(value, (int, float)):
        return str(value)
    key = next((part for part in reversed(problem["loc"]) if isinstance(part, str)), "")
    text = str(value) if isinstance(value, int) or value == 0 else f"{value:g}"
    return text + (_UNITS.get(key.rpartition("_")[2], "") if "_" in key else "")


def _short(text: str) -> str:
    return text if len(text) <= SHOWN_NAME else text[: SHOWN_NAME - 3] + "..."


def _show(value: Any) -> str:
    if isinstance(value, BaseModel):
        return "these values together"
    if isinstance(value, str):
        text = f"the text {value!r}"
    elif isinstance(value, bool):
        text = str(value).lower()
    else:
        text = str(list(value) if isinstance(value, tuple) else value)
    return _short(text)


def _nearest(location: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """Return advice for an unknown key: the most similar known key, or all keys of its table."""
    for part in location[:-1]:
        if isinstance(part, str) and part in model.model_fields:
            model = _table_of(model.model_fields[part].annotation) or model
    known = list(model.model_fields)
    close = difflib.get_close_matches(str(location[-1]).lower(), known, n=1, cutoff=0.6)
    return f"Did you mean {close[0]!r}?" if close else f"Known here: {', '.join(known)}."


def _table_of(annotation: Any) -> type[BaseModel] | None:
    """Return the model inside an annotation such as ``tuple[CameraTable, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_table_of, getattr(annotation, "__args__", ()))), None)
