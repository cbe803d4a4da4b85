"""Read uncompressed grey images of .avi files, of 8 or 16 bits.

The layout is that of Microsoft's RIFF: chunks of a name, a length and content, lists of chunks, and further parts
``RIFF AVIX`` in files of more than a gigabyte. A bitmap's rows are stored from the bottom and filled to four bytes. The
frame rate of the file is that of playing it, which says nothing about the recording.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from lfpiv.experiment.readers.source import ImagePath, NoSuchImage, NotOneImage
from lfpiv.experiment.readers.stack import Frames

GREY_CODES = {b"Y800": 8, b"Y8  ": 8, b"GREY": 8, b"Y16 ": 16}
"""Bits of a pixel by the code of a grey format, whose rows are stored from the top."""
PLAIN_CODES = (bytes(4), b"DIB ", b"RGB ", b"RAW ")
"""Codes of plain bitmaps."""
MOST_CHUNKS = 10_000
"""Largest number of chunks that are passed over beside the images, such as filling."""
GREYS = bytes(value for level in range(256) for value in (level, level, level, 0))
"""Palette of grey values, black first."""

_BITMAP = struct.Struct("<IiiHH4s20x")


class Avi(Frames):
    """Images of an .avi file."""

    def __init__(self, image: ImagePath):
        form, self._places = _found(image)
        columns, rows, bits, from_top = _layout(form)
        self._from_top = from_top
        dtype = np.dtype("u1" if bits == 8 else "<u2")
        super().__init__(image.file, (abs(rows), columns), dtype, len(self._places))
        row = columns * dtype.itemsize
        self._lengths = (abs(rows) * (row + -row % 4), abs(rows) * row)

    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image's pixels."""
        start, length = self._places[number]
        if length == 0:
            raise NoSuchImage(f"none, since image {number} was dropped while the file was written")
        if length not in self._lengths:
            raise ValueError(f"image {number} has {length} bytes, expected {self._lengths[0]}")
        return start, length

    def decode(self, data: bytes) -> np.ndarray:
        """Return the pixels of an image from their bytes, the upper row first."""
        stored = np.frombuffer(data, self.dtype).reshape(self.shape[0], -1)[:, : self.shape[1]]
        return stored if self._from_top else stored[::-1]


def _found(image: ImagePath) -> tuple[bytes, list[tuple[int, int]]]:
    """Return the form of the images, a bitmap header, and first byte and number of bytes of each."""
    form, places, is_video = b"", list[tuple[int, int]](), False
    with image.file.open("rb") as stream:
        for name, start, length in _chunks(stream, image.file.stat().st_size):
            if name == b"strh":
                is_video = stream.read(4) == b"vids"
            elif name == b"strf" and is_video and not form:
                form = stream.read(min(length, _BITMAP.size + len(GREYS)))
            elif name[2:] in (b"db", b"dc"):
                places.append((start, length))
    return form, places


def _chunks(stream: BinaryIO, size: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, first byte and length of each chunk's content, lists opened; the stream stands at the content."""
    head = stream.read(12)
    if head[:4] != b"RIFF" or head[8:] != b"AVI ":
        raise ValueError("no header of an AVI file")
    at, others = 12, 0
    while at + 8 <= size:
        stream.seek(at)
        name, length = struct.unpack("<4sI", stream.read(8))
        if name in (b"RIFF", b"LIST"):
            at += 12
            continue
        yield name, at + 8, length
        others += name[2:] not in (b"db", b"dc") or length < 8
        if others > MOST_CHUNKS:
            raise ValueError(f"more than {MOST_CHUNKS} chunks without an image")
        at += 8 + length + length % 2


def _layout(form: bytes) -> tuple[int, int, int, bool]:
    """Return columns, rows, bits, and whether rows are stored from the top; refuse other than grey values."""
    if len(form) < _BITMAP.size:
        raise ValueError("no images")
    _, columns, rows, _, bits, code = _BITMAP.unpack_from(form)
    if code in GREY_CODES:
        return columns, rows, GREY_CODES[code], True
    if code not in PLAIN_CODES:
        raise NotOneImage(f"images compressed by {code.decode('ascii', 'replace')!r}; save uncompressed grey values")
    palette = form[_BITMAP.size :]
    if bits != 8 or palette != GREYS[: len(palette)]:
        raise NotOneImage(f"bitmaps of {bits} bits, such as a colour image; save grey values, of 8 bits or as Y16")
    return columns, rows, bits, rows < 0
