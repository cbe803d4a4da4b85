"""Vector files of a run as one stack: listed without opening them, read and compared with the first one when needed."""

from __future__ import annotations

import contextlib
import json
import os
import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.experiment.pair_range import pair_range
from lfpiv.geometry.grid import AXES
from lfpiv.records import RecordError, read_object
from lfpiv.results import datasets, netcdf, provenance, stored_damping
from lfpiv.velocity.damping import ATTRIBUTE

if TYPE_CHECKING:
    import h5py

COMMON = ("dt_s", "voxel_mm", "smart", "correlation", "settings")
"""Attributes that must be equal in all files."""

PAIR, INSTANT = "pair", "instant"
"""Dimension over the results: of image pairs, and of a time series."""

CHECKED_FILES = 100
"""Largest number of files that are compared with the first one when they are opened; of more, these are spread evenly.
Every file is compared when it is read for the first time."""

NAME = re.compile(r"(pair|instant)_(\d{1,18})\.nc")
"""Name of a file of results: kind and number."""

_LONG_NAMES = {PAIR: "number of the image pair", INSTANT: "number of the first of the two instants"}


class StackedFiles:
    """Vector files of the chosen pairs in the folder of a run, in order.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None.
    left_out : dict, optional
        Given a dictionary, every file is read in whole, files that are damaged or differ from most others are left out,
        and the dictionary gets their paths with the reasons.

    Raises
    ------
    InputError
        If the folder or the pairs do not exist, or a file that is compared does not fit the first one.
    """

    def __init__(
        self,
        folder: Path,
        pairs: tuple[int, int | None] | None = None,
        left_out: dict[Path, str] | None = None,
    ):
        self.folder = folder / "vectors"
        self.dimension, self.numbers, self.width = _listed(folder, pairs)
        if left_out is not None:
            self.numbers = self._fitting(left_out)
        first = netcdf.read_vectors(self.path(0))
        try:
            depends_on = read_object(first.attrs.get("depends_on", "{}"))
        except RecordError as error:
            raise DamagedFile(self.path(0), f"depends_on: {error}") from None
        self.damping = stored_damping.of_vectors(folder / stored_damping.FILE, depends_on)
        """Damping by ghosts of these vectors; None if it was not measured."""
        self.first = first if self.damping is None else self.damping.unbiased(first)
        """Vectors of the first file, the damping taken off beside them."""
        self.names = [
            name
            for name in dict.fromkeys([*netcdf.VECTOR_UNITS, *map(str, self.first.data_vars)])
            if self.first[name].dims == AXES
        ]
        """Names of the variables over z, y, x."""
        self.shape = tuple(self.first.sizes[axis] for axis in AXES)
        self._reference = _read_signature(self.path(0))
        self._compared = bytearray(len(self.numbers))
        self._compared[0] = 1
        last, most = len(self.numbers) - 1, CHECKED_FILES - 1
        for place in range(1, last + 1) if last <= most else {last * k // most for k in range(1, most + 1)}:
            self._compare(place, _read_signature(self.path(place)))

    def _fitting(self, left_out: dict[Path, str]) -> array[int]:
        """Return the numbers of the files that belong to the largest group of equal settings, axes and variables."""
        groups: list[list[tuple[int, Signature]]] = []
        for place, number in enumerate(self.numbers):
            path = self.path(place)
            try:
                netcdf.read_vectors(path)
                signature = _read_signature(path)
            except InputError as error:
                left_out[path] = str(error)
                continue
            for group in groups:
                with contextlib.suppress(InputError):
                    _check_equal(signature, group[0][1])
                    group.append((number, signature))
                    break
            else:
                groups.append([(number, signature)])
        if not groups:
            raise InputError(next(iter(left_out.values())))
        largest = max(groups, key=len)
        for _, signature in (item for group in groups if group is not largest for item in group):
            try:
                _check_equal(signature, largest[0][1])
            except InputError as error:
                left_out[signature.path] = str(error)
        return array("q", [number for number, _ in largest])

    def __len__(self) -> int:
        return len(self.numbers)

    def path(self, place: int) -> Path:
        """Return the path of the file at a place of the stack."""
        return self.folder / f"{self.dimension}_{self.numbers[place]:0{self.width}d}.nc"

    @cached_property
    def coordinates(self) -> dict[str, Any]:
        """Coordinates along the stack: the numbers, and of a time series also the times [s]."""
        numbers = np.array(self.numbers, np.int64)
        known: dict[str, Any] = {
            self.dimension: (self.dimension, numbers, {"long_name": _LONG_NAMES[self.dimension], "units": "1"})
        }
        if self.dimension == INSTANT:
            interval_s = float(self.first.attrs["dt_s"]) / int(self.first.attrs.get("step", 1))
            start_s = float(self.first.attrs.get("time_s", numbers[0] * interval_s))
            times = start_s + (numbers - numbers[0]) * interval_s
            known["time"] = (self.dimension, times, TIME_ATTRIBUTES)
        return known

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes that all files share."""
        names = ("title", "experiment", "step", "error_correlation_voxel", *COMMON)
        return {key: self.first.attrs[key] for key in (*names, ATTRIBUTE) if key in self.first.attrs}

    def read(self, place: int, names: Sequence[str]) -> list[np.ndarray]:
        """Read variables (z, y, x) of one file.

        Raises
        ------
        InputError
            If the file is damaged, or differs from the first one in settings, axes or variables.
        """
        path = self.path(place)
        provenance.require_marks(path)
        with hdf5.opened(path) as file:
            signature = None if self._compared[place] else _signature(file, path)
            found = self._values(file, names)
        if signature is not None:
            self._compare(place, signature)
        for name, values in zip(names, found, strict=True):
            if values.shape != self.shape:
                raise InputError(f"{path}: expected {name} of shape {self.shape}, found {values.shape}.")
        return found

    def _values(self, file: h5py.File, names: Sequence[str]) -> list[np.ndarray]:
        """Return variables of an open file, or those that follow from them."""

        def stored(name: str) -> np.ndarray:
            return np.asarray(file[name][...], self.first[name].dtype)

        if self.damping is None or not set(names) & self.damping.derived:
            return [stored(name) for name in names]
        needed = {name: (AXES, stored(name)) for name in self.damping.sources}
        attributes = {key: self.first.attrs[key] for key in ("voxel_mm", "dt_s")}
        derived = self.damping.unbiased(xr.Dataset(needed, attrs=attributes))
        return [derived[name].values if name in derived else stored(name) for name in names]

    def block(self, first: int, after: int) -> xr.Dataset:
        """Read the files at places `first` to `after` - 1, each once, as a dataset with all variables."""
        stacks = {name: np.empty((after - first, *self.shape), self.first[name].dtype) for name in self.names}
        for place in range(first, after):
            for name, values in zip(self.names, self.read(place, self.names), strict=True):
                stacks[name][place - first] = values
        return self.dataset(stacks, slice(first, after))

    def dataset(self, stacks: Mapping[str, Any], places: slice = slice(None)) -> xr.Dataset:
        """Return a dataset of arrays, one per variable, over a part of the stack."""
        dims = (self.dimension, *AXES)
        variables = {name: xr.Variable(dims, stack, self.first[name].attrs) for name, stack in stacks.items()}
        along = {
            name: (dim, values[places], attributes) for name, (dim, values, attributes) in self.coordinates.items()
        }
        return xr.Dataset(variables, {**along, **{axis: self.first[axis] for axis in AXES}}, self.attributes)

    def _compare(self, place: int, signature: Signature) -> None:
        _check_equal(signature, self._reference)
        self._compared[place] = 1


TIME_ATTRIBUTES = {
    "units": "s",
    "standard_name": "time",
    "axis": "T",
    "long_name": "time of the first of the two instants, after the first instant of the series",
}
"""Attributes of the times of a series, after the CF conventions; a run states no date."""


def _listed(folder: Path, pairs: tuple[int, int | None] | None) -> tuple[str, array[int], int]:
    """Return dimension, numbers in order and digits in the names of the chosen vector files in the folder of a run."""
    vectors = folder / "vectors"
    if not vectors.is_dir():
        what = "no such folder" if not folder.exists() else "a file" if folder.is_file() else "no vectors in it"
        raise InputError(f"{folder}: expected the folder of a finished run (its --out), found {what}.")
    start, stop = pair_range(pairs)
    text = "" if pairs is None else f"{start}:{'' if stop is None else stop}"
    if start < 0 or (stop is not None and stop <= start):
        raise InputError(f"pairs: expected A:B with 0 <= A < B, found {text}.")
    found = {PAIR: array("q"), INSTANT: array("q")}
    with os.scandir(vectors) as entries:
        for entry in entries:
            if (match := NAME.fullmatch(entry.name)) and match[2] == f"{int(match[2]):0{_WIDTHS[match[1]]}d}":
                found[match[1]].append(int(match[2]))
    if all(found.values()):
        raise InputError(
            f"{vectors}: expected vectors of image pairs or of a time series, found both. Move the files of one run "
            "to another folder."
        )
    dimension = INSTANT if found[INSTANT] else PAIR
    known = np.sort(np.array(found[dimension], np.int64))
    chosen = known[(known >= start) & (known < (np.iinfo(np.int64).max if stop is None else stop))]
    if not chosen.size:
        found_text = f"{dimension}s {known[0]} to {known[-1]}" if known.size else "none"
        raise InputError(f"{vectors}: expected finished {dimension}s {text}, found {found_text}.")
    return dimension, array("q", chosen.tolist()), _WIDTHS[dimension]


_WIDTHS = {PAIR: 4, INSTANT: 6}  # digits in the names, see `lfpiv.results.folder`


@dataclass(frozen=True, kw_only=True)
class Signature:
    """Properties of a vector file that all files must share."""

    path: Path
    attributes: dict[str, Any]
    """Attributes of `COMMON`, and as JSON everything that the vectors depend on except the images."""
    axes: dict[str, np.ndarray]
    """Vector positions along z, y, x [mm]."""
    names: set[str]
    """Names of the variables."""


def _read_signature(path: Path) -> Signature:
    """Read the signature of a file without its values."""
    with hdf5.glanced(path) as file:
        return _signature(file, path)


def _signature(file: h5py.File, path: Path) -> Signature:
    datasets.require_schema(file.attrs.get("schema_version", 0), path)
    provenance.require_name(path, file.attrs)
    attributes = {key: file.attrs[key] for key in COMMON if key in file.attrs}
    depends_on = read_object(file.attrs.get("depends_on", "{}"))
    axes = {axis: file[axis][...] for axis in AXES}
    names = set(file) - {*AXES, netcdf.RECONSTRUCTION, netcdf.FIELD}
    shared = {key: value for key, value in depends_on.items() if key not in provenance.OF_PAIR}
    attributes |= {key: json.dumps(value, sort_keys=True) for key, value in shared.items()}
    return Signature(path=path, attributes=attributes, axes=axes, names=names)


def _check_equal(signature: Signature, reference: Signature) -> None:
    """Refuse a file whose settings, axes or variables differ from those of the reference."""
    for key in {**reference.attributes, **signature.attributes}:
        expected, found = reference.attributes.get(key, ""), signature.attributes.get(key, "")
        if not np.array_equal(expected, found):
            raise _unequal(signature, reference, _difference(key, expected, found))
    for axis in AXES:
        if not np.array_equal(signature.axes[axis], reference.axes[axis]):
            raise _unequal(signature, reference, f"other vector positions along {axis}")
    if signature.names != reference.names:
        differing = ", ".join(sorted(signature.names ^ reference.names))
        raise _unequal(signature, reference, f"other variables: {differing}")


def _unequal(signature: Signature, reference: Signature, found: str) -> InputError:
    return InputError(
        f"{signature.path}: expected vectors made as those of {reference.path}, found {found}. "
        "Run `lfpiv run` on all pairs again, or choose pairs that belong together."
    )


def _difference(key: str, expected: Any, found: Any) -> str:
    """Describe the difference of an attribute: the first setting of a JSON object that differs, or the value."""
    try:
        one, other = json.loads(expected), json.loads(found)
        name = next(name for name in {**one, **other} if one.get(name) != other.get(name))
        return f"{key}.{name} = {json.dumps(other.get(name))} instead of {json.dumps(one.get(name))}"
    except (TypeError, ValueError, AttributeError, StopIteration):
        one, other = (np.ravel(value).tolist() for value in (expected, found))
        return f"{key} = {', '.join(map(str, other)) or 'none'} instead of {', '.join(map(str, one)) or 'none'}"
