"""Read Vision Research's .cine recordings of Phantom cameras.

The layout is Vision Research's "Cine File Format". Numbers are stored least byte first. Images of 8 and 16 bits are
stored from the bottom row, as bitmaps are, unless their height is negative; packed images of 10 and 12 bits from the
top. Packed 10-bit codes are turned into linear 12-bit counts by the table of that document, which the package
cine-handler of the extra ``phantom`` holds.

The maker's software shows a recording mirrored or turned where the file says so (``bFlipH``, ``bFlipV``, ``Rotate``),
though the stored pixels are not. So does this reader.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lfpiv.experiment.readers.mraw import unpack_12
from lfpiv.experiment.readers.source import CannotRead, Header, ImagePath, NotOneImage, Recorded
from lfpiv.experiment.readers.stack import Frames, read_bytes

PACKED_10, PACKED_12 = 256, 1024
"""Values of ``biCompression`` for packed pixels."""
JPEG, UNINTERPOLATED = 1, 2
"""Values of the file header's ``Compression``; 0 is grey, and the last one is grey too without a colour filter."""
SETUP_MARK_AT = 140
"""Place of ``Mark`` and ``Length`` in the SETUP structure, whose length depends on the software [byte]."""
FLIPS_AT, RATE_AT, COLOUR_FILTER_AT, ROTATE_AT, EXPOSURE_AT = 756, 768, 808, 884, 1568
"""Places of ``bFlipH`` (``bFlipV`` follows), ``FrameRate``, ``CFA``, ``Rotate`` and ``ShutterNs`` in it [byte]."""
BITS_AT, WHITE_AT = 896, 5736
"""Places of ``RealBPP`` and ``WhiteLevel`` in it [byte]."""
LEAST_WHITE = 0.75
"""Least white level that is taken for one, in the largest value of a pixel."""
SYNC_AT = 17
"""Place of ``TrigFrame``: 0 where the camera's own clock sets the rate [byte]."""
TIMES, EXPOSURES = 1002, 1003
"""Types of the blocks with time and exposure of each image, in 2^-32 seconds."""
MOST_BLOCKS = 100
"""Largest number of blocks of any type before the images."""

_FILE_HEADER = struct.Struct("<2sHHHiIiIIIIQ")
_BITMAP_HEADER = struct.Struct("<IiiHHII")


