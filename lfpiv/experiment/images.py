"""Read single-channel camera images as float32, and check their headers without decoding them."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.errors import InputError
from lfpiv.experiment import pixel_bytes
from lfpiv.experiment.readers import davis
from lfpiv.experiment.readers.source import SUFFIXES, CannotRead, Header, ImagePath, NotOneImage, split
from lfpiv.settings.rig import RawImages

if TYPE_CHECKING:
    from lfpiv.experiment.readers.table import Reader

DTYPES = ("uint8", "uint16", "uint32", "int16", "int32", "float32", "float64")
SCALED = 2.0
"""Largest value of an image with fractions that was scaled."""
FLIPS = {
    "none": (slice(None), slice(None)),
    "horizontal": (slice(None), slice(None, None, -1)),
    "vertical": (slice(None, None, -1), slice(None)),
    "both": (slice(None, None, -1), slice(None, None, -1)),
}
"""Index that reverses each ``image_flip``; "horizontal" exchanges left and right."""


def read_header(path: Path, label: str, raw: RawImages | None = None) -> Header | None:
    """Check an image without decoding its pixels.

    Parameters
    ----------
    path : Path
        An image file, with the part of it behind ``#`` where it holds several images (`lfpiv.experiment.readers`).
    label : str
        Key and camera of the file, for messages.
    raw : RawImages or None
        Layout of the files without a header, of the camera.

    Returns
    -------
    Header or None
        None for a DaVis image, which has no header that can be read separately. Then only the file's existence, its
        length and the library that decodes it are checked.

    Raises
    ------
    InputError
        If the file is missing, no regular file, truncated or unreadable, or if the path names something other than one
        single-channel image of real numbers.
    """
    place, image = f"{path} ({label})", split(path, raw)
    with _naming(place):
        _require_file(image, place)
        header = _reader(image).header(image)
    if header is not None:
        _require_dtype(header.dtype, place)
    return header


def read_image(path: Path, label: str, *, flip: str = "none", raw: RawImages | None = None) -> np.ndarray:
    """Read one image.

    Parameters
    ----------
    path, label, raw
        As for `read_header`.
    flip : {"none", "horizontal", "vertical", "both"}
        Mirroring to reverse.

    Returns
    -------
    ndarray, shape (rows, columns), float32
        Grey values [counts], contiguous.

    Raises
    ------
    InputError
        If `read_header` refuses the file, or it cannot be decoded or holds values that are not finite.
    """
    header = read_header(path, label, raw)
    place, image = f"{path} ({label})", split(path, raw)
    with _naming(place):
        pixels = _reader(image).read(image)
    if header is None:
        _require_dtype(pixels.dtype.name, place)
    elif pixels.shape != header.shape:
        raise InputError(f"{place}: expected {header.shape} pixels as its header says, found {pixels.shape}.")
    flipped = np.ascontiguousarray(pixels[FLIPS[flip]], np.float32)
    if not np.isfinite(flipped).all():
        raise InputError(f"{place}: expected finite grey values, found NaN or infinity. Save the raw counts.")
    return flipped


def require_contrast(image: np.ndarray, path: Path, label: str) -> None:
    """Refuse an image with the same value everywhere, such as an all-black one, or with a scale from 0 to 1.

    Noise and saturation are measured in counts, whose rounding hides what is in an image that was scaled.

    Raises
    ------
    InputError
        If all pixels are equal, values with fractions reach no further than `SCALED`, or bytes are exchanged or noise.
    """
    low, high = float(image.min()), float(image.max())
    if high <= low or high <= 0:
        what = "is all black" if high <= 0 else f"holds the value {high:g} everywhere"
        raise InputError(f"{path} ({label}): expected an exposed image, found one that {what}. Take the image again.")
    if max(high, -low) <= SCALED and (image != np.rint(image)).any():
        raise InputError(
            f"{path} ({label}): expected grey values in counts, found a scale of 0 to 1 ({low:.3g} to {high:.3g}). "
            "Save all images of this camera as it recorded them; or multiply all by its full scale, 4095 for 12 bits."
        )
    if (found := pixel_bytes.fault(image)) is not None:
        raise InputError(f"{path} ({label}): expected grey values as the camera recorded them, found {found}.")


@contextlib.contextmanager
def _naming(place: str) -> Iterator[None]:
    """Turn all exceptions of a decoder into an `InputError` that names the file."""
    try:
        yield
    except InputError:
        raise
    except CannotRead as error:
        raise InputError(f"{place}: {error}") from None
    except NotOneImage as error:
        raise InputError(f"{place}: expected one single-channel image, found {error}.") from None
    except PermissionError:
        raise InputError(f"{place}: the file may not be read. Change its permissions.") from None
    except Exception as error:  # decoders raise exceptions of many types on damaged files
        text = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{place}: expected a complete image file, found a truncated or damaged one ({text}). Copy it again."
        ) from None


def _require_file(image: ImagePath, place: str) -> None:
    """Refuse what is no regular file, before it is opened, and what has another suffix than images have."""
    try:
        mode = image.file.stat().st_mode
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        if isinstance(error, PermissionError):
            raise
        raise InputError(
            f"{place}: expected an image file, found no such file. Check the path in the experiment file"
            f"{_about_backslashes(image.file)}."
        ) from None
    if not stat.S_ISREG(mode):
        found = "a folder" if stat.S_ISDIR(mode) else "a pipe, socket or device"
        raise InputError(f"{place}: expected an image file, found {found}. Check the path in the experiment file.")
    if image.suffix not in SUFFIXES:
        found = "a file of vectors" if image.suffix in davis.VECTOR_SUFFIXES else repr(image.suffix or "no suffix")
        raise InputError(
            f"{place}: expected an image file ({', '.join(SUFFIXES)}), found {found}. Convert the image without loss."
        )


def _about_backslashes(file: Path) -> str:
    """Return advice for a path of Windows on another system, where a backslash is a character of a name."""
    return "; folders are separated by / here, not by a backslash" if "\\" in str(file) and os.sep == "/" else ""


def _reader(image: ImagePath) -> Reader:
    from lfpiv.experiment.readers.table import READERS

    return READERS[image.suffix]


def _require_dtype(dtype: str, place: str) -> None:
    if dtype not in DTYPES:
        raise InputError(f"{place}: expected pixels of type {', '.join(DTYPES)}, found {dtype}. Save raw grey values.")
