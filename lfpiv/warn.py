"""Warnings that outlive the log: said by the logger, and kept by whoever collects them, whatever the logger's level."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

_collected: ContextVar[list[str] | None] = ContextVar("collected", default=None)


def warn(log: logging.Logger, text: str, *values: Any) -> None:
    """Log a warning, and keep its text, once, where somebody collects; `values` are filled in as `logging` does."""
    log.warning(text, *values)
    texts = _collected.get()
    if texts is not None:
        said = text % values if values else text
        if said not in texts:
            texts.append(said)


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """Collect the warnings of a block in a list; a block inside another keeps its own to itself."""
    texts: list[str] = []
    token = _collected.set(texts)
    try:
        yield texts
    finally:
        _collected.reset(token)
