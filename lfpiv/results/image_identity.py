"""Identity of the images that a result was made from: whether they are still the same, without reading all of them.

A stamp states path, size, times and a digest of the content of each image. An image counts as unchanged if its size and
both times of its last change are as stated: the time of its content, which programs may set back, and the time of its
entry in the file system, which they may not. Where only times differ, as in a copy, the content is read and decides. So
touching or copying images repeats no work, and changing a byte of them does.

Of an image that is a part of a file, such as a page, grey values are compared in place of size and bytes of the file.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from lfpiv import files
from lfpiv.errors import InputError
from lfpiv.experiment import images
from lfpiv.experiment.readers.source import ImagePath

BLOCK_BYTES = 1 << 20
"""Bytes read at once while a digest is computed."""
REMEMBERED = 1 << 16
"""Largest number of images whose digests a process remembers."""


@dataclass(frozen=True)
class ImageState:
    """An image as it is now, without its content."""

    place: str
    """Path from the experiment file."""
    source: ImagePath
    size: int
    """Size of the file [byte]."""
    times_ns: tuple[int, int]
    """Last change of the content and of the entry in the file system [ns]."""

    @classmethod
    def from_file(cls, source: ImagePath, start: Path) -> ImageState:
        """Look at an image. `start` is the folder of the experiment file. Raise OSError if there is no such file."""
        status = source.file.stat()
        times = status.st_mtime_ns, status.st_ctime_ns
        return cls(os.path.relpath(source.path, start), source, status.st_size, times)

    @property
    def record(self) -> list[Any]:
        """Entry of a stamp without the digest: path, size, times."""
        return [self.place, self.size, *self.times_ns]

    @property
    def digest(self) -> str:
        """Digest of the content; empty text if the image cannot be read or changed since it was looked at."""
        return _digest(self)

    def agrees(self, stored: Any) -> bool:
        """Return whether an entry of a stamp states this image."""
        if not isinstance(stored, list) or len(stored) != 5 or stored[0] != self.place:
            return False
        if stored[:-1] == self.record:
            return True
        if not self.source.part and stored[1] != self.size:
            return False
        return bool(stored[-1]) and stored[-1] == self.digest


@dataclass(frozen=True)
class Images:
    """Images that a result is made from, in order: a part of a stamp."""

    states: tuple[ImageState, ...]

    @property
    def names(self) -> Any:
        """What a hash of settings states of them: their paths."""
        return [state.place for state in self.states]

    def stored(self) -> Any:
        """Return what a stamp stores; reads the images."""
        return [[*state.record, state.digest] for state in self.states]

    def agree(self, stored: Any) -> bool:
        """Return whether a stamp states these images; reads those of which only the times differ."""
        if not isinstance(stored, list) or len(stored) != len(self.states):
            return False
        return all(state.agrees(one) for state, one in zip(self.states, stored, strict=True))

    def all_in(self, stored: Any) -> bool:
        """Return whether a stamp states each of these images, and perhaps others that are missing now."""
        known = {one[0]: one for one in stored or () if isinstance(one, list) and one}
        return all(state.agrees(known.get(state.place)) for state in self.states)


@dataclass(frozen=True)
class CondensedImages(Images):
    """Many images, of which a stamp stores two hashes only: of paths, sizes and times, and of paths and contents."""

    @property
    def _state_hash(self) -> str:
        return files.settings_hash(images=[state.record for state in self.states])

    @property
    def _content_hash(self) -> str:
        digests = [[state.place, state.digest] for state in self.states]
        return files.settings_hash(images=digests) if all(digest for _, digest in digests) else ""

    def stored(self) -> Any:
        """Return what a stamp stores; reads the images."""
        return [self._state_hash, self._content_hash]

    def agree(self, stored: Any) -> bool:
        """Return whether a stamp states these images; reads them if their times differ."""
        if not isinstance(stored, list) or len(stored) != 2:
            return False
        return bool(stored[0] == self._state_hash or (stored[1] and stored[1] == self._content_hash))


def look_at(sources: Iterable[ImagePath], start: Path, *, condensed: bool = False) -> Images | None:
    """Return images as they are now; None if one is missing.

    Parameters
    ----------
    start : Path
        Folder of the experiment file.
    condensed : bool
        Store two hashes instead of an entry for each image.
    """
    try:
        states = tuple(ImageState.from_file(source, start) for source in sources)
    except OSError:
        return None
    return CondensedImages(states) if condensed else Images(states)


def same(one: Any, other: Any) -> bool:
    """Return whether two stamps state the same images: equal entries, or equal paths and contents."""
    if one == other:
        return True
    if not (isinstance(one, list) and isinstance(other, list) and len(one) == len(other)):
        return False
    return all(_same_content(first, second) for first, second in zip(one, other, strict=True))


def _same_content(one: Any, other: Any) -> bool:
    entries = all(isinstance(entry, list) and len(entry) == 5 and entry[-1] for entry in (one, other))
    return entries and (one[0], one[-1]) == (other[0], other[-1])


def content_hash(sources: Iterable[ImagePath]) -> str:
    """Hash several images, in order: the bytes of whole files, the grey values of parts of files."""
    digest = hashlib.blake2b(digest_size=16)
    for source in sources:
        _update(digest, source)
        digest.update(b"end of file" + source.part.encode())
    return digest.hexdigest()


def _update(digest: Any, source: ImagePath) -> None:
    """Add the content of an image to a digest."""
    if source.part:
        grey = images.read_image(source.path, "part of a file", raw=source.raw)
        digest.update(repr(grey.shape).encode() + grey.tobytes())
        return
    with source.file.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            digest.update(block)


@lru_cache(maxsize=REMEMBERED)
def _digest(state: ImageState) -> str:
    digest = hashlib.blake2b(digest_size=16)
    try:
        _update(digest, state.source)
        status = state.source.file.stat()
    except (OSError, InputError):
        return ""
    unchanged = (status.st_size, status.st_mtime_ns, status.st_ctime_ns) == (state.size, *state.times_ns)
    return digest.hexdigest() if unchanged else ""
