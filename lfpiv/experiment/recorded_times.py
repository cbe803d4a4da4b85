"""Compare ``dt_s`` with the times that the recordings state, where these leave no doubt.

In a series the times of instants k and k + `step` are ``dt_s`` apart. Those of the two frames of an image pair need not
be: a pulse may come at the end of the first exposure and the next at the beginning of the second. Two exposures that
begin T apart and last e and f allow from T - e to T + f. Times of arrival say nothing about a pair, since double frames
arrive one readout apart; nor do two files, whose clocks may differ, but for buffers of DaVis in one folder.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.readers import davis
from lfpiv.experiment.readers.source import ImagePath, Recorded, split
from lfpiv.experiment.readers.table import READERS
from lfpiv.prompt import seconds
from lfpiv.warn import Code, Warning

TOLERANCE = 0.02
"""Largest relative difference of two times that are taken for one: clocks are better, rounded settings are not."""
LOOKED_AT = 3
"""Number of pairs whose times are read."""


class Times(NamedTuple):
    """Least and largest time between the frames of a vector that a recording allows [s]."""

    least: float
    most: float

    @property
    def is_sharp(self) -> bool:
        """Whether they are one time within the tolerance."""
        return 0 < self.most <= self.least * (1 + 2 * TOLERANCE)

    def contradict(self, dt_s: float) -> bool:
        """Return whether a time is beyond them."""
        return not self.least * (1 - TOLERANCE) <= dt_s <= self.most * (1 + TOLERANCE)

    def __str__(self) -> str:
        if self.is_sharp:
            return seconds((self.least + self.most) / 2)
        return f"at most {seconds(self.most)}" if self.least <= 0 else f"{seconds(self.least)} to {seconds(self.most)}"


def contradictions(experiment: Experiment) -> list[Warning]:
    """Return a warning for each time that recordings state and that contradicts ``dt_s``, with its cameras."""
    cameras: dict[str, list[str]] = {}
    for number, camera in enumerate(experiment.cameras):
        known = list(_times(experiment, number))
        if known and all(one.contradict(experiment.dt_s) for one in known):
            cameras.setdefault(str(known[0]), []).append(camera.name)
    stated = seconds(experiment.dt_s)
    return [
        Warning(code=Code.TIME, subject=", ".join(names), figures={"recorded": recorded, "stated": stated})
        for recorded, names in cameras.items()
    ]


def between(first: ImagePath, second: ImagePath, *, is_series: bool) -> Times | None:
    """Return what the recording says about the time between two frames; None where it says nothing for certain.

    Parameters
    ----------
    first, second : ImagePath
        Images of one camera, of the first and the second frame.
    is_series : bool
        Whether they are instants of a time series, whose light comes at the same moment of each exposure.
    """
    one, two = _recorded(first), _recorded(second)
    if one is None or two is None:
        return None
    if one.pulses_s and first.file == second.file and not is_series:
        return Times(one.pulses_s, one.pulses_s)
    apart_s, error_s = _apart(first, second, one, two)
    if apart_s is None or not apart_s > 0:
        return None
    if is_series:
        return Times(apart_s - error_s, apart_s + error_s)
    if one.is_arrival and one.time_s is not None:
        return None
    before, after = (exposure if exposure else one.interval_s for exposure in (one.exposure_s, two.exposure_s))
    least = 0.0 if before is None else max(apart_s - before, 0.0)
    return Times(least, math.inf if after is None else apart_s + after)


def proposed(path: Path, particle_images: str, camera: str) -> str | None:
    """Return ``dt_s`` as the recording of a camera states it, for a new experiment file; None where it does not.

    Parameters
    ----------
    path : Path
        The experiment file, from whose folder paths are taken.
    particle_images : str
        Pattern of the particle images.
    camera : str
        Name of a camera.
    """
    is_series = "{instant" in particle_images
    numbers = [{"instant": at, "pair": 0, "image": at, "frame": "ab"[at]} for at in (0, 1)]
    try:
        first, second = (split(path.parent / particle_images.format(camera=camera, **one)) for one in numbers)
    except (LookupError, ValueError):  # the pattern is checked elsewhere
        return None
    times = between(first, second, is_series=is_series)
    return None if times is None or not times.is_sharp else f"{(times.least + times.most) / 2:.6g}"


def _apart(first: ImagePath, second: ImagePath, one: Recorded, two: Recorded) -> tuple[float | None, float]:
    """Return the time from one image to the other, and its largest error; None where their clocks may differ [s]."""
    same_file = first.file == second.file
    if one.time_s is not None and two.time_s is not None:
        davis_set = first.suffix in davis.SUFFIXES and first.file.parent == second.file.parent
        return (two.time_s - one.time_s if same_file or davis_set else None), one.uncertainty_s
    if one.interval_s is None or not same_file or not (first.part.isdigit() and second.part.isdigit()):
        return None, 0.0
    return (int(second.part) - int(first.part)) * one.interval_s, 0.0


def _times(experiment: Experiment, camera: int) -> Iterator[Times]:
    """Yield what is known of some pairs of a camera, and of a series from its first instant to its last."""
    recording = experiment.recording
    for pair in experiment.spread_pairs(LOOKED_AT):
        first, second = (experiment.frame_images(frame)[camera] for frame in experiment.pair_frames(pair))
        times = between(first, second, is_series=recording.is_series)
        if times is not None and (times.is_sharp or not recording.is_series):
            yield times
    if recording.is_series:
        ends = [recording.frame(number) for number in (recording.frames[0], recording.frames[-1])]
        first, second = (experiment.frame_images(frame)[camera] for frame in ends)
        steps = (ends[1].number - ends[0].number) / recording.step
        if (times := between(first, second, is_series=True)) is not None:
            yield Times(times.least / steps, times.most / steps)


def _recorded(image: ImagePath) -> Recorded | None:
    """Return what an image's file says about its time; None for a file that cannot be read, which is told elsewhere."""
    try:
        return READERS[image.suffix].recorded(image)
    except Exception:  # decoders raise exceptions of many types on damaged files
        return None
