"""Watch the accuracy of a run in thirteen small cases: one to four cameras, thin and dense, blobs and points.

    python perf/accuracy/table.py                     this checkout against the stored table
    python perf/accuracy/table.py --against COMMIT    this checkout and another one in turns, on the same images
    python perf/accuracy/table.py --store             this checkout, and store its table

Each case is simulated, calibrated and measured by public calls, as a user does, each of its pairs with other particles.
A figure is the rms error of all vectors along an axis. Errors are compared pair by pair: a ratio of rms errors has the
standard error of its logarithm over the pairs.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import simulate

ROOT = Path(__file__).resolve().parents[2]
STORED = Path(__file__).with_suffix(".json")
CACHE = Path(tempfile.gettempdir()) / "lfpiv-accuracy-table"
VOXEL_MM, SIZE_MM, MARGIN_MM, PIXEL_MM = 0.1, (3.2, 3.2, 2.0), 0.6, 0.011
WINDOWS = ((16, 24, 24), (12, 16, 16), (12, 12, 12), (12, 12, 12))
ANGLES_DEG = {1: (0.0,), 2: (40.0, -40.0), 3: (40.0, 0.0, -40.0), 4: (45.0, 15.0, -15.0, -45.0)}
OPTICS = {
    "focal_length_mm": 100.0, "magnification": -1.0, "f_number": 4.0, "microlens_pitch_mm": 0.1,
    "microlens_focal_length_mm": 0.8, "pixel_um": 1000 * PIXEL_MM,
}  # fmt: skip
FLOWS = {
    "shear": {"kind": "shear", "along": "z", "across": "x", "rate": 0.07},
    "swirl": {"kind": "swirl", "peak_mm": 0.18, "core_mm": 0.8, "axis": "y", "axial_mm": 0.12},
    "ring": {"kind": "ring", "radius_mm": 0.9, "core_mm": 0.7, "peak_mm": 0.16},
}
REALISTIC = {
    "exposure": {"particle_counts": 32.0},
    "noise": {"read_noise": 2.0},
    "brightness": {"camera_log_sd": 0.5, "size_log_sd": 0.25},
    "sheet": {"profile": "gaussian", "thickness_mm": 1.33 * SIZE_MM[2], "power": (1.0, 0.8)},
    "stray_light": {"lens_counts": 2.0, "ambient_counts": 0.5, "variation": 0.3},
}
"""Tables of a realistic case: few electrons, light unlike from particle to particle, a sheet wider than the volume."""
SURE = 0.95
"""Probability of the interval of a ratio that must leave out 1 for a case to be called better or worse."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One rig and its particles."""

    cameras: int
    ppm: float
    """Particles per microlens of the volume's x-y face."""
    flow: str
    blob_voxel: float = 0.7
    """Standard deviation of the Gaussian particles [voxel]; 0 for points."""
    realistic: bool = False
    roll_deg: float = 0.0
    """Roll of the microlens arrays, more than planes of voxels can share profiles with [degree]."""

    @property
    def rig(self) -> tuple[int, float]:
        """What cases with one calibration have in common."""
        return self.cameras, self.roll_deg

    @property
    def label(self) -> str:
        kind = f"blobs {self.blob_voxel:g}" if self.blob_voxel else "points"
        images = "real" if self.realistic else "clean"
        return f"{self.cameras} cam {self.ppm:g} ppm {kind} {self.flow} {images}{' turned' if self.roll_deg else ''}"


CASES = (
    Case(cameras=1, ppm=0.1, flow="shear"),
    Case(cameras=1, ppm=0.05, flow="shear", blob_voxel=0.0),
    Case(cameras=1, ppm=0.3, flow="ring", realistic=True),
    Case(cameras=2, ppm=0.1, flow="shear", blob_voxel=0.0),
    Case(cameras=2, ppm=0.5, flow="swirl"),
    Case(cameras=2, ppm=0.5, flow="swirl", roll_deg=1.5),
    Case(cameras=2, ppm=0.5, flow="ring", blob_voxel=0.0),
    Case(cameras=2, ppm=0.05, flow="swirl", realistic=True),
    Case(cameras=2, ppm=0.5, flow="shear", realistic=True),
    Case(cameras=3, ppm=0.7, flow="shear"),
    Case(cameras=3, ppm=0.3, flow="ring", blob_voxel=0.0, realistic=True),
    Case(cameras=4, ppm=0.1, flow="ring", blob_voxel=0.0),
    Case(cameras=4, ppm=1.0, flow="swirl", realistic=True),
)

