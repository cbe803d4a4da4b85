"""Write files of ParaView: images of point data on an even grid, and collections of files with their times."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pyevtk.hl import imageToVTK
from pyevtk.vtk import VtkGroup

from lfpiv.files import state_origin


def write_image(arrays: dict[str, Any], places: xr.Dataset | xr.DataArray, path: Path) -> None:
    """Write point data on an even grid [mm] as VTK image data."""
    axes = [np.asarray(places[axis], float) for axis in "xyz"]
    steps = [(axis[-1] - axis[0]) / (len(axis) - 1) if len(axis) > 1 else math.nan for axis in axes]
    single = next((step for step in steps if math.isfinite(step)), 1.0)  # thickness of a single layer
    spacing = tuple(float(step if math.isfinite(step) else single) for step in steps)

    def ordered(values: np.ndarray) -> np.ndarray:
        kind = np.uint8 if values.dtype == bool else np.float32
        return np.ascontiguousarray(values, kind).transpose(2, 1, 0)  # VTK order (x, y, z), x fastest

    points = {
        name: tuple(map(ordered, item)) if isinstance(item, tuple) else ordered(item) for name, item in arrays.items()
    }
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as scratch:
        origin = tuple(float(axis[0]) for axis in axes)
        written = imageToVTK(str(Path(scratch) / "image"), origin=origin, spacing=spacing, pointData=points)
        state_origin(Path(written))
        os.replace(written, path)


def write_collection(files: dict[Path, float], path: Path) -> None:
    """Write a ParaView collection of files, with relative paths, and their times."""
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as scratch:
        group = VtkGroup(str(Path(scratch) / "collection"))
        for file, time in files.items():
            group.addFile(str(Path(scratch) / file.name), sim_time=time)
        group.save()
        state_origin(Path(scratch) / "collection.pvd")
        os.replace(Path(scratch) / "collection.pvd", path)
