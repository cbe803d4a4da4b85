"""Volumes of a time series: read or reconstruct each instant once, and use its volume in both its pairs.

`Instants` goes along a stretch of pairs and holds the two instants of the present pair. An instant that fails is kept
as a failure, so that both its pairs name the same reason.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol
from zipfile import BadZipFile

import numpy as np

from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.recording import Frame
from lfpiv.files import replacing, writing
from lfpiv.progress import StepProgress, part_of
from lfpiv.results.pair_files import FrameVolume, PairFiles, PairVolumes, VolumeFile
from lfpiv.runs.frame_light import FrameLight, compare

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.reconstruction.sequence import Before
    from lfpiv.runs.pair_volumes import Followed
    from lfpiv.warn import Warning

log = logging.getLogger(__name__)


class InstantWork(Protocol):
    """The work on one instant, which `lfpiv.runs.pair` does."""

    @property
    def experiment(self) -> Experiment:
        """The experiment of the series."""

    @property
    def cameras(self) -> Mapping[str, CalibratedCamera]:
        """Cameras that know what stands still in their images."""

    @property
    def keep_volumes(self) -> bool:
        """Whether volumes are written into the output folder."""

    @property
    def scratch(self) -> Path | None:
        """Folder in which processes store volumes for each other; None for a process by itself."""

    def read_light(self, file: VolumeFile) -> FrameLight:
        """Read and check the images of an instant whose volume is to be reconstructed."""

    def require_weights(self, file: VolumeFile) -> None:
        """Raise InputError if a volume that is not in the folder cannot be reconstructed."""

    def light_again(self, instant: Frame) -> FrameLight:
        """Read the images of an instant, also if its volume is known."""

    def reconstruct(self, light: FrameLight, progress: StepProgress) -> FrameVolume:
        """Reconstruct one instant."""

    def follow(self, light: FrameLight, before: Before | None, progress: StepProgress) -> tuple[Followed, Before]:
        """Reconstruct an instant from its predecessor; return it and what its successor needs."""

    def correct(self, trail: Sequence[Followed], at: int, progress: StepProgress) -> FrameVolume:
        """Reconstruct one of successive instants again from those before and after it."""

    def write(self, write: Callable[[], None], *, large: bool = False) -> None:
        """Start to write a result of the present pair."""


class Failure(Exception):
    """The work on a pair or on one of its instants failed; the text is the reason."""


def failure(error: Exception) -> Failure:
    """Return the reason of an error as users read it, without the frames and arrays that the error refers to."""
    if isinstance(error, Failure):
        return error
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return Failure("out of memory: use fewer workers, larger voxels or a smaller volume")
    if isinstance(error, ValueError):
        return Failure(text)
    log.debug("%s", "".join(traceback.format_exception(error)))
    return Failure(f"unexpected {type(error).__name__}: {text}")


@dataclass(eq=False)
class Instant:
    """One instant: its volume and, once it was read, the light of its images."""

    frame: Frame
    volume: FrameVolume
    light: FrameLight | None


@dataclass(eq=False)
class Instants:
    """The instants of the present pair of a stretch.

    Volumes are taken from the output folder, from another process (`InstantWork.scratch`), or reconstructed.
    """

    work: InstantWork
    stored: Collection[int] = ()
    """Instants whose volumes are stored for other processes."""
    held: dict[Frame, Instant | Failure] = field(default_factory=dict)
    taken: list[Path] = field(default_factory=list)
    """Files of other processes that are read here and needed by no other process."""

    def volumes(self, files: PairFiles, progress: StepProgress) -> PairVolumes:
        """Return the volumes of a pair and the warnings about both its instants.

        Raises
        ------
        Failure
            If one of its instants failed.
        StorageError
            If a volume cannot be written.
        InputError
            If two of the images are the same.
        """
        self._obtain(files, progress)
        first, second = (_usable(self.held[file.frame]) for file in files.frames)
        between = tuple(self._compared(first, second))
        return PairVolumes(frames=(first.volume, second.volume), between=between)

    def keep(self, files: PairFiles, progress: StepProgress) -> None:
        """Reconstruct the instants of a pair whose volumes are not in the output folder; raise as `volumes`."""
        missing = [file for file in files.frames if file.frame in self.held or file.fitting() is None]
        self._obtain(files, progress, missing)
        for file in missing:
            _usable(self.held[file.frame])

    def clear(self) -> None:
        """Forget the instants and remove files of other processes that no one needs any more."""
        self.held.clear()
        for path in self.taken:
            path.unlink(missing_ok=True)
        self.taken.clear()

    def _obtain(self, files: PairFiles, progress: StepProgress, wanted: Sequence[VolumeFile] | None = None) -> None:
        """Hold the instants of a pair, and no others."""
        wanted = files.frames if wanted is None else wanted
        self.held = {frame: found for frame, found in self.held.items() if self._needed(frame, files, wanted)}
        new = [file for file in wanted if file.frame not in self.held]
        for number, file in enumerate(new):
            step = part_of(progress, number / len(new), (number + 1) / len(new))
            try:
                self.held[file.frame] = self._read(file) or self._reconstruct(file, step)
            except StorageError:
                raise
            except Exception as error:  # an error in one instant must not end the series
                self.held[file.frame] = failure(error)

    def _needed(self, frame: Frame, files: PairFiles, wanted: Sequence[VolumeFile]) -> bool:
        """Return whether an instant that is held is held further while a pair is done."""
        return any(frame == file.frame for file in wanted)

    def _read(self, file: VolumeFile) -> Instant | None:
        """Return an instant whose volume is in the output folder or was stored by another process."""
        if (found := file.read()) is not None:
            return Instant(file.frame, found, self._stored_light(file))
        if self.work.scratch is None:
            return None
        there = file.within(self.work.scratch)
        if (found := there.read()) is None:
            return None
        self._take(file, there.path)
        return Instant(file.frame, found, self._stored_light(file))

    def _reconstruct(self, file: VolumeFile, progress: StepProgress) -> Instant:
        light = self.work.read_light(file)
        return self._handed_on(file, Instant(file.frame, self.work.reconstruct(light, progress), light))

    def _handed_on(self, file: VolumeFile, found: Instant) -> Instant:
        """Start to write a new volume where it is wanted; return the instant."""
        if self.work.keep_volumes:
            self.work.write(partial(file.write, found.volume), large=True)
        if file.frame.number in self.stored and self.work.scratch is not None:
            assert found.light is not None
            _write_light(found.light, _light_path(file, self.work.scratch))
            if not self.work.keep_volumes:
                self.work.write(partial(file.within(self.work.scratch).write, found.volume), large=True)
        return found

    def _compared(self, first: Instant, second: Instant) -> Sequence[Warning]:
        """Return the warnings about both instants; none if the images of one cannot be read any more."""
        lights = []
        for one in (first, second):
            try:
                one.light = one.light or self.work.light_again(one.frame)
            except InputError as error:  # the volumes are there, and raw data may be deleted
                log.debug("instants %d and %d are not compared: %s", first.frame.number, second.frame.number, error)
                return ()
            lights.append(one.light)
        return compare(self.work.cameras, lights[0], lights[1])

    def _stored_light(self, file: VolumeFile) -> FrameLight | None:
        """Return the light that another process stored; None if it did not."""
        if self.work.scratch is None:
            return None
        path = _light_path(file, self.work.scratch)
        try:
            light = _read_light(file.frame, list(self.work.cameras), path)
        except (OSError, ValueError, KeyError, BadZipFile):  # it is read from the images
            return None
        self._take(file, path)
        return light

    def _take(self, file: VolumeFile, path: Path) -> None:
        if file.frame.number not in self.stored:
            self.taken.append(path)


def _usable(found: Instant | Failure) -> Instant:
    if isinstance(found, Failure):
        raise found.with_traceback(None)
    return found


def _light_path(file: VolumeFile, folder: Path) -> Path:
    return folder / f"{file.path.stem}.npz"


def _write_light(light: FrameLight, path: Path) -> None:
    """Write what `compare` needs of the light of an instant, atomically."""
    arrays = {f"image_{number}": image for number, image in enumerate(light.images.values())}
    marks = np.array([np.frombuffer(mark, np.uint8) for mark in light.fingerprints.values()])
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as scratch, scratch.open("wb") as file:
            np.savez(file, fingerprints=marks, **arrays)  # type: ignore[arg-type]  # of other arguments


def _read_light(frame: Frame, cameras: Sequence[str], path: Path) -> FrameLight:
    with np.load(path, allow_pickle=False) as stored:
        images = {name: stored[f"image_{number}"] for number, name in enumerate(cameras)}
        marks = {name: mark.tobytes() for name, mark in zip(cameras, stored["fingerprints"], strict=True)}
    return FrameLight(frame=frame, images=images, noise={}, structure={}, fingerprints=marks, warnings=(), seconds=0.0)
