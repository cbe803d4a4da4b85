"""Arrays between the host and the running device, and a count of what was moved.

On the CPU both are the same memory and nothing is moved. Where the loops for a GPU are emulated on the CPU, arrays are
copied as a GPU would need it: an array that is not brought back shows as a wrong result.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
import warp as wp

from lfpiv_kernels import runtime

log = logging.getLogger(__name__)

MOST_ELEMENTS = 2**31 - 1
"""Largest number of elements of an array of Warp."""

if TYPE_CHECKING:
    DeviceArray: TypeAlias = wp.array[Any, Any]
else:
    DeviceArray = wp.array
"""An array on the device."""
Values = np.ndarray | DeviceArray
"""An array of the host, or one on the device."""
Given = TypeVar("Given", bound=Values)
"""The kind of array that a function was given, and returns."""


@dataclass
class Transfers:
    """Sizes of the arrays that were moved, in their order [byte]."""

    to_device: list[int] = field(default_factory=list)
    to_host: list[int] = field(default_factory=list)


_counts: list[Transfers] = []


@contextmanager
def count_transfers() -> Iterator[Transfers]:
    """Count the arrays that are moved while the context is open, by any thread."""
    counted = Transfers()
    _counts.append(counted)
    try:
        yield counted
    finally:
        _counts.remove(counted)


def to_device(values: Values, dtype: type | None = None, device: str | None = None) -> wp.array:
    """Return an array on a device, by default the running one; on the CPU a view of the same memory.

    An array that is on a device already is returned as it is. With `device` "cpu" nothing is moved: work of the host.
    """
    if isinstance(values, wp.array):
        return values
    moved = device is None and runtime.device().form == "gpu"
    if moved:
        for counted in _counts:
            counted.to_device.append(values.nbytes)
    kind = {} if dtype is None else {"dtype": dtype}
    return wp.array(values, device=device or runtime.device().warp, copy=moved, **kind)


def bytes_on_device(values: np.ndarray, device: str | None = None) -> wp.array:
    """Return bytes, shape (byte,), as an array on a device, as `to_device` does, but any number of them.

    Warp knows of the first `MOST_ELEMENTS`. Kernels that take the array's address find the others behind these.
    """
    if values.size <= MOST_ELEMENTS:
        return to_device(values, device=device)
    whole = values[: values.size // 8 * 8].view(np.uint64)
    held: tuple[wp.array, ...] = (to_device(whole, device=device),)
    if device is None and runtime.device().form == "gpu":  # the last bytes fill no word
        last = np.zeros(8, np.uint8)
        last[: values.size % 8] = values[whole.nbytes :]
        words = wp.empty(whole.size + 1, dtype=wp.uint64, device=runtime.device().warp)
        wp.copy(words, held[0])
        wp.copy(words, to_device(last.view(np.uint64)), dest_offset=whole.size)
        held = (words,)
    first = wp.array(ptr=held[0].ptr, dtype=wp.uint8, shape=(MOST_ELEMENTS,), device=held[0].device)
    first.held = (*held, values)  # the memory of both must outlive it
    return first


def overwrite(given: Values, found: wp.array) -> None:
    """Bring what was made of ``to_device(given)`` back into `given`; nothing is to be done for a device's array."""
    if not isinstance(given, wp.array) and runtime.device().form == "gpu":
        given[:] = to_host(found)


def empty(size: int, dtype: type = wp.float32) -> wp.array:
    """Return an array on the running device whose numbers are not set; on the CPU it is memory of NumPy."""
    if runtime.device().form == "gpu":
        return wp.empty(size, dtype=dtype, device=runtime.device().warp)
    return wp.array(np.empty(size, wp.dtype_to_numpy(dtype)), dtype=dtype, device="cpu", copy=False)


def zeros(size: int, dtype: type = wp.float32) -> wp.array:
    """Return an array of zeros on the running device; on the CPU it is memory of NumPy."""
    if runtime.device().form == "gpu":
        return wp.zeros(size, dtype=dtype, device=runtime.device().warp)
    return wp.array(np.zeros(size, wp.dtype_to_numpy(dtype)), dtype=dtype, device="cpu", copy=False)


def clear(array: wp.array) -> None:
    """Set all numbers of a device's array to zero."""
    array.zero_()


def duplicate(array: wp.array) -> wp.array:
    """Return a copy on the same device; on the CPU it is memory of NumPy."""
    if runtime.device().form == "gpu":
        return wp.clone(array)
    return to_device(to_host(array).copy(), array.dtype)


def block(values: Given, part: tuple[slice, ...]) -> Given:
    """Return a contiguous copy of a part of an array, on the same device."""
    cut = values[part]
    return cut.contiguous() if isinstance(cut, wp.array) else np.ascontiguousarray(cut)


def to_host(array: Values) -> np.ndarray:
    """Return a device's array as one of NumPy, after all launches; on the CPU a view of the same memory.

    An array that is on the host already is returned as it is.
    """
    if isinstance(array, np.ndarray):
        return array
    values: np.ndarray = array.numpy()
    if runtime.device().form != "gpu":
        return values
    for counted in _counts:
        counted.to_host.append(values.nbytes)
    return values.copy() if runtime.device().kind == "cpu" else values


def as_given(result: Values, *given: Values) -> Values:
    """Return a result where its sources are: on the device if one of them is there, else on the host."""
    if any(isinstance(one, wp.array) for one in given):
        return to_device(result)
    return to_host(result)
