"""Store finished parts of a study on disk, so that none is computed twice. Files are written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lfpiv import files
from lfpiv.errors import InputError


def open_folder(out: Path, settings: Mapping[str, Any]) -> None:
    """Make the folder, or check that it can be written and holds results of the same settings.

    Raises
    ------
    InputError
        If it cannot be written, or was made with other settings.
    """
    path = out / "work" / "settings.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        before = json.loads(path.read_text("utf-8")) if path.exists() else None
        if before is None:
            files.write_json(settings, path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{out}: the folder cannot be used ({reason}). Choose another one with --out.") from None
    if before is not None and before != dict(settings):
        name = next(key for key in settings if before.get(key) != settings[key])
        raise InputError(
            f"{out}: expected results of {name} {settings[name]!r}, found those of {before.get(name)!r}. "
            "Choose another --out, or remove the folder."
        )


def cached(path: Path, settings: Mapping[str, Any], compute: Callable[[], Any]) -> Any:
    """Return the JSON-able value of `compute`, from its file if that has the same settings.

    Parameters
    ----------
    path : Path
        JSON file of the value.
    settings : mapping
        Everything that the value depends on, JSON-able.
    compute : callable
        Called if there is no file, or one with other settings.
    """
    settings = files.plain(settings)
    if path.exists():
        content = json.loads(path.read_text("utf-8"))
        if content["settings"] == settings:
            return content["value"]
    value = files.plain(compute())
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_json({"settings": settings, "value": value}, path)
    return value


def cached_arrays(
    path: Path, settings: Mapping[str, Any], compute: Callable[[], Mapping[str, ArrayLike]]
) -> dict[str, np.ndarray]:
    """Return the named arrays of `compute`, from their .npz file if that has the same settings."""
    text = json.dumps(files.plain(settings), sort_keys=True)
    if path.exists():
        with np.load(path, allow_pickle=False) as data:
            if str(data["settings"]) == text:
                return {name: data[name] for name in data.files if name != "settings"}
    arrays = {name: np.asarray(value) for name, value in compute().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    named: dict[str, Any] = {"settings": text, **arrays}
    with files.replacing(path) as scratch, scratch.open("wb") as file:
        np.savez_compressed(file, **named)
    return arrays
