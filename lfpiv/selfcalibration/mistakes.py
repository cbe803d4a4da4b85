"""Mistakes that people make with the images of a pair, and the images without each of them."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

Images = Mapping[str, np.ndarray]
"""Camera -> image of one frame, shape (rows, columns), background removed [counts]."""
Shown = Callable[[int, int], Images | None]
"""Returns the images of a frame, given by the number of its pair and 0 or 1; None where there are none."""


class Kind(enum.Enum):
    """Kind of a mistake."""

    NONE = "none"
    FRAMES = "frames"
    """The frames of a pair are exchanged in one camera."""
    CAMERAS = "cameras"
    """The images of two cameras are exchanged."""
    HORIZONTAL = "horizontal"
    """The images of one camera are mirrored left to right."""
    VERTICAL = "vertical"
    BOTH = "both"
    LATE = "late"
    """The images of one camera are of another pair."""
    SHIFTED = "shifted"
    """The images of one camera are late by single images, so that its second frames stand as first ones."""
    OTHER = "other"
    """The image of one camera is one of other particles: no mistake, but a measure of chance."""
    CHANCE = "chance"
    """The images of one camera are turned by half a turn: no mistake, but a measure of chance."""


NO_MISTAKE = (Kind.NONE, Kind.OTHER, Kind.CHANCE)
IN_TIME = (Kind.FRAMES, Kind.LATE, Kind.SHIFTED)
"""Mistakes that replace images by others of the same camera."""
FLIPS: Mapping[Kind, tuple[slice, slice]] = {
    Kind.HORIZONTAL: (slice(None), slice(None, None, -1)),
    Kind.VERTICAL: (slice(None, None, -1), slice(None)),
    Kind.BOTH: (slice(None, None, -1), slice(None, None, -1)),
}


@dataclass(frozen=True)
class Mistake:
    """Mistake that may have been made with the images of a pair; the empty one if they are right."""

    kind: Kind = Kind.NONE
    cameras: tuple[str, ...] = ()
    """The camera whose images are wrong, or the two whose images are exchanged."""
    late: int = 0
    """Pairs, or single images, by which the images of the camera are late; negative: early."""

    @property
    def named(self) -> bool:
        """Whether it is a mistake that may have been made."""
        return self.kind not in NO_MISTAKE

    def undone(self, shown: Shown, pair: int, frame: int) -> Images | None:
        """Return the images of a frame without the mistake; None where there are none."""
        images = shown(pair, frame)
        if images is None or self.kind in (Kind.NONE, Kind.CHANCE):
            return images
        if self.kind is Kind.CAMERAS:
            first, second = self.cameras
            fits = images[first].shape == images[second].shape
            return {**images, first: images[second], second: images[first]} if fits else None
        (name,) = self.cameras
        if self.kind in FLIPS:
            return {**images, name: np.ascontiguousarray(images[name][FLIPS[self.kind]])}
        at = (pair, 1 - frame) if self.kind is Kind.FRAMES else (pair + self.late, frame)
        other = shown(*(divmod(2 * pair + frame + self.late, 2) if self.kind is Kind.SHIFTED else at))
        return None if other is None else {**images, name: other[name]}


RIGHT = Mistake()


def likely_mistakes(cameras: Sequence[str]) -> list[Mistake]:
    """Return the mistakes that are tried with every run."""
    found = [Mistake(Kind.FRAMES, (name,)) for name in _one_of_two(cameras)]
    found += [Mistake(Kind.CAMERAS, pair) for pair in combinations(cameras, 2)]
    return found + [Mistake(Kind.HORIZONTAL, (name,)) for name in cameras]


def other_mistakes(cameras: Sequence[str], shifts: Iterable[int], images: Iterable[int]) -> list[Mistake]:
    """Return the mistakes that are tried where images do not fit clearly.

    Among them are shifts of a camera in time, by pairs or instants (`shifts`) and by single `images`.
    """
    found = [Mistake(kind, (name,)) for kind in (Kind.VERTICAL, Kind.BOTH) for name in cameras]
    in_time = [(Kind.LATE, late) for late in shifts] + [(Kind.SHIFTED, late) for late in images]
    return found + [Mistake(kind, (name,), late) for kind, late in in_time for name in _one_of_two(cameras)]


def _one_of_two(cameras: Sequence[str]) -> Sequence[str]:
    """Leave out the second of two cameras: mistakes in the order of its images are the first camera's."""
    return cameras[:1] if len(cameras) == 2 else cameras
