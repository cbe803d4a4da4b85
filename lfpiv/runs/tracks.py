"""Tracks of single particles over a time series, made after all of its pairs.

The outcome is one file for the series (`lfpiv.results.track_files`). It depends on the linked particles of the finished
pairs and on their images only, so that it is the same for any number of workers, and wherever a run was interrupted.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.files import writing
from lfpiv.geometry.names import PARTICLE
from lfpiv.progress import StepProgress
from lfpiv.results import provenance
from lfpiv.results.particles import read_particles
from lfpiv.results.provenance import Stamp
from lfpiv.results.track_files import write_tracks
from lfpiv.runs.pair import PairWork
from lfpiv.tracking.following import Candidates, follow
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.refinement import Cloud
from lfpiv.tracking.tracks import SHORTEST, track_table

if TYPE_CHECKING:
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.results.folder import Folder

log = logging.getLogger(__name__)

MOST_SIZED = 50
"""Largest number of pairs over which the median size of the particles is taken."""


def keep_or_make(
    experiment: Experiment,
    folder: Folder,
    stamp_of: Callable[[Sequence[int]], Stamp],
    pairs: Sequence[int],
    make_work: Callable[[], PairWork],
    progress: StepProgress,
) -> None:
    """Keep the stored tracks, or make and store them; without tracking or without a series remove them.

    `pairs` have linked particles in the folder. `stamp_of` returns the stamp of the tracks of some pairs. `make_work`
    returns the work on pairs with its weights; it is called only if tracks must be made.
    """
    wanted = experiment.tracking is not None and experiment.recording.is_series
    if not wanted or len(_instants(experiment, pairs)) < SHORTEST:
        if wanted:
            log.info("tracks: none of fewer than %d instants", SHORTEST)
        with writing(folder.tracks):
            folder.tracks.unlink(missing_ok=True)
        return
    stamp, marks = stamp_of(pairs), provenance.read_marks(folder.tracks)
    if marks is not None and stamp.fits(marks):
        log.info("tracks: finished before with the same settings, kept")
        return
    if stamp.parts["images"] is None:
        log.warning("tracks: not made, an image of the series is missing")
        return
    try:
        table = _make(make_work(), pairs, progress)
    except InputError as error:
        log.warning("tracks: not made: %s", error)
        return
    with writing(folder.tracks):
        write_tracks(table, folder.tracks, stamp=stamp)
    valid = table["valid"].values
    log.info(
        "tracks: %d of %d instants and more, %d particles in all; %d shorter or unlike their neighbours left out",
        table.attrs["tracks"],
        SHORTEST,
        valid.sum(),
        len(np.unique(table["track"].values[~valid])),
    )


def _make(work: PairWork, pairs: Sequence[int], progress: StepProgress) -> xr.Dataset:
    """Follow the particles of a series along its instants.

    Parameters
    ----------
    work : PairWork
        Work on pairs, with weights.
    pairs : sequence of int
        Pairs whose linked particles are in the folder.
    progress : callable
        Called with the finished part.

    Returns
    -------
    Dataset
        See `lfpiv.tracking.tracks.track_table`, with the time of each row [s].

    Raises
    ------
    InputError
        If an image cannot be used, or a table of particles is damaged.
    """
    experiment, recording = work.experiment, work.experiment.recording
    search = replace(work.search, sigma_voxel=_median_sigma_voxel(work, pairs))
    cameras = len(search.weights.cameras)
    instants = _instants(experiment, pairs)

    def look(instant: int, positions: np.ndarray, light: np.ndarray) -> FoundParticles:
        frame = work.light_again(recording.frame(instant))
        in_cameras = np.repeat(light[:, None], cameras, axis=1)
        cloud = Cloud(positions_mm=positions * experiment.grid.voxel_mm, light=in_cameras)
        return search.look(frame.images, cloud, noise=frame.noise, clipped=frame.clipped or None)

    def candidates() -> Iterator[tuple[int, Candidates]]:
        known = set(pairs)
        for number, instant in enumerate(instants):
            progress(number / len(instants))
            ends = [(instant - frame * recording.step, frame) for frame in (0, 1)]
            tables = [(read_particles(work.folder.particles(pair)), frame) for pair, frame in ends if pair in known]
            yield instant, Candidates.from_links(tables, recording.step)

    followed = follow(candidates(), look)
    table = track_table(followed, voxel_mm=experiment.grid.voxel_mm, dt_s=experiment.dt_s / recording.step)
    times = np.array([recording.time_s(instant, experiment.dt_s) for instant in table["instant"].values])
    progress(1.0)
    about = {"units": "s", "long_name": "time after the first instant of the series"}
    return table.assign(time=(PARTICLE, times, about))


def _instants(experiment: Experiment, pairs: Sequence[int]) -> list[int]:
    """Return the instants of both frames of pairs, rising, each once."""
    return sorted({frame.number for pair in pairs for frame in experiment.pair_frames(pair)})


def _median_sigma_voxel(work: PairWork, pairs: Sequence[int]) -> float:
    """Return the median size of the particles [voxel] in evenly chosen pairs."""
    some = pairs[:: -(-len(pairs) // MOST_SIZED)]
    sizes = [read_particles(work.folder.particles(pair)).attrs["sigma_voxel"] for pair in some]
    return float(np.median(sizes))
