"""Compare methods of the field on the same images, against seeding and in time; the figures of docs/accuracy.md.

    python perf/accuracy/method_comparison.py --out docs/_static/methods.json [--seeds 1,2,3] [--time-scale paper]

The errors are means over flows and seeds, with the standard error of the mean over seeds. `--only time` or
`--only seeding` computes one part anew and keeps the other one of the file.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from reconstruction_bench import CACHE, score
from reconstruction_cases import ANGLES_DEG, Case, make_rig, record
from reconstruction_ways import WAYS, weights_of

from lfpiv import files

METHODS = (
    ("refocused", 1),
    ("ours", 1),
    ("refocused", 2),
    ("mlos", 2),
    ("printed", 2),
    ("paper", 2),
    ("today", 2),
    ("ours", 2),
    ("truth", 2),
)
"""Ways of `reconstruction_ways.WAYS`, and numbers of cameras."""
PPM = (0.05, 0.1, 0.2, 0.5, 1.0)
FLOWS = ("ring", "swirl", "shear")
FIGURES = ("error", "interior", "q", "valid", "within", "ghosts", "slope_x", "slope_y", "slope_z")
ROUNDS = {"small": 3, "paper": 1}
"""Rounds of the timing. In each, all methods take turns with a pass over the rays."""


def seeding(seeds: Sequence[int], folder: Path) -> list[dict[str, Any]]:
    """Measure all methods at every seeding: mean figures, standard errors, and differences to ours."""
    rows = []
    for ppm in PPM:
        scores = {}
        for name, cameras in METHODS:
            cases = {
                flow: [Case(flow=flow, ppm=ppm, seed=seed, angles_deg=ANGLES_DEG[cameras]) for seed in seeds]
                for flow in FLOWS
            }
            scores[name, cameras] = {
                flow: [score(case, WAYS[name], folder) for case in members] for flow, members in cases.items()
            }
            figures = {key: _mean(scores[name, cameras], key) for key in FIGURES}
            rows.append({"way": name, "cameras": cameras, "ppm": ppm, "figures": figures})
            print(f"{ppm:4g} ppm {name:9s} {cameras}", {key: round(figures[key][0], 3) for key in FIGURES}, flush=True)
        for row in rows[-len(METHODS) :]:
            own, other = scores["ours", 2], scores[row["way"], row["cameras"]]
            row["beyond_ours"] = {key: _mean(other, key, own) for key in ("error", "q")}
    return rows


def _mean(
    scores: Mapping[str, Sequence[Mapping[str, float]]],
    key: str,
    reference: Mapping[str, Sequence[Mapping[str, float]]] | None = None,
) -> tuple[float, float]:
    """Return the mean of a figure over flows and its standard error by the scatter over seeds within each flow.

    With a reference, of the differences to it, seed by seed. Figures that are unknown are left out.
    """
    means, squares = [], []
    for flow, members in scores.items():
        values = np.array([one[key] for one in members], float)
        if reference is not None:
            values = values - np.array([one[key] for one in reference[flow]], float)
        values = values[np.isfinite(values)]
        if len(values):
            means.append(values.mean())
            squares.append(values.var(ddof=1) / len(values) if len(values) > 1 else np.nan)
    if not means:
        return float("nan"), float("nan")
    return float(np.mean(means)), float(np.sqrt(np.sum(squares)) / len(means))


def timing(scale: str, folder: Path) -> list[dict[str, Any]]:
    """Time a frame by each method of two cameras, as a multiple of a pass: a projection and a back-projection."""
    case = Case(scale=scale)
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    weights, names = weights_of(rig, rig.grid), [name for name, cameras in METHODS if cameras == 2 and name != "truth"]
    ratios: dict[str, list[float]] = {name: [] for name in names}
    for name in names if scale == "small" else ():  # what is prepared once per rig
        WAYS[name].reconstruct(rig, recorded, WAYS[name].settings)
    for _ in range(ROUNDS[scale]):
        for name in names:
            start = time.process_time()
            weights.T(weights(np.ones(rig.grid.shape, np.float32)))
            one_pass = time.process_time() - start
            found = WAYS[name].reconstruct(rig, recorded, WAYS[name].settings)
            ratios[name].append(found.cpu_s / one_pass)
            print(f"{name:9s} {found.cpu_s:.2f} s, {ratios[name][-1]:.1f} passes' time", flush=True)
    return [
        {"way": name, "scale": scale, "passes": [float(np.mean(values)), _standard_error(values)]}
        for name, values in ratios.items()
    ]


def _standard_error(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the figures")
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--time-scale", choices=tuple(ROUNDS), default="small", help="size of the rig that is timed")
    parser.add_argument("--only", choices=("seeding", "time"), help="the part that is computed")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images and figures")
    options = parser.parse_args(arguments)
    stored = json.loads(options.out.read_text("utf-8")) if options.only and options.out.exists() else {}
    if options.only != "seeding":
        stored["time"] = timing(options.time_scale, options.cache)
    if options.only != "time":
        seeds = [int(seed) for seed in options.seeds.split(",")]
        stored |= {"seeds": seeds, "flows": FLOWS, "seeding": seeding(seeds, options.cache)}
    files.write_json(files.plain(stored), options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
