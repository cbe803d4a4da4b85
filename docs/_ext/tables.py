"""Tables that cannot rot: keys of experiment and scene files, options of the command line, sentences of the warnings.

`key_rows`, `commands`, `help_text` and `warning_rows` need no Sphinx; `setup` registers the directives ``{keys}``,
``{command}`` and ``{warning-list}``.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import io
import itertools
import json
import os
import re
import textwrap
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticUndefined


def find(name: str) -> type[BaseModel]:
    """Return a model by its dotted name."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def key_rows(model: type[BaseModel]) -> list[tuple[str, str, str, str]]:
    """Key, what it may be, default and meaning of each field of a model that holds a value, no table."""
    schema, meanings = model.model_json_schema(), field_meanings(model)
    rows = []
    for name, field in model.model_fields.items():
        entry = schema["properties"][name]
        if _is_table(entry, schema["$defs"] if "$defs" in schema else {}):
            continue
        rows.append((name, _range(entry, schema.get("$defs", {})), _default(field), meanings.get(name, "")))
    return rows


def field_meanings(model: type[BaseModel]) -> dict[str, str]:
    """Texts below the fields of a model and of the models it derives from."""
    meanings = {}
    for parent in reversed(model.__mro__):
        if not (isinstance(parent, type) and issubclass(parent, BaseModel)) or parent is BaseModel:
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(parent))).body[0].body
        for field, text in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                meanings[field.target.id] = " ".join(inspect.cleandoc(text.value.value).split())
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


def commands() -> dict[str, Any]:
    """Return the commands of the command line by name, those of a group by both names."""
    import typer

    from lfpiv.cli.commands import app

    found = {}
    for name, command in typer.main.get_command(app).commands.items():
        inner = getattr(command, "commands", None)
        if not command.hidden:
            found |= {name: command} if inner is None else {f"{name} {own}": inner[own] for own in inner}
    return found


def help_text(name: str) -> str:
    """Return what ``lfpiv NAME --help`` prints, in lines of 100 characters."""
    from lfpiv.cli import commands

    shown, width = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "100"
    try:
        with contextlib.redirect_stdout(shown):
            commands.call([*name.split(), "--help"])
    finally:
        os.environ.pop("COLUMNS")
        if width is not None:
            os.environ["COLUMNS"] = width
    return re.sub(rf"^Usage: .*?\b{name}\b", f"Usage: lfpiv {name}", shown.getvalue().strip())  # whatever program asks


def markdown_table(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table in Markdown."""
    lines = [titles, tuple("---" for _ in titles), *rows]
    return "\n".join("| " + " | ".join(re.sub(r"(?<!\\)\|", r"\\|", cell) for cell in line) + " |" for line in lines)


def keys_markdown(name: str) -> str:
    """Return the table of a model's keys."""
    rows = [(f"`{key}`", allowed, default, meaning) for key, allowed, default, meaning in key_rows(find(name))]
    return markdown_table(("key", "value", "default", "meaning"), rows)


def warning_rows() -> list[tuple[str, str]]:
    """Return the code of each warning and its sentence, figures as dots."""
    from lfpiv.warn import Code
    from lfpiv.warn.sentences import SENTENCES

    rows = []
    for code, sentence in SENTENCES.items():
        if code is not Code.OTHER:
            rows.append((f"`{code.value}`", re.sub(r"\{[^}]*\}", "...", sentence)))
    return rows


def setup(app):
    """Register the directives."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class Keys(SphinxDirective):
        """Table of the keys of a model."""

        required_arguments = 1

        def run(self):
            return self.parse_text_to_nodes(keys_markdown(self.arguments[0]))

    class Command(SphinxDirective):
        """Help of a command."""

        required_arguments = 1
        final_argument_whitespace = True  # a command of a group has two names

        def run(self):
            return [nodes.literal_block(text := help_text(self.arguments[0]), text, language="none")]

    class WarningList(SphinxDirective):
        """Table of the warnings."""

        def run(self):
            return self.parse_text_to_nodes(markdown_table(("code", "says"), warning_rows()))

    app.add_directive("keys", Keys)
    app.add_directive("warning-list", WarningList)
    app.add_directive("command", Command)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
