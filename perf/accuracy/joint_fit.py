"""Joint fit of both frames beside the correlation of each frame's volume, on the same images.

    python perf/accuracy/joint_fit.py --cases abc:0.5:1:2 ring:0.5:1:2:real abc:0.5:1:2:clean:0

A case is flow, particles per microlens, seed, number of cameras, then condition and size of the blobs [voxel] if they
are not "clean" and 0.7. A row has the mean length of the errors of all and of interior vectors [voxel], slopes of
measured on true fluctuations along x, y, z, the share of errors of valid components within two standard deviations,
the largest error of a valid vector, Q, and CPU time [s].
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from reconstruction_cases import ANGLES_DEG, Case, Recorded, make_rig, record, true_field, true_volume
from reconstruction_ways import guard_layers, particle_size, weights_of

from lfpiv import metrics
from lfpiv.geometry.grid import AXES
from lfpiv.joint.fit import JointFit
from lfpiv.joint.pair import PairSolver
from lfpiv.joint.vectors import joint_vectors
from lfpiv.reconstruction.refinement import needed_refinement
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.settings.processing import Correlation, Smart
from lfpiv.velocity.settings import cut_windows

FOLDER = Path(tempfile.gettempdir()) / "lfpiv-joint-fit"


def case_of(text: str) -> Case:
    """Return a case from its name."""
    flow, ppm, seed, cameras, *more = text.split(":")
    blob = {"blob_voxel": float(more[1])} if len(more) > 1 else {}
    angles, condition = ANGLES_DEG[int(cameras)], more[0] if more else "clean"
    return Case(flow=flow, ppm=float(ppm), seed=int(seed), angles_deg=angles, condition=condition, scale="flat", **blob)


@dataclass(frozen=True)
class Fitted:
    """Volumes and vectors of a case."""

    recorded: Recorded
    volumes: list[xr.DataArray]
    vectors: xr.Dataset
    fit: JointFit | None
    seconds: float
    """CPU time of the solver and the vectors [s]."""


def fitted(case: Case, estimate: str) -> Fitted:
    """Measure a case."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, FOLDER)
    size = particle_size(rig, recorded)
    factor = needed_refinement(size)
    weights = weights_of(rig, rig.grid.padded(guard_layers(rig, recorded)).refined(factor), (size or 0.0) * factor)
    solver = PairSolver(weights, SmartSettings(**Smart().of_one_frame(factor)), estimate=estimate)
    light = [{name: rig.light(name, image) for name, image in images.items()} for images in recorded.images]
    noise = [{name: rig.noise(name, image) for name, image in images.items()} for images in recorded.images]
    correlation = Correlation().model_dump() | {"windows": cut_windows(case.windows, rig.grid.shape)}
    start = time.process_time()
    result = solver.solve(light, noise)
    volumes = [volume.drop_vars("views", errors="ignore") for volume in result.to_dataarrays(rig.grid)]
    vectors = joint_vectors(volumes, dt_s=1.0, **correlation)
    return Fitted(recorded, volumes, vectors, result.fit, time.process_time() - start)


def measured(case: Case, estimate: str) -> str:
    """Measure a case, and return the row of its figures."""
    result = fitted(case, estimate)
    vectors, volumes = result.vectors, result.volumes
    edge = json.loads(vectors.attrs["settings"])["windows"][-1]
    exact = true_field(case, [vectors[axis].values for axis in AXES], edge)
    found, stated = (
        np.stack([vectors[f"{name}_{axis}"].values for axis in "xyz"], -1) for name in ("displacement", "uncertainty")
    )
    error, valid = found - exact, vectors["valid"].values
    length = np.linalg.norm(error, axis=-1)
    inner = length[tuple(slice(1, -1) if n > 2 else slice(None) for n in length.shape)]
    spread = exact - exact.mean((0, 1, 2))
    slopes = (spread * found).sum((0, 1, 2)) / (spread**2).sum((0, 1, 2))
    held = (np.abs(error[valid]) < 2 * stated[valid]).mean()
    quality = np.mean(
        [metrics.reconstruction_quality(one, true_volume(case, result.recorded, k)) for k, one in enumerate(volumes)]
    )
    rms = np.sqrt((error**2).mean((0, 1, 2)))
    fit = "" if result.fit is None else f" ({result.fit.rounds} rounds, {result.fit.misfit_ratio:.2f})"
    return (
        f"{length.mean():.3f} / {inner.mean():.3f} | {' '.join(f'{one:.3f}' for one in rms)} | "
        f"{' '.join(f'{one:.2f}' for one in slopes)} | {100 * held:.0f} % | {length[valid].max():.2f} | "
        f"{100 * valid.mean():.0f} % | {quality:.3f} | {result.seconds:.1f}{fit}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", required=True)
    print("| case | estimate | all / interior | rms x y z | slopes | within 2 | worst | valid | Q | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in parser.parse_args().cases:
        for estimate in ("correlation", "joint"):
            print(f"| {name} | {estimate} | {measured(case_of(name), estimate)} |", flush=True)
