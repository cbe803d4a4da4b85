"""Compare methods of the field on the same images, against seeding and in time; figures of the notebook.

    python perf/accuracy/method_comparison.py --out docs/_static/methods.json [--seeds 1,2,3] [--time-scale paper]

The errors are means over flows and seeds, with the standard error of the mean over seeds. `--only time` or
`--only seeding` computes one part anew and keeps the other one of the file; `--ways ours` measures some methods only.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from reconstruction_bench import CACHE, score
from reconstruction_cases import ANGLES_DEG, Case, make_rig, record
from reconstruction_ways import WAYS, weights_of

from lfpiv import files

METHODS = (
    ("refocused", 1),
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


def seeding(
    seeds: Sequence[int], folder: Path, ways: Sequence[str], known: Sequence[Mapping[str, Any]] = ()
) -> list[dict[str, Any]]:
    """Measure methods at every seeding: mean figures, standard errors, and differences to ours.

    Rows of `known` stand for the methods that are not among `ways`.
    """
    stored = {(row["way"], row["cameras"], row["ppm"]): row for row in known}
    rows: dict[tuple[str, int, float], dict[str, Any]] = {}
    for ppm, (name, cameras) in product(PPM, METHODS):
        key = name, cameras, ppm
        if name not in ways and key in stored:
            rows[key] = dict(stored[key])
            continue
        cases = {
            flow: [Case(flow=flow, ppm=ppm, seed=one, angles_deg=ANGLES_DEG[cameras]) for one in seeds]
            for flow in FLOWS
        }
        scores = {flow: [score(case, WAYS[name], folder) for case in members] for flow, members in cases.items()}
        figures = {figure: mean_of_flows(_values(scores, figure)) for figure in FIGURES}
        single = {figure: _values(scores, figure) for figure in ("error", "q")}
        rows[key] = {"way": name, "cameras": cameras, "ppm": ppm, "figures": figures, "by_flow": single}
        print(
            f"{ppm:4g} ppm {name:9s} {cameras}", {key: round(value[0], 3) for key, value in figures.items()}, flush=True
        )
    for (_, _, ppm), row in rows.items():
        own = rows["ours", 2, ppm]["by_flow"]
        row["beyond_ours"] = {figure: mean_of_flows(values, own[figure]) for figure, values in row["by_flow"].items()}
    return list(rows.values())


def _values(scores: Mapping[str, Sequence[Mapping[str, float]]], figure: str) -> dict[str, list[float]]:
    """Return one figure of every seed by flow."""
    return {flow: [one[figure] for one in members] for flow, members in scores.items()}


def mean_of_flows(
    values: Mapping[str, Sequence[float | None]], reference: Mapping[str, Sequence[float | None]] | None = None
) -> tuple[float, float]:
    """Return the mean of a figure over flows and its standard error by the scatter over seeds within each flow.

    With a reference, of the differences to it, seed by seed. Figures that are unknown are left out.
    """
    means, squares = [], []
    for flow, given in values.items():
        members = np.array(given, float)
        if reference is not None:
            members = members - np.array(reference[flow], float)
        members = members[np.isfinite(members)]
        if len(members):
            means.append(members.mean())
            squares.append(members.var(ddof=1) / len(members) if len(members) > 1 else np.nan)
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
    parser.add_argument(
        "--ways", help="names of `WAYS` that are measured anew; the others keep the figures of the file"
    )
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images and figures")
    options = parser.parse_args(arguments)
    keeps = options.only or options.ways
    stored = json.loads(options.out.read_text("utf-8")) if keeps and options.out.exists() else {}
    if options.only != "seeding":
        stored["time"] = timing(options.time_scale, options.cache)
    if options.only != "time":
        seeds = [int(seed) for seed in options.seeds.split(",")]
        known = stored.get("seeding", []) if options.ways else []
        ways = options.ways.split(",") if options.ways else list(WAYS)
        stored |= {"seeds": seeds, "flows": FLOWS, "seeding": seeding(seeds, options.cache, ways, known)}
    files.write_json(files.plain(stored), options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
