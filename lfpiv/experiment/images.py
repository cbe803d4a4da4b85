"""Read single-channel camera images (TIFF, PNG, DaVis) as float32, and check their headers without decoding them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lfpiv.errors import InputError
from lfpiv.experiment import davis
from lfpiv.experiment.davis import NotOneImage

SUFFIXES = (".tif", ".tiff", ".png", *davis.SUFFIXES)
DTYPES = ("uint8", "uint16", "uint32", "int16", "int32", "float32", "float64")
FLIPS = {
    "none": (slice(None), slice(None)),
    "horizontal": (slice(None), slice(None, None, -1)),
    "vertical": (slice(None, None, -1), slice(None)),
    "both": (slice(None, None, -1), slice(None, None, -1)),
}
"""Index that reverses each ``image_flip``; "horizontal" exchanges left and right."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Header:
    """Header of an image file."""

    shape: tuple[int, int]
    """(rows, columns)."""
    dtype: str
    """Name of the pixel type."""


def read_header(path: Path, label: str) -> Header | None:
    """Check an image file without decoding its pixels.

    Parameters
    ----------
    path : Path
        A TIFF, PNG or DaVis image (see `lfpiv.experiment.davis`).
    label : str
        Key and camera of the file, for messages.

    Returns
    -------
    Header or None
        None for a DaVis image, which has no header that can be read separately. Then only the file's existence, its
        length and the library that decodes it are checked.

    Raises
    ------
    InputError
        If the file is missing, truncated, unreadable, or not one single-channel image of real numbers.
    """
    place = f"{path} ({label})"
    file, _ = davis.split_frame(path)
    if not file.is_file():
        found = "a folder" if file.is_dir() else "no such file"
        raise InputError(f"{place}: expected an image file, found {found}. Check the path in the experiment file.")
    kind = file.suffix.lower()
    if kind not in SUFFIXES:
        found = "a file of vectors" if kind in davis.VECTOR_SUFFIXES else repr(file.suffix or "no suffix")
        raise InputError(
            f"{place}: expected a TIFF, PNG or DaVis image ({', '.join(SUFFIXES)}), found {found}. "
            "Convert the image without loss."
        )
    with _naming(place):
        if kind in davis.SUFFIXES:
            davis.check(path, place)
            return None
        header = _png_header(path) if kind == ".png" else _tiff_header(path)
    _require_dtype(header.dtype, place)
    return header


def read_image(path: Path, label: str, *, flip: str = "none") -> np.ndarray:
    """Read one image.

    Parameters
    ----------
    path, label
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
    header = read_header(path, label)
    place = f"{path} ({label})"
    with _naming(place):
        pixels = _decode(path, place)
    if header is None:
        _require_dtype(str(pixels.dtype), place)
    elif pixels.shape != header.shape:
        raise InputError(f"{place}: expected {header.shape} pixels as its header says, found {pixels.shape}.")
    image = np.ascontiguousarray(pixels[FLIPS[flip]], np.float32)
    if not np.isfinite(image).all():
        raise InputError(f"{place}: expected finite grey values, found NaN or infinity. Save the raw counts.")
    return image


def require_contrast(image: np.ndarray, path: Path, label: str) -> None:
    """Refuse an image with the same value everywhere, such as an all-black one.

    Raises
    ------
    InputError
        If all pixels are equal.
    """
    low, high = float(image.min()), float(image.max())
    if high <= low or high <= 0:
        what = "is all black" if high <= 0 else f"holds the value {high:g} everywhere"
        raise InputError(f"{path} ({label}): expected an exposed image, found one that {what}. Take the image again.")


@contextlib.contextmanager
def _naming(place: str) -> Iterator[None]:
    """Turn all exceptions of a decoder into an `InputError` that names the file."""
    try:
        yield
    except InputError:
        raise
    except NotOneImage as error:
        raise InputError(f"{place}: expected one single-channel image, found {error}.") from None
    except PermissionError:
        raise InputError(f"{place}: the file may not be read. Change its permissions.") from None
    except Exception as error:  # decoders raise exceptions of many types on damaged files
        text = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{place}: expected a complete image file, found a truncated or damaged one ({text}). Copy it again."
        ) from None


def _require_dtype(dtype: str, place: str) -> None:
    if dtype not in DTYPES:
        raise InputError(f"{place}: expected pixels of type {', '.join(DTYPES)}, found {dtype}. Save raw grey values.")


def _tiff_header(path: Path) -> Header:
    import tifffile

    size = path.stat().st_size
    if size == 0:
        raise ValueError("the file is empty")
    with tifffile.TiffFile(path) as tiff:
        if len(tiff.pages) != 1:
            raise NotOneImage(f"{len(tiff.pages)} pages; save one image per file")
        page = tiff.pages.first
        end = max(
            (offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)), default=0
        )
        if len(page.shape) != 2 or page.samplesperpixel != 1:
            raise NotOneImage(f"pixels of shape {page.shape}, such as a colour image; save raw grey values")
        meaning = tifffile.PHOTOMETRIC(page.photometric)
        if meaning is not tifffile.PHOTOMETRIC.MINISBLACK:
            raise NotOneImage(f"{meaning.name} pixels; save raw grey values, 0 = black")
        if page.dtype is None:
            raise ValueError("unknown pixel type")
        (rows, columns), dtype = page.shape, str(page.dtype)
    if end == 0 or end > size:
        raise ValueError(f"pixel data end at byte {end}, the file at byte {size}")
    return Header((int(rows), int(columns)), dtype)


def _png_header(path: Path) -> Header:
    with path.open("rb") as file:
        start = file.read(26)
        file.seek(max(path.stat().st_size - 12, 0))
        end = file.read(12)
    if start[:8] != _PNG_SIGNATURE or len(start) < 26:
        raise ValueError("no PNG signature")
    if end[4:8] != b"IEND":
        raise ValueError("the file ends before its end marker")
    columns, rows = (int.from_bytes(start[at : at + 4], "big") for at in (16, 20))
    depth, colour = start[24], start[25]
    if colour != 0:
        raise NotOneImage("a colour, palette or transparent image; save raw grey values")
    return Header((rows, columns), "uint16" if depth == 16 else "uint8" if depth == 8 else f"uint{depth}")


def _decode(path: Path, place: str) -> np.ndarray:
    if davis.split_frame(path)[0].suffix.lower() in davis.SUFFIXES:
        return davis.read(path, place)
    if path.suffix.lower() == ".png":
        import imagecodecs

        return imagecodecs.png_decode(path.read_bytes())
    import tifffile

    return tifffile.imread(path)
