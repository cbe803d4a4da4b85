"""Compare ways of reconstructing on the same images: error, slopes, bias, Q, ghosts, misfit, passes, time, coverage.

    python perf/accuracy/reconstruction_bench.py --cases blobs,points --conditions clean,real --cameras 2,4 \\
        --flows ring,swirl,shear --ppm 0.5 --seeds 1,2,3 --set smart.iterations=10 --against smart.iterations=40

Each `--set` is one way: a name of `WAYS`, keys of the tables smart, correlation and volume, or both. `--against` is the
reference of the paired differences; without either the defaults of the code stand alone. Results are stored outside the
repository, by case, settings and code, and computed once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from reconstruction_cases import (
    ANGLES_DEG,
    CONDITIONS,
    FLOWS,
    SIZE_MM,
    Case,
    make_rig,
    record,
    true_field,
    true_volume,
)
from reconstruction_ways import WAYS, Way, table_of

import lfpiv
from lfpiv import metrics
from lfpiv.joint.vectors import joint_vectors
from lfpiv.reproduce import rigs, store
from lfpiv.settings.processing import Correlation
from lfpiv.velocity.settings import cut_windows

CACHE = Path(tempfile.gettempdir()) / "lfpiv-reconstruction-bench"
BLOBS = {"points": 0.0, "blobs": rigs.BLOB_VOXEL}
LEAST_MOTION = 0.1
"""Least standard deviation of a true component for which its slope is stated [voxel]."""


# -- figures -----------------------------------------------------------------------------------------------------------


def score(case: Case, way: Way, folder: Path) -> dict[str, float]:
    """Measure a case in one way, or read the figures from the folder.

    Returns
    -------
    dict
        `error`, mean length of the errors against the flow's mean over each window, of all vectors, and `interior`, of
        those not at the border [voxel]; `error_x`, mean absolute components; `bias_x`; `slope_x` of measured on true
        components, NaN where the truth is uniform; `valid`; `within`, part of the valid components within two stated
        sigma; `q`, against blobs; `ghosts`, peaks that are no particle per particle; `misfit` [counts]; `passes`;
        `cpu_s` of a frame, `correlation_s` of a pair. The same with `unbiased_` for vectors corrected for damping.
    """
    settings = {"case": asdict(case), "way": way.reconstruct.__name__, "settings": way.settings, "code": code_state()}
    name = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:20]
    stored = store.cached(folder / "figures" / f"{name}.json", settings, lambda: measure(case, way, folder))
    return {key: float("nan") if value is None else value for key, value in stored.items()}


def measure(case: Case, way: Way, folder: Path) -> dict[str, float]:
    """Measure a case in one way; see `score`."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    found, start = way.reconstruct(rig, recorded, way.settings), time.process_time()
    vectors = found.vectors or vectors_of(case, found.volumes, way.settings)
    figures = {
        "passes": found.passes,
        "misfit": found.misfit,
        "cpu_s": found.cpu_s,
        "correlation_s": (time.process_time() - start) / len(vectors),
    }
    quality = []
    for frame, volume in enumerate(found.volumes):
        q = metrics.reconstruction_quality(volume, true_volume(case, recorded, frame))
        peaks = metrics.particle_quality(volume, recorded.positions_mm[frame])
        quality.append((q, (peaks.found_count - peaks.matched_count) / peaks.true_count))
    figures["q"], figures["ghosts"] = np.mean(quality, axis=0).tolist()
    fields = [field_figures(case, one) for one in vectors]
    return figures | {name: float(np.mean([one[name] for one in fields])) for name in fields[0]}


def vectors_of(case: Case, volumes: Sequence[xr.DataArray], settings: Mapping[str, Any]) -> list[xr.Dataset]:
    """Correlate each volume with the next one; a joint fit has a displacement already."""
    keys = ({"windows": case.windows} if case.windows else {}) | table_of(settings, "correlation")
    options = Correlation(**keys).model_dump()
    if options["windows"] is not None:
        options["windows"] = cut_windows(options["windows"], volumes[0].shape)
    return [joint_vectors(pair, dt_s=rigs.DT_S, **options) for pair in pairwise(volumes)]


