"""What kernels move on a GPU, counted from the addresses that a sample of their threads access, and the time they take.

Memory moves in sectors of 32 bytes. `touched` are the distinct sectors of each instruction of a warp, `needed` the
sectors that its distinct bytes would fill if each contiguous run of them began one. The time of a kernel is the longest
of five:

- the distinct sectors of each thread block through the second cache: the first cache holds what a block reads twice,
  if it is not too much;
- the same of each array, at most the whole array, through the GPU's memory: the second cache holds the rest;
- all touched sectors through the first cache;
- shuffles and shared memory, one instruction per clock and multiprocessor;
- the accesses of a single warp, which waits for each: few warps with much to do take long.

Launches take `LAUNCH_S`.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from gpu_trace import PLACE_BITS, Accesses, Tracer

from lfpiv_kernels.reconstruction.projector_gpu import SECTOR

MEMORY_BYTES_S, L2_BYTES_S = 3.35e12, 5.5e12
"""Bandwidths of an H100's memory and second cache."""
MULTIPROCESSORS, CLOCK_HZ, L1_BYTES_CLOCK = 132, 1.6e9, 128
"""Of an H100: a clock that it keeps under load, and bytes from the first cache per clock and multiprocessor."""
BLOCK_SECTORS = 1024
"""Sectors of the first cache that a thread block has: 256 KiB for eight blocks of 256 threads."""
LATENCY_CLOCKS, IN_FLIGHT = 300, 4
"""Clocks until the second cache answers, and accesses of a warp that wait for it at once."""
LAUNCH_S = 3e-6
"""Time of a launch that does nothing."""


@dataclass(frozen=True)
class Traffic:
    """What one launch moves."""

    kernel: str
    touched: float
    """Sectors, the distinct ones of each instruction of a warp."""
    needed: float
    """Sectors that the distinct bytes of each instruction fill, each contiguous run of them from the first."""
    packed: float
    """Sectors that as many bytes would fill side by side, of each instruction."""
    by_block: float
    """Distinct sectors of each thread block; those of each instruction if a block has more than `BLOCK_SECTORS`."""
    used: float
    """Distinct bytes of each thread block, in sectors."""
    memory: float
    """Bytes through the GPU's memory."""
    exchanges: float
    """Instructions that go through shared memory or from lane to lane."""
    waits: float
    """Accesses that a warp makes one after the other."""
    launches: int = 1

    @property
    def ratio(self) -> float:
        """Sectors touched per sector needed."""
        return self.touched / max(self.needed, 1.0)

    @property
    def strict(self) -> float:
        """Sectors touched per sector that the same bytes would fill side by side."""
        return self.touched / max(self.packed, 1.0)

    @property
    def filled(self) -> float:
        """Distinct sectors of thread blocks per sector that their distinct bytes would fill."""
        return self.by_block / max(self.used, 1.0)

    @property
    def limits_s(self) -> dict[str, float]:
        """Time [s] at each of the five limits."""
        clocks = MULTIPROCESSORS * CLOCK_HZ
        return {
            "memory": self.memory / MEMORY_BYTES_S,
            "second cache": SECTOR * self.by_block / L2_BYTES_S,
            "first cache": SECTOR * self.touched / (clocks * L1_BYTES_CLOCK),
            "shared memory": self.exchanges / clocks,
            "waiting": self.waits * LATENCY_CLOCKS / IN_FLIGHT / CLOCK_HZ,
        }

    @property
    def seconds(self) -> float:
        """Predicted time [s]."""
        return max(self.limits_s.values()) + self.launches * LAUNCH_S


