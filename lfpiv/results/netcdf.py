"""NetCDF files of vectors and volumes: their writers, readers and validator.

A file gets its name when it is complete. So an existing file is a finished result, which a rerun does not repeat.
"""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.files import plain, replacing, write_bytes
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.version import versions

SCHEMA_VERSION = 4
"""Version of the files. 2: the group has its own dimensions. 3: adds ``profile_z``. 4: sealed, and states its name."""

SEALED_SINCE = 4
"""First version whose files are sealed, see `lfpiv.hdf5`."""

FILE = "file"
"""Attribute with the name under which a file was written: a copy under another name is recognised by it."""

VECTOR_UNITS = {
    "u": "m/s",
    "v": "m/s",
    "w": "m/s",
    "displacement_x": "voxel",
    "displacement_y": "voxel",
    "displacement_z": "voxel",
    "valid": "1",
    "peak_ratio": "1",
    "uncertainty": "voxel",
}
"""Variables of a vector dataset and their units."""

PARTICLE = "particle"
"""Dimension of a table of linked particles."""

PARTICLE_UNITS = {
    **dict.fromkeys("xyz", "mm"),
    **dict.fromkeys("uvw", "m/s"),
    **{f"{kind}_{axis}": "voxel" for kind in ("displacement", "uncertainty") for axis in "xyz"},
    "intensity": "counts",
    "residual": "1",
    "valid": "1",
}
"""Variables of a table of linked particles and their units."""

ROUNDING = 1e-5
"""Largest difference between a velocity and its displacement, relative or [voxel]: both have single precision."""

RECONSTRUCTION = "reconstruction"
"""NetCDF group in the file of a pair's vectors: projections, profiles and residuals of its two volumes."""

_GROUP_AXES = {axis: f"voxel_{axis}" for axis in AXES}  # in the file z, y, x are the axes of the vectors
_DESCRIPTIONS: dict[str, dict[str, Any]] = {
    "z": {"axis": "Z"},
    "y": {"axis": "Y"},
    "x": {"axis": "X"},
    "valid": {
        "standard_name": "quality_flag",
        "flag_values": np.array([0, 1], np.int8),
        "flag_meanings": "replaced measured",
    },
    "masked": {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "fluid masked"},
}  # attributes of the CF conventions, for plotting and geometry tools

OF_IMAGES = ("structure", "camera_gain", "light_outside")
"""Figures of each camera's image: correlation of near pixels, brightness relative to the brightest camera, and the
share of its light in pixels that no voxel lights."""


def build_reconstruction(
    volumes: Mapping[str, xr.DataArray], structure: Mapping[str, Mapping[str, float]] | None = None
) -> xr.Dataset:
    """Condense the volumes of a pair to projections, profiles and figures for the report.

    Parameters
    ----------
    volumes : dict
        Frame name -> volume (z, y, x) as `reconstruct` returns it, with its attributes.
    structure : dict, optional
        Frame name -> camera name -> correlation of near pixels of that image. Names the cameras in their order.

    Returns
    -------
    Dataset
        ``projection_z`` (frame, y, x), ``projection_y`` (frame, z, x), ``projection_x`` (frame, z, y) [counts],
        ``profile_z`` (frame, z), the mean brightness of each plane of voxels [counts],
        ``residual`` (frame, iteration), ``stop`` (frame) and, with `structure`, those of `OF_IMAGES` that are known
        (frame, camera).
    """
    frames, first = list(volumes), next(iter(volumes.values()))
    variables: dict[str, tuple[tuple[str, ...], np.ndarray | list[str]]] = {}
    for axis in AXES:
        others = tuple(name for name in AXES if name != axis)
        stack = np.stack([volume.max(axis).transpose(*others).values for volume in volumes.values()])
        variables[f"projection_{axis}"] = (("frame", *others), stack.astype(np.float32))
    profiles = np.stack([volume.mean(["y", "x"], dtype=float).values for volume in volumes.values()])
    variables["profile_z"] = (("frame", "z"), profiles.astype(np.float32))
    histories = [np.atleast_1d(np.asarray(volume.attrs["residual"], float)) for volume in volumes.values()]
    residual = np.full((len(frames), max(map(len, histories))), np.nan)
    for row, history in zip(residual, histories, strict=True):
        row[: len(history)] = history
    variables["residual"] = (("frame", "iteration"), residual)
    variables["stop"] = (("frame",), [str(volume.attrs["stop"]) for volume in volumes.values()])
    coordinates: dict[str, Any] = {"frame": frames}
    if structure and structure[frames[0]]:
        coordinates["camera"] = list(structure[frames[0]])
        rows = np.array([list(structure[frame].values()) for frame in frames], float)
        variables["structure"] = (("frame", "camera"), rows)
        for name in OF_IMAGES:
            if name in first.attrs and name not in variables:
                rows = np.stack([np.atleast_1d(np.asarray(volume.attrs[name], float)) for volume in volumes.values()])
                variables[name] = (("frame", "camera"), rows)
    coordinates |= {axis: (axis, first[axis].values, {"units": "mm"}) for axis in AXES}
    return xr.Dataset(variables, coordinates)


