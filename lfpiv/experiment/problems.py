"""Explain why the values of a TOML file do not fit a model: which key, what was expected, what was found.

A message explains the first problem and names the keys of the others. Missing keys are named together.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

SHOWN_KEYS = 5
"""Largest number of further keys that a message names."""
SHOWN_MISSING = 20
"""Largest number of missing keys that a message names together."""
SHOWN_NAME = 60
"""Most characters of a key, a name or a value in a message."""

MISSING, UNKNOWN = "missing", "extra_forbidden"
"""Types of problems, as pydantic names them."""

_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")

Location = tuple[int | str, ...]


def explain(error: ValidationError, model: type[BaseModel], values: Mapping[str, Any]) -> str:
    """Return a message about the problems of the values of a file.

    Parameters
    ----------
    model : type
        The model that the values do not fit.
    values : mapping
        The values as they are in the file.

    Returns
    -------
    str
        ``smart.iterations: expected 1 or more, found 0. Also look at: dt_s.``
    """
    places = _places(error, values)
    first = places[0]
    absent = [place for place in places if place.is_missing_key] if first.is_missing_key else []
    if absent:
        others = [place for place in places if not place.is_missing_key]
        are = "this key is missing. Add it." if len(absent) == 1 else "these keys are missing. Add them."
        explained = f"{_listed(absent, SHOWN_MISSING, values)}: {are}"
    else:
        others, explained = places[1:], f"{_key(first.location, values)}: {first.expectation(model)}"
    return explained + (f" Also look at: {_listed(others, SHOWN_KEYS, values)}." if others else "")


def explain_each(error: ValidationError, model: type[BaseModel], values: Mapping[str, Any]) -> dict[Location, str]:
    """Return what is wrong at each place of a file. Parameters as for `explain`."""
    absent = "this key is missing. Add it."
    places = _places(error, values)
    return {place.location: absent if place.is_missing_key else place.expectation(model) for place in places}


@dataclass(frozen=True)
class _Place:
    """A place of the file and its problems, one for each form that the value could have."""

    location: Location
    """Keys and numbers of list entries in the file."""
    problems: Sequence[Mapping[str, Any]]
    """As pydantic describes them."""

    @property
    def problem(self) -> Mapping[str, Any]:
        """The problem of the first form."""
        return self.problems[0]

    @property
    def kind(self) -> str:
        """Type of the problem, as pydantic names it."""
        return str(self.problem["type"])

    @property
    def is_missing_key(self) -> bool:
        """Whether a key of a table is missing here."""
        return self.kind == MISSING and isinstance(self.problem["loc"][-1], str)

    def expectation(self, model: type[BaseModel]) -> str:
        """Return what was expected here and what was found, as a sentence."""
        problem, found = self.problem, self.problem.get("input")
        if self.kind == UNKNOWN:
            return f"unknown key. {_nearest(problem['loc'], model)}"
        if self.kind == MISSING and isinstance(found, (list, tuple)):
            return f"expected more values, found only {show(found)}."
        if self.kind in ("union_tag_not_found", "union_tag_invalid"):
            return _kind_expected(problem, model)
        if self.kind == "value_error":
            return f"expected {problem['ctx']['error']}, found {show(found)}."
        if brackets := _brackets(problem):
            return brackets
        wanted = list(dict.fromkeys(map(_wanted, self.problems)))
        text = ", ".join(wanted[:-1]) + " or " + wanted[-1] if len(wanted) > 1 else wanted[0]
        return f"expected {text}, found {show(found)}.{_way(self.problems, found)}"


def _places(error: ValidationError, values: Mapping[str, Any]) -> list[_Place]:
    """Group problems by their place; unknown keys come first, as a misspelt key is often also reported as missing."""
    problems = [one for one in error.errors(include_url=False) if not _follows_from_another(one)]
    found: dict[Location, list[Mapping[str, Any]]] = {}
    forms = set()  # places where a value fits none of several forms
    for problem in problems:
        location = _in_file(problem, values)
        found.setdefault(location, []).append(problem)
        if len(problem["loc"]) > len(location):
            forms.add(location)
    deeper = {location[:length] for location in found for length in range(len(location))}
    places = [_Place(at, some) for at, some in found.items() if not (at in forms and at in deeper)]
    return sorted(places, key=lambda place: place.kind != UNKNOWN)


def _brackets(problem: Mapping[str, Any]) -> str:
    """Return what is wrong with a table in the brackets of several, or the other way round; "" for another problem."""
    name, found = problem["loc"][-1], problem.get("input")
    if problem["type"] == "tuple_type" and isinstance(found, Mapping):
        return f"expected tables in two brackets each, [[{name}]], found one in single brackets. Write [[{name}]]."
    several = isinstance(found, list) and all(isinstance(one, Mapping) for one in found)
    if problem["type"] in ("model_type", "model_attributes_type") and several and isinstance(name, str):
        return f"expected one table in single brackets, [{name}], found two brackets, [[{name}]]. Write [{name}]."
    return ""


def _way(problems: Sequence[Mapping[str, Any]], found: Any) -> str:
    """Return advice for a number in quotes, and for decimals with a comma in a list."""
    if isinstance(found, str) and all(one["type"] in ("float_type", "int_type", "bool_type") for one in problems):
        return " Write it without quotes" + (", with a point." if _DECIMAL_COMMA.fullmatch(found.strip()) else ".")
    first = problems[0]
    if (
        first["type"] == "too_long"
        and isinstance(found, (list, tuple))
        and len(found) == 2 * first["ctx"]["max_length"]
    ):
        return " A comma separates values: write decimals with a point, such as 0.5."
    return ""


def _follows_from_another(problem: Mapping[str, Any]) -> bool:
    """Return whether a list is reported as too short only because entries of it have problems of their own."""
    return bool(problem["type"] == "too_short") and len(problem["input"]) >= problem["ctx"]["min_length"]


def _in_file(problem: Mapping[str, Any], values: Any) -> Location:
    """Return the location of a problem in the file, without pydantic's names for the forms of a union."""
    found: list[int | str] = []
    parts = problem["loc"]
    for number, part in enumerate(parts):
        is_absent = problem["type"] == MISSING and number == len(parts) - 1
        if isinstance(part, str) and isinstance(values, Mapping) and (part in values or is_absent):
            found.append(part)
            values = values.get(part)
        elif isinstance(part, int) and isinstance(values, (list, tuple)):
            found.append(part)
            values = values[part] if part < len(values) else None
    return tuple(found)


