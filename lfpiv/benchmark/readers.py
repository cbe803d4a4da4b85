"""Read vectors of any program: NetCDF files of any names and axes, tables as text, single files or a folder of them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from lfpiv import hdf5
from lfpiv.benchmark import names
from lfpiv.benchmark.measured import MeasuredField, lattice_of
from lfpiv.benchmark.truth import Point, Truth
from lfpiv.errors import InputError
from lfpiv.experiment.readers.limits import LARGEST_IMAGE, SMALL_IMAGE

NETCDF, TABLES = (".nc", ".nc4", ".cdf"), (".csv", ".txt", ".dat", ".tsv")
"""Endings of files that are read."""
LARGEST_EXPANSION = 200
"""Largest size of all values over that of their file; vectors and volumes reach some 50."""
LARGEST_NUMBER = 1e12
"""Magnitude at which a number that a file states of itself is no measurement."""
VECTORS = "vectors"
"""Folder of vectors in the folder of a run."""
LONGEST_MM = 1e6
"""Length at which a position or displacement is a mark for a missing value, such as 1e20 or 1e300 [mm]."""
PARTICLE = "particle"
"""Name of a dimension over particles."""
_NUMBER = re.compile(r"(\d+)(?!.*\d)")
_SECONDS = ("reconstruction_s", "correlation_s"), ("seconds",), ("computing_time_s",)
_MEMORY = ("memory_mib", "peak_memory_mib")


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What the files themselves do not say."""

    names: Mapping[str, str] = field(default_factory=dict)
    """Role of `lfpiv.benchmark.names.ROLES` -> name of a variable or column."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Role, or group of roles -> unit."""
    window_mm: Point | None = None
    """Edges (x, y, z) of the interrogation window [mm]. Default: as the file states."""
    kind: str = "auto"
    """"vectors", "particles", or "auto": scattered vectors are particles."""
    number: int | None = None
    """Number of the pair of a file that does not state it."""
    seconds: float | None = None
    """Computing time of a pair [s]. Default: as the file states."""


def read_result(path: str | Path, truth: Truth, options: ReadOptions | None = None) -> list[MeasuredField]:
    """Read a result: a file, or a folder of files.

    Parameters
    ----------
    path : str or Path
        A NetCDF file, a table as text, a folder of either, or the output folder of ``lfpiv run``.
    truth : Truth
        What is measured: its voxel and its time between frames convert units.
    options : ReadOptions, optional
        Names, units and whatever the files do not say.

    Returns
    -------
    list of MeasuredField
        One for each pair or instant, in order.

    Raises
    ------
    InputError
        If a file cannot be read, a quantity or its unit is missing or ambiguous, or a pair occurs twice or is unknown.
    """
    options = options or ReadOptions()
    fields: dict[int, MeasuredField] = {}
    files = result_files(Path(path))
    numbers = _numbers(files, truth)
    for file in files:
        for one in _read_file(file, truth, options, numbers.get(file)):
            if one.number in fields:
                raise InputError(f"{file}: expected each {truth.noun} once, found {one.number} a second time.")
            if one.number not in truth.numbers and not one.finite.any():
                continue  # the last instants of a series have no partner
            if one.number not in truth.numbers:
                known = f"{truth.numbers[0]} to {truth.numbers[-1]}"
                raise InputError(f"{file}: expected {truth.noun} {known} of the data set, found {one.number}.")
            fields[one.number] = one
    return [fields[number] for number in sorted(fields)]