MEASURE = """
import sys, time
import numpy as np
import lfpiv
out, *experiments = sys.argv[1:]
calibration = lfpiv.calibrate(lfpiv.open_experiment(experiments[0])) if hasattr(lfpiv, "measure_pair") else None
for number, experiment in enumerate(experiments):
    if calibration is not None:
        rig, start = lfpiv.prepare(experiment, calibration, device="cpu"), time.process_time()
        found = [lfpiv.measure_pair(rig, pair) for pair in range(rig.experiment.pairs)]
    else:
        start = time.process_time()
        lfpiv.run(experiment, out + f"-run{number}", device="cpu")
        results = lfpiv.open_results(out + f"-run{number}")
        found = [results.isel(pair=k) for k in range(results.sizes["pair"])]
    cpu = (time.process_time() - start) / len(found)
    fields = [np.stack([one["displacement_" + axis].values for axis in "xyz"], -1) for one in found]
    valid = [float(one["valid"].values.mean()) for one in found]
    axes = {axis: found[0][axis].values for axis in "zyx"}
    np.savez(out + str(number), field=fields, valid=valid, cpu=cpu, root=lfpiv.__file__, **axes)
"""
"""What a state of the code does with the cases of one rig: one calibration, then each pair, by public calls."""


def scene(case: Case, pairs: int, settings: dict) -> Scene:
    """Return the scene of a case."""
    cameras = []
    for number, angle in enumerate(ANGLES_DEG[case.cameras]):
        sine, cosine = abs(np.sin(np.radians(angle))), abs(np.cos(np.radians(angle)))
        columns = (SIZE_MM[0] * cosine + SIZE_MM[2] * sine + MARGIN_MM) / PIXEL_MM
        cameras.append(
            OPTICS
            | {
                "name": f"camera{number + 1}",
                "sensor_width_px": 2 * int(columns / 2),
                "sensor_height_px": 2 * int((SIZE_MM[1] + MARGIN_MM) / PIXEL_MM / 2),
                "nominal_angle_deg": angle,
                "true_yaw_deg": angle + 0.4 - 0.3 * number,
                "true_array_offset_mm": (0.03 - 0.02 * number, -0.02 + 0.015 * number),
                "true_array_roll_deg": case.roll_deg + 0.05 - 0.03 * number,
            }
        )
    size = {"sigma_mm": case.blob_voxel * VOXEL_MM} if case.blob_voxel else {}
    margin = {"margin_mm": (0.5, 0.5, 0.4 * SIZE_MM[2])} if case.realistic else {}
    tables = {
        "name": "table",
        "seed": 11,
        "dt_s": 1e-3,
        "camera": tuple(cameras),
        "board": {"dots": (5, 5), "spacing_mm": 0.6, "dot_diameter_mm": 0.1, "planes_mm": (-1.0, -0.5, 0.0, 0.5, 1.0)},
        "volume": {"size_mm": SIZE_MM, "voxel_mm": VOXEL_MM},
        "particles": {"per_microlens": case.ppm, "pairs": pairs} | size | margin,
        "flow": FLOWS[case.flow],
        "correlation": {"windows": WINDOWS},
    }
    return Scene.model_validate(tables | (REALISTIC if case.realistic else {}) | settings)


def experiment(case: Case, pairs: int, settings: dict, folder: Path) -> Path:
    """Return the experiment file of a case, simulated unless the folder has it."""
    made = scene(case, pairs, settings)
    digest = hashlib.sha256(made.model_dump_json().encode())
    for path in sorted([*(ROOT / "lfpiv/simulation").glob("*.py"), *(ROOT / "lfpiv_kernels/rendering").glob("*.py")]):
        digest.update(path.read_bytes())
    place = folder / "images" / digest.hexdigest()[:16]
    return place / "experiment.toml" if place.exists() else simulate(made, place)