def _key(location: Location, values: Any) -> str:
    """Return the name of a location: ``camera 'cam1', f_number``, ``smart.iterations`` or ``volume.size_mm[2]``."""
    key = ""
    for part in location:
        if isinstance(part, str):
            shown = short(part)
            key += shown if not key or key.endswith(", ") else f".{shown}"
            values = values.get(part)
        else:
            values = values[part] if part < len(values) else None
            name = values.get("name") if isinstance(values, Mapping) else None
            key += f" {short(name)!r}, " if isinstance(name, str) else f"[{part}]"
    return key.rstrip(", ")


def _listed(places: Sequence[_Place], most: int, values: Any) -> str:
    others = len(places) - most
    keys = dict.fromkeys(_key(place.location, values) for place in places[:most])
    apart = "; " if any("," in key for key in keys) else ", "
    return apart.join(keys) + (f" and {others} more" if others > 0 else "")


def _wanted(problem: Mapping[str, Any]) -> str:
    """Return what a value should have been for one form of it. Bounds are in the unit that the key states."""
    context, found = problem.get("ctx", {}), problem.get("input")
    bound = next((value for name, value in context.items() if name in ("gt", "ge", "lt", "le")), None)
    text = f"{bound:g}" if isinstance(bound, float) else str(bound)
    expected: str = {
        "float_type": "a number",
        "int_type": "a whole number",
        "int_from_float": "a whole number",
        "bool_type": "true or false",
        "string_type": "text in quotes",
        "tuple_type": "a list in brackets",
        "model_type": "a table",
        "model_attributes_type": "a table",
        "finite_number": "a finite number",
        "greater_than": f"a number above {text}",
        "greater_than_equal": f"{text} or more",
        "less_than": f"a number below {text}",
        "less_than_equal": f"{text} or less",
        "literal_error": _one_of(str(context.get("expected"))),
        "too_short": f"at least {context.get('min_length')} value(s)",
        "too_long": f"at most {context.get('max_length')} value(s)",
        "string_too_short": "text that is not empty",
        "string_too_long": f"at most {context.get('max_length')} characters",
        "string_pattern_mismatch": "a name of letters, digits, '_', '-' and '.'",
    }.get(problem["type"], problem["msg"][:1].lower() + problem["msg"][1:])
    least = context.get("ge", 0)
    if isinstance(least, float) and least > 0 and isinstance(found, (int, float)) and found <= 0:
        return "a number above 0"
    return expected


def _one_of(expected: str) -> str:
    """Return the values of a literal, which pydantic lists as ``'a', 'b' or 'c'``."""
    return f"one of {expected.replace(' or ', ', ')}" if " or " in expected else expected


def short(text: str) -> str:
    """Return a text, cut if it is too long for a message."""
    return text if len(text) <= SHOWN_NAME else text[: SHOWN_NAME - 3] + "..."


def show(value: Any) -> str:
    """Return a value of a file as messages show it."""
    if isinstance(value, BaseModel):
        return "these values together"
    if isinstance(value, str):
        text = f"the text {value!r}"
    elif isinstance(value, bool):
        text = str(value).lower()
    else:
        text = str(list(value) if isinstance(value, tuple) else value)
    return short(text)


def _nearest(location: Location, model: type[BaseModel]) -> str:
    """Return advice for an unknown key: the most similar known key, or all keys of its table."""
    tables = _tables(location[:-1], model)
    known = list(tables[0].model_fields) if tables else []
    close = difflib.get_close_matches(str(location[-1]).lower(), known, n=1, cutoff=0.6)
    return f"Did you mean {close[0]!r}?" if close else f"Known here: {', '.join(known)}."


def _kind_expected(problem: Mapping[str, Any], model: type[BaseModel]) -> str:
    """Return what the key that names the form of a table should have been, and what it is."""
    key = problem["ctx"]["discriminator"].strip("'")
    kinds = [repr(kind) for table in _tables(problem["loc"], model) for kind in _literals(table, key)]
    expected = f"expected {key} = {' or '.join(kinds)}"
    table = problem["input"]
    found = show(table[key]) if isinstance(table, Mapping) and key in table else f"a table without {key}"
    return f"{expected}, found {found}."


def _literals(table: type[BaseModel], key: str) -> tuple[Any, ...]:
    return get_args(table.model_fields[key].annotation)


def _tables(location: Location, model: type[BaseModel]) -> list[type[BaseModel]]:
    """Return the models that a location may hold: one, or several forms if the location names none of them."""
    models = [model]
    for part in location:
        if not isinstance(part, str):
            continue
        with_key = [one for one in models if part in one.model_fields]
        if with_key:
            models = list(_models_in(with_key[0].model_fields[part].annotation))
        else:  # pydantic names the form of a table by its kind
            models = [one for one in models if "kind" in one.model_fields and part in _literals(one, "kind")] or models
    return models


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models inside an annotation such as ``tuple[CameraTable, ...]`` or a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)
