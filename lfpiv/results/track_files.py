"""The table of tracks of a run: its NetCDF file, and files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.geometry.names import PARTICLE
from lfpiv.results import datasets
from lfpiv.results.folder import TRACKS
from lfpiv.results.paraview import write_poly_data
from lfpiv.results.particles import check_columns, read_columns, stated
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
    return read_columns(path, TRACK_UNITS, "tracks")


def track_figures(path: Path) -> dict[str, Any] | None:
    """Return the figures of the tracks for the summary; None without tracks."""
    return stated(path, FIGURES)


def write_track_vtp(table: xr.Dataset, path: Path) -> None:
    """Write the tracks that are not left out as VTK poly data: a line per track, for ParaView and pyvista."""
    table = table.isel({PARTICLE: table["valid"].values})
    ends = np.flatnonzero(np.diff(table["track"].values, append=-1)) + 1
    vectors = {"velocity": "uvw", "acceleration": [f"acceleration_{axis}" for axis in "xyz"]}
    scalars = [name for name in TRACK_UNITS if name.startswith("uncertainty")]
    scalars = ["track", "instant", "time", "intensity", "signal_to_noise", *scalars]
    write_poly_data(table, path, vectors, scalars, "Lines", ends)
