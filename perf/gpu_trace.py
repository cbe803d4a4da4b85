"""Run Warp kernels written for a GPU on the processor, and note which of their arrays' memory they read and write.

`Tracer` compiles kernel modules so that the compiler calls a function before each load and store (``traced.h``), and
takes the place of ``wp.launch``: host code runs as on a GPU, and a sample of the blocks of threads is noted. Loads that
the compiler saves by keeping values in registers are not noted, as on a GPU. Accesses of a warp are one instruction if
they come from the same place of the code, each lane's for the same time.
"""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.lanes import LANES

Counted = TypeVar("Counted")
FOLDER = Path(__file__).resolve().parent
FLAGS = (
    "-fno-vectorize", "-fno-slp-vectorize", "-fno-unroll-loops", "-fsanitize-coverage-type=1",
    "-fsanitize-coverage-trace-loads", "-fsanitize-coverage-trace-stores",
)  # fmt: skip
"""Options of the compiler: an access at a time, all threads by the same instructions, and a call before each access."""
THREADS_OF_BLOCK = 256
"""Warp's default."""
BLOCKS = 32
"""Blocks of threads that are noted of a launch, about."""
EVENTS = 1 << 23
"""Accesses of a launch that are noted at most."""
GOLDEN, MOST = np.uint64(2654435769), (1 << 32) - 1
"""By which blocks of threads are chosen, see ``is_noted`` of ``traced.h``."""
PLACE_BITS = 40
"""Array k of a launch lies at (k + 1) 2^`PLACE_BITS`."""
ALIGNMENT = 256
"""Multiple of bytes at which memory of a GPU begins."""


@dataclasses.dataclass(frozen=True)
class Accesses:
    """What a sample of a launch's threads read and wrote."""

    events: np.ndarray
    """Shape (access, 2), uint64: two words each, see ``traced.h``."""
    exchanges: int
    """Instructions through shared memory or from lane to lane."""
    scale: float
    """Accesses of the launch per one of the sample."""
    warps: int
    """Of the launch."""
    warps_of_block: int
    nbytes: np.ndarray
    """Of each of the launch's arrays, shape (array,), int64."""


# Modules keep the kernels that begin and end notes when they are compiled without ``traced.h`` again.
@wp.func_native("""
#if defined(LFPIV_TRACED_H)
    traced::events = events.data, traced::capacity = events.shape[0] / 2, traced::used = traced::exchanges = 0;
    traced::ranges = (const traced::Range*)ranges.data, traced::range_count = ranges.shape[0] / 3;
    traced::tasks_of_block = tasks_of_block, traced::tasks_of_warp = tasks_of_warp, traced::apart = apart;
    traced::thinned = thinned, traced::whole = whole;
#endif
""")
def _set(
    events: wp.array(dtype=wp.uint64),
    ranges: wp.array(dtype=wp.uint64),
    tasks_of_block: int,
    tasks_of_warp: int,
    apart: int,
    thinned: int,
    whole: bool,
): ...


@wp.func_native("""
#if defined(LFPIV_TRACED_H)
    found_out.data[0] = traced::used, found_out.data[1] = traced::exchanges, traced::noted = false;
#endif
""")
def _get(found_out: wp.array(dtype=wp.int64)): ...


def _begin_notes(
    # in
    events: wp.array(dtype=wp.uint64),
    ranges: wp.array(dtype=wp.uint64),
    tasks_of_block: int,
    tasks_of_warp: int,
    apart: int,
    thinned: int,
    whole: bool,
):
    _set(events, ranges, tasks_of_block, tasks_of_warp, apart, thinned, whole)


def _end_notes(
    # out
    found_out: wp.array(dtype=wp.int64),
):
    _get(found_out)


def _members(values: Sequence[object]) -> Iterator[object]:
    """Yield arguments, and of structures their members."""
    for value in values:
        names = getattr(getattr(value, "_cls", None), "vars", None)
        if names is None:
            yield value
        else:
            yield from _members([getattr(value, name) for name in names])


def _ranges(arrays: Sequence[wp.array]) -> np.ndarray:
    """Return begin, end and place on a GPU of the allocations in which arrays lie, shape (allocation, 3)."""
    found = []
    for array in arrays:
        root = array
        while isinstance(root._ref, wp.array):
            root = root._ref
        for part in (array, root):
            if part.ptr and part.size:
                found.append((root.ptr, part.ptr, part.ptr + part.size * wp.types.type_size_in_bytes(part.dtype)))
    ranges: list[list[int]] = []
    for root, begin, end in sorted(found, key=lambda one: one[1]):
        if ranges and begin < ranges[-1][1]:
            ranges[-1][1] = max(ranges[-1][1], end)
        else:
            ranges.append([begin, end, root])
    places = [(1 + k << PLACE_BITS) + (begin - root) % ALIGNMENT for k, (begin, _, root) in enumerate(ranges)]
    bounds = [(begin, end, place) for (begin, end, _), place in zip(ranges, places, strict=True)]
    return np.array(bounds, np.uint64).reshape(-1, 3)


@contextmanager
def loops_for_a_gpu() -> Iterator[None]:
    """Let host code take the loops for a GPU, on one thread of the processor."""
    before = runtime.device()
    runtime._device = dataclasses.replace(before, form="gpu", threads=1)
    try:
        yield
    finally:
        runtime._device = before


