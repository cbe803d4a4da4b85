"""The keys of experiment and scene files in words, and as JSON Schema: ranges, units, defaults and meanings."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import textwrap
from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

UNITS = {
    "mm": "mm", "um": "µm", "s": "s", "deg": "degree", "px": "pixel", "gib": "GiB", "voxel": "voxel", "bytes": "byte",
}  # fmt: skip
"""Units by the end of a key."""


def json_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON Schema of a file, with the meaning of each key, for editors that complete and check it."""
    schema: dict[str, Any] = model.model_json_schema()
    known = {one.__name__: one for one in tables_of(model)}
    for name, entry in [(model.__name__, schema), *schema.get("$defs", {}).items()]:
        meanings = field_meanings(known[name]) if name in known else {}
        for key, described in entry.get("properties", {}).items():
            described.pop("title", None)
            if key in meanings:
                described["description"] = meanings[key]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def tables_of(model: Any) -> Iterator[type[BaseModel]]:
    """Yield a model, or those in an annotation, and all models in its fields."""
    todo: list[Any] = [model]
    seen: list[Any] = []
    while todo:
        one = todo.pop()
        if isinstance(one, type) and issubclass(one, BaseModel):
            if one in seen:
                continue
            seen.append(one)
            yield one
            todo += [field.annotation for field in one.model_fields.values()]
        else:
            todo += list(get_args(one))


def unit_of(key: str) -> str:
    """Return the unit of a key, which its end names; "" without one."""
    return UNITS.get(key.rpartition("_")[2], "") if "_" in key else ""


def key_rows(model: type[BaseModel]) -> list[tuple[str, str, str, str]]:
    """Key, what it may be, default and meaning of each field of a model that holds a value, no table."""
    schema, meanings = model.model_json_schema(), field_meanings(model)
    definitions, rows = schema.get("$defs", {}), []
    for name, field in model.model_fields.items():
        entry = schema["properties"][name]
        if not _is_table(entry, definitions):
            rows.append((name, _range(entry, definitions), _default(field), meanings.get(name, "")))
    return rows


def field_meanings(model: type[BaseModel]) -> dict[str, str]:
    """Texts below the fields of a model and of the models it derives from."""
    meanings = {}
    for parent in reversed(model.__mro__):
        if not (isinstance(parent, type) and issubclass(parent, BaseModel)) or parent is BaseModel:
            continue
        (table,) = ast.parse(textwrap.dedent(inspect.getsource(parent))).body
        assert isinstance(table, ast.ClassDef)
        for field, text in itertools.pairwise(table.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                meanings[ast.unparse(field.target)] = " ".join(inspect.cleandoc(str(text.value.value)).split())
    return meanings


def _resolved(entry: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    return definitions[entry["$ref"].rpartition("/")[2]] if "$ref" in entry else entry


def _is_table(entry: dict[str, Any], definitions: dict[str, Any]) -> bool:
    entry = _resolved(entry, definitions)
    parts = [*entry.get("anyOf", []), *entry.get("oneOf", [])]
    if isinstance(entry.get("items"), dict):
        parts.append(entry["items"])
    return entry.get("type") == "object" or any(_is_table(part, definitions) for part in parts)


def _range(entry: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Say in words what a JSON schema allows."""
    entry = _resolved(entry, definitions)
    if "anyOf" in entry:
        parts = [_range(part, definitions) for part in entry["anyOf"] if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(parts))
    if "enum" in entry:
        return " or ".join(f"`{json.dumps(value)}`" for value in entry["enum"])
    if "const" in entry:
        return f"`{json.dumps(entry['const'])}`"
    if entry.get("type") == "array":
        return _list_range(entry, definitions)
    words = {"number": "number", "integer": "whole number", "boolean": "`true` or `false`", "string": "text"}
    text = words[entry["type"]]
    bounds = [
        f"{sign} {entry[key]:g}"
        for key, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
        if key in entry
    ]
    return " ".join([text, ", ".join(bounds)]) if bounds else text


def _list_range(entry: dict[str, Any], definitions: dict[str, Any]) -> str:
    if "prefixItems" in entry:
        items = [_range(item, definitions) for item in entry["prefixItems"]]
        return f"[{', '.join(items)}]" if len(set(items)) > 1 else f"{len(items)} values, each {items[0]}"
    least = entry.get("minItems", 0)
    return f"list of {least} or more, each {_range(entry['items'], definitions)}"


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.default if field.default is not PydanticUndefined else field.default_factory()
    if value is None:
        return "absent"
    return f"`{json.dumps(value)}`"