def field_figures(case: Case, vectors: xr.Dataset) -> dict[str, float]:
    """Compare vectors with the truth, raw ones and, where there are some, those corrected for damping."""
    edge = json.loads(vectors.attrs["settings"])["windows"][-1]
    exact = true_field(case, [vectors[axis].values for axis in "zyx"], edge)
    valid = vectors["valid"].values.astype(bool)
    figures = {"valid": float(valid.mean())}
    for name, prefix in (("displacement", ""), ("displacement_unbiased", "unbiased_")):
        if f"{name}_x" not in vectors:
            continue
        measured = np.stack([vectors[f"{name}_{axis}"].values for axis in "xyz"], axis=-1)
        figures |= {prefix + key: value for key, value in _errors(measured, exact).items()}
    spread = np.stack([vectors[f"uncertainty_{axis}"].values for axis in "xyz"], axis=-1)
    told = valid & np.isfinite(spread).all(-1)
    field_of = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], axis=-1)
    within = np.abs(field_of - exact)[told] <= 2 * spread[told]
    return figures | {"within": float(within.mean()) if told.any() else float("nan")}


def _errors(measured: np.ndarray, exact: np.ndarray) -> dict[str, float]:
    """Return errors and slopes of the vectors that are known; where hardly any is valid, some stay unknown."""
    inner = np.zeros(exact.shape[:3], bool)
    inner[tuple(slice(1, -1) if count > 2 else slice(None) for count in inner.shape)] = True
    known = np.isfinite(measured).all(-1)
    measured, exact, inner = measured[known], exact[known], inner[known]
    error = measured - exact
    length = np.linalg.norm(error, axis=-1)
    if not inner.any():
        names = ("error", "interior", *(f"{name}_{axis}" for name in ("error", "bias", "slope") for axis in "xyz"))
        return dict.fromkeys(names, float("nan"))
    figures = {"error": float(length.mean()), "interior": float(length[inner].mean())}
    for number, axis in enumerate("xyz"):
        true, found = exact[..., number], measured[..., number]
        fluctuation = true - true.mean()
        moved = fluctuation.std() > LEAST_MOTION
        figures[f"error_{axis}"] = float(np.abs(error[..., number]).mean())
        figures[f"bias_{axis}"] = float(error[..., number].mean())
        figures[f"slope_{axis}"] = float(fluctuation @ found / (fluctuation @ fluctuation)) if moved else float("nan")
    return figures


@cache
def code_state() -> str:
    """Return a digest of the installed package's sources, so that results of other code are not taken for its own."""
    digest = hashlib.sha256()
    package = Path(lfpiv.__file__).parent
    for folder in (package, package.parent / "lfpiv_kernels"):
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.h")]):
            digest.update(path.read_bytes())
    for name in ("reconstruction_cases", "reconstruction_ways", "refocused"):
        digest.update((Path(__file__).parent / f"{name}.py").read_bytes())
    return digest.hexdigest()[:16]


# -- tables ------------------------------------------------------------------------------------------------------------

COLUMNS = {
    "error": ("err", "6.3f"), "interior": ("inner", "6.3f"), "slope_x": ("sl x", "5.2f"), "slope_y": ("sl y", "5.2f"),
    "slope_z": ("sl z", "5.2f"), "valid": ("valid", "5.2f"), "within": ("2 sd", "5.2f"), "q": ("Q", "6.3f"),
    "ghosts": ("ghost", "5.2f"), "misfit": ("misfit", "8.0f"), "passes": ("pass", "5.1f"), "cpu_s": ("cpu s", "6.2f"),
}  # fmt: skip
"""Figures of the printed table: head and format."""
PAIRED = ("error", "interior", "slope_x", "slope_y", "slope_z", "within", "q", "ghosts")
"""Figures whose paired differences are printed."""


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean of numbers and its standard error; NaN for the error of a single number. NaN are left out."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if not len(known):
        return float("nan"), float("nan")
    error = known.std(ddof=1) / np.sqrt(len(known)) if len(known) > 1 else float("nan")
    return float(known.mean()), float(error)


def compare(cases: Sequence[Case], ways: Sequence[Way], folder: Path) -> list[dict[str, Any]]:
    """Measure cases in several ways, the reference first; print a table of each group that differs in the seed only.

    Returns
    -------
    list of dict
        One record of each group and way: `case`, `way`, `figures` and `differences` to the reference, each a mean over
        the seeds and its standard error.
    """
    groups: dict[str, list[Case]] = {}
    for case in cases:
        groups.setdefault(case.label, []).append(case)
    width = max(len(way.label) for way in ways)
    records, everything = [], {way.label: [] for way in ways}
    for label, members in groups.items():
        print(f"{label}, {len(members)} seeds\n{'':{width}s} " + _head(COLUMNS), flush=True)
        measured = [[score(case, way, folder) for way in ways] for case in members]
        scores = {way.label: [row[number] for row in measured] for number, way in enumerate(ways)}
        for way in ways:
            figures = {name: mean_and_error([one[name] for one in scores[way.label]]) for name in scores[way.label][0]}
            cells = " ".join(f"{figures[name][0]:{form}}" for name, (_, form) in COLUMNS.items())
            print(f"{way.label:{width}s} {cells}", flush=True)
            differences = _differences(scores[way.label], scores[ways[0].label])
            everything[way.label] += list(zip(scores[way.label], scores[ways[0].label], strict=True))
            records.append({"case": label, "way": way.label, "figures": figures, "differences": differences})
            if way is not ways[0]:
                print(f"{'':{width}s} {_paired_text(differences)}", flush=True)
    for way in ways[1:]:
        first, second = zip(*everything[way.label], strict=True)
        print(f"all {len(first)} cases, {way.label} - {ways[0].label}: {_paired_text(_differences(first, second))}")
    return records