def measure(cases: Sequence[Case], files: Sequence[Path], tree: Path) -> list[dict]:
    """Measure the cases of a rig by the code of a tree.

    Returns
    -------
    list of dict
        Of each case: rms errors (pair, axis) [voxel], part of the vectors that are valid, CPU time of a pair [s].
    """
    with tempfile.TemporaryDirectory() as scratch:
        environment = os.environ | {"PYTHONPATH": str(tree), "ENABLE_TAICHI_HEADER_PRINT": "0"}
        command = [sys.executable, "-c", MEASURE, "found", *map(str, files)]
        done = subprocess.run(command, env=environment, cwd=scratch, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{cases[0].label}, {tree}: {done.stderr[-2000:]}")
        return [_figures(case, Path(scratch) / f"found{number}.npz", tree) for number, case in enumerate(cases)]


def _figures(case: Case, path: Path, tree: Path) -> dict:
    """Compare the vectors of a case with the flow's mean over each window; unknown ones count as 0."""
    with np.load(path) as found:
        if Path(str(found["root"])).resolve().parents[1] != tree.resolve():
            raise SystemExit(f"{tree}: another lfpiv was measured, {found['root']}.")
        z, y, x = np.meshgrid(*(found[axis] for axis in "zyx"), indexing="ij")
        edge = tuple(VOXEL_MM * n for n in WINDOWS[-1][::-1])
        exact = window_mean(scene(case, 1, {}).flow, np.stack([x, y, z], -1).reshape(-1, 3), edge)
        exact = exact.reshape(*x.shape, 3) / VOXEL_MM
        error = np.where(np.isfinite(found["field"]), found["field"], 0) - exact
        rms = np.sqrt((error**2).mean((1, 2, 3))).round(5).tolist()
        return {"rms": rms, "valid": round(float(found["valid"].mean()), 4), "cpu_s": round(float(found["cpu"]), 3)}


def compared(ours: dict, base: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return ratios of the rms errors along x, y, z and of the whole vector to those of a base, and their half widths.

    The ratios are geometric means over the pairs. The half widths are those of the intervals of probability `SURE`.
    """
    both = [np.array(one["rms"]) for one in (ours, base)]
    new, old = (np.column_stack([rms, np.sqrt((rms**2).sum(1))]) for rms in both)
    count = min(len(new), len(old))
    logs = np.log(new[:count] / old[:count])
    half = stats.t.ppf((1 + SURE) / 2, count - 1) * logs.std(0, ddof=1) / np.sqrt(count)
    return np.exp(logs.mean(0)), half


def row(case: Case, ours: dict, base: dict | None) -> str:
    """Return the line of a case: rms errors of the base and ours, ratio with its interval, and verdict."""
    text = f"{case.label:41s} " + " ".join(f"{value:6.3f}" for value in np.mean(ours["rms"], 0))
    text += f"  valid {ours['valid']:.2f}  {ours['cpu_s']:6.2f} s"
    if base is None:
        return text
    ratio, half = compared(ours, base)
    verdict = "worse" if np.log(ratio[3]) > half[3] else "better" if -np.log(ratio[3]) > half[3] else ""
    parts = " ".join(f"{one:5.2f}" for one in ratio)
    return f"{text}  ratio x y z all {parts} +-{half[3]:.2f}  time {ours['cpu_s'] / base['cpu_s']:.2f}  {verdict}"


@contextlib.contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Check out another commit beside this one as long as the context is open."""
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "base"
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status, 1 if a case is worse."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="COMMIT", help="another commit, in place of the stored table")
    parser.add_argument("--store", action="store_true", help="store the table of this checkout")
    parser.add_argument("--case", action="append", help="only cases whose label has this text; may be repeated")
    parser.add_argument("--pairs", type=int, default=4, help="pairs of a case, each with other particles")
    parser.add_argument("--smart", type=json.loads, default={}, help='other settings for this checkout, {"subsets": 1}')
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of the images")
    options = parser.parse_args(arguments)
    stored = json.loads(STORED.read_text()) if STORED.exists() else {}
    settings = {"smart": options.smart} if options.smart else {}
    table, worse = {}, 0
    chosen = [case for case in CASES if not options.case or any(text in case.label for text in options.case)]
    with checkout(options.against) if options.against else contextlib.nullcontext() as tree:
        for rig in dict.fromkeys(case.rig for case in chosen):
            cases = [case for case in chosen if case.rig == rig]
            plain = [experiment(case, options.pairs, {}, options.cache) for case in cases]
            bases = measure(cases, plain, tree) if tree else [stored.get(case.label) for case in cases]
            files = [experiment(case, options.pairs, settings, options.cache) for case in cases] if settings else plain
            for case, ours, base in zip(cases, measure(cases, files, ROOT), bases, strict=True):
                table[case.label] = ours
                line = row(case, ours, base)
                worse += line.endswith("worse")
                print(line, flush=True)
            if options.store:
                kept = {case.label: (stored | table).get(case.label) for case in CASES}
                STORED.write_text(json.dumps({label: one for label, one in kept.items() if one}, indent=1) + "\n")
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
