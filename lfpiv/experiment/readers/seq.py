"""Read StreamPix's .seq recordings of NorPix: uncompressed grey images in blocks of equal size, each with its time.

The layout is in the manual of StreamPix: numbers least byte first; behind the pixels of each image the seconds since
1970 (four bytes), milliseconds and, since version 5, microseconds (two bytes each), and filling.
"""

from __future__ import annotations

import struct

import numpy as np

from lfpiv.experiment.readers.source import ImagePath, NotOneImage, Recorded
from lfpiv.experiment.readers.stack import Frames, read_bytes

MAGIC, NAME = 0xFEED, "Norpix seq".encode("utf-16-le")
HEADER_BYTES, LONG_HEADER_BYTES, LONG_SINCE = 1024, 8192, 5
"""Place of the first image, and that of versions from the last number on [byte]."""
GREY = 100
"""Image format of a grey image; versions below 4 name a compressed one by another format."""
ARRIVAL_S = 0.05
"""Time by which an image may be late in reaching the computer [s]."""
TYPES = {8: "u1", 16: "<u2", 32: "<u4"}
"""Type of a pixel by its stored bits."""

_SIZES_AT, _COMPRESSION_AT = 548, 620
_SIZES = struct.Struct("<9I")


class Seq(Frames):
    """Images of a .seq recording."""

    def __init__(self, image: ImagePath):
        head = read_bytes(image.file, 0, HEADER_BYTES)
        magic, version = struct.unpack_from("<I", head)[0], struct.unpack_from("<i", head, 28)[0]
        if magic != MAGIC or not head[4:].startswith(NAME):
            raise ValueError("no header of StreamPix")
        columns, rows, bits, _, self._length, form, count, origin, self._block = _SIZES.unpack_from(head, _SIZES_AT)
        compression = struct.unpack_from("<I", head, _COMPRESSION_AT)[0] if version >= 4 else 0
        if form != GREY or compression or bits not in TYPES:
            raise NotOneImage(
                f"images of format {form}, {bits} bits, compression {compression}; save uncompressed grey values "
                "of 8 or 16 bits"
            )
        if origin:
            raise NotOneImage(f"a recording whose first image is number {origin} of the file; export it in StreamPix")
        self._start = LONG_HEADER_BYTES if version >= LONG_SINCE else HEADER_BYTES
        self._times = struct.Struct("<IHH" if version >= LONG_SINCE else "<IH")
        super().__init__(image.file, (rows, columns), np.dtype(TYPES[bits]), count)
        expected = rows * columns * self.dtype.itemsize
        if self._length != expected or self._block < expected:
            raise ValueError(f"blocks of {self._block} bytes with {self._length} of pixels, expected {expected}")
        if count == 0:  # the recorder did not get to write it
            self._count = (self.size - self._start) // self._block

    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image's pixels."""
        return self._start + number * self._block, self._length

    def recorded(self, number: int) -> Recorded:
        """Return the time at which an image arrived at the computer, after the first one of the recording."""
        if self._block < self._length + self._times.size:
            return Recorded()
        after = self._microseconds(number) - self._microseconds(0)
        return Recorded(time_s=1e-6 * after, uncertainty_s=ARRIVAL_S, is_arrival=True)

    def _microseconds(self, number: int) -> int:
        start = self.place(number)[0] + self._length
        seconds, milliseconds, *micro = self._times.unpack(read_bytes(self.file, start, self._times.size))
        return int(1_000_000 * seconds + 1000 * milliseconds + sum(micro))
