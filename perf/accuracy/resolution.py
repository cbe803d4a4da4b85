"""Response of the vectors to waves of each length: the smallest structure that the correlation and the joint fit show.

    python perf/accuracy/resolution.py --out docs/figures/resolution.json

A transverse wave along x moves particles along y, across the view, and along z, in depth. The response is the slope of
the measured on the true displacement at the centres of the windows, or at the voxels for the field of the joint fit,
away from the faces. "true" is the correlation of the true volumes: what the windows alone take away.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import xarray as xr
from reconstruction_bench import CACHE, vectors_of
from reconstruction_cases import ANGLES_DEG, Case, make_flow, make_rig, record, true_volume
from reconstruction_ways import WAYS as RECONSTRUCTED

from lfpiv.geometry.grid import AXES
from lfpiv.joint.pair import MOVED

WAYS = ("correlation", "true particles", "joint vectors", "joint field")
FACE_MM = 0.6
"""Distance from the faces that is left out: half of the last window."""


def response(case, axes_mm, displacement_voxel: np.ndarray, voxel_mm: float) -> np.ndarray:
    """Return the slopes along y and z of displacements (z, y, x, 3), in order x, y, z, on axes (z, y, x)."""
    z, y, x = np.meshgrid(*axes_mm, indexing="ij")
    exact = make_flow(case)(np.stack([x, y, z], -1).reshape(-1, 3)).reshape(*x.shape, 3) / voxel_mm
    inner = np.ones(x.shape, bool)
    for axis, values in enumerate(axes_mm):
        far = (
            (values >= values[0] + FACE_MM) & (values <= values[-1] - FACE_MM) if len(values) > 12 else values == values
        )
        inner &= np.expand_dims(far, tuple(k for k in range(3) if k != axis))
    inner &= np.isfinite(displacement_voxel).all(-1)
    exact, found = exact[inner], displacement_voxel[inner]
    return ((exact * found).sum(0) / (exact**2).sum(0).clip(1e-12))[1:]


def of_vectors(case, vectors: xr.Dataset) -> np.ndarray:
    """Return the response of vectors."""
    found = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], -1)
    return response(case, [vectors[axis].values for axis in AXES], found, float(vectors.attrs["voxel_mm"][0]))


def responses(case: Case) -> np.ndarray:
    """Return the responses along y and z of one case: correlation, true volumes, joint vectors, joint field."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, CACHE / "images")
    alone, joint = (RECONSTRUCTED[way].reconstruct(rig, recorded, {}).volumes for way in ("ours", "joint"))
    true = [true_volume(case, recorded, frame) for frame in (0, 1)]
    correlated, ideal, fitted = (vectors_of(case, volumes, {})[0] for volumes in (alone, true, joint))
    first = joint[0]
    moved = np.stack([first[MOVED[axis]].values for axis in "xyz"], -1)
    axes = [first[axis].values for axis in AXES]
    field = response(case, axes, moved, float(axes[2][1] - axes[2][0]))
    return np.stack([*(of_vectors(case, one) for one in (correlated, ideal, fitted)), field])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--waves", nargs="+", type=int, default=[10, 12, 14, 16, 20, 24, 32])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--ppm", type=float, default=0.5)
    parser.add_argument("--out", type=Path, help="JSON file for the plot of docs/accuracy.md")
    arguments, rows = parser.parse_args(), []
    print(f"| wave [voxel] | {' | '.join(f'{way} y, z' for way in WAYS)} |\n|---|---|---|---|---|")
    for wave in arguments.waves:
        of_all = {"flow": f"wave{wave}", "ppm": arguments.ppm, "angles_deg": ANGLES_DEG[2], "scale": "flat"}
        found = np.array([responses(Case(seed=seed, **of_all)) for seed in arguments.seeds])
        mean, error = found.mean(0), found.std(0, ddof=1) / len(found) ** 0.5
        cells = [
            " ".join(f"{m:.2f} ± {e:.2f}" for m, e in zip(*row, strict=True)) for row in zip(mean, error, strict=True)
        ]
        print(f"| {wave} | {' | '.join(cells)} |", flush=True)
        both = np.stack([mean, error], -1).round(4)
        rows.append(
            {"wave": wave}
            | {way: dict(zip("yz", one.tolist(), strict=True)) for way, one in zip(WAYS, both, strict=True)}
        )
    if arguments.out is not None:
        arguments.out.write_text(
            json.dumps({"ppm": arguments.ppm, "seeds": arguments.seeds, "response": rows}, indent=1)
        )
