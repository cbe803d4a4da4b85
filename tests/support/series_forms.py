"""A small time series of the sample data's turbulent flow, in every form of file, and counts of reconstructions."""

import json
import os
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import h5py
import tifffile
from support import scenes
from support.recordings import write_cine

from lfpiv.simulation.simulator import simulate

CAMERAS = ("left", "right")
INSTANTS, STEP = 7, 3
PAIRS = range(INSTANTS - STEP)
"""Numbers of the pairs of a series that starts at 0."""

FORMS = {
    "single": "particles/{camera}/instant_{instant:06d}.tif",
    "tiff": "stacks/{camera}.tif#{instant}",
    "hdf5": "stacks/recording.h5#{camera}/images[{instant}]",
    "cine": "stacks/{camera}.cine#{instant}",
}
"""Path patterns of the same images in files of several forms."""

SITE = '''
"""Log what every process reconstructs from all cameras together."""
import hashlib, os
import lfpiv.report
from lfpiv.reconstruction.solver import SmartSolver

lfpiv.report.write_report = lambda *arguments: None  # takes as long as the run

original = SmartSolver.solve

def solve(self, images, **options):
    if len(self.weights.cameras) == {cameras}:
        digest = hashlib.sha256()
        for name in sorted(images):
            digest.update(images[name].tobytes())
        log = os.open({log!r}, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(log, (digest.hexdigest() + chr(10)).encode())
        os.close(log)
    return original(self, images, **options)

SmartSolver.solve = solve
'''


@dataclass(frozen=True)
class CountedProcesses:
    """Processes that log what they reconstruct from all cameras together, and write no report."""

    folder: Path

    @property
    def log(self) -> Path:
        """File with a line for each reconstruction."""
        return self.folder / "reconstructions.log"

    def environment(self) -> dict[str, str]:
        """Return the variables of a process whose reconstructions, and those of its workers, are logged."""
        (self.folder / "sitecustomize.py").write_text(SITE.format(cameras=len(CAMERAS), log=str(self.log)))
        return os.environ | {"PYTHONPATH": os.pathsep.join([str(self.folder), *filter(None, sys.path)])}

    def counts(self) -> Counter[str]:
        """Return how often each instant's images were reconstructed."""
        return Counter(self.log.read_text().split()) if self.log.exists() else Counter()


def series_scene(file: Path):
    """Return a scene of two cameras and tracers that move as given in a file of the sample data."""
    cameras = [
        scenes.camera(name, angle, (400, 400), true_yaw_deg=angle - 0.5)
        for name, angle in zip(CAMERAS, (40.0, -40.0), strict=True)
    ]
    return scenes.scene(
        "series",
        cameras,
        planes_mm=(-0.7, 0.0, 0.7),
        particles={"count": 150, "instants": INSTANTS, "step": STEP, "sigma_mm": 0.05},
        displacement_mm=(0.0, 0.0, 0.0),
        flow={
            "kind": "tracers",
            "file": str(file),
            "series": "positions",
            "size_mm": (5.0, 5.0, 5.0),
            "box": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
            "as_given": True,
        },
        correlation={"windows": [(12, 16, 16), (12, 12, 12)]},
        smart={"iterations": 8},
        network={"hidden": (12,), "epochs": 60},
    )


def make_series(file: Path, folder: Path) -> Path:
    """Simulate the series, store its images in every form, and return the folder of the experiment files."""
    path = simulate(series_scene(file), folder / "data")
    (path.parent / "stacks").mkdir()
    with h5py.File(path.parent / "stacks" / "recording.h5", "w") as recording:
        for camera in CAMERAS:
            names = [FORMS["single"].format(camera=camera, instant=instant) for instant in range(INSTANTS)]
            frames = tifffile.imread([path.parent / name for name in names])
            recording[f"{camera}/images"] = frames
            tifffile.imwrite(path.parent / "stacks" / f"{camera}.tif", frames, photometric="minisblack")
            write_cine(path.parent / "stacks" / f"{camera}.cine", frames)
    text = path.read_text("utf-8")
    for form, pattern in FORMS.items():
        changed = text.replace(json.dumps(FORMS["single"]), json.dumps(pattern))
        (path.parent / f"{form}.toml").write_text(changed, "utf-8")
    return path.parent


def as_pairs(data: Path) -> Path:
    """Write an experiment of independent pairs of the same images beside a series; return its file."""
    text = (data / "single.toml").read_text("utf-8")
    series = f"images = {json.dumps(FORMS['single'])}\ninstants = {INSTANTS}\nfirst = 0\nstep = {STEP}\n"
    assert series in text
    pairs = f'images = "pairs/{{camera}}_{{pair}}_{{frame}}.tif"\npairs = {len(PAIRS)}\n'
    (data / "pairs.toml").write_text(text.replace(series, pairs), "utf-8")
    (data / "pairs").mkdir()
    for camera in CAMERAS:
        for pair in PAIRS:
            for frame, instant in (("a", pair), ("b", pair + STEP)):
                recorded = data / FORMS["single"].format(camera=camera, instant=instant)
                os.link(recorded, data / "pairs" / f"{camera}_{pair}_{frame}.tif")
    return data / "pairs.toml"
