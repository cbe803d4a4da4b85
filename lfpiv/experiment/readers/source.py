"""Say which image is meant: a file, a part of it, and what is known of it without decoding."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lfpiv.settings.rig import RawImages

STACK_SUFFIXES = (".h5", ".hdf5")
"""Suffixes of files whose parts have names with ``/``."""
SUFFIXES = (
    *(".tif", ".tiff", ".png", ".im7", ".imx", *STACK_SUFFIXES),
    *(".cine", ".mraw", ".b16", ".seq", ".avi", ".raw", ".bin"),
)
"""Suffixes of image files."""


class NotOneImage(Exception):
    """The file holds something other than the one single-channel image asked for; the text names what it holds."""


class NoSuchImage(NotOneImage):
    """The file holds no image of the number or name asked for."""


class CannotRead(Exception):
    """The file cannot be read by this installation or with these settings; the text is a sentence and the way out."""


@dataclass(frozen=True)
class Header:
    """Header of an image."""

    shape: tuple[int, int]
    """(rows, columns)."""
    dtype: str
    """Name of the pixel type."""
    white_level: float | None = None
    """Value from which on pixels are saturated [count]; None where the file states none."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """When an image was recorded, as its file says; None where it does not."""

    time_s: float | None = None
    """Time after the first image of the recording [s]."""
    uncertainty_s: float = 0.0
    """Largest error of a difference of two times [s]."""
    is_arrival: bool = False
    """Whether the time is that of storing the image, not of its exposure."""
    exposure_s: float | None = None
    """Duration of the exposure [s]."""
    interval_s: float | None = None
    """Time between successive images of the file, as the camera was set [s]."""
    pulses_s: float | None = None
    """Time between the two pulses of light of a double frame [s]."""


@dataclass(frozen=True)
class ImagePath:
    """An image: its file, its part of the file, and the layout of a file without a header."""

    file: Path
    part: str = ""
    """Text behind ``#``; "" where none is named."""
    raw: RawImages | None = None
    """Layout of the files without a header, of the camera that recorded the image."""

    @property
    def path(self) -> Path:
        """File and part as one path."""
        return Path(f"{self.file}#{self.part}") if self.part else self.file

    @property
    def suffix(self) -> str:
        """Suffix of the file in small letters."""
        return self.file.suffix.lower()


def split(path: Path, raw: RawImages | None = None) -> ImagePath:
    """Split the path of an image into its file and the part of it behind ``#``.

    A ``#`` counts where the text before it ends in the suffix of an image file, and the text behind it does not.

    Examples
    --------
    >>> from pathlib import Path
    >>> from lfpiv.experiment.readers.source import split
    >>> for path in ("left/B00001.im7#1", "run.h5#images/00012", "left#1.tif"):
    ...     image = split(Path(path))
    ...     print(image.file.as_posix(), repr(image.part))
    left/B00001.im7 '1'
    run.h5 'images/00012'
    left#1.tif ''
    """
    text = str(path)
    at = text.find("#")
    while at >= 0:
        file, part = text[:at], text[at + 1 :]
        suffix = Path(file).suffix.lower()
        if suffix in SUFFIXES and Path(part).suffix.lower() not in SUFFIXES:
            if suffix in STACK_SUFFIXES or "/" not in part:
                return ImagePath(Path(file), part, raw)
        at = text.find("#", at + 1)
    return ImagePath(path, "", raw)
