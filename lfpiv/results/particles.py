"""`open_particles`: the linked particles of all pairs of a run as one table, and their files for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import xarray as xr

from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import plain, replacing
from lfpiv.results import netcdf
from lfpiv.results.stacked_files import NAME

FOLDER = "particles"
"""Folder of the tables inside the folder of a run."""


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
        table = netcdf.read_particles(path).drop_vars(netcdf.PARTICLE, errors="ignore")
        kind = path.name.partition("_")[0]
        about = {"units": "1", "long_name": f"number of the {kind}"}
        tables.append(table.assign({kind: (netcdf.PARTICLE, np.full(table.sizes[netcdf.PARTICLE], number), about)}))
    shared = ("title", "dt_s", "voxel_mm", "step")
    first = tables[0].attrs
    result = xr.concat(tables, netcdf.PARTICLE, combine_attrs="drop", join="override")
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
        stored = netcdf.read_attributes(path)
    except (FileNotFoundError, DamagedFile):
        return {}
    kept = ("found", "linked", "valid_links", "per_microlens", "explained", "crowding", "sigma_voxel")
    return {"particles": {name: plain(stored[name]) for name in kept if name in stored}}


def write_csv(table: xr.Dataset, path: Path, digits: int) -> None:
    """Write a table of particles as text, a row per particle, units in the header."""
    names = list(netcdf.PARTICLE_UNITS)
    titles = [name if (unit := netcdf.PARTICLE_UNITS[name]) == "1" else f"{name} [{unit}]" for name in names]
    frame = table.assign(valid=table["valid"].astype(np.uint8)).to_dataframe()
    with replacing(path) as scratch:
        frame.to_csv(scratch, columns=names, header=titles, index=False, float_format=f"%.{digits}g", encoding="utf-8")


def write_vtp(table: xr.Dataset, path: Path) -> None:
    """Write a table of particles as VTK poly data: a vertex per particle, for ParaView and pyvista."""
    count = table.sizes[netcdf.PARTICLE]
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
        _array(data, name, np.stack([table[part].values for part in parts], axis=1))
    for name in ("intensity", "residual", "valid", *(f"uncertainty_{axis}" for axis in "xyz")):
        _array(data, name, table[name].values)
    points = ElementTree.SubElement(piece, "Points")
    _array(points, "position", np.stack([table[axis].values for axis in "xyz"], axis=1))
    vertices = ElementTree.SubElement(piece, "Verts")
    _array(vertices, "connectivity", np.arange(count, dtype=np.int64))
    _array(vertices, "offsets", np.arange(1, count + 1, dtype=np.int64))
    with replacing(path) as scratch:
        ElementTree.ElementTree(root).write(scratch, encoding="utf-8", xml_declaration=True)


def _array(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    """Add an array as text."""
    whole = values.dtype.kind in "iub"
    kind = "Int64" if whole else "Float64"
    about = {"type": kind, "Name": name, "format": "ascii"}
    if values.ndim == 2:
        about["NumberOfComponents"] = str(values.shape[1])
    text: Sequence[str] = [str(int(v)) if whole else f"{v:.9g}" for v in values.ravel()]
    ElementTree.SubElement(parent, "DataArray", about).text = " ".join(text)
