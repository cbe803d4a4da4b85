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
from typing import Any

import numpy as np

import lfpiv
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.results import netcdf
from lfpiv.results.folder import Folder
from lfpiv.settings.processing import Correlation, Smart


def with_settings(experiment: Experiment, coarser: float, changed: dict[str, dict[str, Any]]) -> Experiment:
    """Return an experiment on voxels that are some times as long, with some settings of SMART and correlation changed.

    The volume has no guard layers, and its voxels are those that are reconstructed, so that a trial takes seconds.
    """
    grid = experiment.grid
    edge = grid.voxel_mm * coarser
    size = [max(n * grid.voxel_mm, 4 * edge) for n in grid.shape[::-1]]
    coarse = Grid.from_extent(centre_mm=tuple(grid.centre_mm.tolist()), size_mm=tuple(size), voxel_mm=edge)
    smart = Smart.model_validate(experiment.smart.model_dump() | {"refinement": 1.0} | changed.get("smart", {}))
    correlation = Correlation.model_validate(experiment.correlation.model_dump() | changed.get("correlation", {}))
    return replace(experiment, grid=coarse, guard_mm=0.0, smart=smart, correlation=correlation, background="none")


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Do what a request asks for; return figures of the vectors."""
    experiment = with_settings(read_experiment(request["experiment"]), request["coarser"], request["changed"])
    stored = Folder(Path(request["results"])).calibration if request.get("results") else None
    calibrated = stored is not None and stored.is_file()
    calibration = lfpiv.load_calibration(stored) if calibrated else lfpiv.thin_lens(experiment)  # type: ignore[arg-type]
    start = time.perf_counter()
    rig = lfpiv.prepare(experiment, calibration)
    pair = int(request["pair"])
    vectors = lfpiv.measure_pair(rig, pair)
    netcdf.write_vectors(vectors, Folder(Path(request["out"])).vectors(pair), attributes={"pair": pair})
    uncertainty = float(np.nanmedian(vectors["uncertainty"].values)) if "uncertainty" in vectors else float("nan")
    return {
        "seconds": round(time.perf_counter() - start, 1),
        "valid": round(100 * float(vectors["valid"].mean()), 1),
        "uncertainty": round(uncertainty, 3) if np.isfinite(uncertainty) else None,
        "voxels": int(np.prod(experiment.grid.shape)),
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
