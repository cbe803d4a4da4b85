"""Read images of HDF5 datasets that are stored in chunks, which may be missing, compressed, or made to inflate.

HDF5 reads chunks that were never written as zeros, and decodes a compressed chunk to whatever size it grows to. So
chunks are looked up first, and decoded here, up to their declared size. Chunks of szip, n-bit and scale-offset are left
to HDF5: the last two cannot inflate, and the size that a chunk of szip states is compared with the declared size.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import h5py
import imagecodecs
import numpy as np

from lfpiv.experiment.readers.source import NoSuchImage, NotOneImage

SHUFFLE, FLETCHER, SZIP, NBIT, SCALE_OFFSET, BITSHUFFLE = 2, 3, 4, 5, 6, 32008
"""Registered numbers of filters."""
BY_HDF5 = frozenset({SZIP, NBIT, SCALE_OFFSET})
"""Filters that HDF5 decodes."""
OWN_FILTERS = (SHUFFLE, FLETCHER, *BY_HDF5)
"""Filters of HDF5 itself but deflate. They cannot inflate, szip apart, which states its size."""
DECODERS: dict[int, Callable[..., bytes | bytearray]] = {
    1: imagecodecs.zlib_decode,
    32000: imagecodecs.lzf_decode,
    32001: imagecodecs.blosc_decode,
    32004: imagecodecs.lz4h5_decode,
    32015: imagecodecs.zstd_decode,
}
"""Decoder of deflate, LZF, Blosc, LZ4 and Zstd by the number of the filter; each stops at a given size."""


def require_filters(dataset: h5py.Dataset) -> None:
    """Refuse a dataset behind a filter that is not read here, by the filter's name."""
    for number, _, name in _filters(dataset):
        if number not in (*OWN_FILTERS, *DECODERS, BITSHUFFLE):
            raise NotOneImage(
                f"a dataset {dataset.name} behind the filter {number} {name}, which is not read; write the images with "
                "gzip, LZ4, Zstd, Blosc or bitshuffle"
            )


def all_written(dataset: h5py.Dataset) -> bool:
    """Return whether every chunk of a dataset was written."""
    grid = [math.ceil(size / edge) for size, edge in zip(dataset.shape, dataset.chunks, strict=True)]
    return bool(dataset.id.get_num_chunks() >= math.prod(grid))


def require_written(dataset: h5py.Dataset, number: int | None) -> None:
    """Refuse an image of which a chunk was never written: HDF5 would read it as zeros."""
    for start in _starts(dataset, number):
        if not _is_written(dataset, start):
            which = "" if number is None else f"image {number} of "
            name = dataset.name.lstrip("/")
            raise NoSuchImage(f"none, since {which}the dataset {name} was never written: the recording was cut short")


def read_chunks(dataset: h5py.Dataset, number: int | None) -> np.ndarray:
    """Return the pixels of an image; raise ValueError for a chunk that grows beyond its declared size."""
    filters, size = _filters(dataset), math.prod(dataset.chunks) * dataset.dtype.itemsize
    if {one for one, _, _ in filters} & BY_HDF5:
        return _by_hdf5(dataset, number, size)
    image = np.empty(dataset.shape[-2:], dataset.dtype)
    rows, columns = dataset.chunks[-2:]
    for start in _starts(dataset, number):
        mask, stored = dataset.id.read_direct_chunk(start)
        for at in reversed(range(len(filters))):
            if not mask >> at & 1:  # a bit of the mask is set where the filter was skipped for this chunk
                stored = _undone(stored, *filters[at][:2], dataset.dtype.itemsize, size)
        if len(stored) != size:
            raise ValueError(f"a chunk holds {len(stored)} bytes of pixels, expected {size}")
        chunk = np.frombuffer(stored, dataset.dtype).reshape(dataset.chunks)
        part = chunk if number is None else chunk[number - start[0]]
        place = image[start[-2] : start[-2] + rows, start[-1] : start[-1] + columns]
        place[...] = part[: place.shape[0], : place.shape[1]]
    return image


def _by_hdf5(dataset: h5py.Dataset, number: int | None, size: int) -> np.ndarray:
    """Return an image that HDF5 decodes; raise ValueError for a chunk of szip that states more than `size` bytes."""
    filters = _filters(dataset)
    if {one for one, _, _ in filters} - set(OWN_FILTERS):
        raise NotOneImage(f"a dataset {dataset.name} behind two filters that compress; write the images with gzip")
    for start in _starts(dataset, number):
        mask, stored = dataset.id.read_direct_chunk(start)
        skipped = mask >> (len(filters) - 1) & 1  # as szip is where it would make a chunk larger
        if filters[-1][0] == SZIP and not skipped and int.from_bytes(stored[:4], "little") > size:
            raise ValueError(f"a chunk of {len(stored)} bytes states more than the {size} bytes of its pixels")
    return dataset[()] if number is None else dataset[number]


