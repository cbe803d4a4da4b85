"""Simulate and run a small experiment, which tests copy and run again in seconds."""

import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support import scenes

from lfpiv.runs import pipeline
from lfpiv.runs.belonging import Agreement
from lfpiv.simulation.simulator import simulate

PAIRS = 4
DISPLACEMENT_VOXEL = (0.8, -0.6, 0.4)
"""Uniform displacement along x, y, z [voxel], no whole number on any axis."""

TRUE_ANGLE_DEG = -0.5
"""Difference between the true and the stated yaw of each camera [degree]."""


@dataclass(frozen=True)
class SmallRun:
    """A finished run with its volumes. Tests work on copies, never on its files."""

    experiment: Path
    out: Path
    summary: dict

    def images(self, folder: Path) -> Path:
        """Copy the experiment with its images and their modification times; return the experiment file."""
        shutil.copytree(self.experiment.parent, folder)
        return folder / self.experiment.name

    def results(self, folder: Path) -> Path:
        """Copy everything that the run wrote; return the folder."""
        shutil.copytree(self.out, folder)
        return folder

    def calibrated(self, folder: Path) -> Path:
        """Create an output folder that holds only the calibration; return it."""
        folder.mkdir()
        shutil.copy2(self.out / "calibration.h5", folder)
        return folder

    def prepared(self, folder: Path) -> Path:
        """Create an output folder that holds what a run measures before its first pair; return it."""
        self.calibrated(folder)
        for name in {"background.h5", "guard.json", "refinement.json"} & {path.name for path in self.out.iterdir()}:
            shutil.copy2(self.out / name, folder)
        return folder


def small_scene(**moved):
    """Return a scene of two cameras. `moved` maps a camera to keys that are changed."""
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


def make_coarse_run(small_run: SmallRun, folder: Path, device: str) -> SmallRun:
    """Run the images and the calibration of the small run again, in voxels no finer than those of the vectors."""
    experiment, out = small_run.images(folder / "data"), small_run.calibrated(folder / "out")
    text = experiment.read_text("utf-8")
    experiment.write_text(text.replace("iterations = 8", "iterations = 8\nrefinement = 1.0"), "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        leave_out(patch.setattr)
        summary = pipeline.run(experiment, out, device=device, keep_volumes=True)
    return SmallRun(experiment, out, summary)


BRIEF = """
import lfpiv.report.page
from lfpiv.cli import commands
from lfpiv.runs import belonging, odd_pairs
from lfpiv.weights import counting

lfpiv.report.page.write_report = lambda *given: given[-1].write_text("", "utf-8")
belonging.check = lambda *given: belonging.Agreement(sentence="not compared")
odd_pairs.settle = lambda *given: []
counting.VOXELS = 2
commands.main()
"""
"""The command line with brief runs and two counted voxels, as in tests that run in this process."""


def start(*arguments, **options) -> subprocess.Popen:
    """Start `BRIEF` in a process whose standard error is a pipe of text.

    The handler of SIGINT is reset, because background jobs of a shell, and their children, ignore interrupts.
    """
    command = [sys.executable, "-c", BRIEF, *map(str, arguments)]
    options["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def write_empty_report(*given) -> None:
    """Write an empty page in place of `lfpiv.write_report`, which takes as long as a small run."""
    given[-1].write_text("", "utf-8")


def leave_out(change) -> None:
    """Write an empty report, compare no cameras and judge no odd pairs; `change` sets an attribute by its name."""
    change("lfpiv.report.page.write_report", write_empty_report)
    change("lfpiv.runs.belonging.check", lambda *given: Agreement(sentence="not compared"))
    change("lfpiv.runs.odd_pairs.settle", lambda *given: [])


def damage(path: Path) -> None:
    """Overwrite pixels in the middle of an image file, without changing its header and length."""
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)


def same_vectors(first: Path, second: Path) -> int:
    """Assert that all arrays of the vectors in two folders are equal; return the number of pairs."""
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
