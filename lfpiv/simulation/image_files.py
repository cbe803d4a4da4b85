"""Write simulated images: TIFF files of one image, and stacks of a series as multi-page TIFF files or HDF5 datasets."""

from __future__ import annotations

import re
import string
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
import tifffile

from lfpiv import hdf5
from lfpiv.experiment.patterns import NUMBER_FORMAT

FIELDS = {"camera", "instant"}
"""Fields of the path of a series' images."""

TIFF, HDF5 = (".tif", ".tiff"), (".h5", ".hdf5")
"""Endings of the files that are written."""

PAGE = re.compile(r"\d+")
DATASET = re.compile(r"(?P<name>[\w./-]+)\[(?P<index>\d+)\]", re.ASCII)


def check_pattern(pattern: str, instants: Sequence[int]) -> None:
    """Refuse a path pattern of a series' images that does not name each image of its own in a file of a known form.

    Parameters
    ----------
    pattern : str
        Path with ``{camera}`` and ``{instant}``.
    instants : sequence of int
        Numbers of the instants.

    Raises
    ------
    ValueError
    """
    try:
        _check_fields(pattern)
        paths = [pattern.format(camera="camera", instant=instant) for instant in (instants[0], instants[-1])]
    except ValueError as error:
        raise ValueError(f"images: a path with {{camera}} and {{instant}} ({error})") from None
    path, part = _parts(paths[0])
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise ValueError("images: a path below the folder of the data set")
    in_tiff = path.endswith(TIFF) and (part is None or PAGE.fullmatch(part))
    in_hdf5 = path.endswith(HDF5) and part is not None and DATASET.fullmatch(part)
    if not in_tiff and not in_hdf5:
        raise ValueError("images: a path that ends in .tif, .tif#{instant} or .h5#NAME[{instant}]")
    if part is not None and instants[0] != 0 and path == _parts(paths[1])[0]:
        raise ValueError("images: first = 0 with a stack, whose images count from 0")


def _check_fields(pattern: str) -> None:
    fields = {name: (width, turn) for _, name, width, turn in string.Formatter().parse(pattern) if name is not None}
    if set(fields) != FIELDS:
        raise ValueError("each of them, and no others")
    width, turn = fields["instant"]
    if fields["camera"] != ("", None) or turn or not NUMBER_FORMAT.fullmatch(width or ""):
        raise ValueError("no other format than {instant:06d}")


def _parts(path: str) -> tuple[str, str | None]:
    """Return a path and what stands behind ``#`` in it, or None."""
    file, mark, part = path.partition("#")
    return file, part if mark else None


class ImageWriter:
    """Write images below a folder; a context that keeps stacks open. Images of a stack are written in order."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._tiff: dict[Path, tifffile.TiffWriter] = {}
        self._hdf5: dict[Path, h5py.File] = {}

    def __enter__(self) -> ImageWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def write(self, name: str, image: np.ndarray) -> None:
        """Write an image under a path relative to the folder, which may name a part of a file behind ``#``."""
        file, part = _parts(name)
        path = self._folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        if part is None:
            tifffile.imwrite(path, image, compression="zlib", metadata=None)
        elif path.suffix in HDF5:
            self._append_hdf5(path, part, image)
        else:
            if path not in self._tiff:
                self._tiff[path] = self._stack.enter_context(tifffile.TiffWriter(path, bigtiff=True))
            self._tiff[path].write(image, compression="zlib", metadata=None, contiguous=False)

    def _append_hdf5(self, path: Path, part: str, image: np.ndarray) -> None:
        if path not in self._hdf5:
            disk = self._stack.enter_context(hdf5.Disk(path, "w+"))
            self._stack.callback(disk.check)
            self._hdf5[path] = self._stack.enter_context(h5py.File(disk, "w"))
        match = DATASET.fullmatch(part)
        assert match is not None
        file, name, index = self._hdf5[path], match["name"], int(match["index"])
        if name not in file:
            shape, limit = (0, *image.shape), (None, *image.shape)
            file.create_dataset(
                name, shape, image.dtype, maxshape=limit, chunks=(1, *image.shape), compression="gzip", fletcher32=True
            )
        dataset = file[name]
        dataset.resize(max(index + 1, len(dataset)), axis=0)
        dataset[index] = image