def _undone(stored: bytes, number: int, values: tuple[int, ...], item_bytes: int, size: int) -> bytes:
    """Undo one filter of a chunk. Decoders return at most the `size` bytes of its pixels and a checksum."""
    if number == SHUFFLE:
        return _bytes_in_order(stored, item_bytes)
    if number == FLETCHER:
        if int.from_bytes(stored[-4:], "little") != imagecodecs.h5checksum_fletcher32(stored[:-4]):
            raise ValueError("the checksum of a chunk is wrong")
        return stored[:-4]
    if number == BITSHUFFLE:
        return _bits_in_order(stored, values, item_bytes, size)
    return bytes(DECODERS[number](stored, out=size + 4))  # 4 bytes: Fletcher-32 may come before the compression


def _bytes_in_order(stored: bytes, item_bytes: int) -> bytes:
    """Undo shuffle: the first bytes of all pixels come first, then all second bytes, and so on."""
    count = len(stored) // item_bytes
    pixels = np.empty((count, item_bytes), np.uint8)
    planes = np.frombuffer(stored, np.uint8, count * item_bytes).reshape(item_bytes, count)
    for at, plane in enumerate(planes):
        pixels[:, at] = plane
    return pixels.tobytes() + stored[count * item_bytes :]


def _bits_in_order(stored: bytes, values: tuple[int, ...], item_bytes: int, size: int) -> bytes:
    """Undo bitshuffle, plain or with blocks compressed by LZ4 or Zstd.

    `values[4]` is the compression: 0, 2 (LZ4) or 3 (Zstd). A compressed chunk states its bytes of pixels (8 bytes)
    and of a block (4 bytes), then the length and content of each block. Pixels that fill no group of 8 follow plain.
    """
    compression = values[4] if len(values) > 4 else 0
    if compression == 0:
        whole = len(stored) // (8 * item_bytes) * 8 * item_bytes
        head = imagecodecs.bitshuffle_decode(stored[:whole], itemsize=item_bytes) if whole else b""
        return bytes(head) + stored[whole:]
    if int.from_bytes(stored[:8], "big") != size:
        raise ValueError(f"a chunk states {int.from_bytes(stored[:8], 'big')} bytes of pixels, expected {size}")
    decode = {2: imagecodecs.lz4_decode, 3: imagecodecs.zstd_decode}[compression]
    block, at, left, parts = int.from_bytes(stored[8:12], "big"), 12, size, []
    if not 0 < block <= size + 8 * 8192 or block % (8 * item_bytes):
        raise ValueError(f"a chunk of blocks of {block} bytes")
    while (part := min(block, left // (8 * item_bytes) * 8 * item_bytes)) > 0:
        end = at + 4 + int.from_bytes(stored[at : at + 4], "big")
        parts.append(imagecodecs.bitshuffle_decode(decode(stored[at + 4 : end], out=part), itemsize=item_bytes))
        at, left = end, left - part
    return b"".join([*parts, stored[at : at + left]])


def _starts(dataset: h5py.Dataset, number: int | None) -> Any:
    """Return the indices of the first element of each chunk that holds a part of an image, in row order."""
    edges = dataset.chunks
    along = [range(0, size, edge) for size, edge in zip(dataset.shape[-2:], edges[-2:], strict=True)]
    first = [] if number is None else [(number // edges[0] * edges[0],)]
    return itertools.product(*first, *along)


def _is_written(dataset: h5py.Dataset, start: tuple[int, ...]) -> bool:
    """Return whether a chunk was written: a buffer of one byte is too small for it, so its pixels are not read."""
    try:
        dataset.id.read_direct_chunk(start, out=np.empty(1, np.uint8))
    except ValueError:  # one byte is too small for it
        return True
    except (RuntimeError, OSError):  # not stored, or damaged: the slow search says which
        return dataset.id.get_chunk_info_by_coord(start).byte_offset is not None
    return True


def _filters(dataset: h5py.Dataset) -> list[tuple[int, tuple[int, ...], str]]:
    """Return number, values and name of a dataset's filters, in the order in which they were applied."""
    settings = dataset.id.get_create_plist()
    found = map(settings.get_filter, range(settings.get_nfilters()))
    return [(int(number), values, name.decode("ascii", "replace")[:40]) for number, _, values, name in found]
