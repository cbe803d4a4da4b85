"""Launches of Warp kernels: each cut into parts that run side by side on the CPU's threads, whole on CUDA."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from lfpiv_kernels import caches, runtime

_loaded: set[tuple[str, str]] = set()
"""Modules and devices that `load` has met in this process."""
_ready: set[tuple[wp.Kernel, str]] = set()
"""Kernels and devices whose module is loaded. Warp takes as long to find that out as to launch a kernel."""
_loading = threading.RLock()  # Warp compiles in one thread at a time


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
    inner: tuple[int, ...] = ()
    """Further axes of the threads. Only the first axis, `size`, is cut into parts."""


def launch(*calls: Call, parts: int | None = None, device: str | None = None) -> None:
    """Launch kernels that do not depend on each other, and wait until all are done.

    Parameters
    ----------
    *calls : Call
        The kernels. On the CPU their parts must write disjoint memory.
    parts : int, optional
        Parts into which each call is cut on the CPU. Default: enough for all threads.
    device : str, optional
        Warp's name of the device. Default: the running device.
    """
    where = runtime.device()
    device = device or where.warp
    for call in calls:
        load(call.kernel, device)  # before threads start: compilation is not thread-safe
    if not runtime.on_threads(device):
        for call in calls:
            if call.size:
                inputs = [*call.inputs, -1, 0] if call.scratch else [*call.inputs, 0]
                wp.launch(call.kernel, dim=(call.size, *call.inner), inputs=inputs, outputs=call.outputs, device=device)
        return
    if parts is None:
        parts = min(runtime.CHUNKS // len(calls), 2 * where.threads)  # each launch costs Python time
    free = list(range(runtime.CHUNKS))  # a stack: memory used last is still in the caches

    def run(_: int, begin: int, end: int) -> None:
        for index in range(begin, end):
            call, part = calls[index // parts], index % parts
            first, last = (call.size * k // parts for k in (part, part + 1))
            if first == last:
                continue
            inputs = [*call.inputs, first]
            if call.scratch:
                slot = free.pop()
                inputs = [*call.inputs, slot, first]
            dim = (last - first, *call.inner)
            wp.launch(call.kernel, dim=dim, inputs=inputs, outputs=call.outputs, device=device)
            if call.scratch:
                free.append(slot)

    runtime.run_chunks(len(calls) * parts, run, chunks=len(calls) * parts, warp_device=device)


def parts_of(size: int, fewest: int) -> int:
    """Return the parts of a launch on the CPU, each with at least `fewest` threads; one if it runs on one core."""
    cores = runtime.device().threads
    return 1 if cores == 1 else min(runtime.CHUNKS, 2 * cores, 1 + size // fewest)


def load(kernel: wp.Kernel, device: str) -> None:
    """Load the module of a kernel on a device. Log that kernels are compiled if the module is not in the cache."""
    if (kernel, device) in _ready:
        return
    module = kernel.module
    with _loading:
        if (module.name, device) not in _loaded:
            _loaded.add((module.name, device))
            folder = Path(wp.config.kernel_cache_dir)
            if not (folder / module.get_module_identifier(1 if device == "cpu" else None)).is_dir():
                caches.log_compilation(folder)
        wp.load_module(module, device=device)
        _ready.add((kernel, device))


def over_voxels(kernel: wp.Kernel, inputs: list[object], *outputs: wp.array) -> None:
    """Launch a kernel with a thread per voxel of its outputs."""
    depth, *plane = outputs[0].shape
    launch(Call(kernel, depth, inputs, outputs, inner=tuple(plane)))
