"""The table of tracks of a run: its NetCDF file, and files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import xarray as xr

from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import plain, replacing, state_origin
from lfpiv.geometry.names import PARTICLE
from lfpiv.results import datasets
from lfpiv.results.folder import TRACKS
from lfpiv.results.particles import add_array, check_columns, write_columns
from lfpiv.results.provenance import Stamp
from lfpiv.version import versions

TRACK_UNITS = {
    "track": "1",
    "instant": "1",
    "time": "s",
    **dict.fromkeys("xyz", "mm"),
    **dict.fromkeys("uvw", "m/s"),
    **{f"acceleration_{axis}": "m/s2" for axis in "xyz"},
    **{f"uncertainty_{axis}": "voxel" for axis in "xyz"},
    **{f"uncertainty_{name}": "m/s" for name in "uvw"},
    **{f"uncertainty_acceleration_{axis}": "m/s2" for axis in "xyz"},
    **{f"found_{axis}": "mm" for axis in "xyz"},
    "intensity": "counts",
    "signal_to_noise": "1",
    "track_length": "1",
    "valid": "1",
    "reason": "1",
}
"""Variables of a table of tracks and their units."""
FIGURES = ("tracks", "rows", "left_out", "acceleration_voxel", "memory_instants", "error_factor")
"""Attributes that the summary states."""


def write_tracks(table: xr.Dataset, path: Path, *, stamp: Stamp) -> None:
    """Write the tracks of a run as NetCDF4, atomically.

    Raises
    ------
    ValueError
        If a variable or a unit is missing or wrong, or a value is not finite.
    """
    check_columns(table, TRACK_UNITS, "tracks")
    counted = {
        "rows": int(table["valid"].sum()),
        "left_out": len(np.unique(table["track"].values[~table["valid"].values])),
    }
    own = {**counted, **stamp.attributes, "versions": versions(), datasets.FILE: path.name}
    datasets.write_groups({"": datasets.packed(table, own)}, path)


def open_tracks(folder: str | Path) -> xr.Dataset:
    """Read the tracks of single particles in the folder of a run on a time series.

    Parameters
    ----------
    folder : str or Path
        Output folder of `lfpiv run`.

    Returns
    -------
    Dataset
        Over ``particle``, a row for each particle that was found at an instant, by ``track`` and then in time. Rows of
        tracks that are left out are there too: ``valid`` is false, and ``reason`` says why.

    Raises
    ------
    InputError
        If there are no tracks, or the file is damaged.
    """
    path = Path(folder) / TRACKS
    if not path.is_file():
        raise InputError(
            f"{path}: expected the tracks of a time series, found none. State [tracking] and a series (instants) in "
            "the experiment file, and run `lfpiv run`."
        )
    table = datasets.read_group(path)
    try:
        check_columns(table, TRACK_UNITS, "tracks")
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return table


def track_figures(path: Path) -> dict[str, Any] | None:
    """Return the figures of the tracks for the summary; None without tracks."""
    try:
        stored = datasets.read_attributes(path)
    except (FileNotFoundError, DamagedFile):
        return None
    return {name: plain(stored[name]) for name in FIGURES if name in stored}


def write_track_csv(table: xr.Dataset, path: Path, digits: int) -> None:
    """Write the tracks as text, a row per particle and instant, units in the header."""
    write_columns(table, path, TRACK_UNITS, digits)


def write_track_vtp(table: xr.Dataset, path: Path) -> None:
    """Write the tracks that are not left out as VTK poly data: a line per track, for ParaView and pyvista."""
    table = table.isel({PARTICLE: table["valid"].values})
    count = table.sizes[PARTICLE]
    ends = np.flatnonzero(np.diff(table["track"].values, append=-1)) + 1
    root = ElementTree.Element("VTKFile", type="PolyData", version="0.1", byte_order="LittleEndian")
    whole = ElementTree.SubElement(root, "PolyData")
    sizes = {"Points": count, "Verts": 0, "Lines": len(ends), "Strips": 0, "Polys": 0}
    piece = ElementTree.SubElement(whole, "Piece", {f"NumberOf{name}": str(size) for name, size in sizes.items()})
    data = ElementTree.SubElement(piece, "PointData", Vectors="velocity")
    for name, parts in (("velocity", "uvw"), ("acceleration", [f"acceleration_{axis}" for axis in "xyz"])):
        add_array(data, name, np.stack([table[part].values for part in parts], axis=1))
    scalars = [name for name in TRACK_UNITS if name.startswith("uncertainty")]
    for name in ("track", "instant", "time", "intensity", "signal_to_noise", *scalars):
        add_array(data, name, table[name].values)
    points = ElementTree.SubElement(piece, "Points")
    add_array(points, "position", np.stack([table[axis].values for axis in "xyz"], axis=1))
    lines = ElementTree.SubElement(piece, "Lines")
    add_array(lines, "connectivity", np.arange(count, dtype=np.int64))
    add_array(lines, "offsets", ends.astype(np.int64))
    with replacing(path) as scratch:
        ElementTree.ElementTree(root).write(scratch, encoding="utf-8", xml_declaration=True)
        state_origin(scratch)
