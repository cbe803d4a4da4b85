"""One pair on longer voxels, which takes seconds: for `lfpiv preview` and trials of settings in the studio."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import xarray as xr

from lfpiv.calibration.camera import Calibration
from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.runs import guard
from lfpiv.runs.frame_light import FrameLight
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.weights.operator import Weights, build_weights


def coarsened(experiment: Experiment, edge_mm: float, least: int = 1) -> Experiment:
    """Return an experiment in the same volume on voxels of another edge, at least a number of them along each axis."""
    grid = experiment.grid
    x, y, z = (max(n * grid.voxel_mm, least * edge_mm) for n in reversed(grid.shape))
    cx, cy, cz = grid.centre_mm.tolist()
    coarse = Grid.from_extent(centre_mm=(cx, cy, cz), size_mm=(x, y, z), voxel_mm=edge_mm)
    # particles are smaller than these voxels: their size, measured for the sieve and the limit, would say nothing
    measured = {key: 0.0 for key in ("sieve_voxel", "intensity_cap") if getattr(experiment.smart, key) == "auto"}
    smart = experiment.smart.model_copy(update={"estimate": "correlation", "refinement": 1.0, **measured})
    return replace(experiment, grid=coarse, smart=smart)


def reconstruct(
    experiment: Experiment, calibration: Calibration, light: Sequence[FrameLight], progress: Progress
) -> tuple[Weights, Sequence[xr.DataArray]]:
    """Return weights in the form that is built fastest, and the volume of each frame, without measurements of a run."""
    layers = guard.layers(experiment, None)
    square = all(camera.lattice.layout == "square" for camera in calibration.cameras.values())
    weights = build_weights(
        calibration,
        guard.with_guard(experiment, layers).grid,
        form="profiles" if square else "pixels",
        progress=lambda fraction: progress("coarse weights", fraction),
    )
    progress("coarse volumes", 0.0)
    work = Reconstructor(experiment=experiment, weights=weights, guard=layers, refinement=1.0)
    images, noise, frames = zip(*((one.images, one.noise, one.frame) for one in light), strict=True)
    volumes = work.volumes(images, noise, frames)
    progress("coarse volumes", 1.0)
    return weights, volumes
