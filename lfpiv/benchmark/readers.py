"""Read vectors of any program: NetCDF files of any names and axes, tables as text, single files or a folder of them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
PARTICLE, ROW = "particle", "row"
"""Names of a dimension over particles, and of one over the rows of a table."""
_NUMBER = re.compile(r"(\d+)(?!.*\d)")


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
    """Return the files of a result, in order; raise InputError if there are none, or tables beside NetCDF files."""
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
class _Rows:
    """Vectors of a file, with what it says of them."""

    path: Path
    frame: pd.DataFrame
    """Role -> values, a row for each vector."""
    named: Mapping[str, str]
    """Role -> name."""
    units: Mapping[str, str]
    """Role -> unit, as far as it is stated."""
    attributes: Mapping[str, Any]
    of_particles: bool

    def in_mm(self, roles: Sequence[str], stated: Mapping[str, str], **scale: float) -> np.ndarray:
        """Return some roles [mm], shape (row, role); NaN for marks of missing values.

        `stated` are units that the file does not have; `scale` as in `names.to_mm`.
        """
        values = []
        for role in roles:
            name = self.named[role]
            unit = names.stated_unit(role, name, self.units.get(role), stated, str(self.path))
            values.append(names.to_mm(self.frame[role].to_numpy(float), unit, f"{self.path}: {name}", **scale))
        found = np.stack(values, axis=1)
        return np.where(np.abs(found) < LONGEST_MM, found, np.nan)

    def stated(self, name: str) -> np.ndarray | None:
        """Return the numbers of an attribute, one or more; None without; refuse others."""
        if name not in self.attributes:
            return None
        try:
            found = np.ravel(np.asarray(self.attributes[name], float))
        except (TypeError, ValueError):
            found = np.empty(0)
        if not len(found) or not (np.abs(found) < LARGEST_NUMBER).all():
            value = str(self.attributes[name])[:60]
            raise InputError(f"{self.path}: expected numbers in the attribute {name!r}, found {value!r}.")
        return found


def _read_file(path: Path, truth: Truth, options: ReadOptions, number: int | None) -> list[MeasuredField]:
    """Return the vectors of a file, one field for each pair in it; `number` is the pair by its name."""
    rows = _rows(path, truth, options)
    if names.NUMBER not in rows.frame:
        stated = rows.stated("instant" if "instant" in rows.attributes else "pair")
        if options.number is not None:
            number = options.number
        elif stated is not None:
            number = int(stated[0])
        if number is None:
            raise InputError(
                f"{path}: expected the number of the {truth.noun}, one of {len(truth.numbers)}, found none. State it "
                "by --number N, in the file's name, or as a variable or attribute `pair`."
            )
        rows.frame[names.NUMBER] = number
    of_row = rows.frame[names.NUMBER]
    if not (of_row == of_row.round()).all():
        raise InputError(f"{path}: expected whole numbers in {rows.named[names.NUMBER]!r}, found others.")
    return [_field(replace(rows, frame=part), int(one), truth, options) for one, part in rows.frame.groupby(of_row)]


def _field(rows: _Rows, number: int, truth: Truth, options: ReadOptions) -> MeasuredField:
    """Return the rows of one pair in millimetres."""
    edges = rows.stated("voxel_mm")
    if edges is not None and not (np.allclose(edges, edges[0]) and edges[0] > 0):
        raise InputError(f"{rows.path}: expected the attribute voxel_mm, one edge > 0, found {edges.tolist()}.")
    voxel_mm = truth.voxel_mm if edges is None else float(edges[0])
    scale = {"dt_s": truth.scene.dt_s, "voxel_mm": voxel_mm}
    moved = names.VELOCITY if rows.named.keys() >= set(names.VELOCITY) else names.DISPLACEMENT
    position = rows.in_mm(names.POSITION, options.units)
    told, flag = set(rows.frame) >= set(names.UNCERTAINTY), rows.frame.get(names.VALID)
    is_particles = _are_particles(rows, position, truth, options.kind)
    memory = rows.stated("memory_mib")
    in_voxels = any(rows.units.get(role, "").lower() in names.VOXEL_UNITS for role in moved)
    note = f"no attribute voxel_mm: voxels are taken to be the data set's, {truth.voxel_mm:g} mm"
    return MeasuredField(
        number=number,
        positions_mm=position,
        displacement_mm=rows.in_mm(moved, options.units, **scale),
        valid=np.ones(len(position), bool) if flag is None else flag.to_numpy(float) > 0,
        uncertainty_mm=rows.in_mm(names.UNCERTAINTY, options.units, **scale) if told else None,
        window_mm=None if is_particles else options.window_mm or _window_mm(rows, voxel_mm),
        is_particles=is_particles,
        seconds=_seconds(rows) if options.seconds is None else options.seconds,
        memory_mib=None if memory is None else float(memory[0]),
        notes=(note,) if in_voxels and edges is None else (),
    )


def _are_particles(rows: _Rows, position_mm: np.ndarray, truth: Truth, kind: str) -> bool:
    """Return whether vectors belong to particles: as stated, or because they lie on no lattice."""
    if kind != "auto":
        return kind == "particles"
    finite = np.isfinite(position_mm).all(1)
    scattered = bool(finite.any()) and lattice_of(position_mm[finite], truth.voxel_mm) is None
    return rows.of_particles or scattered


def _window_mm(rows: _Rows, voxel_mm: float) -> Point | None:
    """Return the window that the attributes state, edges (x, y, z)."""
    if (edges := rows.stated("window_mm")) is not None:
        if len(edges) not in (1, 3) or edges.min() <= 0:
            found = edges.tolist()
            raise InputError(f"{rows.path}: expected window_mm, one or three lengths > 0, found {found}.")
        x, y, z = np.broadcast_to(edges, 3).tolist()
        return x, y, z
    try:
        edges = json.loads(rows.attributes["settings"])["windows"][-1]  # of lfpiv, in voxels (z, y, x)
        z, y, x = (float(voxel_mm * edge) for edge in edges)
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return x, y, z


def _seconds(rows: _Rows) -> float | None:
    """Return the stated time; lfpiv states it in two parts."""
    for keys in (("reconstruction_s", "correlation_s"), ("seconds",)):
        if all(key in rows.attributes for key in keys):
            return float(sum(found[0] for key in keys if (found := rows.stated(key)) is not None))
    return None


def load_netcdf(path: Path) -> xr.Dataset:
    """Read a NetCDF file of any program, with the numbers of its axes as they are.

    Raises
    ------
    InputError
        If it cannot be read, or declares far more values than its bytes hold.
    """
    try:
        with xr.open_dataset(path, engine=hdf5.netcdf_engine(path), decode_times=False) as dataset:
            values, size = sum(variable.size for variable in dataset.variables.values()), path.stat().st_size
            if values > LARGEST_IMAGE or 8 * values > SMALL_IMAGE + LARGEST_EXPANSION * size:
                raise ValueError(f"{size:,} bytes declare {values:,} values")
            return dataset.load()
    except Exception as error:  # readers raise whatever they meet
        text = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a NetCDF file, found that it cannot be read ({text}).") from None


def _load_table(path: Path) -> xr.Dataset:
    """Read a table as text, whose first line has the titles of its columns, as variables over rows."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a table as text, found that it cannot be read ({error}).") from None
    first = next((number for number, line in enumerate(lines) if line.strip("# \t,;")), 0)
    head = lines[first] if lines else ""
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
    if not len(frame):
        raise InputError(f"{path}: expected rows below the titles, found none.")
    variables = {}
    for title in titles:
        name, unit = names.split_title(title)
        values = pd.to_numeric(frame[title], errors="coerce").to_numpy(float)
        about = {"units": unit} if unit else {}
        if np.isnan(values).all():
            about["text"] = str(frame[title].iloc[0])
        variables[name] = (ROW, values, about)
    return xr.Dataset(variables)


