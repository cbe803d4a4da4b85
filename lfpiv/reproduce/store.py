"""Finished parts of a reproduction on disk: each appears under its name by rename only, and is not computed twice."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
            write_json(path, settings)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{out}: the folder cannot be used ({reason}). Choose another one with --out.") from None
    if before is not None and before != dict(settings):
        name = next(key for key in settings if before.get(key) != settings[key])
        raise InputError(
            f"{out}: expected results of {name} {settings[name]!r}, found those of {before.get(name)!r}. "
            "Choose another --out, or remove the folder."
        )


def kept(path: Path, settings: Mapping[str, Any], compute: Callable[[], Any]) -> Any:
    """Return the JSON-able value of `compute`, from the file where it was computed with the same settings before.

    Parameters
    ----------
    path : Path
        JSON file to keep it in.
    settings : mapping
        What the value depends on, JSON-able.
    compute : callable
        Called where there is no file, or one of other settings.
    """
    settings = jsonable(settings)
    if path.exists():
        content = json.loads(path.read_text("utf-8"))
        if content["settings"] == settings:
            return content["value"]
    value = jsonable(compute())
    write_json(path, {"settings": settings, "value": value})
    return value


def kept_arrays(
    path: Path, settings: Mapping[str, Any], compute: Callable[[], Mapping[str, ArrayLike]]
) -> dict[str, np.ndarray]:
    """Return the named arrays of `compute`, from the .npz file where they were computed with the same settings."""
    text = json.dumps(jsonable(settings), sort_keys=True)
    if path.exists():
        with np.load(path, allow_pickle=False) as data:
            if str(data["settings"]) == text:
                return {name: data[name] for name in data.files if name != "settings"}
    arrays = {name: np.asarray(value) for name, value in compute().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    named: dict[str, Any] = {"settings": text, **arrays}
    with scratch.open("wb") as file:
        np.savez_compressed(file, **named)
    os.replace(scratch, path)
    return arrays


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file by rename."""
    write_bytes(path, (json.dumps(jsonable(value), indent=1) + "\n").encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file by rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    scratch.write_bytes(content)
    os.replace(scratch, path)


def jsonable(value: Any) -> Any:
    """Convert NumPy values, tuples and paths for JSON; NaN and infinity become null."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if isinstance(value, np.generic):
        return jsonable(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
