"""Methods of the benchmark's table: this software, and baselines on the same images with the same calibration.

This software fits both frames together, or links the particles of a single camera. Every other method but OpenPIV
correlates its volumes as this software does where frames stand alone, so their rows differ by the reconstruction.
OpenPIV correlates slices of this software's volumes. It is GPL and optional: it is imported where it is used.
"""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from refocused import refocused_volume

from lfpiv import metrics
from lfpiv.benchmark.truth import Truth
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.joint.vectors import joint_vectors
from lfpiv.reconstruction.settings import PLAIN
from lfpiv.reconstruction.volume import reconstruct
from lfpiv.results.datasets import write_dataset
from lfpiv.runs.frame_light import FrameLight
from lfpiv.runs.measurement import Rig
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.weights.operator import Weights, build_weights

Volumes = tuple[xr.DataArray, xr.DataArray]
PAPER_ITERATIONS = 10
OPENPIV_WINDOWS = (24, 12, 12)
"""Edges of OpenPIV's windows; the last is the thickness of its slices too [voxel]."""
OPENPIV_PADDING = 3
"""Dark margin of the slices [half windows]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A case that is ready to be measured."""

    rig: Rig
    truth: Truth
    weights: Weights
    """Weights on the voxels of the experiment, for baselines."""

    @property
    def grid(self) -> Grid:
        """Voxels of the experiment."""
        return self.rig.experiment.grid


def prepared(rig: Rig, truth: Truth) -> Prepared:
    """Return a case with the weights of its baselines."""
    return Prepared(rig=rig, truth=truth, weights=build_weights(rig.calibration, rig.experiment.grid))


Reconstruct = Callable[[Prepared, int], Volumes]


def by_lfpiv(case: Prepared, pair: int) -> Volumes:
    """Reconstruct by the defaults of this software."""
    return case.rig.volumes(pair)


def by_paper(case: Prepared, pair: int) -> Volumes:
    """Reconstruct by the paper's ten plain iterations."""

    def one(light: FrameLight) -> xr.DataArray:
        plain = PLAIN | {"accelerate": False, "floor_share": 0.0}
        return reconstruct(case.weights, light.images, PAPER_ITERATIONS, floor=light.noise, **plain)

    first, second = case.rig.light(pair)
    return one(first), one(second)


def by_first_guess(case: Prepared, pair: int) -> Volumes:
    """Return SMART's multiplicative first guess (MLOS)."""

    def one(light: FrameLight) -> xr.DataArray:
        return reconstruct(case.weights, light.images, 0, floor=light.noise, **(PLAIN | {"floor_share": 0.0}))

    first, second = case.rig.light(pair)
    return one(first), one(second)


def by_refocusing(case: Prepared, pair: int) -> Volumes:
    """Refocus the light field of each camera, and combine the stacks by their product."""

    def one(light: FrameLight) -> xr.DataArray:
        values = refocused_volume(case.rig.calibration, light.images, case.grid)
        return xr.DataArray(values, case.grid.coordinates(), AXES)

    first, second = case.rig.light(pair)
    return one(first), one(second)


def by_truth(case: Prepared, pair: int) -> Volumes:
    """Return the true particles as blobs: the error that correlation itself has."""

    def one(frame: int) -> xr.DataArray:
        return metrics.truth_volume(*case.truth.frame(pair, frame), case.grid)

    return one(0), one(1)


def by_default(case: Prepared, pair: int, volumes: Volumes) -> xr.Dataset:
    """Return the vectors of this software: from links with a single camera, else from the joint fit."""
    if case.rig.experiment.by_links:
        return case.rig.vectors(pair)
    return joint_vectors(volumes, dt_s=case.rig.experiment.dt_s, **case.rig.correlation)


def correlated(case: Prepared, pair: int, volumes: Volumes) -> xr.Dataset:
    """Correlate volumes as this software does where frames stand alone."""
    first, second = volumes
    return correlate(first, second, dt_s=case.rig.experiment.dt_s, **case.rig.correlation)


