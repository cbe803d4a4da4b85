"""NetCDF files of vectors and volumes: their writers, readers and validator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.results import datasets
from lfpiv.version import versions

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

ROUNDING = 1e-5
"""Largest difference between a velocity and its displacement, relative or [voxel]: both have single precision."""

RECONSTRUCTION = "reconstruction"
"""NetCDF group in the file of a pair's vectors: projections, profiles and residuals of its two volumes."""

FIELD = "field"
"""NetCDF group in the file of a pair's vectors: the displacement field of its joint fit."""

_GROUP_AXES = {axis: f"voxel_{axis}" for axis in AXES}  # in the file z, y, x are the axes of the vectors

OF_IMAGES = ("structure", "camera_gain", "light_outside", "light")
"""Figures of each camera's image: correlation of near pixels, brightness relative to the brightest camera, the share of
its light in pixels that no voxel lights, and its light in the other pixels [counts]."""


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
    valid = vectors["valid"].values
    for name in "uvw":
        values = vectors[name].values
        if values.dtype.kind not in "fiu":
            raise ValueError(f"vectors: expected {name!r} to be numbers, found {values.dtype}.")
        if wrong := int((valid & ~np.isfinite(values)).sum()):
            raise ValueError(f"vectors: expected numbers in {name!r} where vectors are valid, {wrong} are not finite.")


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
    """Check a volume; raise ValueError if its axes do not increase, or an intensity is no number of 0 or more."""
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
    vectors: xr.Dataset,
    path: Path,
    *,
    attributes: Mapping[str, Any],
    reconstruction: xr.Dataset | None = None,
    field: xr.Dataset | None = None,
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
    field : Dataset, optional
        From `lfpiv.joint_field`; stored as the group "field".

    Raises
    ------
    ValueError
        If the dataset does not have the form that `check_vectors` requires.
    """
    check_vectors(vectors)
    path.parent.mkdir(parents=True, exist_ok=True)
    groups = {"": datasets.packed(vectors, {**attributes, "versions": versions(), datasets.FILE: path.name})}
    for name, group in ((RECONSTRUCTION, reconstruction), (FIELD, field)):
        if group is not None:
            groups[name] = datasets.packed(group.rename(_GROUP_AXES), {}, root=False)
    datasets.write_groups(groups, path)


def read_vectors(path: Path) -> xr.Dataset:
    """Read the vectors of one pair into memory, verified.

    Raises
    ------
    InputError
        If the file is missing, of another schema, damaged, or no vector dataset.
    """
    vectors = datasets.read_group(path)
    try:
        check_vectors(vectors)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return vectors


def read_reconstruction(path: Path) -> xr.Dataset | None:
    """Read the condensed volumes in the file of a pair's vectors; None if the file has none."""
    return _read_beside(path, RECONSTRUCTION)


def read_field(path: Path) -> xr.Dataset | None:
    """Read the field of a joint fit in the file of a pair's vectors; None if the file has none."""
    return _read_beside(path, FIELD)


def _read_beside(path: Path, group: str) -> xr.Dataset | None:
    try:
        stored = datasets.read_group(path, group)
    except InputError:
        return None
    return stored.rename({name: axis for axis, name in _GROUP_AXES.items() if name in stored.dims})


def write_volume(volume: xr.DataArray, path: Path, *, attributes: Mapping[str, Any]) -> None:
    """Write one volume (z, y, x) [counts] as NetCDF4, atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    check_volume(volume)
    own = {**attributes, "versions": versions(), datasets.FILE: path.name}
    datasets.write_groups({"": datasets.packed(volume.rename("intensity").to_dataset(), own)}, path)


def read_volume(path: Path, *, grid: Grid | None = None) -> xr.DataArray:
    """Read one volume into memory, verified.

    Parameters
    ----------
    grid : Grid, optional
        The voxels that it must have. A file that declares others is not read.

    Raises
    ------
    InputError
        If the file is missing, of another schema, damaged, or no volume.
    """
    if grid is not None and path.exists():
        with hdf5.opened(path) as file:
            if (shape := file["intensity"].shape) != grid.shape:
                raise DamagedFile(path, f"it has {shape} voxels, the volume {grid.shape}")
    dataset = datasets.read_group(path)
    if "intensity" not in dataset or dataset["intensity"].dims != AXES:
        raise InputError(f"{path}: expected a volume 'intensity' over (z, y, x), found {list(dataset.data_vars)}.")
    try:
        check_volume(dataset["intensity"])
        if grid is not None:
            _check_voxels(dataset["intensity"], grid)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    return dataset["intensity"]
