"""Compare the stated pairs or instants with the images that there are, without opening one image after the other.

Files are listed by folder, so that the time follows the number of files and not the stated number. Images inside a file
are counted by its reader.
"""

from __future__ import annotations

import bisect
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.experiment.readers.source import ImagePath, NoSuchImage, split
from lfpiv.experiment.readers.table import READERS
from lfpiv.experiment.recording import Frame

MOST_PROBED = 10_000
"""Largest number of images that are looked for by name inside a file."""
MOST_DIGITS = 18
"""Most digits of a number in the name of a file."""
NAMED_GAPS = 5
"""Largest number of gaps that a message names."""

_HOLE = "\0"


class _Hole:
    """Stands for the number in a path."""

    def __format__(self, form: str) -> str:
        return _HOLE


@dataclass(frozen=True, kw_only=True)
class Missing:
    """Pairs, or instants of a series, whose images are not all there."""

    experiment: Experiment
    stated: range
    """Numbers as stated."""
    complete: int
    """Number of those with all their images."""
    end: range
    """The last numbers, of which there is no image at all; empty if there is one of the last."""
    gaps: tuple[range, ...]
    """Numbers before, of which an image is missing."""
    first: str
    """Path and label of the first missing image."""
    counts_from_one: bool
    """Whether the files are numbered by one more than stated."""

    @property
    def pairs_at_end(self) -> range:
        """Pairs at the end that cannot be done; those of a series need the instant `step` later."""
        recording, pairs = self.experiment.recording, self.experiment.numbers
        if not self.end:
            return range(0)
        return range(max(self.end.start - (recording.shared_step or 0), pairs.start), pairs.stop)

    def message(self) -> str:
        """Return key, pattern, stated and found numbers, which are missing, and what to do."""
        experiment, noun = self.experiment, self.experiment.noun
        missing = [f"{_numbers(noun, gap)} within" for gap in self.gaps[:NAMED_GAPS]]
        missing += [f"{len(self.gaps) - NAMED_GAPS} more gaps"] if len(self.gaps) > NAMED_GAPS else []
        missing += [f"{_numbers(noun, self.end)} at the end"] if self.end else []
        return (
            f"{experiment.path}: particles.{noun}s: expected the images of {len(self.stated)} {noun}s, "
            f"{experiment.particle_images!r}, found those of {self.complete}; missing: {', '.join(missing)}. The first "
            f"missing one is {self.first}: no such file or image. {self._way()}"
        )

    def _way(self) -> str:
        noun, stated = self.experiment.noun, self.stated
        if self.counts_from_one:
            if self.experiment.recording.is_series:
                return f"The images count from {stated.start + 1}: state particles.first = {stated.start + 1}."
            return f"The images count from 1 to {stated.stop}, pairs count from 0: rename the images."
        if self.end and (enough := self.end.start - stated.start) > (self.experiment.recording.shared_step or 0):
            return f"State particles.{noun}s = {enough}, or add the images."
        return "Add the images."


def missing(experiment: Experiment) -> Missing | None:
    """Return which of the stated pairs or instants have not all their images; None if all have, or none has any.

    A file that cannot be listed or opened counts as there; its own check explains why.
    """
    recording = experiment.recording
    stated = recording.frames if recording.is_series else recording.numbers
    complete: set[int] | None = None
    some: set[int] = set()
    for sequence in _sequences(experiment):
        if (numbers := sequence.present(range(stated.start, stated.stop + 1))) is not None:
            complete = numbers if complete is None else complete & numbers
            some |= numbers
    if complete is None or not some:
        return None
    beyond, last = stated.stop in complete, max((one for one in some if one in stated), default=stated.start - 1)
    present = sorted(number for number in complete if number in stated)
    gaps = tuple(_gaps(present, range(stated.start, last + 1)))
    end = range(last + 1, stated.stop)
    lost = gaps[0][0] if gaps else end.start
    first = _first_missing(experiment, lost) if gaps or end else None
    if first is None:
        return None
    from_one = beyond and not end and stated.start not in some
    return Missing(
        experiment=experiment, stated=stated, complete=len(present), end=end, gaps=gaps, first=first,
        counts_from_one=from_one,
    )  # fmt: skip


def _numbers(noun: str, numbers: range) -> str:
    return f"{noun} {numbers[0]}" if len(numbers) == 1 else f"{noun}s {numbers[0]} to {numbers[-1]}"


