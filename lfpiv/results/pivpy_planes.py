"""Write planes of vectors in the form of pivpy: one NetCDF file per depth, all pairs or instants in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.progress import StepProgress
from lfpiv.results import datasets, stores
from lfpiv.results.stacked_files import INSTANT, TIME_ATTRIBUTES
from lfpiv.velocity import derived

VARIABLES = ("u", "v", "w", "valid", "masked")
"""Variables of the vector files that go into a plane; an export names all others as left out."""

_MM_PER_M = 1000.0


def write_planes(
    results: xr.Dataset,
    depths: np.ndarray,
    target: Path,
    *,
    times: np.ndarray,
    known_interval: bool,
    files: Sequence[str],
    progress: StepProgress,
) -> list[Path]:
    """Write one file per depth.

    Parameters
    ----------
    results : Dataset
        Vectors over pair or instant, z, y, x.
    depths : ndarray
        Places z of the planes [mm].
    target : Path
        Folder to write to.
    times : ndarray
        Time of each pair or instant [s], or the number of the pair where the interval is not known.
    known_interval : bool
        Whether the times of pairs are in seconds. Times of instants always are.
    files : sequence of str
        Names of the vector files, which each plane states as an attribute.
    progress : callable
        Called with the finished fraction.

    Returns
    -------
    list of Path
        The files, in the order of `depths`.
    """
    written = []
    for number, depth in enumerate(depths):
        progress(number / len(depths))
        path = target / f"plane_z{depth:+.3f}mm.nc"
        datasets.write_dataset(_plane(results.sel(z=depth), times, known_interval, files), path)
        written.append(path)
    progress(1.0)
    return written


def _plane(results: xr.Dataset, times: np.ndarray, known_interval: bool, files: Sequence[str]) -> xr.Dataset:
    """Return one plane of vectors in pivpy's form: dimensions y, x, t; velocities in mm/s, as lengths in mm."""
    dims, along = ("y", "x", "t"), next(str(name) for name in results.dims if name not in ("y", "x"))
    variable_of = {"u": "u", "v": "v", "w": "velocity_z"}  # pivpy keeps derived scalars in w
    variables: dict[str, Any] = {}
    for name, variable in variable_of.items():
        values = results[name].transpose("y", "x", along).values.astype(float) * _MM_PER_M
        standard = {"standard_name": f"{name}_velocity"} if name == variable else {}
        text = f"velocity along {derived.COMPONENTS[name]}"
        variables[variable] = (dims, values, {"units": "mm/s", "long_name": text, **standard})
    flags = results["valid"].transpose("y", "x", along).values.astype(float)
    if "masked" in results:
        flags[results["masked"].transpose("y", "x", along).values] = -1
    text = "1: measured, 0: replaced, -1: masked"
    variables["chc"] = (dims, flags, {"standard_name": "validity_flag", "long_name": text})
    time = {"units": "frame", "long_name": "number of the pair"}
    if known_interval:
        time = {"units": "s", "long_name": stores.PAIR_TIME_ATTRIBUTES["long_name"]}
    elif along == INSTANT:
        time = {"units": "s", "long_name": TIME_ATTRIBUTES["long_name"]}
    coordinates = {
        "x": ("x", results["x"].values, {"units": "mm"}),
        "y": ("y", results["y"].values, {"units": "mm"}),
        "t": ("t", times.astype(float), time),
        "z": ((), float(results["z"]), {"units": "mm", "long_name": "depth of the plane"}),
    }
    attributes = {
        "delta_t": float(results.attrs["dt_s"]),
        "files": list(files),
        "pivpy_schema_version": "1",
    }
    return xr.Dataset(variables, coordinates, attributes)
