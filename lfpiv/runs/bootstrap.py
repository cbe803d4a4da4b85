"""Damping by ghosts of a run: measured once in simulated pairs, after recorded ones are finished.

The outcome is one file for all pairs (`lfpiv.results.stored_damping`). It depends on finished vectors, their images and
fixed seeds only, so that it is the same for any number of workers.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from lfpiv.damping.bootstrap import evenly_spread, measure_damping
from lfpiv.errors import InputError
from lfpiv.files import writing
from lfpiv.geometry.grid import AXES
from lfpiv.progress import StepProgress
from lfpiv.results import netcdf, stored_damping
from lfpiv.results.provenance import Stamp
from lfpiv.results.stored_damping import StoredDamping
from lfpiv.runs.frame_light import FrameLight
from lfpiv.runs.pair import PairWork
from lfpiv.velocity.damping import Damping

if TYPE_CHECKING:
    import xarray as xr

    from lfpiv.experiment.experiment import Experiment
    from lfpiv.results.folder import Folder

log = logging.getLogger(__name__)

IMITATED = 4
"""Largest number of recorded pairs whose images show how many particles there are."""
FLOWS = 32
"""Number of recorded pairs whose vectors show the flow, unless more are simulated."""

StampOf = Callable[[Sequence[int]], Stamp]
"""Returns the stamp of the damping measured with some pairs."""


def stored(experiment: Experiment, folder: Folder, stamp_of: StampOf) -> StoredDamping | None:
    """Return the stored damping if it fits the run; None if it is off, missing, or of other settings or images."""
    if not experiment.simulated_pairs or (found := stored_damping.read(folder.bootstrap)) is None:
        return None
    known, marks = found
    return known if stamp_of(known.pairs).fits(marks) else None


def keep_or_measure(
    experiment: Experiment,
    folder: Folder,
    stamp_of: StampOf,
    finished: Callable[[], Sequence[int]],
    make_work: Callable[[], PairWork],
    progress: StepProgress,
) -> StoredDamping | None:
    """Return the stored damping, or measure and store it; None if it is off or no pair can be imitated.

    `finished` returns the pairs whose vectors are in the folder, `make_work` the work on pairs with its weights. Both
    are called only if pairs must be simulated.
    """
    if not experiment.simulated_pairs:
        if experiment.by_links:
            log.info("damping by ghosts: not measured where linked particles give the vectors")
        elif experiment.bootstrap.pairs:
            why = "since a joint fit hardly damps" if experiment.is_joint else "in so short a run"
            log.info("damping by ghosts: not measured %s; set bootstrap.pairs to measure it", why)
        with writing(folder.bootstrap):
            folder.bootstrap.unlink(missing_ok=True)
        return None
    if experiment.in_sequence:
        log.info("damping by ghosts: not measured in a series whose instants follow from those before (smart.predict)")
        return None
    if (known := stored(experiment, folder, stamp_of)) is not None:
        log.info("damping by ghosts: measured before, kept")
        return known
    pairs = evenly_spread(finished(), max(experiment.simulated_pairs, FLOWS))
    if not pairs or stamp_of(pairs).parts["images"] is None:
        log.info("damping by ghosts: not measured, no finished %s has its images", experiment.noun)
        return None
    start, damping, reason = time.perf_counter(), None, ""
    try:
        damping = _measure(make_work(), pairs, progress)
    except InputError as error:
        log.warning("damping by ghosts: not measured: %s", error)
        return None
    except ValueError as error:
        reason = str(error)
        log.warning("damping by ghosts: not measured: %s", reason)
    seconds = time.perf_counter() - start
    found = StoredDamping(damping=damping, pairs=tuple(pairs), seconds=seconds, reason=reason)
    stored_damping.write(found, stamp_of(pairs), folder.bootstrap)
    if damping is not None:
        for axis in AXES[::-1]:
            log.info("%s", sentence(damping, axis))
        log.info("simulated pairs: %s", damping.likeness)
    return found


def sentence(damping: Damping, axis: str) -> str:
    """Return the damping along an axis as a sentence."""
    found = damping.axes[axis]
    used = "taken off" if found.applied else "not significant" if found.fluctuation else "no fluctuations"
    if found.significant and found.amplifies:
        used = "not taken off, since that would raise the error"
    if not found.alike:
        used = "not taken off, since simulated pairs are harder to measure than recorded ones"
    return (
        f"damping by ghosts along {axis}: slope of measured on true fluctuations {found.slope:.3f} +- "
        f"{found.slope_error:.3f}, offset {found.offset:+.3f} +- {found.offset_error:.3f} voxel; {used}; "
        f"expected error {found.raw_error:.3f} voxel raw, {found.unbiased_error:.3f} without damping"
    )


def _measure(work: PairWork, pairs: list[int], progress: StepProgress) -> Damping:
    """Measure the damping with the vectors and the images of some finished pairs."""
    assert work.weights is not None
    vectors: list[xr.Dataset] = [netcdf.read_vectors(work.folder.vectors(pair)) for pair in pairs]
    frames: list[FrameLight] = []
    for pair in evenly_spread(pairs, IMITATED):
        frames += [work.light_again(frame) for frame in work.experiment.pair_frames(pair)]
    noise = {name: sum(frame.noise[name] for frame in frames) / len(frames) for name in frames[0].noise}
    start = frames[0]  # simulated particles are where its volume has light, so they are measured with its mask
    mask = work.reconstructor.solid(start.frame)
    first = work.reconstructor.solver.smart.solve(start.images, floor=start.noise, mask=mask)
    # simulated particles are alike, so that their images would choose another limit
    as_recorded = work.reconstructor.with_intensity_cap(first.intensity_cap)
    return measure_damping(
        work.weights,
        vectors,
        [frame.images for frame in frames],
        partial(work.measure, frames=(start.frame, start.frame), reconstructor=as_recorded),
        pairs=work.experiment.simulated_pairs,
        noise=noise,
        volume=first.volume,
        progress=progress,
    )
