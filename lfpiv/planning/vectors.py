"""Vectors of a pair: what it takes to measure them, to write their file, and how large the file is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.grid import AXES
from lfpiv.planning.cost import Cost, grown, timed
from lfpiv.planning.part import SHIFT_VOXEL, Volume, blobs
from lfpiv.results.folder import Folder
from lfpiv.results.netcdf import RECONSTRUCTION
from lfpiv.results.pair_files import FrameRecord, FrameVolume, PairFiles, PairVolumes
from lfpiv.runs import pair_figures
from lfpiv.runs.pair_vectors import measure_vectors
from lfpiv.settings.processing import DEFAULT_WINDOWS
from lfpiv.velocity import vector_grid
from lfpiv.velocity.multi_pass import COARSE_OVERLAP
from lfpiv.velocity.settings import Triple, cut_windows, largest_within
from lfpiv.velocity.windows import Windows

BLOCK_EDGE = 64
"""Edge of the block that is correlated [voxel], unless a window is larger."""
BLOCK_STEP = 1.25
"""Least edge of the block, relative to the largest window."""


@dataclass(frozen=True, kw_only=True)
class VectorFile:
    """The file of a pair's vectors."""

    correlate: Cost
    """Measure the vectors."""
    write: Cost
    """Measure their figures and write the file."""
    size: int
    """Size of the file [byte]."""


def plan_vectors(whole: Volume, per_voxel: float, volume: xr.DataArray, scratch: Path) -> VectorFile:
    """Correlate a block of the volume and write the file of its vectors; return the cost and the size for the whole.

    Parameters
    ----------
    whole : Volume
    per_voxel : float
        Particles per reconstructed voxel.
    volume : DataArray
        Volume of a part, which the file condenses.
    scratch : Path
        Folder for the file.
    """
    experiment, grid = whole.experiment, whole.experiment.grid
    block = whole.of_edges(_block_edges(experiment))
    fine = whole.refinement
    first, second = (
        xr.DataArray(
            blobs(block.experiment.grid.shape, per_voxel * fine**3, whole.particle_voxel / fine, shift),
            block.experiment.grid.coordinates(),
            AXES,
        )
        for shift in (0.0, SHIFT_VOXEL)
    )
    measure_vectors(first[:24, :24, :24], second[:24, :24, :24], _with_windows(block.experiment, (24, 24, 24)))
    vectors, correlate = timed(lambda: measure_vectors(first, second, block.experiment))
    growth = passed_voxels(experiment, grid.shape) / passed_voxels(experiment, block.experiment.grid.shape)
    vectors.attrs |= {"reconstruction_s": 0.0, "correlation_s": 0.0, "warnings": "[]"}
    names = experiment.frames if experiment.series is None else ("a", "b")
    records = [
        FrameRecord(structure={camera.name: 0.5 for camera in experiment.cameras}, warnings=(), seconds=0.0)
        for _ in names
    ]
    frames = FrameVolume(volume=volume, record=records[0]), FrameVolume(volume=volume, record=records[1])
    written = _Written(block.experiment, Folder(scratch, experiment.series), PairVolumes(frames=frames, names=names))
    counts = vector_grid.planned(experiment.correlation, grid.shape).count
    sizes, write = [], []
    few = vectors.isel({axis: slice(0, 2) for axis in AXES})
    for some in (few, vectors):
        path, cost = timed(partial(written.write, some, whole))
        sizes.append(_size(path, {}))
        write.append(cost)
    own = dict(zip(AXES, counts, strict=True)) | {f"voxel_{axis}": n for axis, n in zip(AXES, grid.shape, strict=True)}
    size = _size(path, own)
    return VectorFile(
        correlate=correlate * growth, write=grown((sizes[0], write[0]), (sizes[1], write[1]), size), size=size
    )


@dataclass(frozen=True)
class _Written:
    """The file of a pair, as a run writes it."""

    experiment: Experiment
    folder: Folder
    volumes: PairVolumes

    def write(self, vectors: xr.Dataset, whole: Volume) -> Path:
        """Write it with some vectors."""
        number = self.experiment.numbers[0]
        files = PairFiles.of(self.experiment, "", self.folder, number, guard=whole.guard, refinement=whole.refinement)
        condensed = self.volumes.condensed()
        figures = pair_figures.measure(vectors, condensed, self.volumes.warnings)
        attributes = {
            "experiment": self.experiment.name,
            "smart": self.experiment.smart.model_dump(),
            "correlation": self.experiment.correlation.model_dump(),
            "figures": figures.to_json(),
        }
        files.write_vectors(vectors, condensed, attributes)
        return files.vectors


def passed_voxels(experiment: Experiment, shape: Triple) -> float:
    """Return the voxels of all windows of all passes, which the time of a correlation is proportional to."""
    correlation, total = experiment.correlation, 0
    windows = cut_windows(correlation.windows or DEFAULT_WINDOWS, shape)
    for number, window in enumerate(windows):
        last = number == len(windows) - 1
        overlap = correlation.overlap if last else max(correlation.overlap, COARSE_OVERLAP)
        total += math.prod(Windows.overlapping(shape, window, overlap).count) * math.prod(window)
    return float(total)


def _block_edges(experiment: Experiment) -> Triple:
    shape = experiment.grid.shape
    largest = np.max(cut_windows(experiment.correlation.windows or DEFAULT_WINDOWS, shape), axis=0)
    z, y, x = (
        min(n, max(BLOCK_EDGE, math.ceil(BLOCK_STEP * int(edge)))) for n, edge in zip(shape, largest, strict=True)
    )
    return z, y, x


def _with_windows(experiment: Experiment, shape: Triple) -> Experiment:
    """Return the experiment with windows that fit into a small volume: it loads the kernels."""
    given = experiment.correlation.windows
    if given is None:
        return experiment
    shape = largest_within(shape, experiment.grid.shape)
    windows = cut_windows(given, shape)
    return replace(experiment, correlation=experiment.correlation.model_copy(update={"windows": windows}))


def _size(path: Path, lengths: Mapping[str, int]) -> int:
    """Return the size of a file if its dimensions had other lengths; each variable keeps its compression."""
    import h5py

    total = float(path.stat().st_size)
    with h5py.File(path, "r") as file:
        for group in ("", RECONSTRUCTION):
            dataset = xr.open_dataset(path, group=group or None, engine="h5netcdf")
            with dataset:
                for name, item in dataset.variables.items():
                    growth = math.prod(lengths.get(str(axis), n) / n for axis, n in item.sizes.items())
                    total += (growth - 1) * file[f"{group}/{name}"].id.get_storage_size()
    return round(total)
