"""Read TOML files into frozen models; messages name the key, what was expected and what was found."""

from __future__ import annotations

import codecs
import difflib
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
    try:
        text = path.read_text("utf-8-sig")  # editors on Windows may write a byte order mark
    except FileNotFoundError:
        raise InputError(f"{path}: expected a TOML file, found no such file. Check the path.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a TOML file, found a folder. Name the .toml file in it.") from None
    except UnicodeDecodeError as error:
        if error.object[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            found = "UTF-16"
        else:
            line = error.object[: error.start].count(b"\n") + 1
            found = f"the byte {error.object[error.start]:#04x} in line {line}, as Latin-1 text or an image has"
        raise InputError(f"{path}: expected a TOML text file in UTF-8, found {found}. Save it as UTF-8.") from None
    except OSError as error:
        raise InputError(f"{path}: the file cannot be read ({error.strerror}). Check its permissions.") from None
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: expected TOML, found a mistake: {error}.") from None
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{path}: {_explain(error, model, values)}") from None


def _explain(error: ValidationError, model: type[BaseModel], values: Mapping[str, Any]) -> str:
    # Unknown keys first: a misspelt key is often also reported as missing.
    problems = sorted(error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden")
    keys = list(dict.fromkeys(_key(problem["loc"], values) for problem in problems))
    more = f" Also look at: {', '.join(keys[1:])}." if len(keys) > 1 else ""
    return f"{keys[0]}: {_expectation(problems[0], model)}{more}"


def _key(location: tuple[int | str, ...], values: Any) -> str:
    """Return the name of a location: ``camera 'cam1', f_number``, ``smart.iterations`` or ``volume.size_mm[2]``."""
    key = ""
    for part in location:
        if isinstance(values, Mapping) and values.get("kind") == part and part not in values:
            continue  # pydantic's tag for one form of a union, which is not a key of the file
        if isinstance(part, str) and isinstance(values, Mapping):
            key += part if not key or key.endswith(", ") else f".{part}"
            values = values.get(part)
        elif isinstance(part, int) and isinstance(values, list):
            values = values[part] if part < len(values) else None
            name = values.get("name") if isinstance(values, Mapping) else None
            key += f" {name!r}, " if isinstance(name, str) else f"[{part}]"
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
        "greater_than": f"a number above {context.get('gt')}",
        "greater_than_equal": f"{context.get('ge')} or more",
        "less_than": f"a number below {context.get('lt')}",
        "less_than_equal": f"{context.get('le')} or less",
        "literal_error": f"one of {str(context.get('expected')).replace(' or ', ', ')}",
        "too_short": f"at least {context.get('min_length')} value(s)",
        "too_long": f"at most {context.get('max_length')} value(s)",
        "string_too_short": "text that is not empty",
        "string_pattern_mismatch": "a name of letters, digits, '_', '-' and '.'",
    }.get(kind, problem["msg"][:1].lower() + problem["msg"][1:])
    quoted = isinstance(found, str) and kind in ("float_type", "int_type", "bool_type")
    return f"expected {expected}, found {_show(found)}.{' Write it without quotes.' if quoted else ''}"


def _show(value: Any) -> str:
    if isinstance(value, BaseModel):
        return "these values together"
    if isinstance(value, str):
        text = f"the text {value!r}"
    elif isinstance(value, bool):
        text = str(value).lower()
    else:
        text = str(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else text[:57] + "..."


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
