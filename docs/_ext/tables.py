"""Tables that cannot rot: keys of experiment and scene files, options of the command line, sentences of the warnings.

`written_tables` writes keys and commands into the pages. `setup` registers the directive ``{warning-list}``.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
from typing import Any

from pydantic import BaseModel

from lfpiv.settings.keys import key_rows


def find(name: str) -> type[BaseModel]:
    """Return a model by its dotted name."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


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
    """Register the directive."""
    from sphinx.util.docutils import SphinxDirective

    class WarningList(SphinxDirective):
        """Table of the warnings."""

        def run(self):
            return self.parse_text_to_nodes(markdown_table(("code", "says"), warning_rows()))

    app.add_directive("warning-list", WarningList)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
