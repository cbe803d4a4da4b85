"""Memory of the correlation's kernels, and their launches on the threads of the CPU or on the GPU."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime

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


def to_device(values: np.ndarray, dtype: type = float) -> wp.array:
    """Return an array on the running device; on the CPU a view."""
    where = runtime.device()
    return wp.array(values, dtype=dtype, device=where.warp, copy=where.kind != "cpu")


@dataclass(frozen=True)
class Call:
    """A kernel to launch over `size` threads.

    A launch covers a part of the threads. The kernel's last inputs, which `launch` adds, are the number of the scratch
    memory that the launch may use (-1 on CUDA, where each thread has its own) if `scratch`, and its first thread.
    """

    kernel: wp.Kernel
    size: int
    inputs: Sequence[object]
    outputs: Sequence[object]
    scratch: bool = False


def launch(*calls: Call) -> None:
    """Launch kernels that do not depend on each other, on threads on the CPU, and wait until all are done."""
    where = runtime.device()
    for call in calls:
        wp.load_module(call.kernel.module, device=where.warp)  # before threads start: compilation is not thread-safe
    on_cpu = where.kind == "cpu"
    chunks = min(runtime.CHUNKS // len(calls), 2 * where.threads) if on_cpu else 1  # each launch costs Python time
    free = list(range(runtime.CHUNKS)) if on_cpu else [-1]  # a stack: memory used last is still in the caches

    def run(_: int, begin: int, end: int) -> None:
        for index in range(begin, end):
            call, chunk = calls[index // chunks], index % chunks
            first, last = (call.size * k // chunks for k in (chunk, chunk + 1))
            if first == last:
                continue
            slot = free.pop()
            inputs = [*call.inputs, slot, first] if call.scratch else [*call.inputs, first]
            wp.launch(call.kernel, dim=last - first, inputs=inputs, outputs=call.outputs, device=where.warp)
            free.append(slot)

    runtime.run_chunks(len(calls) * chunks, run, chunks=len(calls) * chunks)
