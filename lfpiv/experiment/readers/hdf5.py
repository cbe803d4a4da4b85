"""Read images from HDF5 datasets.

The text behind ``#`` names a dataset, an image in it, or both: ``run.h5#images[12]`` or ``run.h5#images/12`` is image
12 of a dataset of three dimensions (image, row, column), ``run.h5#images/00012`` a dataset of two dimensions,
``run.h5#12`` image 12 of the file's only dataset of images. Pixels in other files are refused: external links,
external storage and virtual datasets.
"""

from __future__ import annotations

import re
import weakref

import h5py
import numpy as np

from lfpiv.experiment.readers.hdf5_chunks import all_written, read_chunks, require_filters, require_written
from lfpiv.experiment.readers.limits import require_plausible
from lfpiv.experiment.readers.source import Header, ImagePath, NoSuchImage, NotOneImage, Recorded
from lfpiv.experiment.readers.stack import OPEN_STACKS, OpenFiles

MOST_LINKS = 16
"""Largest number of soft links on the way to a dataset."""
MOST_OBJECTS = 1000
"""Largest number of objects that are looked at for the file's only dataset of images."""

_INDEXED = re.compile(r"(?P<name>.+)\[(?P<number>\d{1,18})\]")
_LAST = re.compile(r"(?P<name>.+)/(?P<number>\d{1,18})")


class Hdf5Images:
    """An HDF5 file that stays open as long as this object lives: hold it while a dataset of it is read."""

    def __init__(self, image: ImagePath):
        self._file = h5py.File(image.file, "r")
        weakref.finalize(self, self._file.close)
        self._only: h5py.Dataset | None = None

    def find(self, part: str) -> tuple[h5py.Dataset, int | None]:
        """Return the dataset that the text behind ``#`` names, and the number of the image in it.

        The number is None for a dataset of two dimensions. Brackets always hold a number. Other digits are read as a
        number only if no dataset has that name.
        """
        name, number = part, None
        if match := _INDEXED.fullmatch(part):
            name, number = match["name"], int(match["number"])
            found = self._dataset(name)
        elif part:
            found = self._dataset(part)
            if found is None and (match := _LAST.fullmatch(part)):
                name, number = match["name"], int(match["number"])
                found = self._dataset(name)
            if found is None and part.isascii() and part.isdigit() and len(part) < 18:
                name, number = "", int(part)
                found = self._only_dataset()
        else:
            found = self._only_dataset()
        if found is None:
            raise NoSuchImage(f"no dataset {name[:80]!r}; name one behind the file, such as #images[0]")
        return found, self._number(found, number)

    @staticmethod
    def _number(dataset: h5py.Dataset, number: int | None) -> int | None:
        """Return the number of the image in a dataset, 0 if a stack of one needs none; refuse what holds no images."""
        shape: tuple[int, ...] = dataset.shape or ()
        name = dataset.name.lstrip("/")
        if len(shape) == 2:
            if number is not None:
                raise NotOneImage(f"one image in the dataset {name}; name it without a number")
            return None
        if len(shape) != 3:
            raise NotOneImage(f"a dataset {name} of shape {shape}, not (image, row, column) or (row, column)")
        if shape[0] == 0:
            raise NoSuchImage(f"a dataset {name} of no images: nothing was recorded")
        if number is None and shape[0] != 1:
            raise NotOneImage(f"{shape[0]} images; name one behind the file: #{name}[0] to #{name}[{shape[0] - 1}]")
        if (number or 0) >= shape[0]:
            raise NoSuchImage(f"{shape[0]} images in the dataset {name}, none of number {number}; they count from 0")
        return number or 0

    def _dataset(self, name: str) -> h5py.Dataset | None:
        """Return a dataset by its path in the file; None if there is none. Follow no link out of the file."""
        group, names, links = self._file, [part for part in name.split("/") if part], 0
        while names:
            first = names.pop(0)
            if not group.id.links.exists(first.encode()):  # unlike `in`, it does not follow the link
                return None
            link = group.get(first, getlink=True)
            if isinstance(link, h5py.SoftLink):
                links += 1
                if links > MOST_LINKS:
                    raise NotOneImage(f"more than {MOST_LINKS} links on the way to {name[:80]!r}")
                names = [part for part in link.path.split("/") if part] + names
                group = self._file if link.path.startswith("/") else group
                continue
            if not isinstance(link, h5py.HardLink):
                raise NotOneImage(f"a link into another file at {first[:80]!r}; name that file, or copy the dataset")
            group = group[first]
            if names and not isinstance(group, h5py.Group):
                return None
        return group if isinstance(group, h5py.Dataset) else None

    def _only_dataset(self) -> h5py.Dataset:
        """Return the file's only dataset of images: of three dimensions, or else of two."""
        if self._only is None:
            found: dict[int, list[str]] = {2: [], 3: []}
            looked = 0

            def look(name: str, thing: h5py.Dataset | h5py.Group) -> bool | None:
                nonlocal looked
                looked += 1
                if isinstance(thing, h5py.Dataset) and thing.dtype.kind in "uif" and len(thing.shape or ()) in found:
                    found[len(thing.shape)].append(name)
                return True if looked >= MOST_OBJECTS else None

            self._file.visititems(look)
            names = found[3] or found[2]
            if looked >= MOST_OBJECTS:
                raise NotOneImage(f"more than {MOST_OBJECTS} objects; name one behind the file, such as #images[0]")
            if len(names) != 1:
                some = f" ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})" if names else ""
                found_here = f"{len(names) or 'no'} datasets of images{some}"
                raise NotOneImage(f"{found_here}; name one behind the file, such as #images[0]")
            self._only = self._file[names[0]]
        return self._only


