"""Layout of a correlation's windows, blocks and lags, and the choice of the cheapest way to correlate them.

Windows that overlap consist of blocks whose edges divide window and step. The products of a block are summed once, at
every lag, and added up for every window that contains the block: at 50 % overlap this is an eighth of the work. A block
is correlated directly or, on the CPU, by transforms along z and y (see `transforms`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation.transforms import transform_size

Triple = tuple[int, int, int]
"""Values in the order (z, y, x)."""

LANES = native.constant("products.h", "LANES")
"""Neighbouring windows that a CPU task handles at once; rows of windows are padded to a multiple of it."""
GROUP = 32
"""Neighbouring blocks that a CPU task correlates by transforms at once."""

_DIRECT_SECONDS = 2.2e-11
"""Time of a multiply-add of the direct kernel [s]. This and the costs below: per lane on one core with AVX-512."""
_FETCH = 3
"""Time of fetching a voxel for a group of lanes [multiply-add of the direct kernel]."""
_SPECTRAL_SECONDS = 8e-11
"""Time of a multiply-add of the spectral kernel [s]."""
_SUM_SECONDS = 1e-10
"""Time of adding a row of blocks to its windows, per lag [s]."""


@dataclass(frozen=True)
class Plan:
    """Layout of windows, blocks and lags; every triple in the order (z, y, x)."""

    shape: Triple
    """Volume [voxel]."""
    window: Triple
    """Edges of a window [voxel]."""
    step: Triple
    """Distance of windows [voxel]."""
    search: Triple
    """Largest lag [voxel]."""
    origin: Triple
    """First voxel of window (0, 0, 0)."""
    count: Triple
    """Windows per axis."""
    block: Triple
    """Edges of the blocks that windows consist of [voxel]; those of the window if windows share no blocks."""
    spectral: bool = False
    """Whether blocks are correlated by transforms along z and y."""

    @cached_property
    def lags(self) -> Triple:
        """Lags per axis."""
        return tuple(2 * r + 1 for r in self.search)

    @cached_property
    def stride(self) -> Triple:
        """Distance of blocks [voxel]."""
        return self.step if self.block == self.window else self.block

    @cached_property
    def block_count(self) -> Triple:
        """Blocks per window and axis."""
        return tuple(w // b for w, b in zip(self.window, self.block, strict=True))

    @cached_property
    def block_step(self) -> Triple:
        """Distance of windows [block]."""
        return tuple(s // d for s, d in zip(self.step, self.stride, strict=True))

    @cached_property
    def block_grid(self) -> Triple:
        """Blocks per axis that all windows need."""
        return tuple((c - 1) * m + k for c, m, k in zip(self.count, self.block_step, self.block_count, strict=True))

    @cached_property
    def pitch(self) -> int:
        """Lanes from one row of blocks to the next: the blocks, and padding for the farthest lag of the last one."""
        return self.block_grid[2] + (self.block[2] + self.lags[2] - 2) // self.stride[2]

    @cached_property
    def lanes(self) -> int:
        """Lanes of a layer of blocks."""
        return whole_groups(self.block_grid[1] * self.pitch)

    def seconds(self) -> float:
        """Predict the time on one CPU core [s]."""
        lags = math.prod(self.lags)
        block = self._spectral_products() * _SPECTRAL_SECONDS if self.spectral else self._products() * _DIRECT_SECONDS
        sums = self.count[0] * (self.block_count[0] * self.block_count[1] + self.block_count[2]) * lags * self.lanes
        return self.block_grid[0] * self.lanes * block + sums * _SUM_SECONDS

    def _products(self) -> float:
        """Multiply-adds per block of the direct kernel, fetches included."""
        reach = [b + n - 1 for b, n in zip(self.block, self.lags, strict=True)]
        return math.prod(self.block) * math.prod(self.lags) + _FETCH * (math.prod(self.block) + math.prod(reach))

    def _spectral_products(self) -> float:
        """Multiply-adds per block of the spectral kernel, transforms included."""
        nz, ny = (transform_size(b, r) for b, r in zip(self.block[:2], self.search[:2], strict=True))
        block_x, around_x, lags_x = self.block[2], self.stride[2] * (1 + LANES / GROUP), self.lags[2]
        points = (nz / 2 - 1) * (ny + 2) + 2
        along_z = nz * (self.block[0] / 2 + nz / 4) * math.prod(self.stride[1:])
        along_y = nz * (ny / 2 + 1) * 2 * (block_x * self.block[1] / 2 + around_x * ny / 4)
        back = nz * lags_x * (ny / 4 + 1) * self.lags[1] + (nz / 4 + 1) * math.prod(self.lags)
        return along_z + along_y + 3 * points * block_x * lags_x + back


def window_grid(shape: Triple, window: Triple, step: Triple) -> tuple[Triple, Triple]:
    """Place windows inside a volume so that equal margins remain at both ends.

    Parameters
    ----------
    shape, window, step : tuple of int
        Volume, window edges and their distance, order (z, y, x) [voxel].

    Returns
    -------
    origin, count : tuple of int
        First voxel of the first window, and the number of windows, per axis.
    """
    count = tuple((n - w) // s + 1 for n, w, s in zip(shape, window, step, strict=True))
    origin = tuple((n - w - (c - 1) * s) // 2 for n, w, s, c in zip(shape, window, step, count, strict=True))
    return origin, count


def possible_plans(shape: Triple, window: Triple, step: Triple, search: Triple) -> list[Plan]:
    """Return every plan that the running device can follow: whole or shared blocks, on the CPU also by transforms."""
    origin, count = window_grid(shape, window, step)
    whole = Plan(tuple(shape), tuple(window), tuple(step), tuple(search), origin, count, tuple(window))
    shared = replace(whole, block=tuple(math.gcd(w, s) for w, s in zip(window, step, strict=True)))
    direct = [whole, shared]
    if runtime.device().form == "gpu":
        return direct
    return direct + [replace(plan, spectral=True) for plan in direct]


def make_plan(shape: Triple, window: Triple, step: Triple, search: Triple) -> Plan:
    """Return the plan with the least predicted time.

    Raises
    ------
    ValueError
        If a window does not fit into the volume, a step is below 1 or `search` is below 2.
    """
    if any(not 1 <= w <= n for w, n in zip(window, shape, strict=True)) or min(step) < 1:
        raise ValueError(f"window: expected edges within the volume {shape} and steps >= 1, got {window} and {step}.")
    if min(search) < 2:
        raise ValueError(f"search: expected at least 2 voxels per axis, got {search}.")
    return min(possible_plans(shape, window, step, search), key=Plan.seconds)


def whole_groups(lanes: int) -> int:
    """Return the next multiple of `LANES`."""
    return -(-lanes // LANES) * LANES


def largest_factor(edge: int) -> int:
    """Return the largest factor of `edge` that is at most its square root."""
    return max(n for n in range(1, math.isqrt(edge) + 1) if edge % n == 0)
