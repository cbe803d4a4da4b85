"""Memory and launches of the correlation's kernels."""

import math
import threading

import numpy as np
import warp as wp

from . import runtime

_KEPT_BYTES = 1 << 28
"""Most memory that a thread keeps for its next call."""
_LINE = 16
"""Floats of a cache line."""


class _Arena(threading.local):
    """Memory of CPU calls, kept between them: fresh pages cost as much as a quarter of the work done in them."""

    def __init__(self):
        self.room, self.taken = np.empty(0, np.float32), 0

    def reset(self) -> None:
        """Make all of it free again, as much as the last call would have liked to have."""
        wanted = min(self.taken, _KEPT_BYTES // 4)
        if wanted > self.room.size:
            self.room = np.empty(wanted, np.float32)
        self.taken = 0

    def take(self, size: int) -> np.ndarray:
        """Uninitialised floats that start a cache line."""
        size = -(-size // _LINE) * _LINE + _LINE
        begin, self.taken = self.taken, self.taken + size
        part = self.room[begin : self.taken] if self.taken <= self.room.size else np.empty(size, np.float32)
        return part[-part.ctypes.data // 4 % _LINE :]


_arena = _Arena()


def free_memory() -> None:
    """Make the memory of all arrays that `new_array` made for this thread free again."""
    _arena.reset()


def new_array(shape: tuple[int, ...]) -> wp.array:
    """Uninitialised float array on the running device, on the CPU valid until `free_memory`."""
    where = runtime.device()
    if where.kind == "cpu":
        size = math.prod(shape)
        return wp.array(_arena.take(size)[:size].reshape(shape), dtype=float, device=where.warp, copy=False)
    return wp.empty(shape, dtype=float, device=where.warp)


def to_device(values: np.ndarray, dtype: type = float) -> wp.array:
    """Array on the running device; on the CPU a view that keeps its owner."""
    where = runtime.device()
    return wp.array(values, dtype=dtype, device=where.warp, copy=where.kind != "cpu")


def launch(kernel, size, inner, inputs, outputs, *, slots=False, after_slot=()) -> None:
    """Launch over (size, *inner), threaded on the CPU; the kernel's last input is the first index of its part.

    With `slots` the input before says which scratch memory is the part's own; -1 on CUDA.
    """
    where = runtime.device()
    wp.load_module(kernel.module, device=where.warp)  # before threads start: compilation is not thread-safe

    def part(chunk: int, begin: int, end: int) -> None:
        own = [chunk if where.kind == "cpu" else -1] if slots else []
        arguments = [*inputs, *own, *after_slot, begin]
        wp.launch(kernel, dim=(end - begin, *inner), inputs=arguments, outputs=outputs, device=where.warp)

    runtime.run_chunks(size, part, chunks=min(runtime.CHUNKS, 2 * where.threads))  # a launch costs 0.1 ms of Python
