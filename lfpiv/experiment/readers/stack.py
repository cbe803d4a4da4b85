"""Read numbered images from files that stay open, or whose headers are kept, between images."""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from lfpiv.experiment.readers.limits import require_plausible
from lfpiv.experiment.readers.source import Header, ImagePath, NoSuchImage, NotOneImage, Recorded

Opened = TypeVar("Opened")

UNSETTLED_NS = 2 * 10**9
"""Age below which a file may change again without another time of change: clocks of file systems are coarse [ns]."""


class OpenFiles(Generic[Opened]):
    """The files used last, opened, by process, path, size and time of the last change.

    Parameters
    ----------
    limit : int
        Largest number of files that are kept open.
    """

    def __init__(self, limit: int):
        self._limit = limit
        self._opened: OrderedDict[Hashable, Opened] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, image: ImagePath, open_file: Callable[[ImagePath], Opened]) -> Opened:
        """Return the opened file of an image; open it if it is not open, changed since then, or has just changed."""
        status = os.stat(image.file)
        if abs(time.time_ns() - status.st_mtime_ns) < UNSETTLED_NS:
            return open_file(image)
        key = (os.getpid(), str(image.file), status.st_ino, status.st_size, status.st_mtime_ns, image.raw)
        with self._lock:
            if key in self._opened:
                self._opened.move_to_end(key)
                return self._opened[key]
        opened = open_file(image)
        with self._lock:
            opened = self._opened.setdefault(key, opened)
            while len(self._opened) > self._limit:
                self._opened.popitem(last=False)  # closed when its last user lets go of it
        return opened


class Stack(ABC):
    """Images of one file, numbered from 0. Threads may read from it at the same time."""

    noun = "image"
    """What an image is called in messages."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of images in the file."""

    @abstractmethod
    def header(self, number: int) -> Header:
        """Return the header of an image; raise ValueError if it is damaged or its pixels are not all in the file."""

    @abstractmethod
    def read(self, number: int) -> np.ndarray:
        """Return the pixels of an image as they are stored, shape (rows, columns)."""

    def recorded(self, number: int) -> Recorded:
        """Return when an image was recorded, as far as the file says."""
        return Recorded()

    def holds(self, number: int) -> bool:
        """Return whether there is an image of that number."""
        return number < self.count

    def number(self, part: str) -> int:
        """Return the number of the image that the text behind ``#`` names; raise NotOneImage if there is none."""
        if not part:
            if self.count == 0:
                raise NoSuchImage(f"a file of no {self.noun}s: nothing was recorded")
            if self.count != 1:
                raise NotOneImage(f"{self._counted()}; name one behind the file: #0 to #{self.count - 1}")
            return 0
        if not (part.isascii() and part.isdigit() and len(part) < 18):
            raise NotOneImage(f"a part called {part[:80]!r}; name one by number, counted from 0 (#0)")
        if not self.holds(int(part)):
            raise NoSuchImage(f"{self._counted()}, none of them #{part}; they count from 0")
        return int(part)

    def _counted(self) -> str:
        return f"{self.count} {self.noun}{'' if self.count == 1 else 's'}"


class Frames(Stack):
    """Images of one size at known places of a file."""

    def __init__(self, file: Path, shape: tuple[int, int], dtype: np.dtype[Any], count: int):
        self.file = file
        self.shape = shape
        self.dtype = dtype
        self.size = os.stat(file).st_size
        self._count = count
        require_plausible(shape, 1, self.size)

    @property
    def count(self) -> int:
        """Number of images in the file, as its header says."""
        return self._count

    @abstractmethod
    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image's pixels."""

    def decode(self, data: bytes) -> np.ndarray:
        """Return the pixels of an image from their bytes."""
        return np.frombuffer(data, self.dtype).reshape(self.shape)

    def header(self, number: int) -> Header:
        """Return the header of an image; raise ValueError if its pixels are not all in the file."""
        self._whole_place(number)
        return Header(self.shape, self.dtype.name)

    def read(self, number: int) -> np.ndarray:
        """Return the pixels of an image."""
        return self.decode(read_bytes(self.file, *self._whole_place(number)))

    def _whole_place(self, number: int) -> tuple[int, int]:
        start, length = self.place(number)
        if start < 0 or start + length > self.size:
            raise ValueError(f"pixel data end at byte {start + length}, the file at byte {self.size}")
        return start, length


def read_bytes(file: Path, start: int, length: int) -> bytes:
    """Return some bytes of a file; raise ValueError if it ends before."""
    with file.open("rb") as stream:
        stream.seek(start)
        data = stream.read(length)
    if len(data) < length:
        raise ValueError(f"the file ends before byte {start + length}")
    return data


OPEN_STACKS = 16
"""Number of files that are kept open: one for each camera of an experiment, and some for single images."""

_stacks: OpenFiles[Stack] = OpenFiles(OPEN_STACKS)


@dataclass(frozen=True)
class StackReader:
    """Reader of files of numbered images."""

    open_file: Callable[[ImagePath], Stack]
    """Open a file."""

    def header(self, image: ImagePath) -> Header:
        """Return the header of an image without decoding it."""
        stack = _stacks.get(image, self.open_file)
        return stack.header(stack.number(image.part))

    def read(self, image: ImagePath) -> np.ndarray:
        """Return the pixels of an image."""
        stack = _stacks.get(image, self.open_file)
        return stack.read(stack.number(image.part))

    def recorded(self, image: ImagePath) -> Recorded:
        """Return when an image was recorded, as far as the file says."""
        stack = _stacks.get(image, self.open_file)
        return stack.recorded(stack.number(image.part))

    def in_order(self, image: ImagePath) -> bool:
        """Return whether the images of the file are numbered from 0 without gaps: they are."""
        return True
