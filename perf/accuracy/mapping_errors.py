"""Compare the stated error of mappings with their true one: a row for each lens, drawn rigs, with the scatter of seeds.

    python perf/accuracy/mapping_errors.py [--lenses thin,tessar,telephoto] [--seeds 1,2,3]

Each seed draws angle, magnification, pitch, dots, planes and misalignment of one camera. Errors are means over 0.9 of
the pupil's radius and the box of the dots [microlens pitch]. A rig takes 5 s of processor time with a thin lens, 50 s
with a lens of strong aberrations.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import lfpiv
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.simulation.scene import Scene, true_mapping
from lfpiv.simulation.simulator import simulate

INNER, RAYS = 0.9, 20_000
"""Part of the pupil's radius within which mappings are compared, and the number of rays."""
PLANES_MM = ((-0.8, -0.4, 0.0, 0.4, 0.8), (-0.8, -0.2, 0.4), (-0.9, -0.45, 0.0, 0.45))
TANK = {
    "point_mm": (0.0, 0.0, 20.0),
    "normal": (0.0, 0.0, 1.0),
    "thickness_mm": 6.0,
    "index": 1.49,
    "medium_index": 1.333,
}


def surfaces(stop: int, *rows: tuple[float, float, float]) -> dict[str, Any]:
    """Return the table of a lens: number of the stop, then radius, thickness and index behind each surface."""
    names = ("radius_mm", "thickness_mm", "index")
    return {
        "surfaces": tuple(
            dict(zip(names, row, strict=True)) | {"stop": number == stop} for number, row in enumerate(rows)
        )
    }


TELEPHOTO = surfaces(  # f/5.6; M. Laikin, Lens Design, 4th ed., CRC Press, 2007, p. 91
    3,
    *((21.816, 6.073, 1.5168), (-68.331, 2.286, 1.66446), (77.008, 1.222, 1.0), (0.0, 26.281, 1.0)),
    *((-14.516, 2.286, 1.50847), (-18.854, 2.553, 1.78582), (-29.040, 0.396, 1.0), (-432.786, 2.014, 1.71736)),
    (-70.345, 0.0, 1.0),
)
PETZVAL = surfaces(  # f/1.4; the same, p. 75
    4,
    *((33.693, 10.16, 1.6779), (-68.374, 1.524, 1.0), (-50.871, 4.064, 1.7552), (138.427, 2.54, 1.0)),
    *((0.0, 22.857, 1.0), (29.779, 7.62, 1.6779), (-62.489, 5.641, 1.0), (-21.882, 2.032, 1.58144), (76.299, 0.0, 1.0)),
)
LENSES: dict[str, tuple[float, dict[str, Any]]] = {
    "thin": (4.0, {}),
    "hexagonal": (4.0, {"microlens_layout": "hexagonal"}),
    "water": (4.0, {"window": (TANK,)}),
    "double_gauss": (4.0, {"lens": {"prescription": "double_gauss"}}),
    "double_gauss_water": (4.0, {"lens": {"prescription": "double_gauss"}, "window": (TANK,)}),
    "petzval": (4.0, {"lens": PETZVAL}),
    "cooke_triplet": (4.0, {"lens": {"prescription": "cooke_triplet"}}),
    "tessar": (4.5, {"lens": {"prescription": "tessar"}}),
    "heliar": (4.5, {"lens": {"prescription": "heliar"}}),
    "telephoto": (8.0, {"lens": TELEPHOTO}),
}
"""f-number of each lens and the tables of its camera. Thin lenses but where a lens is named."""


