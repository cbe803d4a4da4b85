"""Read PNG images with imagecodecs."""

from __future__ import annotations

import numpy as np

from lfpiv.experiment.readers.limits import require_plausible
from lfpiv.experiment.readers.source import Header, ImagePath, NotOneImage
from lfpiv.experiment.readers.stack import Stack

MOST_BEHIND = 4096
"""Largest number of bytes from the end marker on, such as of files that are filled to whole blocks [byte]."""

_SIGNATURE, _END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


class Png(Stack):
    """The image of a PNG file."""

    def __init__(self, image: ImagePath):
        self._file = image.file
        self._header = _header(image)

    @property
    def count(self) -> int:
        """Number of images in the file."""
        return 1

    def header(self, number: int) -> Header:
        """Return the header."""
        return self._header

    def read(self, number: int) -> np.ndarray:
        """Return the pixels."""
        import imagecodecs

        pixels: np.ndarray = imagecodecs.png_decode(self._file.read_bytes())
        return pixels[..., 0] if pixels.ndim == 3 else pixels  # a grey value may be named as transparent


def _header(image: ImagePath) -> Header:
    size = image.file.stat().st_size
    with image.file.open("rb") as file:
        start = file.read(26)
        file.seek(max(size - MOST_BEHIND, 0))
        end = file.read()
    if start[:8] != _SIGNATURE or len(start) < 26:
        raise ValueError("no PNG signature")
    if _END not in end:
        raise ValueError("the file ends before its end marker")
    columns, rows = (int.from_bytes(start[at : at + 4], "big") for at in (16, 20))
    depth, colour = start[24], start[25]
    if colour != 0:
        raise NotOneImage("a colour, palette or transparent image; save raw grey values")
    require_plausible((rows, columns), depth // 8, size)
    return Header((rows, columns), "uint16" if depth == 16 else "uint8" if depth == 8 else f"uint{depth}")
