"""Structure of stored HDF5 and NetCDF4 files: nothing may lie outside the file, and no array may exceed its bytes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from lfpiv.errors import DamagedFile

if TYPE_CHECKING:
    import h5py

LARGEST_RATIO = 1032
"""Largest ratio of deflate: a stored byte makes at most so many."""

LARGEST_COUNT = 10_000
"""Largest number of objects in a file, and of attributes of an object."""

_DIMENSION = b"This is a netCDF dimension but not a netCDF variable"  # such a dataset has a length and no values


def check_structure(file: h5py.File, size: int) -> None:
    """Refuse what a result never holds: links that leave the file or go in circles, and arrays larger than their bytes.

    Parameters
    ----------
    size : int
        Size of the file [byte].

    Raises
    ------
    DamagedFile
        The message names the object.
    """
    import h5py

    seen: set[int] = set()
    waiting: list[tuple[str, Any]] = [("/", h5py.h5g.open(file.id, b"/"))]
    while waiting:
        name, item = waiting.pop()
        address = int(h5py.h5o.get_info(item).addr)
        if address in seen:
            raise DamagedFile(file.filename, f"{name} is linked twice")
        seen.add(address)
        if len(seen) > LARGEST_COUNT:
            raise DamagedFile(file.filename, f"it has more than {LARGEST_COUNT} objects")
        reason = _wrong_attributes(item, size)
        if not reason and isinstance(item, h5py.h5d.DatasetID):
            reason = _wrong_dataset(item)
        if reason:
            raise DamagedFile(file.filename, f"{name}: {reason}")
        if isinstance(item, h5py.h5g.GroupID):
            waiting += _members(file.filename, name, item)


def _members(path: str, name: str, group: Any) -> list[tuple[str, Any]]:
    """Return names and identifiers of what a group holds."""
    import h5py

    count = group.get_num_objs()
    if count > LARGEST_COUNT:
        raise DamagedFile(path, f"{name} holds more than {LARGEST_COUNT} objects")
    found = []
    for member in list(group):
        full = f"{name.rstrip('/')}/{member.decode('utf-8', 'replace')}"
        if group.links.get_info(member).type != h5py.h5l.TYPE_HARD:
            raise DamagedFile(path, f"{full} is a link to another place")
        item = h5py.h5o.open(group, member)
        if not isinstance(item, (h5py.h5g.GroupID, h5py.h5d.DatasetID)):
            raise DamagedFile(path, f"{full} is neither a group nor an array")
        found.append((full, item))
    return found


def _wrong_attributes(item: Any, size: int) -> str:
    """Return what is wrong with the attributes of an object; empty if nothing is."""
    import h5py

    count = h5py.h5a.get_num_attrs(item)
    if count > LARGEST_COUNT:
        return f"{count} attributes"
    for number in range(count):
        attribute = h5py.h5a.open(item, index=number)
        if math.prod(attribute.shape or ()) * attribute.get_type().get_size() > size:
            return f"attribute {attribute.name.decode('utf-8', 'replace')!r} is larger than the file"
    return ""


def _wrong_dataset(dataset: Any) -> str:
    """Return what is wrong with the storage of an array; empty if nothing is."""
    import h5py

    created, shape = dataset.get_create_plist(), dataset.shape
    if dataset.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        return ""
    layout = created.get_layout()
    if created.get_external_count() or layout not in (h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED):
        return "its values lie in other files"
    filters = {created.get_filter(number)[0] for number in range(created.get_nfilters())}
    if filters - {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}:
        return "it is packed by an unknown filter"
    declared, stored = math.prod(shape) * dataset.get_type().get_size(), dataset.get_storage_size()
    if stored == 0 and declared and _is_dimension(dataset):
        return ""
    if layout == h5py.h5d.CHUNKED and declared:
        chunks = created.get_chunk()
        expected = math.prod(-(-length // chunk) for length, chunk in zip(shape, chunks, strict=True))
        grows = [most == h5py.h5s.UNLIMITED for most in dataset.get_space().get_simple_extent_dims(True)]
        if any(chunk > length and not free for length, chunk, free in zip(shape, chunks, grows, strict=True)):
            return f"chunks of {chunks} exceed its shape {shape}"
        if (found := dataset.get_num_chunks()) != expected:
            return f"only {found} of {expected} chunks are stored"
    ratio = LARGEST_RATIO if h5py.h5z.FILTER_DEFLATE in filters else 1
    if declared > ratio * stored:
        return f"{declared} bytes are declared, {stored} are stored"
    return ""


def _is_dimension(dataset: Any) -> bool:
    """Return whether a dataset only states the length of a dimension, as NetCDF stores one without coordinate."""
    import h5py

    if not h5py.h5a.exists(dataset, b"NAME"):
        return False
    value = h5py.Dataset(dataset).attrs["NAME"]
    return bytes(value if isinstance(value, bytes) else str(value).encode()).startswith(_DIMENSION)
