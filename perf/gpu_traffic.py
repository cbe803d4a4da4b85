"""What a launch of a kernel moves on a GPU, counted from the addresses that a sample of its threads access.

Memory moves in sectors of 32 bytes. `touched` are the distinct sectors of each instruction of a warp, `needed` the
sectors that its distinct bytes would fill if each contiguous run of them began one. The time of a kernel is the longest
of five: the distinct sectors of each thread block through the second cache (the first cache holds what a block
reads twice, if it is not too much); the distinct bytes of the launch through the GPU's memory (the second cache holds
the rest); all touched sectors through the first cache; shuffles and shared memory, one instruction per clock and
multiprocessor; the accesses of a single warp, which waits for each: few warps with much to do take long. Launches take
`LAUNCH_S`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

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
    atomics: float
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


def count_sectors(
    kernel: str, events: np.ndarray, exchanges: int, scale: float, memory: float, warps: int, warps_of_block: int
) -> Traffic:
    """Count the sectors of a sample of thread blocks.

    Parameters
    ----------
    kernel : str
        Name of the kernel.
    events : ndarray, shape (access, 2), uint64
        Accesses, see ``Trace`` in ``lanes.h``.
    exchanges : int
        Instructions through shared memory or from lane to lane.
    scale : float
        Thread blocks of the launch per one of the sample.
    memory : float
        Bytes of the whole launch through the GPU's memory.
    warps, warps_of_block : int
        Warps of the launch and of a thread block.
    """
    size = (events[:, 1] >> np.uint64(2) & np.uint64(63)).astype(np.int64)
    events, size = events[size > 0], size[size > 0]
    address = (events[:, 1] >> np.uint64(8)).astype(np.int64)
    address -= address.min(initial=1 << 60) // SECTOR * SECTOR
    _, instruction = np.unique(events[:, 0] >> np.uint64(8), return_inverse=True)
    block = (events[:, 0] >> np.uint64(40)).astype(np.int64) // warps_of_block
    kind = events[:, 1] & np.uint64(3)
    _, sector = np.unique(address // SECTOR, return_inverse=True)
    apart = np.int64(sector.max(initial=0) + 1)
    moved = np.unique(instruction * apart + sector)
    block_of = np.zeros(int(instruction.max(initial=0)) + 1, np.int64)
    block_of[instruction] = block
    of_blocks = np.bincount(block_of[moved // apart]) if len(moved) else np.zeros(1, np.int64)
    distinct = np.bincount(np.unique(block * apart + sector) // apart, minlength=len(of_blocks))
    by_block = int(np.where(distinct > BLOCK_SECTORS, of_blocks, distinct).sum())
    needed, packed, _ = _runs(instruction, address, size)
    *_, used = _runs(block, address, size)
    counts = (scale * count for count in (len(moved), needed, packed, by_block, used))
    waits = scale * (int(instruction.max(initial=-1)) + 1) / warps
    return Traffic(kernel, *counts, memory, scale * int((kind == 2).sum()), scale * exchanges, waits)


def total(name: str, parts: Sequence[Traffic]) -> Traffic:
    """Return the traffic of several launches."""
    names = [field.name for field in fields(Traffic)][1:]
    return Traffic(name, *(sum(getattr(part, field) for part in parts) for field in names))
