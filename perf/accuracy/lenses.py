"""Measure whole runs through main lenses of published prescriptions, beside a thin lens: a row for each lens.

    python perf/accuracy/lenses.py --out docs/figures/lenses.json [--lenses thin,double_gauss] [--pairs 24]

Two small cameras look at a swirl. The mapping is compared with the true rays over 0.9 of the pupil and over all of it,
the weights with counted rays, the vectors with the flow: by correlation and by the joint fit of the same images. The
standard error of a displacement is the scatter over pairs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import lfpiv
from lfpiv import files
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.scene import Scene, true_mapping
from lfpiv.simulation.simulator import simulate

LENSES = {"thin": 4.0, "double_gauss": 4.0, "cooke_triplet": 4.0, "tessar": 4.5, "heliar": 4.5}
"""f-number of each lens; a thin one is the simulator's ideal lens."""
ANGLE_DEG, WINDOWS = 40.0, ((12, 16, 16), (12, 12, 12), (10, 10, 10))
INNER, RAYS = 0.9, 20_000
"""Part of the pupil's radius within which a mapping is compared, and the number of rays."""
ESTIMATES = ("correlation", "joint")


def scene(lens: str, pairs: int, seed: int) -> Scene:
    """Return two cameras with a lens, a board of five planes, and particles in a swirl."""
    camera: dict[str, Any] = {
        **{"focal_length_mm": 100.0, "magnification": -1.0, "f_number": LENSES[lens], "pixel_um": 8.0},
        **{"microlens_pitch_mm": 0.1, "microlens_focal_length_mm": 0.2 * LENSES[lens], "true_array_roll_deg": 0.05},
        **{"sensor_width_px": 400, "sensor_height_px": 400},
    }
    if lens != "thin":
        camera["lens"] = {"prescription": lens}
    angles = {"left": ANGLE_DEG, "right": -ANGLE_DEG}
    cameras = [
        camera | {"name": name, "nominal_angle_deg": angle, "true_yaw_deg": angle - 0.5}
        for name, angle in angles.items()
    ]
    return Scene.model_validate(
        {
            **{"name": lens, "seed": seed, "dt_s": 1e-3, "camera": cameras},
            "board": {
                **{"dots": (5, 5), "spacing_mm": 0.5, "dot_diameter_mm": 0.1},
                "planes_mm": (-0.8, -0.4, 0.0, 0.4, 0.8),
            },
            "volume": {"size_mm": (2.0, 2.0, 1.2), "voxel_mm": 0.1},
            "particles": {"per_microlens": 0.4, "pairs": pairs, "sigma_mm": 0.05},
            "flow": {"kind": "swirl", "peak_mm": 0.12, "core_mm": 0.8, "axial_mm": 0.05},
            "correlation": {"windows": WINDOWS},
        }
    )


def mapping_errors(calibration: lfpiv.Calibration, truth: Path) -> dict[str, float]:
    """Return the mean errors of the mappings over the pupil [pitch]: stated, and against the true rays."""
    errors: dict[str, list[float]] = {"stated": [], "inner": [], "whole": []}
    true = {camera["name"]: true_mapping(camera) for camera in json.loads(truth.read_text("utf-8"))["camera"]}
    for name, camera in calibration.cameras.items():
        random, radius = np.random.default_rng(1), camera.optics.pupil_radius_mm
        points, pupil = random.uniform(*camera.region_mm, (RAYS, 3)), random_on_pupil(radius, RAYS, random)
        miss = np.linalg.norm(camera.map(points, pupil) - true[name](points, pupil), axis=1) / camera.lattice.pitch_mm
        passes, inner = np.isfinite(miss), np.linalg.norm(pupil, axis=1) < INNER * radius
        errors["stated"].append(float(camera.report.sigma_nor_test))
        errors["inner"].append(float(miss[passes & inner].mean()))
        errors["whole"].append(float(miss[passes].mean()))
    return {name: float(np.mean(values)) for name, values in errors.items()}


def displacement_errors(vectors: xr.Dataset, flow: Any) -> tuple[float, float]:
    """Return the mean error of the valid vectors [voxel] and its standard error over pairs."""
    centres = np.stack(np.meshgrid(*[vectors[axis].values for axis in "zyx"], indexing="ij")[::-1], -1).reshape(-1, 3)
    voxel_mm = float(np.atleast_1d(vectors.attrs["voxel_mm"])[0])
    exact = window_mean(flow, centres, voxel_mm * WINDOWS[-1][0]) / voxel_mm
    found = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], -1)
    miss = np.linalg.norm(found.reshape(len(found), -1, 3) - exact, axis=-1)
    valid = vectors.valid.values.reshape(miss.shape)
    of_pair = np.array([one[right].mean() for one, right in zip(miss, valid, strict=True)])
    return float(of_pair.mean()), float(of_pair.std(ddof=1) / np.sqrt(len(of_pair)))


def measure(lens: str, pairs: int, seed: int, folder: Path) -> dict[str, Any]:
    """Return the row of a lens."""
    rig = scene(lens, pairs, seed)
    experiment = simulate(rig, folder / "data")
    text = experiment.read_text("utf-8")
    row: dict[str, Any] = {"lens": lens, "pairs": pairs, "displacement": {}}
    for estimate in ESTIMATES:
        out = folder / estimate
        experiment.write_text(f'{text}\n[smart]\nestimate = "{estimate}"\n', "utf-8")
        if estimate != ESTIMATES[0]:
            out.mkdir()
            shutil.copy2(folder / ESTIMATES[0] / "calibration.h5", out)
        summary = lfpiv.run(experiment, out)
        row["displacement"][estimate] = displacement_errors(lfpiv.open_results(out), rig.flow)
        row |= {"weights": float(np.mean(summary["weights"]["count_check_l2"])), "form": summary["weights"]["form"]}
        row["iterations"] = float(
            np.mean([len(one) - 1 for pair in summary["pairs"] for one in pair["residual"].values()])
        )
    calibration = lfpiv.load_calibration(folder / ESTIMATES[0] / "calibration.h5")
    warnings = sorted({warning.code.name for camera in calibration.cameras.values() for warning in camera.warnings})
    return row | {"mapping": mapping_errors(calibration, folder / "data/truth/spec.json"), "warnings": warnings}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the rows; other lenses' rows are kept")
    parser.add_argument("--lenses", default=",".join(LENSES))
    parser.add_argument("--pairs", type=int, default=24)
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args(arguments)
    rows = json.loads(options.out.read_text("utf-8")) if options.out.exists() else []
    for lens in options.lenses.split(","):
        with tempfile.TemporaryDirectory() as folder:
            row = measure(lens, options.pairs, options.seed, Path(folder))
        rows = [one for one in rows if one["lens"] != lens] + [row]
        print(json.dumps(row), flush=True)
        files.write_json(rows, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
