"""Read Photron's .mraw recordings, whose header lies beside them: text (.cih) or XML (.cihx)."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lfpiv.experiment.readers.source import CannotRead, ImagePath, NotOneImage, Recorded
from lfpiv.experiment.readers.stack import Frames

HEADER_BYTES = 1 << 20
"""Largest part of a header that is read [byte]."""

_XML_KEYS = {
    "Total Frame": "frameInfo/totalFrame",
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "File Format": "imageFileInfo/fileFormat",
    "Camera Type": "deviceInfo/deviceName",
    "Record Rate(fps)": "recordInfo/recordRate",
    "Save Step": "frameInfo/skipFrame",
}
"""Elements of the XML header, each in its parents, by the keys of the text header: names such as width come twice."""
_MODEL = re.compile(r"-([MC])\d*(?![A-Za-z0-9])")
"""Letter in the name of a model that says monochrome or colour, as in "type 1100K-M-64GB" and "model 675K-M3"."""


class Mraw(Frames):
    """Images of a recording, one after the other: of 8 or 16 bits, or of 12 bits, two in three bytes."""

    def __init__(self, image: ImagePath, header: Mapping[str, str]):
        rows, columns, count, self._bits = (
            _number(header, key) for key in ("Image Height", "Image Width", "Total Frame", "Color Bit")
        )
        if (form := header.get("File Format", "mraw").lower()) != "mraw":
            raise NotOneImage(f"a recording saved as {form}; save it as MRAW")
        _require_grey(header.get("Color Type", "Mono"), header.get("Camera Type", ""), self._bits)
        super().__init__(image.file, (rows, columns), np.dtype("u1" if self._bits == 8 else "<u2"), count)
        if rows * columns * self._bits % 8:
            raise ValueError(f"{rows} x {columns} pixels of {self._bits} bits do not fill whole bytes")
        self._length = rows * columns * self._bits // 8
        self._interval_s = _interval_s(header.get("Record Rate(fps)", ""), header.get("Save Step", ""))
        if count * self._length < self.size:
            raise ValueError(f"its header declares {count * self._length} bytes, the file has {self.size}")

    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image's pixels."""
        return number * self._length, self._length

    def recorded(self, number: int) -> Recorded:
        """Return the time between images, from the rate of recording."""
        return Recorded(interval_s=self._interval_s)

    def decode(self, data: bytes) -> np.ndarray:
        """Return the pixels of an image from their bytes."""
        return unpack_12(data).reshape(self.shape) if self._bits == 12 else super().decode(data)


def open_mraw(image: ImagePath) -> Mraw:
    """Open a recording with the header beside it."""
    for suffix, parse in ((".cihx", _xml_entries), (".cih", _text_entries)):
        beside = _beside(image.file, suffix)
        if beside is not None:
            with beside.open("rb") as file:
                return Mraw(image, parse(file.read(HEADER_BYTES).decode("utf-8", "replace")))
    raise CannotRead(
        f"expected the header of the recording beside it, {image.file.with_suffix('.cih').name} or .cihx, found none. "
        "Copy it too."
    )


def unpack_12(data: bytes) -> np.ndarray:
    """Return counts of 12 bits, of which two are packed in three bytes, the highest bits first."""
    first, middle, last = np.frombuffer(data, np.uint8).reshape(-1, 3).T.astype(np.uint16)
    return np.stack([first << 4 | middle >> 4, (middle & 15) << 8 | last], axis=1).ravel()


def _require_grey(colour: str, camera: str, bits: int) -> None:
    """Refuse pixels behind a colour filter and odd bits. Both kinds of cameras write the colour type Raw."""
    model = _MODEL.search(camera)
    if bits not in (8, 12, 16):
        raise NotOneImage(f"{colour[:20]} pixels of {bits} bits; save 8, 12 or 16 bits")
    if colour.lower() == "mono" or (colour.lower() == "raw" and model is not None and model[1] == "M"):
        return
    if colour.lower() == "raw" and model is None:
        raise NotOneImage(
            f"pixels of the colour type Raw of a camera {camera[:60]!r}, whose name says neither M, monochrome, nor C, "
            "colour; save the recording of a monochrome camera with the colour type Mono, such as with 16 bits"
        )
    raise NotOneImage(f"{colour[:20]} pixels of {bits} bits of a colour camera; record with a monochrome camera")


def _beside(file: Path, suffix: str) -> Path | None:
    """Return the file of another suffix, in small or capital letters; None if there is no regular one."""
    return next((path for end in (suffix, suffix.upper()) if (path := file.with_suffix(end)).is_file()), None)


def _text_entries(text: str) -> dict[str, str]:
    """Return the entries of a text header, "key : value" in each line."""
    lines = (line.partition(":") for line in text.removeprefix("\ufeff").splitlines())
    return {key.strip(): value.strip() for key, colon, value in lines if colon}


def _xml_entries(text: str) -> dict[str, str]:
    """Return the entries of an XML header, which stands between other bytes, under the keys of the text header."""
    found = {key: functools.reduce(_element, path.split("/"), text) for key, path in _XML_KEYS.items()}
    return {key: value for key, value in found.items() if value}


def _element(text: str, name: str) -> str:
    """Return what stands in the first element of a name; "" if there is none. Takes time in proportion to the text."""
    inside = text.partition(f"<{name}>")[2]
    content, end, _ = inside.partition(f"</{name}>")
    return content.strip() if end else ""


def _interval_s(rate: str, step: str) -> float | None:
    """Return the time between the stored images; None where it is not stated, or images were left out on saving [s]."""
    try:
        images_per_s = float(rate)
    except ValueError:
        return None
    return 1 / images_per_s if 1e-3 < images_per_s < 1e9 and step in ("", "0", "1") else None


def _number(header: Mapping[str, str], key: str) -> int:
    text = header.get(key, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ValueError(f"its header has {key} = {text[:40]!r}")
    return int(text)
