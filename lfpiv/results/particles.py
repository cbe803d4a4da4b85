"""Tables of linked particles: their NetCDF files, those of a run as one table, and files for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import xarray as xr

from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import plain, replacing, state_origin
from lfpiv.geometry.names import PARTICLE
from lfpiv.results import datasets
from lfpiv.results.stacked_files import NAME
from lfpiv.version import versions

FOLDER = "particles"
"""Folder of the tables inside the folder of a run."""

PARTICLE_UNITS = {
    **dict.fromkeys("xyz", "mm"),
    **dict.fromkeys("uvw", "m/s"),
    **{f"{kind}_{axis}": "voxel" for kind in ("displacement", "uncertainty") for axis in "xyz"},
    "intensity": "counts",
    "residual": "1",
    "valid": "1",
}
"""Variables of a table of linked particles and their units."""


def check_particles(table: xr.Dataset) -> None:
    """Check the form of a table of linked particles.

    Raises
    ------
    ValueError
        If a variable or a unit is missing or wrong, or a value is not finite.
    """
    check_columns(table, PARTICLE_UNITS, "particles")


def check_columns(table: xr.Dataset, units: Mapping[str, str], what: str) -> None:
    """Check that a table has finite variables with their units, and which of its rows are valid.

    Raises
    ------
    ValueError
        If not; the message begins with `what` the table holds.
    """
    for name, unit in units.items():
        if name not in table or table[name].dims != (PARTICLE,):
            raise ValueError(f"{what}: expected the variable {name!r} over {PARTICLE}, found {list(table.data_vars)}.")
        if (found := table[name].attrs.get("units")) != unit:
            raise ValueError(f"{what}: expected {name!r} in {unit}, found {found}.")
        if not np.isfinite(table[name].values).all():
            raise ValueError(f"{what}: expected finite numbers in {name!r}, found others.")
    if table["valid"].dtype != bool:
        raise ValueError(f"{what}: expected 'valid' to be boolean, found {table['valid'].dtype}.")


def write_particles(table: xr.Dataset, path: Path, *, attributes: Mapping[str, Any]) -> None:
    """Write the linked particles of one pair as NetCDF4, atomically.

    Raises
    ------
    ValueError
        If the table does not have the form that `check_particles` requires.
    """
    check_particles(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    own = {**attributes, "versions": versions(), datasets.FILE: path.name}
    datasets.write_groups({"": datasets.packed(table, own)}, path)


def read_particles(path: Path) -> xr.Dataset:
    """Read the linked particles of one pair into memory, verified.

    Raises
    ------
    InputError
        If the file is missing, of a newer schema, damaged, or no table of particles.
    """
    table = datasets.read_group(path)
    try:
        check_particles(table)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return table


def open_particles(folder: str | Path, *, pairs: tuple[int, int | None] | None = None) -> xr.Dataset:
    """Read the linked particles of all finished pairs in the folder of a run.

    Parameters
    ----------
    folder : str or Path
        Output folder of `lfpiv run`.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None.

    Returns
    -------
    Dataset
        The variables of the particle files over ``particle``, one pair after the other. The variable ``pair``, of a
        time series ``instant``, is the number of each particle's pair. Attributes: ``dt_s``, ``voxel_mm``, and ``step``
        of a series.

    Raises
    ------
    InputError
        If there are no particles, or a file is damaged.
    """
    files = particle_files(Path(folder), pairs)
    tables = []
    for number, path in files.items():
        table = read_particles(path).drop_vars(PARTICLE, errors="ignore")
        kind = path.name.partition("_")[0]
        about = {"units": "1", "long_name": f"number of the {kind}"}
        tables.append(table.assign({kind: (PARTICLE, np.full(table.sizes[PARTICLE], number), about)}))
    shared = ("title", "dt_s", "voxel_mm", "step")
    first = tables[0].attrs
    result = xr.concat(tables, PARTICLE, combine_attrs="drop", join="override")
    return result.assign_attrs({name: first[name] for name in shared if name in first})


def particle_files(folder: Path, pairs: tuple[int, int | None] | None = None) -> dict[int, Path]:
    """Return the files of the linked particles by pair, in order.

    Raises
    ------
    InputError
        If there are none.
    """
    first, last = (0, None) if pairs is None else pairs
    found = {}
    for path in sorted((folder / FOLDER).glob("*.nc")):
        match = NAME.fullmatch(path.name)
        if match and int(match[2]) >= first and (last is None or int(match[2]) < last):
            found[int(match[2])] = path
    if not found:
        raise InputError(
            f"{folder / FOLDER}: expected linked particles, found none. State the table [tracking] in the experiment "
            "file and run `lfpiv run`."
        )
    return dict(sorted(found.items()))


def figures(path: Path) -> dict[str, Any]:
    """Return the figures of a pair's linked particles as entry ``particles`` of the summary; none without a file."""
    try:
        stored = datasets.read_attributes(path)
    except (FileNotFoundError, DamagedFile):
        return {}
    kept = ("found", "linked", "valid_links", "per_microlens", "explained", "crowding", "sigma_voxel")
    return {"particles": {name: plain(stored[name]) for name in kept if name in stored}}