_open_files: OpenFiles[Hdf5Images] = OpenFiles(OPEN_STACKS)


def header(image: ImagePath) -> Header:
    """Return the header of an image without reading its pixels."""
    opened = _open_files.get(image, Hdf5Images)  # a name keeps the file open until the header is read
    return _checked(*opened.find(image.part))


def in_order(image: ImagePath) -> bool:
    """Return whether all numbers of images from 0 exist: the image is in a stack, of which all images were written."""
    opened = _open_files.get(image, Hdf5Images)
    dataset, number = opened.find(image.part)
    return number is not None and (dataset.chunks is None or all_written(dataset))


def recorded(image: ImagePath) -> Recorded:
    """Return an empty record: HDF5 has no standard place for the time at which an image was recorded."""
    return Recorded()


def read(image: ImagePath) -> np.ndarray:
    """Return the pixels of an image."""
    opened = _open_files.get(image, Hdf5Images)
    dataset, number = opened.find(image.part)
    _checked(dataset, number)
    if dataset.chunks is not None:
        return read_chunks(dataset, number)
    return dataset[()] if number is None else dataset[number]


def _checked(dataset: h5py.Dataset, number: int | None) -> Header:
    """Return the header of an image.

    Refuse pixels in other files, pixels that were never written, and sizes that the stored bytes cannot make.
    """
    settings = dataset.id.get_create_plist()
    if dataset.is_virtual or settings.get_external_count():
        raise NotOneImage(f"a dataset {dataset.name} whose pixels are in another file; copy them into this one")
    if dataset.dtype.kind not in "uif":
        raise NotOneImage(f"a dataset {dataset.name} of type {dataset.dtype}; save raw grey values")
    shape = dataset.shape[-2:]
    stored = dataset.id.get_storage_size()
    require_plausible(shape, dataset.dtype.itemsize, stored)
    if dataset.chunks is not None:
        require_plausible(dataset.chunks, dataset.dtype.itemsize, stored)
        require_filters(dataset)
        require_written(dataset, number)
    if stored == 0:
        raise NoSuchImage(f"none, since the dataset {dataset.name} was never written: it has no pixels")
    return Header((int(shape[0]), int(shape[1])), dataset.dtype.name)