def _gaps(present: list[int], stated: range) -> Iterator[range]:
    """Yield the ranges of stated numbers between and beside those that are present, in rising order."""
    before = stated.start - 1
    for number in [*present, stated.stop]:
        if number > before + 1:
            yield range(before + 1, min(number, stated.stop))
        before = number


@dataclass(frozen=True)
class _Sequence:
    """Images of one camera by one laser, one for each number."""

    experiment: Experiment
    camera: CameraSetup
    laser: int

    @property
    def per_number(self) -> int:
        """Distance of the numbers in the paths of successive images."""
        return self.experiment.recording.lasers if "{image" in self.experiment.particle_images else 1

    def frame(self, number: int) -> Frame:
        """Return the frame of a pair or an instant."""
        recording = self.experiment.recording
        return recording.frame(recording.lasers * number + self.laser)

    def image(self, number: int) -> ImagePath:
        """Return the image of a pair or an instant."""
        return split(self.experiment.frame_path(self.camera.name, self.frame(number)), self.camera.raw)

    def label(self, number: int) -> str:
        """Return key, camera and number of an image, for messages."""
        return self.experiment.frame_label(self.camera.name, self.frame(number))

    def present(self, numbers: range) -> set[int] | None:
        """Return the numbers of the images that there are; None where that is not known."""
        fields = dict.fromkeys(("pair", "instant", "image"), _Hole()) | {"frame": self.frame(numbers.start).name}
        path = self.experiment.particle_images.format(camera=self.camera.name, **fields)
        pattern = split(self.experiment.path.parent / path, self.camera.raw)
        if _HOLE in str(pattern.file):
            return self._listed(pattern.file, numbers)
        return self._inside(numbers) if _HOLE in pattern.part else None

    def _listed(self, pattern: Path, numbers: range) -> set[int] | None:
        """Return the numbers whose files are in their folders; None if a folder cannot be listed."""
        place = next(at for at, part in enumerate(pattern.parts) if _HOLE in part)
        expression = re.escape(pattern.parts[place]).replace(re.escape(_HOLE), r"\s*(\d+)", 1)
        form, found = re.compile(expression.replace(re.escape(_HOLE), r"\s*\d+")), set()
        try:
            with os.scandir(Path(*pattern.parts[:place])) as entries:
                for entry in entries:
                    match = form.fullmatch(entry.name)
                    if match is not None and len(match[1]) <= MOST_DIGITS:
                        number, rest = divmod(int(match[1]) - self.laser * (self.per_number - 1), self.per_number)
                        if rest == 0 and number in numbers and self._is_named(number, entry, place):
                            found.add(number)
        except FileNotFoundError:
            return set()
        except OSError:
            return None
        return found

    def _is_named(self, number: int, entry: os.DirEntry[str], place: int) -> bool:
        """Return whether the path of an image goes through an entry of a folder, and its file is there."""
        file = self.image(number).file
        if file.parts[place] != entry.name:
            return False
        return place == len(file.parts) - 1 or file.exists()

    def _inside(self, numbers: range) -> set[int] | None:
        """Return the numbers of the images that a file of many holds; None where that takes too long to find out."""
        first = self.image(numbers.start)
        if not first.file.is_file() or first.suffix not in READERS:
            return None if first.file.exists() else set()
        if _in_order(first):
            end = bisect.bisect_left(numbers, True, key=lambda number: not _is_there(self.image(number)))
            return set(numbers[:end])
        if len(numbers) > MOST_PROBED:
            return None
        return {number for number in numbers if _is_there(self.image(number))}


def _sequences(experiment: Experiment) -> list[_Sequence]:
    lasers = range(experiment.recording.lasers)
    return [_Sequence(experiment, camera, laser) for camera in experiment.cameras for laser in lasers]


def _in_order(image: ImagePath) -> bool:
    """Return whether the images of a file are numbered from 0 without gaps, as far as it can be read."""
    try:
        return READERS[image.suffix].in_order(image)
    except Exception:  # decoders raise exceptions of many types on damaged files, which their own check explains
        return False


def _is_there(image: ImagePath) -> bool:
    """Return whether a file exists and holds an image; one that is damaged is there."""
    if not image.file.exists():
        return False
    try:
        READERS[image.suffix].header(image)
    except NoSuchImage:
        return False
    except Exception:  # as above
        return True
    return True


def _first_missing(experiment: Experiment, number: int) -> str | None:
    """Return path and label of a missing image of a pair or instant; None if all are there after all."""
    for sequence in _sequences(experiment):
        if not _is_there(image := sequence.image(number)):
            return f"{image.path} ({sequence.label(number)})"
    return None
