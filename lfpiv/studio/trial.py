"""Measure one pair with other settings on coarser voxels, in a process of its own: ``python -m lfpiv.studio.trial``.

It reads a request as JSON from standard input, writes the vectors to the folder that the request names, and prints
figures as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from pydantic import BaseModel, ValidationError

import lfpiv
from lfpiv.calibration.camera import Calibration
from lfpiv.errors import InputError
from lfpiv.experiment import problems
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.results import netcdf
from lfpiv.results.folder import Folder
from lfpiv.runs import guard
from lfpiv.runs.frame_light import pair_light, read_darks
from lfpiv.runs.pair_vectors import measure_vectors
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.settings.processing import Correlation, Smart

Settings = TypeVar("Settings", bound=BaseModel)


def with_settings(experiment: Experiment, coarser: float, changed: dict[str, dict[str, Any]]) -> Experiment:
    """Return an experiment on voxels that are some times as long, with some settings of SMART and correlation changed.

    Particles are smaller than coarse voxels. So their size and the cap, where these are to be measured, are left out.
    """
    grid = experiment.grid
    edge = grid.voxel_mm * coarser
    x, y, z = (max(n * grid.voxel_mm, 4 * edge) for n in grid.shape[::-1])
    cx, cy, cz = grid.centre_mm.tolist()
    coarse = Grid.from_extent(centre_mm=(cx, cy, cz), size_mm=(x, y, z), voxel_mm=edge)
    stated = experiment.smart.model_dump() | changed.get("smart", {})
    measured = {key: 0.0 for key in ("sieve_voxel", "intensity_cap") if stated[key] == "auto"}
    smart = checked(Smart, stated | measured | {"refinement": 1.0, "estimate": "correlation"})
    correlation = checked(Correlation, experiment.correlation.model_dump() | changed.get("correlation", {}))
    return replace(experiment, grid=coarse, smart=smart, correlation=correlation)


def checked(table: type[Settings], values: dict[str, Any]) -> Settings:
    """Return a table of settings, or raise InputError with what is wrong in it."""
    try:
        return table.model_validate(values)
    except ValidationError as error:
        (place, text), *_ = problems.explain_each(error, table, values).items()
        raise InputError(f"{'.'.join(map(str, place))}: {text}") from None


def vectors_of(experiment: Experiment, calibration: Calibration, pair: int) -> xr.Dataset:
    """Reconstruct both frames of a pair and correlate them, without the checks and measurements of a run."""
    layers = guard.layers(experiment, None)
    square = all(camera.lattice.layout == "square" for camera in calibration.cameras.values())
    form = "profiles" if square else "pixels"  # which is built fastest
    weights = lfpiv.build_weights(calibration, guard.with_guard(experiment, layers).grid, form=form)
    darks = read_darks(experiment)
    light = pair_light(experiment, calibration.cameras, darks, pair)
    work = Reconstructor(experiment=experiment, weights=weights, guard=layers, refinement=1.0)
    images, noise, frames = ([getattr(one, name) for one in light] for name in ("images", "noise", "frame"))
    first, second = work.volumes(images, noise, frames)
    return measure_vectors(first, second, experiment)


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Do what a request asks for; return figures of the vectors."""
    experiment = with_settings(read_experiment(request["experiment"]), request["coarser"], request["changed"])
    stored = Folder(Path(request["results"])).calibration if request.get("results") else None
    calibrated = stored is not None and stored.is_file()
    calibration = lfpiv.load_calibration(stored) if calibrated else lfpiv.thin_lens(experiment)  # type: ignore[arg-type]
    start = time.perf_counter()
    pair = int(request["pair"])
    vectors = vectors_of(experiment, calibration, pair)
    netcdf.write_vectors(vectors, Folder(Path(request["out"])).vectors(pair), attributes={"pair": pair})
    uncertainty = float(np.nanmedian(vectors["uncertainty"].values)) if "uncertainty" in vectors else float("nan")
    return {
        "seconds": round(time.perf_counter() - start, 1),
        "valid": round(100 * float(vectors["valid"].mean()), 1),
        "uncertainty": round(uncertainty, 3) if np.isfinite(uncertainty) else None,
        "vectors": int(vectors["valid"].size),
        "calibrated": calibrated,
    }


def main() -> None:
    """Read a request, answer it; print one line of JSON, with ``error`` where it cannot be answered."""
    try:
        answer = measure(json.load(sys.stdin))
    except (InputError, ValueError, OSError) as error:
        answer = {"error": str(error)}
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
