"""Read images of LaVision's DaVis (.im7, .imx) with LaVision's library lvpyio, which the extra ``davis`` installs.

A DaVis buffer may hold several frames: both exposures of a pair, and several cameras. A number behind the file's name
selects one: ``B00001.im7#0`` is the first frame, ``B00001.im7#1.0`` the first exposure of the second camera in a buffer
of double frames (frame 2 * 1 + 0). A buffer of one frame needs no number.
"""

from __future__ import annotations

import functools
import re
from typing import Any

import numpy as np

from lfpiv.experiment.readers.source import CannotRead, ImagePath, NotOneImage, Recorded

SUFFIXES = (".im7", ".imx")
"""Suffixes of image files."""
VECTOR_SUFFIXES = (".vc7", ".vec")
"""Suffixes of vector files."""

UNITS_S = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "\u03bcs": 1e-6, "us": 1e-6, "ns": 1e-9}
"""Units of time by their signs, of which micro has two [s]."""

_TIME = re.compile(r"(?P<number>-?\d+(\.\d+)?([eE][-+]?\d+)?)\s*(?P<unit>s|ms|[µ\u03bcu]s|ns)")
_FRAME = re.compile(r"(?:(?P<camera>\d+)\.)?(?P<frame>\d+)")


def header(image: ImagePath) -> None:
    """Check a DaVis image without decoding it: a buffer is decoded with all its frames.

    Raises
    ------
    CannotRead
        If the extra ``davis`` is missing.
    NotOneImage
        If the text behind ``#`` cannot name a frame.
    ValueError
        If the file is empty.
    """
    _library()
    _named_frame(image.part)
    if image.file.stat().st_size == 0:
        raise ValueError("the file is empty")


def in_order(image: ImagePath) -> bool:
    """Return whether the images of a file are numbered without gaps: not known before it is decoded."""
    return False


def read(image: ImagePath) -> np.ndarray:
    """Read one frame of a DaVis image buffer.

    Parameters
    ----------
    image : ImagePath
        The file, with the frame behind ``#`` where it holds several.

    Returns
    -------
    ndarray, shape (rows, columns)
        Grey values [counts], of the stored type unless the buffer scales them.

    Raises
    ------
    CannotRead
        If the extra ``davis`` is missing.
    NotOneImage
        If there is no such frame, or it is not one image of grey values.
    """
    buffer = _buffer_of(image)
    frame = buffer[_frame_number(image.part, len(buffer))]
    if "PIXEL" not in frame.components:
        raise NotOneImage(f"a frame #{image.part or 0} without pixels, such as a vector field")
    if str(frame.attributes.get("RGBFrame", "0")) != "0":
        raise NotOneImage("pixels behind a colour filter; record with a monochrome camera")
    masked = [int(np.size(mask) - np.count_nonzero(mask)) for mask in frame.masks]  # 1 marks a valid pixel
    if any(masked):
        raise NotOneImage(f"an image with {sum(masked)} masked pixels; save it as it was recorded")
    planes = frame.components["PIXEL"].planes
    if len(planes) != 1 or np.ndim(planes[0]) != 2:
        raise NotOneImage(f"{len(planes)} planes of shape {np.shape(planes[0])}, such as a volume")
    pixels: np.ndarray = np.asarray(planes[0])
    scale = frame.scales.i
    if (scale.slope, scale.offset) == (1.0, 0.0):
        return pixels
    return float(scale.offset) + float(scale.slope) * pixels.astype(float)


def recorded(image: ImagePath) -> Recorded:
    """Return time, exposure and time between the pulses of a frame, from its attributes."""
    buffer = _buffer_of(image)
    attributes = buffer[_frame_number(image.part, len(buffer))].attributes
    time_s, exposure_s, pulses_s = (
        _seconds(str(attributes.get(name, ""))) for name in ("AcqTimeSeries", "ExposureTime", "FrameDt")
    )
    return Recorded(time_s=time_s, exposure_s=exposure_s, pulses_s=pulses_s or None)


def _seconds(text: str) -> float | None:
    """Return the time that a text such as "80 µs" states; None for any other text [s]."""
    match = _TIME.fullmatch(text.strip())
    return None if match is None else float(match["number"]) * UNITS_S[match["unit"]]


def _buffer_of(image: ImagePath) -> Any:
    status = image.file.stat()
    return _buffer(_library(), str(image.file), status.st_mtime_ns, status.st_size)


def _library() -> Any:
    try:
        import lvpyio
    except ImportError as error:
        found = "found none" if isinstance(error, ModuleNotFoundError) else f"found one that does not load ({error})"
        raise CannotRead(
            f"LaVision images are read by the package lvpyio, {found}. Install the extra davis with "
            "pip install 'lfpiv[davis]', or save the images as TIFF in DaVis."
        ) from None
    return lvpyio


@functools.lru_cache(maxsize=1)
def _buffer(library: Any, file: str, changed_ns: int, size: int) -> Any:
    """Read a buffer; the last one is cached because the frames of a file are read one after the other."""
    return library.read_buffer(file)


def _named_frame(fragment: str) -> int | None:
    """Return the number of the frame that the text behind ``#`` names; None for no text."""
    if not fragment:
        return None
    match = _FRAME.fullmatch(fragment)
    if match is None:
        raise NotOneImage(f"a frame called {fragment!r}; name it by number (#0) or #CAMERA.EXPOSURE (#1.0)")
    if match["camera"] is None:
        return int(match["frame"])
    if int(match["frame"]) > 1:
        raise NotOneImage(f"exposure {match['frame']} in #{fragment}; a double frame has the exposures 0 and 1")
    return 2 * int(match["camera"]) + int(match["frame"])


def _frame_number(fragment: str, count: int) -> int:
    """Return the number of the named frame in a buffer of `count` frames."""
    number = _named_frame(fragment)
    if number is None:
        if count == 1:
            return 0
        raise NotOneImage(f"{count} frames; name one behind the file: #0 to #{count - 1}, or #CAMERA.EXPOSURE")
    if number >= count:
        raise NotOneImage(f"{count} frame{'' if count == 1 else 's'}, none of them #{fragment}; they count from 0")
    return number
