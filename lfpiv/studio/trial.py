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
from pydantic import BaseModel, ValidationError

import lfpiv
from lfpiv.errors import InputError
from lfpiv.experiment import problems
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.results import netcdf
from lfpiv.results.folder import Folder
from lfpiv.runs import coarse
from lfpiv.runs.frame_light import pair_light, read_darks
from lfpiv.runs.pair_vectors import measure_vectors

LEAST_VOXELS = 4
"""Least number of voxels along each axis: the smallest window."""

Settings = TypeVar("Settings", bound=BaseModel)


def with_settings(experiment: Experiment, coarser: float, changed: dict[str, dict[str, Any]]) -> Experiment:
    """Return an experiment on voxels that are some times as long, with other settings of SMART and correlation."""
    tables: dict[str, Any] = {
        name: checked(type(table), table.model_dump() | changed.get(name, {}))
        for name, table in (("smart", experiment.smart), ("correlation", experiment.correlation))
    }
    return coarse.coarsened(replace(experiment, **tables), coarser * experiment.grid.voxel_mm, LEAST_VOXELS)


def checked(table: type[Settings], values: dict[str, Any]) -> Settings:
    """Return a table of settings, or raise InputError with what is wrong in it."""
    try:
        return table.model_validate(values)
    except ValidationError as error:
        (place, text), *_ = problems.explain_each(error, table, values).items()
        raise InputError(f"{'.'.join(map(str, place))}: {text}") from None


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Do what a request asks for; return figures of the vectors."""
    experiment = with_settings(read_experiment(request["experiment"]), request["coarser"], request["changed"])
    stored = Folder(Path(request["results"])).calibration if request.get("results") else None
    calibrated = stored is not None and stored.is_file()
    calibration = lfpiv.load_calibration(stored) if calibrated else lfpiv.thin_lens(experiment)  # type: ignore[arg-type]
    start = time.perf_counter()
    pair = int(request["pair"])
    light = pair_light(experiment, calibration.cameras, read_darks(experiment), pair)
    _, (first, second) = coarse.reconstruct(experiment, calibration, light, lambda *_: None)
    vectors = measure_vectors(first, second, experiment)
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
