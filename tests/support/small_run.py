"""A small simulated experiment that everything runs on in seconds once it is calibrated."""

import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from support import scenes

from lfpiv.runs import pipeline
from lfpiv.simulation.simulator import simulate

PAIRS = 4
DISPLACEMENT_VOXEL = (0.8, -0.6, 0.4)
"""Uniform flow along x, y, z: off whole voxels on every axis."""

TRUE_ANGLE_DEG = -0.5
"""Turn of each camera from where it is said to be."""


@dataclass(frozen=True)
class SmallRun:
    """A finished run that kept its volumes; nobody may change it."""

    experiment: Path
    out: Path
    summary: dict

    def images(self, folder: Path) -> Path:
        """Copy of the experiment with its images, times of change included; return its file."""
        shutil.copytree(self.experiment.parent, folder)
        return folder / self.experiment.name

    def results(self, folder: Path) -> Path:
        """Copy of everything that the run wrote."""
        shutil.copytree(self.out, folder)
        return folder

    def calibrated(self, folder: Path) -> Path:
        """Return a new output folder that holds the calibration and nothing else."""
        folder.mkdir()
        shutil.copy2(self.out / "calibration.h5", folder)
        return folder


def small_scene(**moved):
    """Scene of two cameras; `moved` has more keys of a camera by its name."""
    cameras = [
        scenes.camera(
            name,
            angle,
            (400, 400),
            **{"true_yaw_deg": angle + TRUE_ANGLE_DEG, "true_array_roll_deg": 0.05} | moved.get(name, {}),
        )
        for name, angle in (("left", 40.0), ("right", -40.0))
    ]
    return scenes.scene(
        "small",
        cameras,
        planes_mm=(-0.7, 0.0, 0.7),
        particles={"count": 120, "pairs": PAIRS, "sigma_mm": 0.05},
        displacement_mm=(0.08, -0.06, 0.04),
        correlation={"windows": [(12, 16, 16), (12, 12, 12)]},
        smart={"iterations": 8},
        network={"hidden": (12,), "epochs": 60},
    )


def make_small_run(folder: Path, device: str) -> SmallRun:
    scene = small_scene()
    experiment = simulate(scene, folder / "data")
    summary = pipeline.run(experiment, folder / "out", device=device, keep_volumes=True)
    return SmallRun(experiment, folder / "out", summary)


def start(*arguments, **options) -> subprocess.Popen:
    """Start the command line as a process of its own; its standard error is a pipe of text.

    A shell's background jobs ignore interrupts, and so would what they start.
    """
    command = [sys.executable, "-m", "lfpiv", *map(str, arguments)]
    options["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def damage(path: Path) -> None:
    """Spoil the pixels of an image in the middle; its header and its length stay."""
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)


def same_vectors(first: Path, second: Path) -> int:
    """Compare every array of all vectors in two folders, byte by byte; return how many pairs there are."""
    names = sorted(path.name for path in (first / "vectors").iterdir())
    assert names == sorted(path.name for path in (second / "vectors").iterdir())
    for name in names:
        for group in (None, "reconstruction"):
            one, other = (
                xr.load_dataset(folder / "vectors" / name, group=group, engine="h5netcdf") for folder in (first, second)
            )
            assert list(one.variables) == list(other.variables)
            for variable in one.variables:
                a, b = one[variable].values, other[variable].values
                assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), (name, variable)
    return len(names)
