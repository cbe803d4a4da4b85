"""Score reconstructed volumes of any program: Q and ghosts."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import xarray as xr

from lfpiv import metrics
from lfpiv.benchmark import names
from lfpiv.benchmark.figures import BLOB_VOXEL, MATCH_VOXEL
from lfpiv.benchmark.readers import NETCDF, load_netcdf
from lfpiv.benchmark.truth import Truth
from lfpiv.errors import InputError
from lfpiv.geometry.grid import AXES, Grid

_NAME = re.compile(r"(\d+)(?:_([ab]))?$")
"""Number of the pair or instant, and the frame, at the end of a file's name: pair_0000_a.nc, instant_000003.nc."""


def score_volumes(path: Path, truth: Truth) -> dict[str, list[float]]:
    """Compare volumes with the true particles.

    Parameters
    ----------
    path : Path
        A NetCDF file of one volume, or a folder of them. The end of a name says pair and frame: ``pair_0000_b.nc``;
        of a time series the instant. A name without one is the first frame of the first pair.

    Returns
    -------
    dict
        Key of a figure of `lfpiv.benchmark.figures.VOLUME_FIGURES` -> its value in each volume.

    Raises
    ------
    InputError
        If a file is missing, is no volume, or belongs to no pair.
    """
    if path.is_dir():
        files = sorted(one for one in path.iterdir() if one.suffix.lower() in NETCDF and not one.name.startswith("."))
    else:
        files = [path]
    if not files or not all(one.is_file() for one in files):
        raise InputError(f"{path}: expected NetCDF files of volumes, found none.")
    found: dict[str, list[float]] = {}
    for file in files:
        for key, value in _score_volume(file, truth).items():
            found.setdefault(key, []).append(value)
    return found


def _score_volume(path: Path, truth: Truth) -> dict[str, float]:
    volume = read_volume(path)
    number, frame = _frame(path, truth)
    positions, intensities = truth.frame(number, frame)
    voxel = float(np.median(np.diff(volume["x"].values)))
    z, y, x = (float(volume[axis].values[0]) for axis in AXES)
    nz, ny, nx = volume.shape
    grid = Grid(shape=(nz, ny, nx), voxel_mm=voxel, first_centre_mm=(z, y, x))
    true = metrics.truth_volume(positions, intensities, grid, BLOB_VOXEL * truth.voxel_mm / voxel)
    radius = MATCH_VOXEL * truth.voxel_mm / voxel
    peaks = metrics.particle_quality(volume.values, positions, grid=grid, radius_voxel=radius)
    ghosts = peaks.found_count - peaks.matched_count
    return {
        "quality": metrics.reconstruction_quality(volume.values, true.values),
        "ghost_share": ghosts / peaks.found_count if peaks.found_count else float("nan"),
        "ghosts": ghosts / peaks.true_count,
    }


def _frame(path: Path, truth: Truth) -> tuple[int, int]:
    """Return the pair and the frame, 0 or 1, of a file."""
    match = _NAME.search(path.stem)
    number = int(match[1]) if match else truth.numbers[0]
    if number not in truth.numbers:
        raise InputError(
            f"{path}: expected the volume of {truth.noun} {truth.numbers[0]} to {truth.numbers[-1]}, found {number}."
        )
    return number, 1 if match and match[2] == "b" else 0


def read_volume(path: Path) -> xr.DataArray:
    """Read a volume of cubic voxels, whatever the order of its axes.

    Returns
    -------
    DataArray, shape (z, y, x)
        Light, with the centres of its voxels as coordinates [mm].

    Raises
    ------
    InputError
        If the file cannot be read, or has no single volume of finite numbers on even axes.
    """
    dataset = load_netcdf(path)
    solids = [str(name) for name in dataset.data_vars if set(dataset[name].dims) == set(AXES)]
    if len(solids) != 1:
        found = ", ".join(solids) or "none"
        raise InputError(f"{path}: expected one volume over x, y and z, found {found}.")
    volume = dataset[solids[0]].transpose(*AXES).astype(float)
    places = {}
    for axis in AXES:
        if axis not in volume.coords:
            raise InputError(f"{path}: expected the coordinate {axis} of the voxels, found none.")
        unit = names.stated_unit(axis, axis, volume[axis].attrs.get("units"), {}, str(path))
        places[axis] = names.to_mm(volume[axis].values, unit, f"{path}: {axis}")
    volume = volume.assign_coords(places).sortby(list(AXES))
    steps = np.concatenate([np.diff(volume[axis].values) for axis in AXES])
    if not len(steps) or not np.allclose(steps, np.median(steps), rtol=1e-3) or not np.isfinite(volume.values).all():
        raise InputError(f"{path}: expected finite numbers on cubic voxels, found others.")
    return volume.clip(min=0.0)
