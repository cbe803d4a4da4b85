"""Read pages of TIFF and BigTIFF files with tifffile.

ImageJ writes a stack of more than 4 GiB with one directory, that of the first image, and the others right behind it.
"""

from __future__ import annotations

import logging
import re
import struct
import threading
import weakref

import numpy as np
import tifffile

from lfpiv.experiment.readers.limits import require_apart, require_plausible
from lfpiv.experiment.readers.source import Header, ImagePath, NotOneImage
from lfpiv.experiment.readers.stack import Stack, read_bytes

MOST_TAGS = 4096
"""Largest number of entries of a page's directory; tifffile takes more for damage as well."""
COMPRESSIONS = {
    "NONE": 1,
    "LZW": 5,
    "deflate": 8,
    "old deflate": 32946,
    "PackBits": 32773,
    "LZMA": 34925,
    "Zstd": 50000,
}
"""Compressions without loss, whose decoders stop at the size that the directory declares."""
STRIP_FILL = 4
"""Largest number of bytes that fill up a strip of pixels [byte]."""

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it says of damage would come beside our message


class TiffStack(Stack):
    """Pages of a TIFF file that stays open; the places of its pages are kept as far as they were asked for."""

    noun = "page"

    def __init__(self, image: ImagePath):
        self._file = image.file
        self._size = image.file.stat().st_size
        if self._size == 0:
            raise ValueError("the file is empty")
        self._lock = threading.RLock()
        self._tiff = tifffile.TiffFile(image.file)
        weakref.finalize(self, self._tiff.close)
        self._offsets = [self._tiff.pages.first.offset]
        self._seen = set(self._offsets)
        self._complete = False
        self._behind = 0  # images behind the first one, without a directory

    @property
    def count(self) -> int:
        """Number of pages; the directories of all pages are visited once."""
        with self._lock:
            while not self._complete:
                self._find_next()
            return len(self._offsets) + self._behind

    def holds(self, number: int) -> bool:
        """Return whether there is a page of that number; visit directories up to it only."""
        with self._lock:
            while not self._complete and number >= len(self._offsets):
                self._find_next()
            return number < len(self._offsets) + self._behind

    def header(self, number: int) -> Header:
        """Return the header of a page."""
        with self._lock:
            page = self._page(number)
        return self._checked(page, number)

    def read(self, number: int) -> np.ndarray:
        """Return the pixels of a page."""
        with self._lock:
            page = self._page(number)
            header = self._checked(page, number)
            if number < len(self._offsets):
                return page.asarray()
        start, length = self._place_behind(page, number)
        dtype = np.dtype(header.dtype).newbyteorder(self._tiff.byteorder)
        return np.frombuffer(read_bytes(self._file, start, length), dtype).reshape(header.shape)

    def _page(self, number: int) -> tifffile.TiffPage:
        """Return the directory of a page; images without a directory have the first page's."""
        number = number if number < len(self._offsets) else 0
        self._tiff.filehandle.seek(self._offsets[number])
        return tifffile.TiffPage(self._tiff, number)

    @staticmethod
    def _place_behind(page: tifffile.TiffPage, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image behind the first page."""
        length = sum(page.databytecounts)
        return page.dataoffsets[0] + number * length, length

    def _find_next(self) -> None:
        """Find the directory of the page behind the last one known."""
        form, file, last = self._tiff.tiff, self._tiff.filehandle, self._offsets[-1]
        try:
            file.seek(last)
            (tags,) = struct.unpack(form.tagnoformat, file.read(form.tagnosize))
            if tags > MOST_TAGS:
                raise ValueError(f"the directory of page {len(self._offsets) - 1} has {tags} entries")
            following = file.read(tags * form.tagsize + form.offsetsize)[tags * form.tagsize :]
            (offset,) = struct.unpack(form.offsetformat, following)
        except struct.error:
            raise ValueError(f"the file ends in the directory of page {len(self._offsets) - 1}") from None
        if offset == 0:
            self._complete = True
            self._behind = self._count_behind() if len(self._offsets) == 1 else 0
        elif offset >= self._size or offset in self._seen:
            raise ValueError(f"no page where page {len(self._offsets) - 1} says that the next one begins")
        else:
            self._offsets.append(offset)
            self._seen.add(offset)

    def _count_behind(self) -> int:
        """Return the number of images behind the only page, as ImageJ's description of it says."""
        page = self._page(0)
        images = re.search(r"^images=(\d{1,12})$", page.description, re.MULTILINE)
        if not page.description.startswith("ImageJ=") or images is None or not page.is_contiguous:
            return 0
        return max(int(images[1]) - 1, 0)

    def _checked(self, page: tifffile.TiffPage, number: int) -> Header:
        """Return the header of a page; refuse one that is not one single-channel image with all its pixels."""
        if not page.shape:
            raise ValueError("a page that states no size")
        if len(page.shape) != 2 or page.samplesperpixel != 1:
            raise NotOneImage(
                f"pixels of shape {page.shape} in one page, such as a colour image, or a stack that was saved as one "
                "page; save each image as a page of raw grey values (tifffile: photometric='minisblack')"
            )
        meaning = tifffile.PHOTOMETRIC(page.photometric)
        if meaning is not tifffile.PHOTOMETRIC.MINISBLACK:
            raise NotOneImage(f"{meaning.name} pixels; save raw grey values, 0 = black")
        if (turned := page.tags.valueof("Orientation", 1)) not in (0, 1):  # 0 is no value of the tag
            raise NotOneImage(
                f"pixels to be shown turned or mirrored (tag Orientation is {turned}), which programs do or do not; "
                "save them as they are shown, with the tag 1"
            )
        if page.bitspersample == 24:  # tifffile reads them wrong where the highest byte comes first
            raise NotOneImage("pixels of 24 bits; save 8, 16 or 32 bits")
        if page.compression not in COMPRESSIONS.values():
            known = ", ".join(list(COMPRESSIONS)[1:])
            raise NotOneImage(
                f"pixels compressed by {tifffile.COMPRESSION(page.compression).name}; expected one of none, {known}"
            )
        if page.dtype is None:
            raise ValueError("unknown pixel type")
        if number >= len(self._offsets):
            require_apart([self._place_behind(page, number)], self._size)
        else:
            require_apart(zip(page.dataoffsets, page.databytecounts, strict=True), self._size)
        rows, columns = page.shape
        stored, strips = sum(page.databytecounts), len(page.databytecounts)
        require_plausible((rows, columns), page.dtype.itemsize, stored)
        pixels = rows * ((columns * page.bitspersample + 7) // 8)  # rows begin at whole bytes
        if page.compression == 1 and not page.is_tiled and not pixels <= stored <= pixels + STRIP_FILL * strips:
            raise ValueError(f"{stored} bytes of pixels where its directory declares {rows} x {columns} {page.dtype}")
        return Header((int(rows), int(columns)), str(page.dtype))