def _rows(path: Path, truth: Truth, options: ReadOptions) -> _Rows:
    """Return the vectors of a file, whatever the order of its axes."""
    dataset = _load_table(path) if path.suffix.lower() in TABLES else load_netcdf(path)
    numbers = [str(name) for name, variable in dataset.variables.items() if variable.dtype.kind in "fiub"]
    named = names.find_names(numbers, options.names, str(path))
    for name in named.values():
        if (text := dataset[name].attrs.get("text")) is not None and dataset[name].dims == (ROW,):
            raise InputError(f"{path}: expected numbers in the column {name!r}, found {text!r}.")
    places = {dim for role in names.POSITION for dim in dataset[named[role]].dims}
    components = [role for role in named if role in (*names.VELOCITY, *names.DISPLACEMENT)]
    base = places | {dim for role in components for dim in dataset[named[role]].dims}
    named = {role: name for role, name in named.items() if set(dataset[name].dims) <= base}
    further = sorted(str(dim) for dim in base - places)
    if len(further) > 1:
        raise InputError(
            f"{path}: expected one dimension beside those of x, y and z, over pairs or instants, found "
            f"{', '.join(further)}. Write one file for each pair."
        )
    if further and names.NUMBER not in named:
        (along,) = further
        if dataset.sizes[along] > len(truth.numbers):
            most = f"{len(truth.numbers)} {truth.noun}s along {along!r}"
            raise InputError(f"{path}: expected at most {most}, found {dataset.sizes[along]}.")
        dataset = dataset.assign_coords({along: np.array(truth.numbers[: dataset.sizes[along]])})
        named[names.NUMBER] = along
    frame = dataset[list(named.values())].to_dataframe().reset_index()
    units = {role: str(dataset[name].attrs["units"]) for role, name in named.items() if "units" in dataset[name].attrs}
    return _Rows(
        path=path,
        frame=pd.DataFrame({role: frame[name] for role, name in named.items()}),
        named=named,
        units=units,
        attributes=dataset.attrs,
        of_particles=PARTICLE in base,
    )