def write_csv(table: xr.Dataset, path: Path, digits: int) -> None:
    """Write a table of particles as text, a row per particle, units in the header."""
    write_columns(table, path, PARTICLE_UNITS, digits)


def write_columns(table: xr.Dataset, path: Path, units: Mapping[str, str], digits: int) -> None:
    """Write the variables of a table that have units as text, a row per particle, units in the header."""
    titles = [name if unit == "1" else f"{name} [{unit}]" for name, unit in units.items()]
    frame = table.assign(valid=table["valid"].astype(np.uint8)).to_dataframe()
    with replacing(path) as scratch:
        form = f"%.{digits}g"
        frame.to_csv(scratch, columns=list(units), header=titles, index=False, float_format=form, encoding="utf-8")


def write_vtp(table: xr.Dataset, path: Path) -> None:
    """Write a table of particles as VTK poly data: a vertex per particle, for ParaView and pyvista."""
    count = table.sizes[PARTICLE]
    root = ElementTree.Element("VTKFile", type="PolyData", version="0.1", byte_order="LittleEndian")
    sizes = {
        "NumberOfPoints": count,
        "NumberOfVerts": count,
        "NumberOfLines": 0,
        "NumberOfStrips": 0,
        "NumberOfPolys": 0,
    }
    whole = ElementTree.SubElement(root, "PolyData")
    piece = ElementTree.SubElement(whole, "Piece", {name: str(size) for name, size in sizes.items()})
    data = ElementTree.SubElement(piece, "PointData", Vectors="velocity")
    for name, parts in (("velocity", "uvw"), ("displacement", [f"displacement_{axis}" for axis in "xyz"])):
        add_array(data, name, np.stack([table[part].values for part in parts], axis=1))
    for name in ("intensity", "residual", "valid", *(f"uncertainty_{axis}" for axis in "xyz")):
        add_array(data, name, table[name].values)
    points = ElementTree.SubElement(piece, "Points")
    add_array(points, "position", np.stack([table[axis].values for axis in "xyz"], axis=1))
    vertices = ElementTree.SubElement(piece, "Verts")
    add_array(vertices, "connectivity", np.arange(count, dtype=np.int64))
    add_array(vertices, "offsets", np.arange(1, count + 1, dtype=np.int64))
    with replacing(path) as scratch:
        ElementTree.ElementTree(root).write(scratch, encoding="utf-8", xml_declaration=True)
        state_origin(scratch)


def add_array(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    """Add an array to an element of a VTK file, as text."""
    whole = values.dtype.kind in "iub"
    kind = "Int64" if whole else "Float64"
    about = {"type": kind, "Name": name, "format": "ascii"}
    if values.ndim == 2:
        about["NumberOfComponents"] = str(values.shape[1])
    text: Sequence[str] = [str(int(v)) if whole else f"{v:.9g}" for v in values.ravel()]
    ElementTree.SubElement(parent, "DataArray", about).text = " ".join(text)
