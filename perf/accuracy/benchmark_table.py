"""Make cases of the benchmark, measure them by this software and by baselines, score all; figures of the page.

    python perf/accuracy/benchmark_table.py --out docs/figures/benchmark.json [--cases base,shear] [--methods lfpiv]

Cases, calibrations and results stay in the folder of `--cache` and are not made again: take another folder for other
code. A row that the file has is replaced if it is scored anew; others are kept. Every method writes NetCDF files, which
`lfpiv benchmark score` reads.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_methods import METHODS, Prepared, Volumes, measure, prepared

from lfpiv import files
from lfpiv.benchmark.cases import case_list, case_of
from lfpiv.benchmark.make import make
from lfpiv.benchmark.score import CURVE, Score, ScoreOptions, score_results
from lfpiv.benchmark.truth import Truth, open_truth
from lfpiv.benchmark.volumes import read_volume
from lfpiv.calibration.camera import load_calibration
from lfpiv.calibration.cameras import calibrate
from lfpiv.experiment.opening import open_experiment
from lfpiv.runs.measurement import prepare

CACHE = Path(tempfile.gettempdir()) / "lfpiv-benchmark"
CASES = ("base", "seeding-0.5", "cameras-1", "cameras-3", "realistic", "turbulence")
KEPT = (
    "completeness", "error", "error_percent", "median", "error_point", "error_at_50", "error_at_80", "error_at_90",
    "error_at_95", "slope_x", "slope_y", "slope_z", "outliers", "divergence", "within_one", "within_two", "sigma_width",
    "quality", "ghosts", "seconds",
)  # fmt: skip
"""Figures that are stored."""


def measure_case(name: str, methods: Sequence[str], cache: Path, pairs: int) -> list[dict[str, Any]]:
    """Measure the first pairs of a case by several methods; return a row of each."""
    folder = cache / name
    make([name], folder / "data")
    truth, case = open_truth(folder / "data"), None
    rows = []
    for method in methods:
        for pair in truth.numbers[:pairs]:
            if not (folder / method / "vectors" / f"pair_{pair:04d}.nc").exists():
                case = case or _prepared(folder, truth)
                measure(case, method, pair, folder / method, shared_volumes(folder, method, pair))
        rows.append(row_of(name, method, score_method(folder, method, pairs)))
        print(rows[-1]["case"], method, {key: rows[-1]["figures"][key]["value"] for key in KEPT[:9]}, flush=True)
    return rows


def _prepared(folder: Path, truth: Truth) -> Prepared:
    """Return a case ready to be measured; its calibration is kept."""
    experiment, stored = open_experiment(folder / "data" / "experiment.toml"), folder / "calibration.h5"
    if not stored.exists():
        calibrate(experiment).save(stored)
    return prepared(prepare(experiment, load_calibration(stored)), truth)


def shared_volumes(folder: Path, method: str, pair: int) -> Volumes | None:
    """Return the volumes that a method takes from this software's, measured before; None if it makes its own."""
    if method != "openpiv":
        return None
    first, second = (read_volume(folder / "lfpiv" / "volumes" / f"pair_{pair:04d}_{frame}.nc") for frame in "ab")
    return first, second


def score_method(folder: Path, method: str, pairs: int) -> Score:
    """Score what a method wrote, as `lfpiv benchmark score` does."""
    out = folder / method
    volumes = out / "volumes" if (out / "volumes").is_dir() else None
    options = ScoreOptions(volumes=volumes, pairs=(0, pairs))
    (score,) = score_results(folder / "data", [out], options, labels=[METHODS[method][0]])
    return score


def row_of(name: str, method: str, score: Score) -> dict[str, Any]:
    """Return a row of the table."""
    figures = score.to_dict()["figures"]
    curve = [score.curve.bound_at(part) for part in CURVE]
    return {
        "case": name,
        "varies": case_of(name).varies,
        "method": method,
        "label": METHODS[method][0],
        "pairs": len(score.instants),
        "figures": {key: figures[key] for key in KEPT if key in figures},
        "curve": {"part": np.round(CURVE, 3).tolist(), "error": curve},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the rows")
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--pairs", type=int, default=3, help="first pairs of each case that are measured")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of cases and results")
    options = parser.parse_args(arguments)
    methods = options.methods.split(",")
    if "openpiv" in methods and importlib.util.find_spec("openpiv") is None:
        print("OpenPIV is not installed: its rows are left out", file=sys.stderr)
        methods.remove("openpiv")
    stored = json.loads(options.out.read_text("utf-8")) if options.out.exists() else {"rows": []}
    rows = {(row["case"], row["method"]): row for row in stored["rows"]}
    for name in options.cases.split(","):
        for row in measure_case(name, methods, options.cache, options.pairs):
            rows[row["case"], row["method"]] = row
        table = {"benchmark": case_list().version, "rows": list(rows.values())}
        files.write_json(files.plain(table), options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