class Cine(Frames):
    """Images of a .cine recording, numbered from the first one that is stored."""

    def __init__(self, image: ImagePath):
        head = read_bytes(image.file, 0, _FILE_HEADER.size)
        kind, _, compression, version, _, _, _, count, bitmap_at, setup_at, offsets_at, _ = _FILE_HEADER.unpack(head)
        if kind != b"CI" or version not in (0, 1):
            raise ValueError(f"no cine header, or one of version {version}")
        bitmap = _BITMAP_HEADER.unpack(read_bytes(image.file, bitmap_at, _BITMAP_HEADER.size))
        bitmap_bytes, columns, rows, planes, bits, self._packing, _ = bitmap
        if bitmap_bytes < _BITMAP_HEADER.size or planes != 1 or columns < 1 or rows == 0:
            raise ValueError(
                f"a bitmap header of {bitmap_bytes} bytes for {planes} planes of {rows} x {columns} pixels"
            )
        self._top_down = rows < 0 or self._packing != 0
        super().__init__(image.file, (abs(rows), columns), np.dtype("u1" if bits == 8 else "<u2"), count)
        self._setup = _setup(image, setup_at)
        self._blocks = _blocks(image, setup_at + len(self._setup), offsets_at) if self._setup else {}
        _require_grey(compression, bits, self._packing, self._field(COLOUR_FILTER_AT))
        self._turns = _turns(self._field(ROTATE_AT, "<i"))
        self._offsets_at = offsets_at
        self._offset = struct.Struct("<q" if version else "<I")
        self._table_end = offsets_at + count * self._offset.size
        self._require_table()
        self._table = _linear_counts() if self._packing == PACKED_10 else None

    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image's pixels, behind its annotation."""
        start, least = self._start(number), self._table_end
        if not least <= start <= self.size:
            raise ValueError(f"image {number} begins at byte {start}, expected one from {least} to {self.size}")
        if number and abs(start - (other := self._start(number - 1))) < self._lengths()[0]:
            raise ValueError(f"image {number} begins at byte {start}, within image {number - 1} at byte {other}")
        (annotation,) = struct.unpack("<I", read_bytes(self.file, start, 4))
        if annotation < 8 or start + annotation > self.size:
            raise ValueError(f"image {number} has an annotation of {annotation} bytes")
        (length,) = struct.unpack("<I", read_bytes(self.file, start + annotation - 4, 4))
        if length not in self._lengths():
            raise ValueError(f"image {number} has {length} bytes, expected {self._lengths()[0]}")
        return start + annotation, length

    def header(self, number: int) -> Header:
        """Return the header of an image as it is shown, perhaps turned."""
        header = replace(super().header(number), white_level=self._white_level())
        return replace(header, shape=header.shape[::-1]) if self._turns % 2 else header

    def decode(self, data: bytes) -> np.ndarray:
        """Return the pixels of an image from their bytes, mirrored and turned as the file says."""
        rows, columns = self.shape
        if self._table is not None:
            stored = self._table(data).reshape(self.shape)
        elif self._packing == PACKED_12:
            stored = unpack_12(data).reshape(self.shape)
        else:
            stored = np.frombuffer(data, self.dtype).reshape(rows, -1)[:, :columns]
        across, down = self._field(FLIPS_AT) != 0, self._field(FLIPS_AT + 4) != 0
        shown = stored[:: 1 if self._top_down != down else -1, :: -1 if across else 1]
        return np.rot90(shown, self._turns)

    def recorded(self, number: int) -> Recorded:
        """Return time and exposure of an image from their blocks, and the interval if the camera's clock set it."""
        exposure, rate = self._block(EXPOSURES, "<I", number), self._field(RATE_AT)
        time, first = (self._block(TIMES, "<Q", one) for one in (number, 0))
        seconds = None if time is None or first is None else (time - first) / 2**32
        shutter = self._field(EXPOSURE_AT)
        return Recorded(
            time_s=seconds,
            exposure_s=exposure / 2**32 if exposure else shutter * 1e-9 or None,
            interval_s=1 / rate if rate and self._setup[SYNC_AT] == 0 else None,
        )

    def _white_level(self) -> float | None:
        """Return the white level of the SETUP structure, if it is near the largest value that pixels can have."""
        bits = self._field(BITS_AT)
        if self._packing:
            bits = 12  # packed 10-bit codes are read as 12-bit counts
        elif self.dtype.itemsize == 1:
            bits = 8
        level = self._field(WHITE_AT, "<i")
        return float(level) if 8 <= bits <= 16 and LEAST_WHITE < level / ((1 << bits) - 1) <= 1 else None

    def _field(self, at: int, form: str = "<I") -> int:
        """Return a field of the SETUP structure; 0 where the software that wrote it did not know the field."""
        return int(struct.unpack_from(form, self._setup, at)[0]) if at + 4 <= len(self._setup) else 0

    def _block(self, kind: int, form: str, number: int) -> int | None:
        """Return the entry of an image in a block; None without such a block."""
        start, length = self._blocks.get(kind, (0, 0))
        size = struct.calcsize(form)
        if length < self.count * size:
            return None
        return int(struct.unpack(form, read_bytes(self.file, start + number * size, size))[0])

    def _start(self, number: int) -> int:
        """Return the first byte of an image's annotation."""
        entry = self._offsets_at + number * self._offset.size
        return int(self._offset.unpack(read_bytes(self.file, entry, self._offset.size))[0])

    def _require_table(self) -> None:
        """Refuse a table that ends behind the file or its first image. Images may be stored in any order."""
        if not self.count or self._table_end > min(self.size, self._start(0)):
            raise ValueError(f"no table of {self.count} images at byte {self._offsets_at}")

    def _lengths(self) -> tuple[int, ...]:
        """Return the sizes that an image's pixels may have: with and without rows filled to four bytes [byte]."""
        rows, columns = self.shape
        if self._packing:
            return (rows * columns * (10 if self._packing == PACKED_10 else 12) // 8,)
        row = columns * self.dtype.itemsize
        return (rows * row, rows * (row + -row % 4))


def _setup(image: ImagePath, start: int) -> bytes:
    """Return the SETUP structure as far as its software wrote it; nothing where it has no mark."""
    try:
        mark, length = struct.unpack("<2sH", read_bytes(image.file, start + SETUP_MARK_AT, 4))
        return read_bytes(image.file, start, length) if mark == b"ST" else b""
    except ValueError:  # the file ends before
        return b""


def _blocks(image: ImagePath, start: int, end: int) -> dict[int, tuple[int, int]]:
    """Return first byte and number of bytes of each block between the SETUP structure and the table of images."""
    found: dict[int, tuple[int, int]] = {}
    while start + 8 <= end and len(found) < MOST_BLOCKS:
        try:
            size, kind, _ = struct.unpack("<IHH", read_bytes(image.file, start, 8))
        except ValueError:
            break
        if size < 8 or start + size > end:
            break
        found[kind] = (start + 8, size - 8)
        start += size
    return found


def _turns(angle_deg: int) -> int:
    """Return the number of quarter turns counterclockwise by which images are shown."""
    if angle_deg % 90:
        raise ValueError(f"images turned by {angle_deg} degrees")
    return angle_deg // 90 % 4


def _require_grey(compression: int, bits: int, packing: int, colour_filter: int) -> None:
    """Refuse recordings of other than single-channel raw counts."""
    if compression == JPEG or packing not in (0, PACKED_10, PACKED_12):
        raise NotOneImage("compressed images; save the recording as raw cine")
    if bits not in (8, 16):
        raise NotOneImage(f"pixels of {bits} bits, such as a colour image; save raw grey values")
    if compression == UNINTERPOLATED and colour_filter & 0xFFFFFF:  # the last byte names the sensor head
        raise NotOneImage("pixels behind a colour filter; record with a monochrome camera")


def _linear_counts() -> Callable[[bytes], np.ndarray]:
    """Return the function that unpacks 10-bit codes and turns them into linear counts."""
    try:
        from cine_reader import unpack_10bit_numpy
    except ImportError as error:
        found = "found none" if isinstance(error, ModuleNotFoundError) else f"found one that does not load ({error})"
        raise CannotRead(
            f"packed 10-bit images are read with the package cine-handler, {found}. Install the extra phantom with "
            "pip install 'lfpiv[phantom]', or save the recording with 16 bits."
        ) from None
    return unpack_10bit_numpy
