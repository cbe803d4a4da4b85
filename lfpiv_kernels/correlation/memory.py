"""Memory of the correlation's kernels: on the CPU each thread reuses its own."""

import threading

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.transfer import Values, to_device

_ARENA_BYTES = 1 << 28
"""Largest memory that a thread retains for its next call."""
_LINE = 16
"""Floats of a cache line."""


class _Arena(threading.local):
    """CPU memory of the calling thread, reused by its next call: writing to new pages is slow."""

    def __init__(self):
        self.memory, self.taken = np.empty(0, np.float32), 0

    def reset(self) -> None:
        """Free all arrays, and grow the memory to the size that the last call needed."""
        wanted = min(self.taken, _ARENA_BYTES // 4)
        if wanted > self.memory.size:
            self.memory = np.empty(wanted, np.float32)
        self.taken = 0

    def take(self, size: int) -> np.ndarray:
        """Return uninitialised floats that start a cache line."""
        padded = -(-size // _LINE) * _LINE + _LINE
        begin, self.taken = self.taken, self.taken + padded
        part = self.memory[begin : self.taken] if self.taken <= self.memory.size else np.empty(padded, np.float32)
        skipped = -part.ctypes.data // 4 % _LINE
        return part[skipped : skipped + size]


_arena = _Arena()


def free_memory() -> None:
    """Free all arrays that `new_array` made in this thread."""
    _arena.reset()


def new_array(size: int) -> wp.array:
    """Return uninitialised floats on the running device; on the CPU they are valid until `free_memory`."""
    where = runtime.device()
    if where.kind == "cpu":
        return wp.array(_arena.take(size), dtype=float, device=where.warp, copy=False)
    return wp.empty(size, dtype=float, device=where.warp)


def on_device(volume: Values) -> wp.array:
    """Return a volume as floats on the running device, gap-free; nothing is moved if it is there."""
    if isinstance(volume, wp.array):
        return volume
    return to_device(np.ascontiguousarray(volume, np.float32), float)


def empty_volume(shape: tuple[int, ...], dtype: type = float) -> wp.array:
    """Return an uninitialised volume on the running device, which lives as long as it is used."""
    return wp.empty(shape, dtype=dtype, device=runtime.device().warp)
