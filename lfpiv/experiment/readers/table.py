"""Name the reader of each suffix."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from lfpiv.experiment.readers import davis, hdf5
from lfpiv.experiment.readers.avi import Avi
from lfpiv.experiment.readers.b16 import B16
from lfpiv.experiment.readers.cine import Cine
from lfpiv.experiment.readers.mraw import open_mraw
from lfpiv.experiment.readers.png import Png
from lfpiv.experiment.readers.raw import Raw
from lfpiv.experiment.readers.seq import Seq
from lfpiv.experiment.readers.source import Header, ImagePath, Recorded
from lfpiv.experiment.readers.stack import StackReader
from lfpiv.experiment.readers.tiff import TiffStack


class Reader(Protocol):
    """Reader of a format: an object, or a module with these functions."""

    def header(self, image: ImagePath) -> Header | None:
        """Check an image without decoding it; return its header, None where that takes decoding."""

    def in_order(self, image: ImagePath) -> bool:
        """Return whether the images of the file are numbered from 0 without gaps."""

    def recorded(self, image: ImagePath) -> Recorded:
        """Return when an image was recorded, as far as its file says."""

    def read(self, image: ImagePath) -> np.ndarray:
        """Return the pixels of an image [counts], shape (rows, columns), of the stored type."""


READERS: dict[str, Reader] = {
    ".tif": StackReader(TiffStack),
    ".tiff": StackReader(TiffStack),
    ".png": StackReader(Png),
    ".im7": davis,
    ".imx": davis,
    ".h5": hdf5,
    ".hdf5": hdf5,
    ".cine": StackReader(Cine),
    ".mraw": StackReader(open_mraw),
    ".b16": StackReader(B16),
    ".seq": StackReader(Seq),
    ".avi": StackReader(Avi),
    ".raw": StackReader(Raw),
    ".bin": StackReader(Raw),
}
"""Reader of each suffix."""
