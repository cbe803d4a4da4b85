"""Volumes of frames: read or reconstruct each frame once, and use its volume in all its pairs.

`Frames` goes along a work unit and holds both frames of the present pair, each reconstructed by itself. A frame
that fails is kept as a failure, so that all its pairs name the same reason. `JointFrames` fits both frames of a pair
together; `lfpiv.runs.sequences` follows frames along a series.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar
from zipfile import BadZipFile

import numpy as np

from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.recording import Frame
from lfpiv.files import replacing, writing
from lfpiv.progress import StepProgress, part_of
from lfpiv.results.pair_files import FrameVolume, PairFiles, PairVolumes, VolumeFile
from lfpiv.runs.frame_light import FrameLight, compare
from lfpiv.runs.frame_work import FrameWork
from lfpiv.selfcalibration.paired_frames import out_of_order, summed_light
from lfpiv.warn import Code, Warning

log = logging.getLogger(__name__)

Result = TypeVar("Result")


class Failure(Exception):
    """The work on a pair or on one of its frames failed; the text is the reason."""


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
class HeldFrame:
    """One frame: the light of its images and its volume, once they are known."""

    frame: Frame
    light: FrameLight | None = None
    volume: FrameVolume | None = None


@dataclass(eq=False)
class Frames:
    """The frames of the present pair of a work unit, each reconstructed by itself.

    Volumes are taken from the output folder, from another process (`FrameWork.scratch`), or reconstructed.
    """

    work: FrameWork
    stored: Collection[int] = ()
    """Frames whose volumes are stored for other processes."""
    held: dict[Frame, HeldFrame | Failure] = field(default_factory=dict)
    taken: list[Path] = field(default_factory=list)
    """Files of other processes that are read here and needed by no other process."""
    summed: dict[int, Mapping[str, np.ndarray]] = field(default_factory=dict)
    """Instant -> light of its images summed over microlenses, of the last instants of a series."""

    def volumes(self, files: PairFiles, progress: StepProgress) -> PairVolumes:
        """Return the volumes of a pair and the warnings about both its frames.

        Raises
        ------
        Failure
            If one of its frames failed.
        StorageError
            If a volume cannot be written.
        InputError
            If two of the images are the same.
        """
        self.held = {frame: found for frame, found in self.held.items() if self._needed(frame, files)}
        for file in files.frames:
            if file.frame not in self.held:
                self.held[file.frame] = attempted(partial(self._obtain, file))
        between = self._complete(files, progress)
        first, second = (_usable(self.held[file.frame]).volume for file in files.frames)
        assert first is not None and second is not None
        return PairVolumes(frames=(first, second), names=self.work.experiment.frames, between=tuple(between))

    def clear(self) -> None:
        """Forget the frames and remove files of other processes that no one needs any more."""
        self.held.clear()
        for path in self.taken:
            path.unlink(missing_ok=True)
        self.taken.clear()

    def _needed(self, frame: Frame, files: PairFiles) -> bool:
        """Return whether a frame that is held is held further while a pair is done."""
        return any(frame == file.frame for file in files.frames)

    def _obtain(self, file: VolumeFile) -> HeldFrame:
        """Return a frame with its volume, or with the light from which the volume is reconstructed."""
        if (known := self._known(file)) is not None:
            return known
        self.work.require_weights(file)
        return HeldFrame(file.frame, self.work.light_again(file.frame))

    def _complete(self, files: PairFiles, progress: StepProgress) -> Sequence[Warning]:
        """Compare the images of both frames, then reconstruct what is missing; return the warnings about both."""
        first, second = (_usable(self.held[file.frame]) for file in files.frames)
        between = self._compared(first, second)
        new = [one for one in (first, second) if one.volume is None]
        self.work.log_warnings(files.pair, [warning for one in new if one.light for warning in one.light.warnings])
        self._reconstruct(new, (first, second), progress)
        self._hand_on(files, new)
        return between

    def _reconstruct(self, new: Sequence[HeldFrame], both: Sequence[HeldFrame], progress: StepProgress) -> None:
        """Reconstruct the new ones of both frames of a pair, each by itself."""
        for number, one in enumerate(new):
            assert one.light is not None
            step = part_of(progress, number / len(new), (number + 1) / len(new))
            self.work.writer.wait_large()
            found = attempted(partial(self.work.reconstructor.frame, one.light, step))
            if isinstance(found, Failure):
                self.held[one.frame] = found
            else:
                one.volume = found

    def _compared(self, first: HeldFrame, second: HeldFrame) -> Sequence[Warning]:
        """Return the warnings about both frames; none if the images of one cannot be read any more.

        The warnings about an image pair are stored with its first volume, since no other pair shares it.
        """
        shared = self.work.experiment.recording.is_series
        if first.volume is not None and not shared:
            return ()
        for one in (first, second):
            try:
                one.light = one.light or self.work.light_again(one.frame)
            except InputError as error:  # the volumes are there, and raw data may be deleted
                log.debug("%s and %s are not compared: %s", first.frame.label, second.frame.label, error)
                return ()
        assert first.light is not None and second.light is not None
        found = compare(self.work.cameras, first.light, second.light)
        if shared:
            return [*found, *self._out_of_order(first.light, second.light)]
        first.light = replace(first.light, warnings=(*first.light.warnings, *found))
        return ()

    def _out_of_order(self, first: FrameLight, second: FrameLight) -> list[Warning]:
        """Return the warnings about cameras whose first image of two stands out of order beside the one before it."""
        number, cameras = first.frame.number, self.work.cameras
        step = second.frame.number - number
        for light in (first, second):
            if light.frame.number not in self.summed:
                self.summed[light.frame.number] = summed_light(light.images, cameras)
        self.summed = {known: found for known, found in self.summed.items() if known >= number - 2 * step}
        if number - step not in self.summed:  # it failed, is none, or belongs to the work before
            return []
        images = [found for at in range(-2, 2) if (found := self.summed.get(number + at * step)) is not None]
        return [
            Warning(code=Code.OUT_OF_ORDER, subject=name, instants=(number,))
            for name in cameras
            if out_of_order(*(image[name] for image in images))
        ]

    def _hand_on(self, files: PairFiles, new: Sequence[HeldFrame]) -> None:
        """Start to write new volumes where they are wanted."""
        for file in files.frames:
            one = next((one for one in new if one.frame == file.frame), None)
            if one is None or one.volume is None:
                continue
            if self.work.keep_volumes:
                self.work.write(partial(file.write, one.volume), large=True)
            if file.frame.number in self.stored and self.work.scratch is not None:
                assert one.light is not None
                _write_light(one.light, _light_path(file, self.work.scratch))
                if not self.work.keep_volumes:
                    self.work.write(partial(file.within(self.work.scratch).write, one.volume), large=True)

    def _known(self, file: VolumeFile) -> HeldFrame | None:
        """Return a frame whose volume is in the output folder or was stored by another process."""
        if (found := file.read()) is not None:
            return HeldFrame(file.frame, self._stored_light(file), found)
        if self.work.scratch is None:
            return None
        there = file.within(self.work.scratch)
        if (found := there.read()) is None:
            return None
        self._take(file, there.path)
        return HeldFrame(file.frame, self._stored_light(file), found)

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


class JointFrames(Frames):
    """The frames of image pairs, both fitted together with their displacement."""

    def _reconstruct(self, new: Sequence[HeldFrame], both: Sequence[HeldFrame], progress: StepProgress) -> None:
        if new:
            lights = [one.light or self.work.light_again(one.frame) for one in both]
            self.work.writer.wait_large()
            both[0].volume, both[1].volume = self.work.reconstructor.pair(lights, progress)


def attempted(work: Callable[[], Result]) -> Result | Failure:
    """Return the result of the work on a frame, or why it failed: an error in one must not end the others."""
    try:
        return work()
    except StorageError:
        raise
    except Exception as error:
        return failure(error)


def _usable(found: HeldFrame | Failure) -> HeldFrame:
    if isinstance(found, Failure):
        raise found.with_traceback(None)
    return found


def _light_path(file: VolumeFile, folder: Path) -> Path:
    return folder / f"{file.path.stem}.npz"


def _write_light(light: FrameLight, path: Path) -> None:
    """Write what `compare` needs of the light of a frame, atomically."""
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