def _runs(groups: np.ndarray, address: np.ndarray, size: np.ndarray) -> tuple[int, int, int]:
    """Return the sectors that the distinct bytes of each group fill.

    They are counted by contiguous runs, each rounded up; side by side, each group rounded up; and not rounded.
    """
    if not len(address):
        return 0, 0, 0
    order = np.lexsort((address, groups))
    groups, address, size = groups[order], address[order], size[order]
    new = np.append(True, (groups[1:] != groups[:-1]) | (address[1:] != address[:-1]))
    groups, address, size = groups[new], address[new], size[new]  # aligned, so two accesses are one or apart
    first = np.append(True, groups[1:] != groups[:-1])
    begins = first | np.append(True, address[1:] != (address + size)[:-1])
    runs, whole = (np.add.reduceat(size, np.flatnonzero(of)) for of in (begins, first))
    return int((-(-runs // SECTOR)).sum()), int((-(-whole // SECTOR)).sum()), int(whole.sum() / SECTOR)


def count_sectors(kernel: str, found: Accesses) -> Traffic:
    """Count what a launch of a kernel moves from the accesses of a sample of its thread blocks."""
    events, size = found.events, (found.events[:, 1] >> np.uint64(2) & np.uint64(63)).astype(np.int64)
    address = (events[:, 1] >> np.uint64(8)).astype(np.int64)
    _, instruction = np.unique(events[:, 0] >> np.uint64(8), return_inverse=True)
    block = (events[:, 0] >> np.uint64(40)).astype(np.int64) // found.warps_of_block
    numbers, sector = np.unique(address // SECTOR, return_inverse=True)
    apart = np.int64(len(numbers) + 1)
    moved = np.unique(instruction * apart + sector)
    block_of = np.zeros(int(instruction.max(initial=0)) + 1, np.int64)
    block_of[instruction] = block
    of_blocks = np.bincount(block_of[moved // apart]) if len(moved) else np.zeros(1, np.int64)
    distinct = np.unique(block * apart + sector)
    array = (numbers * SECTOR >> PLACE_BITS)[distinct % apart] - 1
    of_arrays = SECTOR * found.scale * np.bincount(array, minlength=len(found.nbytes))
    distinct = np.bincount(distinct // apart, minlength=len(of_blocks))
    by_block = int(np.where(distinct > BLOCK_SECTORS, of_blocks, distinct).sum())
    needed, packed, _ = _runs(instruction, address, size)
    *_, used = _runs(block, address, size)
    counts = (found.scale * count for count in (len(moved), needed, packed, by_block, used))
    waits = found.scale * (int(instruction.max(initial=-1)) + 1) / found.warps
    memory = float(np.minimum(of_arrays, found.nbytes).sum())
    return Traffic(kernel, *counts, memory, found.scale * found.exchanges, waits)


def total(name: str, parts: Sequence[Traffic]) -> Traffic:
    """Return the traffic of several launches."""
    names = [field.name for field in fields(Traffic)][1:]
    return Traffic(name, *(sum(getattr(part, field) for part in parts) for field in names))


@dataclass(frozen=True)
class Work:
    """Traffic of some work."""

    launches: list[Traffic]
    host_s: float
    """Processor time between the launches [s]."""

    @property
    def seconds(self) -> float:
        """Predicted time of the launches [s]."""
        return sum(one.seconds for one in self.launches)

    def by_kernel(self) -> list[tuple[Traffic, float]]:
        """Return the traffic and the time [s] of each kernel, slowest first."""
        names = dict.fromkeys(one.kernel for one in self.launches)
        groups = [[one for one in self.launches if one.kernel == name] for name in names]
        rows = [(total(of[0].kernel, of), sum(one.seconds for one in of)) for of in groups]
        return sorted(rows, key=lambda row: -row[1])

    def table(self) -> list[str]:
        """Return a row per kernel, for people."""
        rows = [f"{'kernel':36s} launches  touched /needed /packed by block /filled       ms  limit"]
        for one, seconds in self.by_kernel():
            limit = max(one.limits_s, key=lambda name: one.limits_s[name])
            rows.append(
                f"{one.kernel:36s} {one.launches:8d} {one.touched / 1e6:8.2f}M {one.ratio:6.2f} {one.strict:7.2f} "
                f"{one.by_block / 1e6:7.2f}M {one.filled:7.2f} {1e3 * seconds:8.3f}  {limit}"
            )
        return rows

    def rows(self) -> list[dict[str, object]]:
        """Return a row per kernel, for a file."""
        return [dataclasses.asdict(one) | {"seconds": seconds} for one, seconds in self.by_kernel()]


def trace(run: Callable[[], object], tracer: Tracer[Traffic]) -> Work:
    """Run some work twice, and return the traffic of the second time.

    Raises
    ------
    RuntimeError
        If the accesses of a launch could not be noted.
    """
    with tracer.running():
        run()  # finds out how much of a launch can be noted
        tracer.launches.clear()
        start, tracer.kernel_s = time.process_time(), 0.0
        run()
        host = time.process_time() - start - tracer.kernel_s
    launches = [one for one in tracer.launches if one is not None]
    if len(launches) < len(tracer.launches):
        raise RuntimeError("a launch has more accesses than can be noted.")
    return Work(launches, host)
