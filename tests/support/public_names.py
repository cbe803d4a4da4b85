"""Public names of `lfpiv`, as type checkers see them."""

import ast
from pathlib import Path

import lfpiv


def public_names() -> dict[str, str]:
    """Name -> module that it is imported from in the block for type checkers of ``lfpiv/__init__.py``."""
    block = next(node for node in ast.parse(Path(lfpiv.__file__).read_text("utf-8")).body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    return {alias.name: node.module for node in block.body for alias in node.names}


def public_modules() -> set[str]:
    """Names of modules that are public as a whole."""
    return set(public_names()) - set(lfpiv.__all__)
