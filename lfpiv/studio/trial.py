"""Measure one pair on coarser voxels, in a process of its own: ``python -m lfpiv.studio.trial``.

It reads a request as JSON from standard input, writes the vectors to the folder that the request names, and prints
what it took as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import lfpiv
from lfpiv.experiment.opening import experiment_of
from lfpiv.results import netcdf
from lfpiv.results.folder import Folder
from lfpiv.runs import coarse
from lfpiv.runs.frame_light import pair_light, read_darks
from lfpiv.runs.pair_vectors import measure_vectors
from lfpiv.settings.experiment import ExperimentTable

LEAST_VOXELS = 4  # along each axis: the smallest window


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Do what a request asks for; return the seconds that it took, and whether the cameras are calibrated."""
    stated = experiment_of(Path(request["experiment"]), ExperimentTable.model_validate(request["values"]))
    experiment = coarse.coarsened(stated, request["coarser"] * stated.grid.voxel_mm, LEAST_VOXELS)
    stored = Folder(Path(request["results"])).calibration if request.get("results") else None
    calibrated = stored is not None and stored.is_file()
    calibration = lfpiv.load_calibration(stored) if calibrated else lfpiv.thin_lens(experiment)  # type: ignore[arg-type]
    start = time.perf_counter()
    pair = int(request["pair"])
    light = pair_light(experiment, calibration.cameras, read_darks(experiment), pair)
    _, (first, second) = coarse.reconstruct(experiment, calibration, light, lambda *_: None)
    vectors = measure_vectors(first, second, experiment)
    netcdf.write_vectors(vectors, Folder(Path(request["out"])).vectors(pair), attributes={"pair": pair})
    return {"seconds": round(time.perf_counter() - start, 1), "calibrated": calibrated}


def main() -> None:
    """Read a request, answer it; print one line of JSON, or say on standard error why it cannot be answered."""
    try:
        print(json.dumps(measure(json.load(sys.stdin))))
    except (ValueError, OSError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
