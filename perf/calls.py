"""What a user calls: correlate, reconstruct, measure_pair, calibrate, open_results, the import, and a run once more.

Only public names are used, so `run.py --against` measures these calls of any commit, on the same simulated images.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
from work import BARE_CORRELATION, SHIFT, Work, particles, require

import lfpiv

ROOT = Path(__file__).resolve().parents[1]
SHAPE = (64, 128, 128)
"""Volumes of the correlation (z, y, x)."""
FOLDER = "LFPIV_PERF_CALLS"
"""Environment variable: folder of the simulated experiment, shared by the processes of a comparison."""
DISPLACEMENT_VOXEL = (0.8, -0.6, 0.4)
"""True displacement of the simulated particles along x, y, z [voxel]."""
ERROR_VOXEL = 0.4
"""Largest mean error of a right result [voxel]: twice that of this small rig."""
CAMERA = """
[[camera]]
name = "{name}"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 8.0
sensor_width_px = 400
sensor_height_px = 400
nominal_angle_deg = {angle}
true_yaw_deg = {yaw}
"""
SCENE = """
name = "calls"
seed = 3
dt_s = 1e-3
[board]
dots = [5, 5]
spacing_mm = 0.5
dot_diameter_mm = 0.1
planes_mm = [-0.7, 0.0, 0.7]
[volume]
size_mm = [2.0, 2.0, 1.2]
voxel_mm = 0.1
[particles]
count = 120
pairs = 2
sigma_mm = 0.05
[flow]
kind = "uniform"
displacement_mm = [0.08, -0.06, 0.04]
[correlation]
windows = [[12, 16, 16], [12, 12, 12]]
""" + "".join(CAMERA.format(name=name, angle=angle, yaw=angle - 0.5) for name, angle in (("l", 40.0), ("r", -40.0)))


def simulate(folder: Path) -> None:
    """Simulate the experiment by this checkout."""
    (folder / "scene.toml").write_text(SCENE)
    command = [sys.executable, "-m", "lfpiv", "simulate", "scene.toml", "--out", "data"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=True)


@cache
def _experiment() -> Path:
    """Return the experiment file; simulate it unless the process that started this one did."""
    if FOLDER not in os.environ:
        folder = tempfile.mkdtemp(prefix="lfpiv-calls-")
        simulate(Path(folder))
        os.environ[FOLDER] = folder
    return Path(os.environ[FOLDER]) / "data" / "experiment.toml"


@cache
def _scratch() -> Path:
    return Path(tempfile.mkdtemp(prefix="lfpiv-calls-"))


def remove() -> None:
    """Remove what this process wrote."""
    if _scratch.cache_info().currsize:
        shutil.rmtree(_scratch(), ignore_errors=True)


def _right(vectors) -> dict[str, float]:
    """Compare the mean displacement of vectors with the truth."""
    found = [float(vectors[f"displacement_{axis}"].mean()) for axis in "xyz"]
    error = float(np.abs(np.subtract(found, DISPLACEMENT_VOXEL)).max())
    require(error < ERROR_VOXEL, f"a mean displacement of {found} voxel")
    return {"error_voxel": error}


def _correlate(window: int) -> Work:
    first, second = particles(SHAPE), particles(SHAPE, SHIFT)

    def check(vectors):
        found = np.array([np.median(vectors[f"displacement_{axis}"]) for axis in "zyx"])
        error = float(np.abs(found - SHIFT).max())
        require(error < 0.05, f"a median displacement of {found}")
        return {"error_voxel": error}

    options = {"dt_s": 1.0, "voxel_mm": 0.1, "windows": (window,), **BARE_CORRELATION}
    return Work(lambda: lfpiv.correlate(first, second, **options), check, {"pairs": 1})


def _reconstruct() -> Work:
    rig = lfpiv.prepare(_experiment())
    light = rig.light(0)[0]

    def check(volume):
        require(bool(np.isfinite(volume).all()) and float(volume.sum()) > 0, "a volume without light")
        return {}

    return Work(
        lambda: lfpiv.reconstruct(rig.weights, light.images, floor=light.noise, **rig.smart), check, {"frames": 1}
    )


def _measure_pair() -> Work:
    rig = lfpiv.prepare(_experiment())
    return Work(lambda: lfpiv.measure_pair(rig, 0), _right, {"pairs": 1})


def _calibrate() -> Work:
    experiment = lfpiv.open_experiment(_experiment())

    def check(calibration):
        require(len(calibration.cameras) == 2, f"{len(calibration.cameras)} cameras")
        return {}

    return Work(lambda: lfpiv.calibrate(experiment), check, {"rigs": 1})


def _finished() -> Path:
    out = _scratch() / "out"
    lfpiv.run(_experiment(), out)
    return out


def _open_results() -> Work:
    out = _finished()

    def run():
        with lfpiv.open_results(out) as results:
            return results.load()

    return Work(run, _right, {"runs": 1})


def _rerun() -> Work:
    out = _finished()

    def check(_):
        with lfpiv.open_results(out) as results:
            return _right(results)

    return Work(lambda: lfpiv.run(_experiment(), out), check, {"runs": 1})


def _import() -> Work:
    command = [sys.executable, "-c", "import lfpiv; print(lfpiv.correlate, lfpiv.open_results)"]

    def check(done):
        require(done.returncode == 0, done.stderr)
        return {}

    return Work(lambda: subprocess.run(command, cwd=_scratch(), capture_output=True, text=True), check, {"imports": 1})


CALLS: dict[str, Callable[[], Work]] = {
    "call_import": _import,
    "call_correlate_8": partial(_correlate, 8),
    "call_correlate_16": partial(_correlate, 16),
    "call_calibrate": _calibrate,
    "call_reconstruct": _reconstruct,
    "call_measure_pair": _measure_pair,
    "call_open_results": _open_results,
    "call_rerun": _rerun,
}
"""Name -> the function that prepares the call."""
SIMULATED = CALLS.keys() - {"call_import", "call_correlate_8", "call_correlate_16"}
"""Calls that need the simulated experiment."""
