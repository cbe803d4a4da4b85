"""`lfpiv demo`: all steps on a small simulated experiment, and a comparison of the result with the known flow."""

from __future__ import annotations

import importlib.resources
import logging
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.errors import InputError
from lfpiv.progress import Progress, ignore_progress
from lfpiv.report import flow, known_flow
from lfpiv.results import netcdf
from lfpiv.results.folder import Folder
from lfpiv.runs import pipeline, unchanged
from lfpiv.simulation.scene import Scene, open_scene
from lfpiv.simulation.simulator import simulate
from lfpiv_kernels import runtime

log = logging.getLogger(__name__)


def run(out: str | Path, *, device: str | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Simulate the demo scene into ``out/experiment`` unless it exists, and run all steps on it into `out`.

    Parameters
    ----------
    out : path
        Folder for the simulated experiment and the results.
    device, progress
        As for `pipeline.run`.

    Returns
    -------
    dict
        The content of ``summary.json``, with figures of the first pair under ``demo``; see `compare_with_truth`.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    out, report = Path(out), progress or ignore_progress
    if device is not None:  # before the simulation, which takes any device
        try:
            runtime.start(device)
        except (RuntimeError, ValueError) as error:
            raise InputError(str(error)) from None
    with importlib.resources.as_file(importlib.resources.files("lfpiv.cli") / "demo_scene.toml") as path:
        scene = open_scene(path)
        experiment = out / "experiment" / "experiment.toml"
        if experiment.exists():
            log.info("simulated experiment: made before, kept")
        else:
            simulate(scene, experiment.parent, progress=lambda _, fraction: report("simulation", fraction))
    command = {"experiment": str(experiment), "pairs": None, "device": device, "keep_volumes": False}
    summary = unchanged.repeat(command | {"workers": None, "scheduler": None}, out)
    if summary is None:
        summary = pipeline.run(experiment, out, device=device, progress=progress)
    return summary | {"demo": compare_with_truth(scene, out)}


def compare_with_truth(scene: Scene, out: Path) -> dict[str, float]:
    """Return the error of the first pair's inner vectors against the true flow, as in the report [voxel].

    Errors are NaN if there is no vector. ``vectors`` is the number of vectors, ``speed_m_per_s`` the median speed of
    the valid ones, ``voxel_m_per_s`` the velocity of one voxel.
    """
    vectors = netcdf.read_vectors(Folder(out).vectors(0))
    speed = np.linalg.norm([vectors[name].values[vectors["valid"].values] for name in "uvw"], axis=0)
    found = known_flow.compare(vectors, scene, 0)
    error = found.length_voxel
    return {
        "mean_error_voxel": float(error.mean()) if error.size else float("nan"),
        "median_error_voxel": float(np.median(error)) if error.size else float("nan"),
        "largest_displacement_voxel": found.largest_voxel,
        "voxel_m_per_s": flow.voxel_velocity(vectors),
        "vectors": vectors["valid"].size,
        "speed_m_per_s": float(np.median(speed)) if speed.size else float("nan"),
    }