def check_vectors(vectors: xr.Dataset) -> None:
    """Check the form of a vector dataset.

    Raises
    ------
    ValueError
        If a variable, a coordinate, a unit or the attribute ``dt_s`` or ``voxel_mm`` is missing or wrong, or u, v, w do
        not follow from the displacements.
    """
    for axis in AXES:
        if axis not in vectors.coords or vectors[axis].dims != (axis,):
            raise ValueError(f"vectors: expected the coordinate {axis} in mm, found {list(vectors.coords)}.")
        if (unit := vectors[axis].attrs.get("units")) != "mm":
            raise ValueError(f"vectors: expected the coordinate {axis} in mm, found it in {unit or 'no unit'}.")
    for name, unit in VECTOR_UNITS.items():
        if name not in vectors:
            raise ValueError(f"vectors: expected the variable {name!r}, found {list(vectors.data_vars)}.")
        if vectors[name].dims[-3:] != AXES:
            raise ValueError(f"vectors: expected {name!r} over (z, y, x), found {vectors[name].dims}.")
        if vectors[name].attrs.get("units", "1") != unit:
            raise ValueError(f"vectors: expected {name!r} in {unit}, found {vectors[name].attrs.get('units')}.")
    if vectors["valid"].dtype != bool:
        raise ValueError(f"vectors: expected 'valid' to be boolean, found {vectors['valid'].dtype}.")
    dt_s = np.asarray(vectors.attrs.get("dt_s", 0.0))
    if dt_s.shape != () or dt_s.dtype.kind not in "fiu" or not 0 < dt_s < np.inf:
        raise ValueError(f"vectors: expected the attribute dt_s > 0, found {vectors.attrs.get('dt_s')}.")
    voxel_mm = np.asarray(vectors.attrs.get("voxel_mm", ()))
    if voxel_mm.shape != (3,) or voxel_mm.dtype.kind not in "fiu" or not ((voxel_mm > 0) & (voxel_mm < np.inf)).all():
        found = vectors.attrs.get("voxel_mm")
        raise ValueError(f"vectors: expected the attribute voxel_mm, edges (z, y, x) > 0, found {found}.")
    for name, axis, edge_mm in zip("wvu", AXES, voxel_mm, strict=True):
        displacement = vectors[f"displacement_{axis}"].values
        moved = vectors[name].values / (1e-3 * edge_mm / vectors.attrs["dt_s"])
        wrong = ~np.isclose(moved, displacement, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
        if wrong.any():
            raise ValueError(
                f"vectors: expected {name!r} to be 'displacement_{axis}' times voxel_mm / dt_s, found {wrong.sum()} of "
                f"{wrong.size} that are not. Change both, or keep what you derive under another name."
            )
    _check_numbers(vectors)


def _check_numbers(vectors: xr.Dataset) -> None:
    """Refuse axes that do not increase, and valid vectors that are no numbers."""
    for axis in AXES:
        _check_axis(vectors[axis])
    valid = vectors["valid"]
    for name in "uvw":
        values = vectors[name]
        if values.dtype.kind not in "fiu":
            raise ValueError(f"vectors: expected {name!r} to be numbers, found {values.dtype}.")
        if wrong := int((valid & ~np.isfinite(values)).sum()):
            raise ValueError(f"vectors: expected numbers in {name!r} where vectors are valid, {wrong} are not finite.")


def _check_places(vectors: xr.Dataset, grid: Grid) -> None:
    """Refuse vectors beyond the volume, or measured in other voxels."""
    if not np.allclose(vectors.attrs["voxel_mm"], grid.voxel_mm, rtol=1e-6):
        raise ValueError(f"vectors: expected voxels of {grid.voxel_mm:g} mm, found {vectors.attrs['voxel_mm']}.")
    for number, axis in enumerate(AXES):
        places, voxels = vectors[axis].values, grid.axis_mm(number)
        if not (voxels[0] - grid.voxel_mm < places[0] and places[-1] < voxels[-1] + grid.voxel_mm):
            raise ValueError(f"vectors: expected {axis} within the volume, found {places[0]:g} to {places[-1]:g} mm.")


def _check_axis(axis: xr.DataArray) -> None:
    values = axis.values
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all() or not (np.diff(values) > 0).all():
        raise ValueError(f"expected the coordinate {axis.name} to increase from value to value, found it otherwise.")


def _check_voxels(volume: xr.DataArray, grid: Grid) -> None:
    """Refuse a volume at another place than the experiment's."""
    for number, axis in enumerate(AXES):
        if not np.allclose(volume[axis].values, grid.axis_mm(number), rtol=0, atol=1e-3 * grid.voxel_mm):
            raise ValueError(f"volume: its voxels lie at other places along {axis} than those of the experiment.")


def check_volume(volume: xr.DataArray) -> None:
    """Check the form of a volume.

    Raises
    ------
    ValueError
        If it does not lie on axes that increase, or an intensity is no number of 0 or more.
    """
    if volume.dims != AXES:
        raise ValueError(f"volume: expected the dimensions (z, y, x), found {volume.dims}.")
    for axis in AXES:
        if axis in volume.coords:
            _check_axis(volume[axis])
    values = volume.values
    if values.dtype.kind not in "fiu" or not (values.size and np.isfinite(values.min()) and np.isfinite(values.max())):
        raise ValueError("volume: expected finite intensities, found others.")
    if values.min() < 0:
        raise ValueError(f"volume: expected intensities of 0 or more, found {values.min():g}.")


def write_vectors(
    vectors: xr.Dataset, path: Path, *, attributes: Mapping[str, Any], reconstruction: xr.Dataset | None = None
) -> None:
    """Write the vectors of one pair as NetCDF4, atomically.

    Parameters
    ----------
    vectors : Dataset
        Dims z, y, x [mm]; the variables of `VECTOR_UNITS`.
    path : Path
        Target; an existing file is replaced.
    attributes : dict
        Added to the dataset's attributes: settings, their hash, seconds.
    reconstruction : Dataset, optional
        From `build_reconstruction`; stored as the group "reconstruction".

    Raises
    ------
    ValueError
        If the dataset does not have the form that `check_vectors` requires.
    """
    check_vectors(vectors)
    path.parent.mkdir(parents=True, exist_ok=True)
    groups = {"": _packed(vectors, {**attributes, "versions": versions(), FILE: path.name})}
    if reconstruction is not None:
        groups[RECONSTRUCTION] = _packed(reconstruction.rename(_GROUP_AXES), {})
    _write(groups, path)


def read_vectors(path: Path, *, grid: Grid | None = None) -> xr.Dataset:
    """Read the vectors of one pair into memory, verified.

    Parameters
    ----------
    path : Path
    grid : Grid, optional
        The volume, in which the vectors must lie.

    Raises
    ------
    InputError
        If the file is missing, of a newer schema, damaged, or no vector dataset.
    """
    vectors = _read(path, None)
    try:
        check_vectors(vectors)
        if grid is not None:
            _check_places(vectors, grid)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return vectors


def read_reconstruction(path: Path) -> xr.Dataset | None:
    """Read the condensed volumes in the file of a pair's vectors; None if the file has none."""
    try:
        stored = _read(path, RECONSTRUCTION)
    except InputError:
        return None
    return stored.rename({name: axis for axis, name in _GROUP_AXES.items() if name in stored.dims})


def write_volume(volume: xr.DataArray, path: Path, *, attributes: Mapping[str, Any]) -> None:
    """Write one volume (z, y, x) [counts] as NetCDF4, atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    check_volume(volume)
    own = {**attributes, "versions": versions(), FILE: path.name}
    _write({"": _packed(volume.rename("intensity").to_dataset(), own)}, path)


def read_volume(path: Path, *, grid: Grid | None = None) -> xr.DataArray:
    """Read one volume into memory, verified.

    Parameters
    ----------
    path : Path
    grid : Grid, optional
        The voxels that it must have. A file that declares others is not read.

    Raises
    ------
    InputError
        If the file is missing, of a newer schema, damaged, or no volume.
    """
    if grid is not None and path.exists():
        with hdf5.opened(path) as file:
            if (shape := file["intensity"].shape) != grid.shape:
                raise DamagedFile(path, f"it has {shape} voxels, the volume {grid.shape}")
    dataset = _read(path, None)
    if "intensity" not in dataset or dataset["intensity"].dims != AXES:
        raise InputError(f"{path}: expected a volume 'intensity' over (z, y, x), found {list(dataset.data_vars)}.")
    try:
        check_volume(dataset["intensity"])
        if grid is not None:
            _check_voxels(dataset["intensity"], grid)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return dataset["intensity"]


def check_particles(table: xr.Dataset) -> None:
    """Check the form of a table of linked particles.

    Raises
    ------
    ValueError
        If a variable or a unit is missing or wrong, or a value is not finite.
    """
    for name, unit in PARTICLE_UNITS.items():
        if name not in table or table[name].dims != (PARTICLE,):
            raise ValueError(
                f"particles: expected the variable {name!r} over {PARTICLE}, found {list(table.data_vars)}."
            )
        if (found := table[name].attrs.get("units")) != unit:
            raise ValueError(f"particles: expected {name!r} in {unit}, found {found}.")
        if not np.isfinite(table[name].values).all():
            raise ValueError(f"particles: expected finite numbers in {name!r}, found others.")
    if table["valid"].dtype != bool:
        raise ValueError(f"particles: expected 'valid' to be boolean, found {table['valid'].dtype}.")


def write_particles(table: xr.Dataset, path: Path, *, attributes: Mapping[str, Any]) -> None:
    """Write the linked particles of one pair as NetCDF4, atomically.

    Raises
    ------
    ValueError
        If the table does not have the form that `check_particles` requires.
    """
    check_particles(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write({"": _packed(table, {**attributes, "versions": versions(), FILE: path.name})}, path)


def read_particles(path: Path) -> xr.Dataset:
    """Read the linked particles of one pair into memory, verified.

    Raises
    ------
    InputError
        If the file is missing, of a newer schema, damaged, or no table of particles.
    """
    table = _read(path, None)
    try:
        check_particles(table)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return table


def read_attributes(path: Path) -> dict[str, Any]:
    """Read the attributes of a finished NetCDF or HDF5 file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFile
        If it is damaged.
    """
    with hdf5.opened(path, values=False) as file:
        found = dict(file.attrs)
    return {key: value.item() if getattr(value, "size", 0) == 1 else value for key, value in found.items()}


def write_dataset(dataset: xr.Dataset, path: Path, *, attributes: Mapping[str, Any] | None = None) -> None:
    """Write a dataset of any form as NetCDF4, atomically; attributes of other types become JSON.

    Raises
    ------
    OSError
        If the disk has less space than the dataset takes uncompressed: HDF5 does not survive a disk that fills up.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if dataset.nbytes > shutil.disk_usage(path.parent).free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    with replacing(path) as scratch:  # straight to disk: it may be larger than the memory
        _packed(dataset, attributes or {}).to_netcdf(scratch, engine="h5netcdf")
        hdf5.seal(scratch)


def for_file(dataset: xr.Dataset, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return a dataset with the attributes and encodings of a file, for writers that write it in parts."""
    return _packed(dataset, attributes)


def _packed(dataset: xr.Dataset, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return a dataset with the attributes and the compression that it has in a file."""
    dataset = dataset.copy()
    own = {"schema_version": SCHEMA_VERSION, **dataset.attrs, **attributes}
    dataset.attrs = {key: _attribute(value) for key, value in own.items()}
    summed = {"fletcher32": True}
    packed = {**summed, "zlib": True, "complevel": 1, "shuffle": True}
    for name, item in dataset.variables.items():
        described = {**item.attrs, **_DESCRIPTIONS.get(str(name), {})}
        item.attrs = {key: _attribute(value) for key, value in described.items()}
        numbers = item.ndim and item.size and item.dtype.kind in "fiub"
        item.encoding = {} if not numbers else packed if item.ndim >= 2 else summed
    return dataset


def _write(groups: Mapping[str, xr.Dataset], path: Path) -> None:
    """Write datasets as the groups of a NetCDF4 file; "" is its root. It is built in memory: see `write_bytes`."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    content = io.BytesIO()
    with h5netcdf.File(content, "w") as file:
        for group, dataset in groups.items():
            dataset.dump_to_store(H5NetCDFStore(file.create_group(group) if group else file))
    hdf5.seal(content)
    write_bytes(content.getbuffer(), path)


def _attribute(value: Any) -> Any:
    """Return a value as a NetCDF attribute: numbers, lists of numbers and text as they are, all else as JSON."""
    if isinstance(value, (str, int, float, np.number)) and not isinstance(value, bool):
        return value
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) > 0:
        numbers = value if isinstance(value, np.ndarray) else list(value)
        if all(isinstance(item, (int, float, np.number)) and not isinstance(item, bool) for item in numbers):
            return np.asarray(numbers)
    return json.dumps(plain(value))


def _read(path: Path, group: str | None) -> xr.Dataset:
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    try:
        with hdf5.opened(path) as file:
            require_schema(file.attrs.get("schema_version", 0), path)
            _check_flags(file if group is None else file[group], path)
            with h5netcdf.File(file, "r", decode_vlen_strings=True) as opened:  # the verified file, opened once
                dataset = xr.load_dataset(H5NetCDFStore(opened if group is None else opened[group]))
    except FileNotFoundError:
        raise InputError(
            f"{path}: expected a NetCDF file of a run, found no such file. Run the step that writes it."
        ) from None
    dataset.attrs.pop(hdf5.SEALED, None)
    return dataset


def _check_flags(group: Any, path: Path) -> None:
    """Refuse flags other than 0 and 1, which reading as a dataset would hide."""
    for name, item in group.items():
        if item.attrs.get("dtype") == "bool" and not np.isin(item[()], (0, 1)).all():
            raise DamagedFile(path, f"{name!r} holds values other than 0 and 1")


def require_schema(version: Any, path: Path) -> None:
    """Refuse a file of a newer schema, or of none, and one without the seal that its schema has."""
    number = np.ravel(version)
    whole = int(number[0]) if number.size == 1 and number.dtype.kind in "iu" else 0
    if not 1 <= whole <= SCHEMA_VERSION:
        raise InputError(
            f"{path}: expected schema version 1 to {SCHEMA_VERSION}, found {str(version)[:40]}. Update lfpiv."
        )
    if whole >= SEALED_SINCE and not hdf5.is_sealed(path):
        raise DamagedFile(path, "it has no seal: it is cut off, or another program changed it")
