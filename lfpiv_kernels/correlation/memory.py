"""Memory and launches of the correlation's kernels."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime

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


def new_array(size: int) -> wp.array:
    """Uninitialised floats on the running device, on the CPU valid until `free_memory`."""
    where = runtime.device()
    if where.kind == "cpu":
        return wp.array(_arena.take(size)[:size], dtype=float, device=where.warp, copy=False)
    return wp.empty(size, dtype=float, device=where.warp)


def to_device(values: np.ndarray, dtype: type = float) -> wp.array:
    """Array on the running device; on the CPU a view that keeps its owner."""
    where = runtime.device()
    return wp.array(values, dtype=dtype, device=where.warp, copy=where.kind != "cpu")


@dataclass(frozen=True)
class Call:
    """A kernel to launch over `size` threads; its last input is the first index of the part it is launched for."""

    kernel: wp.Kernel
    size: int
    inputs: Sequence[object]
    outputs: Sequence[object]
    after_slot: Sequence[object] | None = None
    """Inputs behind the number of the scratch memory that is the part's own, -1 on CUDA; None: the kernel has none."""


def launch(*calls: Call) -> None:
    """Launch kernels that do not depend on each other, threaded on the CPU; returns when all are done."""
    where = runtime.device()
    for call in calls:
        wp.load_module(call.kernel.module, device=where.warp)  # before threads start: compilation is not thread-safe
    on_cpu = where.kind == "cpu"
    chunks = min(runtime.CHUNKS // len(calls), 2 * where.threads) if on_cpu else 1  # a launch costs 0.1 ms of Python
    free = list(range(runtime.CHUNKS))  # memory that was used last is the first to be used again: it is in the caches

    def part(_: int, begin: int, end: int) -> None:
        for index in range(begin, end):
            call, chunk = calls[index // chunks], index % chunks
            first, last = (call.size * k // chunks for k in (chunk, chunk + 1))
            if first == last:
                continue
            slot = free.pop() if on_cpu else -1
            own = [] if call.after_slot is None else [slot, *call.after_slot]
            inputs = [*call.inputs, *own, first]
            wp.launch(call.kernel, dim=last - first, inputs=inputs, outputs=call.outputs, device=where.warp)
            free.append(slot)

    runtime.run_chunks(len(calls) * chunks, part, chunks=len(calls) * chunks)
