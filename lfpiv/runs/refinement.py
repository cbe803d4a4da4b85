"""Refinement of a run: how much smaller than the voxels of the experiment the reconstructed ones are.

A particle smaller than a voxel is no sum of voxels: its images do not fit, and light that is left over makes ghosts. So
``smart.refinement = "auto"`` measures the particles' size once per output folder, before the weights are built, and
stores the outcome. The grid of the experiment stays that of the volumes that are written.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from lfpiv.geometry.grid import Layers
from lfpiv.reconstruction.refinement import LARGEST, STEP, measure_size, needed_refinement
from lfpiv.records import RecordError, validate
from lfpiv.results import stamps, stored_outcome
from lfpiv.results.provenance import Marks
from lfpiv.runs import memory
from lfpiv.runs.guard import SampledLight, with_guard
from lfpiv.warn import Code, Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.results.folder import Folder

log = logging.getLogger(__name__)

POINT_VOXEL = 0.05
"""Size of particles below which the images do not distinguish them from points [voxel]."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """Size of the particles, and the refinement that follows from it."""

    pairs: tuple[int, ...]
    """Pairs that the size was measured in; empty if no pair shows particles."""
    size_voxel: float | None
    """Standard deviation of the particles [voxel of the experiment]; 0 for points, None if it could not be measured."""
    factor: float
    """Edge of a voxel over the edge of a reconstructed voxel, >= 1."""
    demanded: float
    """The same without regard to the memory."""

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Any) -> Refinement:
        """Read the form that a file stores; raise RecordError if it has another form, or numbers out of range."""
        found = validate(cls, stored)
        size = 0.0 if found.size_voxel is None else found.size_voxel
        if not (math.isfinite(size) and size >= 0 and 1 <= found.factor <= found.demanded <= LARGEST):
            raise RecordError("its size or its factors are out of range")
        return found


def read(folder: Folder) -> tuple[Refinement, Marks] | None:
    """Read the stored outcome, whether it fits or not, and its marks; None if it is missing or damaged."""
    return stored_outcome.read(folder.refinement, lambda content: Refinement.from_json(content.get("refinement")))


def factor(experiment: Experiment, found: Refinement | None) -> float:
    """Return the refinement of an experiment: stated in its file, or measured; 1 before it is measured."""
    stated = experiment.smart.refinement
    if stated != "auto":
        return float(stated)
    return 1.0 if found is None else found.factor


def refined(experiment: Experiment, factor: float) -> Experiment:
    """Return the experiment with smaller voxels."""
    return replace(experiment, grid=experiment.grid.refined(factor))


def keep_or_measure(
    experiment: Experiment,
    folder: Folder,
    stamp_hash: str,
    background: str | None,
    calibration: Calibration,
    light: SampledLight,
    guard: Layers,
) -> Refinement | None:
    """Return the stored outcome, or measure the size of the particles and store the outcome; None if not "auto".

    `stamp_hash` is the hash of the stamp of the board's calibration, `background` that of the subtracted light, `guard`
    are the guard layers.
    """
    if experiment.smart.refinement != "auto":
        return None
    if (known := read(folder)) is not None:
        found, marks = known
        if stamps.of_guard(experiment, stamp_hash, found.pairs, background).fits(marks):
            log.info("size of the particles: measured before, kept")
            return found
    start = time.perf_counter()
    instants = light()
    images = [image for instant in instants.values() for image in instant]
    size = measure_size(calibration, experiment.grid, images) if images else None
    demanded = needed_refinement(size)
    found = Refinement(
        pairs=tuple(instants),
        size_voxel=None if size is None else round(size, 3),
        factor=_fitting(with_guard(experiment, guard), demanded, size or 0.0),
        demanded=demanded,
    )
    _log(experiment, found, time.perf_counter() - start)
    stamp = stamps.of_guard(experiment, stamp_hash, found.pairs, background)
    stored_outcome.write({"refinement": found.to_json()}, stamp, folder.refinement)
    return found


def warnings(experiment: Experiment, found: Refinement | None) -> list[Warning]:
    """Return a warning if the memory allows larger voxels only than the particles demand."""
    if found is None or experiment.smart.refinement != "auto" or found.factor == found.demanded:
        return []
    voxel_mm = experiment.grid.voxel_mm
    figures = {
        "size": found.size_voxel or 0.0,
        "demanded_mm": voxel_mm / found.demanded,
        "used_mm": voxel_mm / found.factor,
    }
    return [Warning(code=Code.COARSE_VOXELS, figures=figures)]


def _fitting(experiment: Experiment, demanded: float, size_voxel: float) -> float:
    """Return the largest refinement up to the demanded one that fits into the memory of one process."""
    limit, tried = memory.allowed_bytes(experiment), demanded
    while tried > 1:
        finer = refined(experiment, tried)
        if memory.run_bytes(finer, memory.weights_bytes(finer, size_voxel * tried), 1) <= limit:
            return tried
        tried = round(tried - STEP, 2)
    return 1.0


def _log(experiment: Experiment, found: Refinement, seconds: float) -> None:
    """Log the size of the particles and the price of the refinement."""
    if found.size_voxel is None:
        size = "cannot be measured in these images"
    elif found.size_voxel < POINT_VOXEL:
        size = "too small to be measured; they are taken for points"
    else:
        size = f"{found.size_voxel:.2f} voxel (standard deviation of a blob)"
    log.info("size of the particles: %s (%.1f s)", size, seconds)
    if found.factor > 1:
        more, edge = found.factor**3, experiment.grid.voxel_mm / found.factor
        log.info("volumes are reconstructed on voxels of %.3g mm: %.1f times as many as are written", edge, more)