class Tracer(Generic[Counted]):
    """Compile modules so that they note accesses, and launch their kernels.

    Parameters
    ----------
    modules : sequence of str
        Names of kernel modules. Launches of others are not noted.
    count : callable
        Takes a kernel's name and the `Accesses` of a launch, and returns what becomes of them in `launches`. Launches
        with equal shapes and numbers are counted once.
    sampled : sequence of str
        Names of those modules of which only the threads that are noted run. So their results are incomplete.

    A launch that has too many accesses is noted anew, and less of it, when its like comes again. So run all twice.
    """

    def __init__(self, modules: Sequence[str], count: Callable[[str, Accesses], Counted], sampled: Sequence[str] = ()):
        self._count = count
        self.launches: list[Counted | None] = []
        """Of every launch in turn, what `count` returned; None where there was no room for its accesses."""
        self._events = np.empty(2 * EVENTS, np.uint64)
        self._found = np.zeros(2, np.int64)
        self._notes: dict[str, tuple[wp.Kernel, wp.Kernel]] = {}
        self._known: dict[tuple[object, ...], Counted] = {}
        self._of_lanes: set[str] = set()  # modules whose kernels walk the lanes of a warp
        self._samples: dict[tuple[object, ...], tuple[int, int]] = {}
        self._options: dict[str, dict[str, object]] = {}
        self._modules, self._sampled = tuple(modules), frozenset(sampled)
        self._launch = wp.launch
        self.kernel_s = 0.0
        """Processor time of launches and notes [s]."""

    @contextmanager
    def running(self) -> Iterator[None]:
        """Take the place of ``wp.launch``; kernels' loops are those for a GPU meanwhile."""
        for name in self._modules:
            self._prepare(name)
        wp.launch = self._traced
        try:
            with loops_for_a_gpu():
                yield
        finally:
            wp.launch = self._launch
            for name, options in self._options.items():
                wp.set_module_options(options, module=name)

    def _prepare(self, name: str) -> None:
        """Set the options of a module, and give it the kernels that begin and end the notes."""
        importlib.import_module(name)
        module = wp.get_module(name)
        options = self._options[name] = dict(module.options)
        build = options.get("extra_build_options") or wp.ModuleBuildOptions()
        preamble = f'#define LFPIV_EMULATE_GPU\n#include "traced.h"\n{build.extra_cpu_preamble}'
        traced = wp.ModuleBuildOptions(
            extra_cpu_include_dirs=[native.FOLDER, FOLDER],
            extra_cpu_preamble=preamble,
            extra_build_dependencies=[*build.extra_build_dependencies, FOLDER / "traced.h"],
        )
        if str(native.FOLDER / "lanes.h") in map(str, build.extra_build_dependencies):
            self._of_lanes.add(name)
        flags = " ".join([str(options.get("cpu_compiler_flags") or wp.config.cpu_compiler_flags), *FLAGS])
        wp.set_module_options({"extra_build_options": traced, "cpu_compiler_flags": flags}, module=name)
        self._notes[name] = tuple(
            wp.Kernel(func, key=f"{func.__name__}_of_{name.rpartition('.')[2]}", module=module)
            for func in (_begin_notes, _end_notes)
        )

    def _traced(self, kernel: wp.Kernel, dim: object, inputs: Sequence = (), outputs: Sequence = (), **where) -> None:
        """Launch a kernel, and note what a sample of its threads accesses."""
        name = kernel.module.name
        if name not in self._notes:
            self._launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **where)
            return
        start, short = time.process_time(), f"{name.rpartition('.')[2]}.{kernel.key}"
        members = list(_members([*inputs, *outputs]))
        arrays = [one for one in members if isinstance(one, wp.array)]
        scalars = tuple(one for one in members if isinstance(one, (int, float)))
        known = (name, kernel.key, tuple(dim), tuple(array.shape for array in arrays), scalars)
        lanes = LANES if name in self._of_lanes else 1
        tasks = int(np.prod(dim))
        blocks = -(-tasks * lanes // THREADS_OF_BLOCK)
        apart, thinned = self._samples.setdefault(known, (max(1, blocks // BLOCKS), 1))
        noted = 0 if known in self._known else apart
        begin, end = self._notes[name]
        ranges = _ranges(arrays).ravel()
        numbers = THREADS_OF_BLOCK // lanes, LANES // lanes, noted, thinned, name not in self._sampled
        self._launch(begin, dim=1, inputs=[_wrap(self._events), _wrap(ranges), *numbers], device="cpu")
        self._launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **where)
        self._launch(end, dim=1, outputs=[_wrap(self._found)], device="cpu")
        if noted:
            share = 1.1 * int(self._found[0]) / EVENTS
            if share > 1.1:  # full: note less of the next launch of its kind
                fewer = min(share, blocks / apart)
                self._samples[known] = int(np.ceil(fewer * apart)), int(np.ceil(share / fewer)) * thinned
            else:
                nbytes = (ranges[1::3] - ranges[::3]).astype(np.int64)
                self._known[known] = self._count(short, self._accesses(tasks, lanes, nbytes, apart, thinned))
        self.launches.append(self._known.get(known))
        self.kernel_s += time.process_time() - start

    def _accesses(self, tasks: int, lanes: int, nbytes: np.ndarray, apart: int, thinned: int) -> Accesses:
        """Return what was noted."""
        per_block, warps = THREADS_OF_BLOCK // LANES, -(-tasks * lanes // LANES)
        block = np.arange(warps, dtype=np.uint64) // np.uint64(per_block)
        sampled = int((block * GOLDEN & np.uint64(MOST) <= MOST // apart).sum())
        used, exchanges = map(int, self._found)
        events = self._events[: 2 * used].reshape(-1, 2).copy()
        return Accesses(events, exchanges // thinned, thinned * warps / sampled, warps, per_block, nbytes)


def _wrap(array: np.ndarray) -> wp.array:
    """Return an array of the host's memory as Warp's."""
    return wp.array(array, dtype=wp.dtype_from_numpy(array.dtype), device="cpu", copy=False)
