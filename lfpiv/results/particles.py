"""Tables of linked particles: their NetCDF files, those of a run as one table, and files for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.errors import DamagedFile, InputError
from lfpiv.experiment.pair_range import pair_range
from lfpiv.files import plain
from lfpiv.geometry.names import PARTICLE
from lfpiv.results import datasets, paraview
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
        If a variable or a unit is missing or wrong, or a value is not finite.
    """
    check_columns(table, PARTICLE_UNITS, "particles")
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
    return read_columns(path, PARTICLE_UNITS, "particles")


def read_columns(path: Path, units: Mapping[str, str], what: str) -> xr.Dataset:
    """Read a table into memory, verified; raise InputError if it is damaged or not as `check_columns` wants it."""
    table = datasets.read_group(path)
    try:
        check_columns(table, units, what)
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


def particle_files(folder: Path, pairs: tuple[int, int | None] | None) -> dict[int, Path]:
    """Return the files of the linked particles by pair, in order; raise InputError if there are none."""
    first, last = pair_range(pairs)
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
    known = stated(path, ("found", "linked", "valid_links", "per_microlens", "explained", "crowding", "sigma_voxel"))
    return {} if known is None else {"particles": known}


def stated(path: Path, names: Sequence[str]) -> dict[str, Any] | None:
    """Return the attributes of a file that have some names; None without a file."""
    try:
        stored = datasets.read_attributes(path)
    except (FileNotFoundError, DamagedFile):
        return None
    return {name: plain(stored[name]) for name in names if name in stored}


def write_vtp(table: xr.Dataset, path: Path) -> None:
    """Write a table of particles as VTK poly data: a vertex per particle, for ParaView and pyvista."""
    vectors = {"velocity": "uvw", "displacement": [f"displacement_{axis}" for axis in "xyz"]}
    scalars = ("intensity", "residual", "valid", *(f"uncertainty_{axis}" for axis in "xyz"))
    paraview.write_poly_data(table, path, vectors, scalars, "Verts", np.arange(1, table.sizes[PARTICLE] + 1))