def result_files(path: Path) -> list[Path]:
    """Return the files of a result, in order.

    Raises
    ------
    InputError
        If there are none, or a folder has tables beside NetCDF files.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InputError(f"{path}: expected a file or a folder of vectors, found nothing of that name.")
    folder = path / VECTORS if (path / VECTORS).is_dir() else path
    inside = sorted(one for one in folder.iterdir() if one.is_file() and not one.name.startswith("."))
    found = [[one for one in inside if one.suffix.lower() in endings] for endings in (NETCDF, TABLES)]
    if all(found):
        raise InputError(
            f"{folder}: expected NetCDF files or tables, found both, such as {found[0][0].name} and "
            f"{found[1][0].name}. State the files of one kind, in a folder of their own."
        )
    files = found[0] or found[1]
    if not files:
        raise InputError(f"{folder}: expected files of vectors ({', '.join(NETCDF + TABLES)}), found none.")
    return sorted(files, key=lambda one: (_number_of(one) is None, _number_of(one) or 0, one.name))


def _number_of(path: Path) -> int | None:
    match = _NUMBER.search(path.stem)
    return int(match[1]) if match else None


def _numbers(files: Sequence[Path], truth: Truth) -> dict[Path, int]:
    """Return the pair of each file by its name; of as many files as pairs that are named otherwise, by their order."""
    found = {file: number for file in files if (number := _number_of(file)) is not None}
    if set(found.values()) <= set(truth.numbers) and len(found) == len(files):
        return found
    if len(files) == len(truth.numbers):
        return dict(zip(files, truth.numbers, strict=True))
    return {} if len(files) == 1 else found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Columns:
    """Values of a file, one row per vector, with what it says of them."""

    path: Path
    values: Mapping[str, np.ndarray]
    """Role -> values, shape (vector,)."""
    named: Mapping[str, str]
    """Role -> name."""
    units: Mapping[str, object]
    """Name -> unit."""
    attributes: Mapping[str, Any]
    of_particles: bool


def _read_file(path: Path, truth: Truth, options: ReadOptions, number: int | None) -> list[MeasuredField]:
    """Return the vectors of a file, one field for each pair in it; `number` is the pair by its name."""
    columns = _read_table(path, options) if path.suffix.lower() in TABLES else _read_netcdf(path, truth, options)
    if names.NUMBER in columns.values:
        of_row = columns.values[names.NUMBER]
        if not np.array_equal(of_row, np.round(of_row)):
            raise InputError(f"{path}: expected whole numbers in {columns.named[names.NUMBER]!r}, found others.")
        of_row = of_row.astype(int)
    else:
        of_row = np.full(len(columns.values["x"]), _stated_number(columns, truth, options, number))
    return [_field(columns, of_row == one, int(one), truth, options) for one in np.unique(of_row)]


def _stated_number(columns: _Columns, truth: Truth, options: ReadOptions, number: int | None) -> int:
    """Return the number of the pair of a file that holds one pair."""
    if options.number is not None:
        return options.number
    for name in ("pair", "instant"):
        if name in columns.attributes:
            return int(_stated(columns, name)[0])
    if number is not None:
        return number
    raise InputError(
        f"{columns.path}: expected the number of the {truth.noun}, one of {len(truth.numbers)}, found none. "
        "State it by --number N, in the file's name, or as a variable or attribute `pair`."
    )


def _field(columns: _Columns, rows: np.ndarray, number: int, truth: Truth, options: ReadOptions) -> MeasuredField:
    """Return the rows of one pair in millimetres."""
    stated = {role: values[rows] for role, values in columns.values.items()}
    voxel_mm, notes = _voxel_mm(columns, truth)

    def mm(role: str, dt_s: float | None, voxel: float | None) -> np.ndarray:
        name = columns.named[role]
        unit = names.stated_unit(role, name, columns.units.get(name), options.units, str(columns.path))
        return names.to_mm(stated[role], unit, f"{columns.path}: {name}", dt_s=dt_s, voxel_mm=voxel)

    moved = names.VELOCITY if all(role in stated for role in names.VELOCITY) else names.DISPLACEMENT

    def along(roles: Sequence[str], *scale: float | None) -> np.ndarray:
        values = np.stack([mm(role, *(scale or (None, None))) for role in roles], axis=1)
        return np.where(np.abs(values) < LONGEST_MM, values, np.nan)

    position = along(names.POSITION)
    displacement = along(moved, truth.scene.dt_s, voxel_mm)
    spread = None
    if all(role in stated for role in names.UNCERTAINTY):
        spread = along(names.UNCERTAINTY, truth.scene.dt_s, voxel_mm)
    flag = stated.get(names.VALID)
    is_particles = options.kind == "particles" or (options.kind == "auto" and columns.of_particles)
    if options.kind == "auto" and not is_particles:
        finite = np.isfinite(position).all(1)
        is_particles = lattice_of(position[finite], truth.voxel_mm) is None and bool(finite.any())
    return MeasuredField(
        number=number,
        positions_mm=position,
        displacement_mm=displacement,
        valid=np.ones(len(position), bool) if flag is None else np.nan_to_num(flag) > 0,
        uncertainty_mm=spread,
        window_mm=None if is_particles else options.window_mm or _window_mm(columns, voxel_mm),
        is_particles=is_particles,
        seconds=options.seconds if options.seconds is not None else _seconds(columns),
        memory_mib=next((float(_stated(columns, name)[0]) for name in _MEMORY if name in columns.attributes), None),
        notes=notes if any(str(unit).lower() in names.VOXEL_UNITS for unit in _used_units(columns, moved)) else (),
    )


def _used_units(columns: _Columns, moved: tuple[str, ...]) -> list[object]:
    return [columns.units.get(columns.named[role]) for role in moved]


def _voxel_mm(columns: _Columns, truth: Truth) -> tuple[float, tuple[str, ...]]:
    """Return the edge of the file's voxel, or that of the data set's with a note."""
    if "voxel_mm" in columns.attributes:
        edges = _stated(columns, "voxel_mm")
        if np.allclose(edges, edges[0]) and edges[0] > 0:
            return float(edges[0]), ()
        raise InputError(f"{columns.path}: expected the attribute voxel_mm, one edge > 0, found {edges.tolist()}.")
    return truth.voxel_mm, (f"no attribute voxel_mm: voxels are taken to be the data set's, {truth.voxel_mm:g} mm",)


def _window_mm(columns: _Columns, voxel_mm: float) -> Point | None:
    """Return the window that the attributes state, edges (x, y, z)."""
    for name in ("window_mm", "interrogation_window_mm"):
        if name in columns.attributes:
            edges = _stated(columns, name)
            if len(edges) not in (1, 3) or edges.min() <= 0:
                raise InputError(f"{columns.path}: expected {name}, one or three lengths > 0, found {edges.tolist()}.")
            x, y, z = np.broadcast_to(edges, 3)
            return float(x), float(y), float(z)
    try:
        edges = json.loads(columns.attributes["settings"])["windows"][-1]  # of lfpiv, in voxels (z, y, x)
        z, y, x = (float(voxel_mm * edge) for edge in edges)
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return x, y, z


def _seconds(columns: _Columns) -> float | None:
    for group in _SECONDS:
        if all(name in columns.attributes for name in group):
            return float(sum(_stated(columns, name)[0] for name in group))
    return None


def _stated(columns: _Columns, name: str) -> np.ndarray:
    """Return the numbers of an attribute, one or more; refuse others."""
    value = columns.attributes[name]
    try:
        found = np.ravel(np.asarray(value, float))
    except (TypeError, ValueError):
        found = np.empty(0)
    if not len(found) or not (np.abs(found) < LARGEST_NUMBER).all():
        raise InputError(f"{columns.path}: expected numbers in the attribute {name!r}, found {str(value)[:60]!r}.")
    return found


def load_netcdf(path: Path) -> xr.Dataset:
    """Read a NetCDF file of any program, with the numbers of its axes as they are.

    Raises
    ------
    InputError
        If it cannot be read, or declares far more values than its bytes hold.
    """
    try:
        hdf5.require_opening(path)
        with xr.open_dataset(path, decode_times=False) as dataset:
            values, size = sum(variable.size for variable in dataset.variables.values()), path.stat().st_size
            if values > LARGEST_IMAGE or 8 * values > SMALL_IMAGE + LARGEST_EXPANSION * size:
                raise ValueError(f"{size:,} bytes declare {values:,} values")
            return dataset.load()
    except Exception as error:  # readers raise whatever they meet
        text = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a NetCDF file, found that it cannot be read ({text}).") from None


def _read_netcdf(path: Path, truth: Truth, options: ReadOptions) -> _Columns:
    """Return the vectors of a NetCDF file, whatever the order of its axes."""
    dataset = load_netcdf(path)
    about = {str(name): dict(dataset[name].attrs) for name in dataset.variables if dataset[name].dtype.kind in "fiub"}
    for name in set(about) & set(map(str, dataset.coords)):
        axis = str(about[name].get("axis", "")).lower()
        if axis in names.POSITION and name.lower() not in names.COMMON_NAMES[axis] and dataset[name].ndim == 1:
            about[name]["standard_name"] = names.STANDARD_NAMES[axis][0]
    named = names.find_names(about, options.names, str(path))
    roles = [role for role in named if role not in (names.NUMBER, names.VALID, *names.UNCERTAINTY)]
    base = {dim for role in roles for dim in dataset[named[role]].dims}
    kept = [role for role in named if set(dataset[named[role]].dims) <= base]
    parts = {role: dataset[named[role]] for role in kept}
    extra = _pair_dimension(path, dataset, named, base)
    if extra is not None and names.NUMBER not in parts:
        count = dataset.sizes[extra]
        if count > len(truth.numbers):
            raise InputError(
                f"{path}: expected at most {len(truth.numbers)} {truth.noun}s along {extra!r}, found {count}."
            )
        parts[names.NUMBER] = xr.DataArray(np.array(truth.numbers[:count]), dims=extra)
        named[names.NUMBER] = extra
    even = xr.broadcast(*(part.drop_vars(list(part.coords)) for part in parts.values()))
    units = {name: stated.get("units") for name, stated in about.items()}
    return _Columns(
        path=path,
        values={role: np.asarray(part.values, float).ravel() for role, part in zip(parts, even, strict=True)},
        named=named,
        units=units,
        attributes=dataset.attrs,
        of_particles=PARTICLE in base,
    )


def _pair_dimension(path: Path, dataset: xr.Dataset, named: Mapping[str, str], base: set[Any]) -> str | None:
    """Return the dimension over pairs, the one that no position has; None if there is none."""
    places = {dim for role in names.POSITION for dim in dataset[named[role]].dims}
    further = sorted(str(dim) for dim in base - places)
    if len(further) > 1:
        raise InputError(
            f"{path}: expected one dimension beside those of x, y and z, over pairs or instants, found "
            f"{', '.join(further)}. Write one file for each pair."
        )
    return further[0] if further else None


def _read_table(path: Path, options: ReadOptions) -> _Columns:
    """Return the vectors of a table as text, whose first line has the titles of its columns."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a table as text, found that it cannot be read ({error}).") from None
    head = next((line for line in lines if line.strip("# \t,;")), "")
    first = lines.index(head) if head else 0
    mark = next((one for one in "\t;," if one in head), r"\s+")
    titles = [title.strip().strip('"') for title in re.split(mark, head.lstrip("# \t"))]
    if len(titles) < 6:
        raise InputError(f"{path}: expected the titles of six or more columns in the first line, found {head[:80]!r}.")
    decimal = "," if mark == ";" and any("," in line for line in lines[first + 1 : first + 3]) else "."
    try:
        frame = pd.read_csv(
            path, sep=mark, skiprows=first + 1, header=None, names=titles, comment="#", decimal=decimal,
            encoding="utf-8", engine="python" if mark == r"\s+" else "c", index_col=False, skipinitialspace=True,
        )  # fmt: skip
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: expected a table of {len(titles)} columns, found otherwise ({error}).") from None
    about: dict[str, dict[str, Any]] = {}
    columns = {}
    for title in titles:
        name, unit = names.split_title(title)
        about[name] = {"units": unit}
        columns[name] = frame[title]
    named = names.find_names(about, options.names, str(path))
    values = {}
    for role, name in named.items():
        values[role] = pd.to_numeric(columns[name], errors="coerce").to_numpy(float)
        if np.isnan(values[role]).all() and len(values[role]):
            raise InputError(f"{path}: expected numbers in the column {name!r}, found {columns[name].iloc[0]!r}.")
    if not len(frame):
        raise InputError(f"{path}: expected rows below the titles, found none.")
    return _Columns(
        path=path,
        values=values,
        named=named,
        units={name: stated["units"] for name, stated in about.items()},
        attributes={},
        of_particles=False,
    )
