"""Measure the figures of the page on accuracy: one or two parameters of a measurement at a time, the others usual.

    python perf/accuracy/headlines.py --out docs/figures/accuracy.json [--seeds 1,2,3] [--only angle,window]

Every part is a list of rows with means over flows and seeds, and standard errors by the scatter over seeds. Figures
against seeding are those of `method_comparison.py`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from method_comparison import FLOWS, mean_of_flows
from reconstruction_bench import CACHE, field_figures, score, vectors_of
from reconstruction_cases import ANGLES_DEG, Case, make_rig, record, true_field
from reconstruction_ways import WAYS

from lfpiv import files
from lfpiv.geometry.grid import Grid
from lfpiv.weights.choice import form_errors
from lfpiv.weights.counting import CountedVoxels
from lfpiv.weights.stored_grid import StoredGrid

HALF_ANGLES_DEG = (10.0, 20.0, 30.0, 45.0, 60.0)
"""Angles of two cameras on either side of z."""
SPEEDS = (0.25, 0.5, 1.0, 1.5, 2.0)
"""Displacements relative to those of the flows, whose largest is 1.6 voxels."""
WINDOWS = ((24, 16, 8, 8), (24, 16, 12, 12), (24, 16, 16), (24, 20, 20))
VOXELS_PITCH = (0.5, 1.0, 1.5, 2.0)
"""Voxel edges at which weights are compared with counted rays [microlens pitch]."""
BINS = 6
"""Groups of vectors by their stated uncertainty, equally many in each."""
FIGURES = ("error", "q", "ghosts", "error_x", "error_y", "error_z")

Row = dict[str, Any]


def against_angle(seeds: Sequence[int], folder: Path) -> list[Row]:
    """Measure with two cameras at equal angles on either side of z."""
    return [
        {"half_angle_deg": angle, **_scores(Case(angles_deg=(angle, -angle)), seeds, folder)}
        for angle in HALF_ANGLES_DEG
    ]


def against_cameras(seeds: Sequence[int], folder: Path) -> list[Row]:
    """Measure with one to four cameras."""
    return [
        {"cameras": count, **_scores(Case(angles_deg=angles), seeds, folder)} for count, angles in ANGLES_DEG.items()
    ]


def against_displacement(seeds: Sequence[int], folder: Path) -> list[Row]:
    """Measure the flows at several speeds."""
    return [{"speed": speed, **_scores(Case(speed=speed), seeds, folder)} for speed in SPEEDS]


def against_window(seeds: Sequence[int], folder: Path) -> list[Row]:
    """Correlate the same volumes, and the true particles, in several windows."""
    found: dict[tuple[str, int], dict[str, list[float]]] = {}
    for flow in FLOWS:
        for seed in seeds:
            case = Case(flow=flow, seed=seed)
            for name in ("ours", "truth"):
                volumes = _volumes(case, name, folder)
                for windows in WINDOWS:
                    (vectors,) = vectors_of(case, volumes, {"correlation.windows": windows})
                    error = field_figures(case, vectors)["error"]
                    found.setdefault((name, windows[-1]), {}).setdefault(flow, []).append(error)
    return [
        {"window": windows[-1]} | {name: mean_of_flows(found[name, windows[-1]]) for name in ("ours", "truth")}
        for windows in WINDOWS
    ]


def weights_error(seeds: Sequence[int], folder: Path) -> list[Row]:
    """Compare integrated weights with counted rays, one voxel's image at a time."""
    rows = []
    for edge in VOXELS_PITCH:
        for angle in (0.0, 45.0):
            rig = make_rig("small", (angle,))
            (camera,) = rig.calibration.cameras.values()
            edge_mm = edge * camera.optics.microlens_pitch_mm / abs(camera.optics.magnification)
            grid = Grid.from_extent(centre_mm=(0.0, 0.0, 0.0), size_mm=(3.2, 3.2, 2.8), voxel_mm=edge_mm)
            counted = CountedVoxels(StoredGrid.for_cameras(grid, [camera]), camera)
            errors = np.array(form_errors(counted, "profiles"))
            spread = float(errors.std(ddof=1) / np.sqrt(len(errors)))
            rows.append({"voxel_pitch": edge, "angle_deg": angle, "error": [float(errors.mean()), spread]})
    return rows


def stated_uncertainty(seeds: Sequence[int], folder: Path) -> list[Row]:
    """Compare the stated uncertainty of components with their true errors, from the surest vectors to the others."""
    stated, errors = [], []
    for condition in ("clean", "real"):
        for flow in FLOWS:
            for seed in seeds:
                case = Case(flow=flow, seed=seed, condition=condition)
                (vectors,) = vectors_of(case, _volumes(case, "ours", folder), {})
                edge = json.loads(vectors.attrs["settings"])["windows"][-1]
                exact = true_field(case, [vectors[axis].values for axis in "zyx"], edge)
                good = vectors["valid"].values.astype(bool)
                for number, axis in enumerate("xyz"):
                    errors.append((vectors[f"displacement_{axis}"].values - exact[..., number])[good])
                    stated.append(vectors[f"uncertainty_{axis}"].values[good])
    told, error = np.concatenate(stated), np.concatenate(errors)
    known = np.isfinite(told) & np.isfinite(error)
    told, error = told[known], error[known]
    rows = []
    for members in np.array_split(np.argsort(told), BINS):
        squares = np.square(error[members])
        rms = float(np.sqrt(squares.mean()))
        spread = float(squares.std(ddof=1) / np.sqrt(len(members)) / (2 * rms))
        within = float((np.abs(error[members]) <= 2 * told[members]).mean())
        rows.append(
            {"stated": float(np.sqrt(np.square(told[members]).mean())), "true": [rms, spread], "within": within}
        )
    return rows


PARTS: dict[str, Callable[[Sequence[int], Path], list[Row]]] = {
    "angle": against_angle,
    "cameras": against_cameras,
    "displacement": against_displacement,
    "window": against_window,
    "weights": weights_error,
    "uncertainty": stated_uncertainty,
}


def _scores(case: Case, seeds: Sequence[int], folder: Path) -> dict[str, tuple[float, float]]:
    """Return mean figures of a case over flows and seeds, and their standard errors."""
    scores = {
        flow: [score(replace(case, flow=flow, seed=seed), WAYS["ours"], folder) for seed in seeds] for flow in FLOWS
    }
    return {
        figure: mean_of_flows({flow: [one[figure] for one in members] for flow, members in scores.items()})
        for figure in FIGURES
    }


def _volumes(case: Case, way: str, folder: Path):
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    return WAYS[way].reconstruct(rig, recorded, WAYS[way].settings).volumes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the figures")
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--only", default=",".join(PARTS), help="parts that are computed; the file keeps the others")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images and figures")
    options = parser.parse_args(arguments)
    stored = json.loads(options.out.read_text("utf-8")) if options.out.exists() else {}
    seeds = [int(seed) for seed in options.seeds.split(",")]
    for name in options.only.split(","):
        stored[name] = PARTS[name](seeds, options.cache)
        files.write_json(files.plain({"seeds": seeds, "flows": FLOWS, **stored}), options.out)
        print(name, json.dumps(files.plain(stored[name])), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