def _head(columns: Mapping[str, tuple[str, str]]) -> str:
    return " ".join(f"{head:>{form.split('.')[0]}s}" for head, form in columns.values())


def _differences(
    scores: Sequence[Mapping[str, float]], reference: Sequence[Mapping[str, float]]
) -> dict[str, tuple[float, float]]:
    return {
        name: mean_and_error([one[name] - other[name] for one, other in zip(scores, reference, strict=True)])
        for name in scores[0]
        if name in reference[0]
    }


def _paired_text(differences: Mapping[str, tuple[float, float]]) -> str:
    shown = ((name, differences[name]) for name in PAIRED if np.isfinite(differences[name][0]))
    return "  ".join(f"{name} {mean:+.3f}±{error:.3f}" for name, (mean, error) in shown)


# -- command line ------------------------------------------------------------------------------------------------------


def parse_way(words: Sequence[str]) -> Way:
    """Return the way of a name of `WAYS` (default "ours") and of settings KEY=VALUE, values as in TOML."""
    named = [word for word in words if "=" not in word]
    if len(named) > 1 or not set(named) <= WAYS.keys():
        raise ValueError(f"--set: expected at most one of {', '.join(WAYS)}, then KEY=VALUE, got {' '.join(words)}.")
    base, given = WAYS[named[0] if named else "ours"], {}
    for word in words:
        if "=" in word:
            key, value = word.split("=", 1)
            try:
                given[key] = json.loads(value)
            except json.JSONDecodeError:
                given[key] = value
    label = " ".join([*named, *(word for word in words if "=" in word)]) or base.label
    return Way(label=label, reconstruct=base.reconstruct, settings={**base.settings, **given})


def parse_cases(options: argparse.Namespace) -> list[Case]:
    """Return all combinations of the options, seeds innermost."""
    kinds = [BLOBS[name] if name in BLOBS else float(name.removeprefix("blobs")) for name in options.cases.split(",")]
    if options.angles:
        rigs_angles = [tuple(float(angle) for angle in options.angles.split(","))]
    else:
        rigs_angles = [ANGLES_DEG[int(count)] for count in options.cameras.split(",")]
    lists = (
        options.conditions.split(","),
        rigs_angles,
        [float(value) for value in options.ppm.split(",")],
        options.flows.split(","),
        [int(value) for value in options.seeds.split(",")],
    )
    return [
        Case(
            flow=flow,
            ppm=ppm,
            seed=seed,
            blob_voxel=blob,
            condition=condition,
            angles_deg=angles,
            scale=options.scale,
            frames=options.frames,
        )
        for blob, (condition, angles, ppm, flow, seed) in product(kinds, product(*lists))
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="blobs", help="particles: blobs, points, or blobs0.5, blobs1.0, ... [voxel]")
    parser.add_argument("--conditions", default="clean", help=", ".join(CONDITIONS))
    parser.add_argument("--cameras", default="2", help="numbers of cameras, 1 to 4")
    parser.add_argument("--angles", help="angles of the cameras instead, such as --angles=60,-30")
    parser.add_argument("--flows", default="ring,swirl,shear", help=", ".join(FLOWS))
    parser.add_argument("--ppm", default="0.5", help="particles per microlens")
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--frames", type=int, default=2, help="frames of a series")
    parser.add_argument("--scale", choices=tuple(SIZE_MM), default="small")
    parser.add_argument("--set", nargs="+", action="append", default=[], metavar="WAY", help="NAME and KEY=VALUE")
    parser.add_argument("--against", nargs="*", metavar="WAY", help="the reference, default: the code's defaults")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images and figures")
    parser.add_argument("--json", type=Path, help="file for all means and standard errors")
    options = parser.parse_args(arguments)
    ways = [parse_way(options.against or []), *(parse_way(words) for words in options.set)]
    records = compare(parse_cases(options), ways, options.cache)
    if options.json is not None:
        options.json.write_text(json.dumps(records, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
