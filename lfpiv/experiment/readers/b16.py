"""Read PCO's .b16 files, one image of 16-bit counts.

The layout is in the appendix "Image file formats" of the manuals of PCO's cameras: numbers of four bytes, least first,
for file size, header size, width, height and the mark of an extended header, whose first number is 1 for a colour
camera.
"""

from __future__ import annotations

import struct

import numpy as np

from lfpiv.experiment.readers.source import ImagePath, NotOneImage
from lfpiv.experiment.readers.stack import Frames

_BASIC_BYTES = 24


class B16(Frames):
    """The image of a .b16 file."""

    def __init__(self, image: ImagePath):
        with image.file.open("rb") as file:
            start = file.read(_BASIC_BYTES + 4)
        if len(start) < _BASIC_BYTES or start[:4] not in (b"PCO-", b"pco-"):
            raise ValueError("no PCO header")
        size, self._start, columns, rows, extended = struct.unpack("<5i", start[4:_BASIC_BYTES])
        if self._start < _BASIC_BYTES or size != self._start + 2 * rows * columns:
            raise ValueError(f"{size} bytes for a header of {self._start} bytes and {rows} x {columns} pixels")
        if extended and start[_BASIC_BYTES:] not in (b"", bytes(4)):
            raise NotOneImage("pixels behind a colour filter; record with a monochrome camera")
        super().__init__(image.file, (rows, columns), np.dtype("<u2"), 1)

    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of the image's pixels."""
        return self._start, 2 * self.shape[0] * self.shape[1]