def scene(lens: str, seed: int) -> Scene:
    """Return a rig of one camera that a seed draws."""
    random, (f_number, tables) = np.random.default_rng(seed), LENSES[lens]
    angle = float(random.choice([-1, 1]) * random.uniform(22, 42))
    magnification, pitch = -float(random.choice([0.8, 1.0, 1.2])), float(random.choice([0.1, 0.112]))
    dots, planes = int(random.choice([5, 7])), PLANES_MM[random.integers(len(PLANES_MM))]
    camera = {
        **{"name": "only", "focal_length_mm": 100.0, "magnification": magnification, "f_number": f_number},
        **{"pixel_um": 8.0, "sensor_width_px": int(random.choice([400, 440])), "sensor_height_px": 400},
        **{"microlens_pitch_mm": pitch, "microlens_focal_length_mm": 0.98 * pitch * f_number * (1 - magnification)},
        **{"nominal_angle_deg": angle, "true_yaw_deg": angle + float(random.uniform(-2, 2))},
        **{"true_pitch_deg": float(random.uniform(-1, 1)), "true_array_roll_deg": float(random.uniform(-0.4, 0.4))},
    }
    width_mm = 2.1 / abs(magnification)
    board = {"dots": (dots, dots), "spacing_mm": width_mm / (dots - 1), "dot_diameter_mm": 0.1, "planes_mm": planes}
    return Scene.model_validate(
        {
            **{"name": lens, "seed": seed, "dt_s": 1e-3, "camera": (camera | tables,), "board": board},
            **{"volume": {"size_mm": (1.5, 1.5, 1.2), "voxel_mm": 0.1}, "particles": {"count": 10}},
            "flow": {"kind": "uniform", "displacement_mm": (0.05, 0.0, 0.0)},
        }
    )


def measure(lens: str, seed: int) -> dict[str, Any]:
    """Return what is stated of a rig's mapping, and its true error within the pupil's inner part and over all of it."""
    with tempfile.TemporaryDirectory() as folder:
        experiment = simulate(scene(lens, seed), Path(folder) / "data")
        table = json.loads((experiment.parent / "truth/spec.json").read_text("utf-8"))["camera"][0]
        try:
            camera = lfpiv.calibrate(experiment).cameras["only"]
        except lfpiv.InputError as error:
            return {"lens": lens, "seed": seed, "refused": str(error)}
    random, radius = np.random.default_rng(1), camera.optics.pupil_radius_mm
    points, pupil = random.uniform(*camera.region_mm, (RAYS, 3)), random_on_pupil(radius, RAYS, random)
    miss = np.linalg.norm(camera.map(points, pupil) - true_mapping(table)(points, pupil), axis=1)
    miss, inner = miss / camera.lattice.pitch_mm, np.linalg.norm(pupil, axis=1) < INNER * radius
    report = camera.report
    return {
        **{"lens": lens, "seed": seed, "stated": report.sigma_nor_test, "inner": float(np.nanmean(miss[inner]))},
        **{"whole": float(np.nanmean(miss)), "held_out": report.sigma_nor_stated},
        "dots": f"{report.dots_found} of {report.dots_expected}",
        "warnings": sorted(warning.code.name for warning in camera.warnings),
    }


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Return a line on the rigs of a lens: geometric mean of stated over true error, and the factor of its scatter."""
    right = [row for row in rows if "stated" in row]
    if not right:
        return f"{rows[0]['lens']}: refused"
    ratio = np.log([row["stated"] / row["inner"] for row in right])
    inner = ", ".join(f"{row['inner']:.4f}" for row in right)
    return (
        f"{rows[0]['lens']}: true {inner}; stated over true {np.exp(ratio.mean()):.2f}, scatter a factor of "
        f"{np.exp(ratio.std()):.2f} over {len(right)} of {len(rows)} rigs"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lenses", default=",".join(LENSES))
    parser.add_argument("--seeds", default="1,2,3")
    options = parser.parse_args(arguments)
    lines = []
    for lens in options.lenses.split(","):
        rows = []
        for seed in map(int, options.seeds.split(",")):
            rows.append(measure(lens, seed))
            print(json.dumps(rows[-1]), flush=True)
        lines.append(summary(rows))
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
