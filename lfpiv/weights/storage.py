"""Weights as files that several processes map into their memory, so that a machine holds them once.

A folder has one ``.npy`` file per array and the header ``weights.json``, which is written last. Pages of the files are
read when a kernel reads them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv import files
from lfpiv.errors import InputError
from lfpiv.files import writing
from lfpiv.geometry.grid import Grid
from lfpiv.weights.forms.table import form_named, form_of
from lfpiv.weights.memory_left import MemoryLeft
from lfpiv.weights.operator import Weights
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.weight_blocks import BlockRows
from lfpiv_kernels.weights.microimages import Microimages

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

SCHEMA_VERSION = 6
_HEADER = "weights.json"
_HASHED_BYTES = 1 << 24
"""Size of the pieces in which arrays are hashed [byte]."""


def save_weights(weights: Weights, folder: Path) -> str:
    """Write weights into a folder. Its files are replaced if they exist.

    Parameters
    ----------
    weights : Weights
        From `build_weights`. Weights that are not counted yet are counted first.
    folder : Path
        Target.

    Returns
    -------
    str
        Hash of the content, for `open_weights`.

    Raises
    ------
    StorageError
        If the folder cannot be written or the disk is full.
    """
    digest = hashlib.blake2b(digest_size=16)
    projectors = [weights.projector(name) for name in weights.cameras]

    def put(name: str, value: Any) -> Any:
        """Write an array, or the arrays of a dataclass; return its entry of the header."""
        if dataclasses.is_dataclass(value):
            return {
                field.name: put(f"{name}.{field.name}", getattr(value, field.name))
                for field in dataclasses.fields(value)
            }
        if not isinstance(value, np.ndarray):
            return value
        array = np.ascontiguousarray(value)
        np.save(folder / f"{name}.npy", array)
        _add(digest, f"{name}.npy", array)
        return f"{name}.npy"

    with writing(folder / _HEADER):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _HEADER).unlink(missing_ok=True)
        header = {
            "schema_version": SCHEMA_VERSION,
            "grid": dataclasses.asdict(weights.grid),
            "order": weights.stored.order,
            "method": weights.method,
            "camera_sums": put("camera_sums", weights.camera_sums),
            "cameras": {
                name: [form_of(one).__name__, *(put(f"camera{number}.{k}", part) for k, part in enumerate(one.parts))]
                for number, (name, one) in enumerate(zip(weights.cameras, projectors, strict=True))
            },
        }
        content = digest.hexdigest()
        files.write_json(header | {"content": content}, folder / _HEADER)
    return content


def open_weights(folder: Path, cameras: Mapping[str, CalibratedCamera], content: str | None = None) -> Weights:
    """Map the weights of a folder into memory, read-only.

    Parameters
    ----------
    folder : Path
        Folder that `save_weights` wrote.
    cameras : mapping of str to CalibratedCamera
        The cameras that the weights were built for.
    content : str, optional
        Hash that `save_weights` returned. The arrays are read once to compare it. Without it they are not verified.

    Raises
    ------
    InputError
        If the folder holds no complete weights, or those of other cameras or of another content.
    """
    path = folder / _HEADER
    try:
        header = json.loads(path.read_text("utf-8"))
        if header["schema_version"] != SCHEMA_VERSION:
            raise ValueError(f"schema version {header['schema_version']}")
        if list(header["cameras"]) != list(cameras):
            raise ValueError(f"cameras {', '.join(header['cameras'])}")
        grid = Grid(**{name: _tuple(value) for name, value in header["grid"].items()})
        arrays: dict[str, np.ndarray] = {}
        camera_sums = _map(folder, header["camera_sums"], arrays)
        forms, parts = {}, {}
        for name, (kind, *entries) in header["cameras"].items():
            forms[name] = form_named(kind)
            pairs = zip(forms[name].parts, entries, strict=True)
            parts[name] = [_take(one, folder, entry, arrays) for one, entry in pairs]
        if content not in (None, _content(arrays)):
            raise ValueError("weights of another run")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: expected the weights of this run, found none that fit ({error}).") from None
    stored = StoredGrid(grid, _tuple(header["order"]))
    memory = MemoryLeft(cameras.values(), grid)
    projectors = {name: forms[name].load(name, own, cameras, memory) for name, own in parts.items()}
    return Weights(stored, cameras, projectors, header["method"], camera_sums=np.array(camera_sums))


def _content(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the hash of arrays by the names of their files."""
    digest = hashlib.blake2b(digest_size=16)
    for name, array in arrays.items():
        _add(digest, name, array)
    return digest.hexdigest()


def _add(digest: Any, name: str, array: np.ndarray) -> None:
    """Add an array and the name of its file to a hash, piece by piece."""
    digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
    content = array.reshape(-1).view(np.uint8)
    for first in range(0, len(content), _HASHED_BYTES):
        digest.update(content[first : first + _HASHED_BYTES].tobytes())


_PARTS = {"microimages": Microimages, "rows": BlockRows}
"""Fields of `Blocks` that are dataclasses."""


def _take(kind: type, folder: Path, entry: Mapping[str, Any], arrays: dict[str, np.ndarray]) -> Any:
    """Make a dataclass from its entry of the header; arrays stay in their files, and are noted in `arrays`."""
    values = {}
    for field in dataclasses.fields(kind):
        value = entry[field.name]
        if isinstance(value, dict):
            values[field.name] = _take(_PARTS[field.name], folder, value, arrays)
        elif isinstance(value, str) and value.endswith(".npy"):
            values[field.name] = _map(folder, value, arrays)
        else:
            values[field.name] = _tuple(value)
    return kind(**values)


def _map(folder: Path, name: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
    if Path(name).name != name:
        raise ValueError(f"a file {name!r} elsewhere")
    try:
        array: np.ndarray = np.load(folder / name, mmap_mode="r", allow_pickle=False)
    except ValueError:  # an empty array cannot be mapped
        array = np.load(folder / name, allow_pickle=False)
    arrays[name] = np.asarray(array)
    return arrays[name]


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
