"""How windows, blocks and lags of a correlation are laid out, and which way to compute it is the cheapest."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import scipy.fft

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation.blocks import LANES
from lfpiv_kernels.correlation.transforms import transform_size

METHODS = ("auto", "direct", "fft")
GROUP = 32
"""Lanes a CPU task of the spectral kernel works on."""

_DIRECT_SECONDS = 2.2e-11
"""Cost of one multiply-add of the direct kernel, all lanes counted (measured, one core, AVX-512)."""
_FETCH = 3
"""Multiply-adds that take as long as fetching a voxel for a group of lanes."""
_SPECTRAL_SECONDS = 8e-11
"""Cost of one multiply-add of the spectral kernel (measured, as above)."""
_SUM_SECONDS = 1e-10
"""Cost of adding one row of blocks to its windows, per lag (measured, as above)."""
_FFT_SECONDS = 1.1e-9
"""Cost of a transform per point and log2(points), three transforms a window, copies included (measured, as above)."""


@dataclass(frozen=True)
class Plan:
    """Where windows, blocks and lags lie; every triple in the order (z, y, x)."""

    shape: tuple[int, int, int]
    window: tuple[int, int, int]
    step: tuple[int, int, int]
    search: tuple[int, int, int]
    origin: tuple[int, int, int]
    """First voxel of window (0, 0, 0)."""
    count: tuple[int, int, int]
    """Windows per axis."""
    block: tuple[int, int, int]
    """Edges of the blocks that windows are made of; the window itself where nothing is shared."""
    spectral: bool = False
    """Whether blocks are correlated by transforms along z and y, see `correlation_transforms`."""

    @cached_property
    def lags(self) -> tuple[int, int, int]:
        """Lags per axis."""
        return tuple(2 * r + 1 for r in self.search)

    @cached_property
    def shared(self) -> bool:
        """Whether windows are sums of smaller blocks."""
        return self.block != self.window

    @cached_property
    def stride(self) -> tuple[int, int, int]:
        """Distance of blocks [voxel]."""
        return self.block if self.shared else self.step

    @cached_property
    def block_count(self) -> tuple[int, int, int]:
        """Blocks per window and axis."""
        return tuple(w // b for w, b in zip(self.window, self.block, strict=True))

    @cached_property
    def block_step(self) -> tuple[int, int, int]:
        """Distance of windows [block]."""
        return tuple(s // d for s, d in zip(self.step, self.stride, strict=True))

    @cached_property
    def block_grid(self) -> tuple[int, int, int]:
        """Blocks per axis that all windows need."""
        return tuple((c - 1) * m + k for c, m, k in zip(self.count, self.block_step, self.block_count, strict=True))

    @cached_property
    def pitch(self) -> int:
        """Lanes from one row of blocks to the next: the blocks, and room for the farthest lag of the last one."""
        return self.block_grid[2] + (self.block[2] + self.lags[2] - 2) // self.stride[2]

    @cached_property
    def lanes(self) -> int:
        """Lanes of a layer of blocks."""
        return whole_groups(self.block_grid[1] * self.pitch)

    def direct_seconds(self) -> float:
        """Predict the time of the direct way on one CPU core."""
        lags, blocks = math.prod(self.lags), self.block_grid[0] * self.lanes
        if self.spectral:
            nz, ny = (transform_size(b, r) for b, r in zip(self.block[:2], self.search[:2], strict=True))
            tap, near, lag = self.block[2], self.stride[2] * (1 + LANES / GROUP), self.lags[2]
            points = (nz / 2 - 1) * (ny + 2) + 2
            planes = nz * (self.block[0] / 2 + nz / 4) * math.prod(self.stride[1:])
            forth = nz * (ny / 2 + 1) * 2 * (tap * self.block[1] / 2 + near * ny / 4)
            back = nz * lag * (ny / 4 + 1) * self.lags[1] + (nz / 4 + 1) * lags
            block = planes + forth + 3 * points * tap * lag + back
        else:
            reach = [b + n - 1 for b, n in zip(self.block, self.lags, strict=True)]
            block = math.prod(self.block) * lags + _FETCH * (math.prod(self.block) + math.prod(reach))
        seconds = block * (_SPECTRAL_SECONDS if self.spectral else _DIRECT_SECONDS)
        sums = self.count[0] * (self.block_count[0] * self.block_count[1] + self.block_count[2]) * lags * self.lanes
        return blocks * seconds + sums * _SUM_SECONDS

    def fft_seconds(self) -> float:
        """Predict the time of the transforms on one CPU core."""
        points = math.prod(self.transform_shape())
        return math.prod(self.count) * points * math.log2(points) * _FFT_SECONDS

    def transform_shape(self) -> tuple[int, int, int]:
        """Zero-padded transform that holds a window and every lag without wrapping around."""
        return tuple(scipy.fft.next_fast_len(w + n - 1, real=True) for w, n in zip(self.window, self.lags, strict=True))


def window_grid(
    shape: tuple[int, int, int], window: tuple[int, int, int], step: tuple[int, int, int]
) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Place windows inside a volume; what remains is shared between both ends.

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


def make_plan(shape, second_shape, window, step, search, method) -> tuple[Plan, str]:
    """Check the arguments of `correlate_windows`; the plan and the method to use."""
    if second_shape != shape or len(shape) != 3:
        raise ValueError(f"second: expected two volumes of equal shape (z, y, x), got {shape} and {second_shape}.")
    if any(not 1 <= w <= n for w, n in zip(window, shape, strict=True)) or min(step) < 1:
        raise ValueError(f"window: expected edges within the volume {shape} and steps >= 1, got {window} and {step}.")
    if min(search) < 2:
        raise ValueError(f"search: expected at least 2 voxels per axis, got {search}.")
    if method not in METHODS:
        raise ValueError(f"method: expected one of {METHODS}, got {method!r}.")
    origin, count = window_grid(shape, window, step)
    whole = Plan(shape, tuple(window), tuple(step), tuple(search), origin, count, tuple(window))
    shared = replace(whole, block=tuple(math.gcd(w, s) for w, s in zip(window, step, strict=True)))
    plans = [whole, shared]
    if runtime.device().kind == "cpu":
        plans += [replace(plan, spectral=True) for plan in plans]
    direct = min(plans, key=Plan.direct_seconds)
    if method == "auto":
        on_gpu = runtime.device().kind == "cuda"
        method = "direct" if on_gpu or direct.direct_seconds() <= whole.fft_seconds() else "fft"
    return (whole if method == "fft" else direct), method


def whole_groups(lanes: int) -> int:
    """Next multiple of `LANES`."""
    return -(-lanes // LANES) * LANES


def largest_factor(edge: int) -> int:
    """Largest factor that is no larger than its counterpart."""
    return max(n for n in range(1, math.isqrt(edge) + 1) if edge % n == 0)
