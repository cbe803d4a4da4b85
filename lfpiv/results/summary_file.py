"""Write ``summary.json`` with a digest of its entries."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lfpiv import files
from lfpiv.files import writing
from lfpiv.records import digest


def write(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Write ``summary.json``; return its content with the digest."""
    entries = {name: value for name, value in content.items() if name != "digest"}
    written = {**entries, "digest": digest(files.plain(entries))}
    with writing(path):
        files.write_json(written, path)
    return written