def by_openpiv(case: Prepared, pair: int, volumes: Volumes) -> xr.Dataset:
    """Correlate slices of volumes by OpenPIV: u and v in slices along z, w in slices along y.

    A slice is the sum over as many layers as a window is wide. Windows are deformed in the last two passes.
    """
    first, second = (volume.values.astype(float) for volume in volumes)
    step = OPENPIV_WINDOWS[-1] // 2
    counts = [1 + (size - OPENPIV_WINDOWS[-1]) // step for size in first.shape]
    moved = np.full((*counts, 3), np.nan)
    valid = np.ones(tuple(counts), bool)
    for number in range(counts[0]):
        layers = slice(number * step, number * step + OPENPIV_WINDOWS[-1])
        across, down, good = _planar(first[layers].sum(0), second[layers].sum(0))
        moved[number, ..., 0], moved[number, ..., 1] = across, down
        valid[number] &= good
    for number in range(counts[1]):
        layers = slice(number * step, number * step + OPENPIV_WINDOWS[-1])
        _, down, good = _planar(first[:, layers].sum(1), second[:, layers].sum(1))
        moved[:, number, :, 2] = down
        valid[:, number] &= good
    grid = case.grid
    places = [
        grid.axis_mm(axis)[0] + grid.voxel_mm * (step * np.arange(1, counts[axis] + 1) - 0.5) for axis in range(3)
    ]
    axes = {name: (name, place, {"units": "mm"}) for name, place in zip(AXES, places, strict=True)}
    speed = grid.voxel_mm / 1000 / case.rig.experiment.dt_s
    variables = {name: (AXES, moved[..., k] * speed, {"units": "m/s"}) for k, name in enumerate("uvw")}
    return xr.Dataset({**variables, "valid": (AXES, valid)}, axes)


def _planar(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacements along columns and rows [pixel], and which are valid, at centres half a window apart."""
    from openpiv import windef
    from openpiv.settings import PIVSettings

    step, settings = OPENPIV_WINDOWS[-1] // 2, PIVSettings()
    settings.windowsizes, settings.overlap = OPENPIV_WINDOWS, tuple(edge // 2 for edge in OPENPIV_WINDOWS)
    settings.num_iterations = len(OPENPIV_WINDOWS)
    around = OPENPIV_PADDING * step  # dark pixels, so that the first pass has enough windows for its spline
    images = [np.pad(image, around).astype(np.float32) for image in (first, second)]
    with contextlib.redirect_stdout(io.StringIO()):  # its validation prints
        _, _, across, up, flags = windef.simple_multipass(*images, settings)
    inner = (slice(OPENPIV_PADDING, -OPENPIV_PADDING),) * 2
    across, down = np.asarray(across, float)[inner], -np.asarray(up, float)[inner]  # its v points against the rows
    good = np.isfinite(across) & np.isfinite(down) & ~np.asarray(flags, bool)[inner]
    return across, down, good


METHODS: Mapping[str, tuple[str, Reconstruct, Callable[[Prepared, int, Volumes], xr.Dataset]]] = {
    "lfpiv": ("lfpiv, defaults", by_lfpiv, by_default),
    "paper": ("ten plain iterations (the paper's)", by_paper, correlated),
    "mlos": ("first guess (MLOS)", by_first_guess, correlated),
    "refocused": ("refocused stacks", by_refocusing, correlated),
    "openpiv": ("OpenPIV on slices of lfpiv's volumes", by_lfpiv, by_openpiv),
    "truth": ("true particles, correlated", by_truth, correlated),
}
"""Name -> label, reconstruction and correlation."""


def measure(case: Prepared, method: str, pair: int, folder: Path, volumes: Volumes | None = None) -> Volumes:
    """Measure a pair, and write vectors and volumes as a user of any program would hand them in.

    `volumes` are those of a method that shares them. CPU time is stated in the file; of shared volumes that of the
    correlation alone.
    """
    start = time.process_time()
    _, reconstructed, correlation = METHODS[method]
    found = reconstructed(case, pair) if volumes is None else volumes
    vectors = correlation(case, pair, found)
    seconds = time.process_time() - start
    names = [name for name in ("u", "v", "w", "valid") if name in vectors]
    names += [f"uncertainty_{axis}" for axis in "xyz" if f"uncertainty_{axis}" in vectors]
    kept = vectors[names].drop_attrs(deep=False)
    edge = OPENPIV_WINDOWS[-1] * case.grid.voxel_mm
    if "settings" in vectors.attrs:
        edge = _window_mm(vectors)
    about = {"voxel_mm": case.grid.voxel_mm, "window_mm": edge, "pair": pair, "seconds": seconds}
    (folder / "vectors").mkdir(parents=True, exist_ok=True)
    write_dataset(kept.assign_attrs(about), folder / "vectors" / f"pair_{pair:04d}.nc")
    if volumes is None:
        (folder / "volumes").mkdir(exist_ok=True)
        for name, volume in zip("ab", found, strict=True):
            plain = xr.DataArray(volume.values.astype(np.float32), case.grid.coordinates(), AXES, name="intensity")
            write_dataset(plain.to_dataset(), folder / "volumes" / f"pair_{pair:04d}_{name}.nc")
    return found


def _window_mm(vectors: xr.Dataset) -> float | list[float]:
    """Return the edges (x, y, z) of the last window."""
    z, y, x = json.loads(vectors.attrs["settings"])["windows"][-1]
    edges = np.array([x, y, z]) * np.asarray(vectors.attrs["voxel_mm"])[::-1]
    return [float(edge) for edge in edges]
