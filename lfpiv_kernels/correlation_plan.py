"""How windows, blocks and lags of a correlation are laid out, and which way to compute it is the cheapest."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft

from . import runtime
from .correlation_kernels import LANES

METHODS = ("auto", "direct", "fft")

_DIRECT_SECONDS = 2.2e-11
"""Cost of one multiply-add of the direct kernel, all lanes counted (measured, one core, AVX-512)."""
_FETCH = 3
"""Multiply-adds that take as long as fetching a voxel for a group of lanes."""
_PLANE_SECONDS = 8e-10
"""Cost of a voxel of the planes that are combined for fewer products (measured, as above)."""
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
    products: int = 0
    """Products per block along z, see `products_along_z`; 0: one per voxel and lag."""

    @property
    def lags(self) -> tuple[int, int, int]:
        """Lags per axis."""
        return tuple(2 * r + 1 for r in self.search)

    @property
    def shared(self) -> bool:
        """Whether windows are sums of smaller blocks."""
        return self.block != self.window

    @property
    def stride(self) -> tuple[int, int, int]:
        """Distance of blocks [voxel]."""
        return self.block if self.shared else self.step

    @property
    def block_count(self) -> tuple[int, int, int]:
        """Blocks per window and axis."""
        return tuple(w // b for w, b in zip(self.window, self.block, strict=True))

    @property
    def block_step(self) -> tuple[int, int, int]:
        """Distance of windows [block]."""
        return tuple(s // d for s, d in zip(self.step, self.stride, strict=True))

    @property
    def block_grid(self) -> tuple[int, int, int]:
        """Blocks per axis that all windows need."""
        return tuple((c - 1) * m + k for c, m, k in zip(self.count, self.block_step, self.block_count, strict=True))

    @property
    def pitch(self) -> int:
        """Lanes from one row of blocks to the next: the blocks, and room for the farthest lag of the last one."""
        return self.block_grid[2] + (self.block[2] + self.lags[2] - 2) // self.stride[2]

    @property
    def lanes(self) -> int:
        """Lanes of a layer of blocks."""
        return whole_groups(self.block_grid[1] * self.pitch)

    def direct_seconds(self) -> float:
        """Predict the time of the direct way on one CPU core."""
        reach = [b + n - 1 for b, n in zip(self.block, self.lags, strict=True)]
        plane, lags = math.prod(self.lags[1:]), math.prod(self.lags)
        depths = (self.products, self.products) if self.products else (self.block[0], reach[0])
        gathered = sum(n * math.prod(edges) for n, edges in zip(depths, (self.block[1:], reach[1:]), strict=True))
        products = self.products or self.block[0] * self.lags[0]
        block = products * math.prod(self.block[1:]) * plane + self.products * lags + _FETCH * gathered
        planes = 2 * self.products * self.block_grid[0] * self.lanes * math.prod(self.stride[1:])
        sums = self.count[0] * (self.block_count[0] * self.block_count[1] + self.block_count[2]) * lags * self.lanes
        return block * self.block_grid[0] * self.lanes * _DIRECT_SECONDS + planes * _PLANE_SECONDS + sums * _SUM_SECONDS

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
    if runtime.device().kind == "cpu":  # on CUDA nothing is gained by fewer products: the planes would have to be kept
        for plan in (whole, shared):
            plans.append(replace(plan, products=len(products_along_z(plan.block[0], plan.lags[0])[0])))
    direct = min(plans, key=Plan.direct_seconds)
    if method == "auto":
        on_gpu = runtime.device().kind == "cuda"
        method = "direct" if on_gpu or direct.direct_seconds() <= whole.fft_seconds() else "fft"
    return (whole if method == "fft" else direct), method


@functools.lru_cache
def products_along_z(block: int, lags: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factor the correlation of `block` voxels with ``block + lags - 1``: fewer products than one per voxel and lag.

    It is ``inverse @ ((taps @ a) * (near @ b))``, a discrete Fourier transform in real numbers: of frequency f of a
    and b, with real parts ar, br and imaginary parts ai, bi, the products are (ar - ai) br, ar (bi - br) and
    ai (bi + br), whose sums are the real and imaginary part of conj(a) b. Numbers or whole planes may be multiplied,
    planes by correlating them. The transform is as long as `near`: nothing wraps around.

    Returns
    -------
    taps, near, inverse : ndarray, shapes (products, block), (products, block + lags - 1), (lags, products)
    """
    size = block + lags - 1
    taps, near, inverse = [], [], []
    k, lag = np.arange(size), np.arange(lags)
    for f in range(size // 2 + 1):
        angle, turn = 2 * np.pi * f * k / size, 2 * np.pi * f * lag / size
        real, imaginary = np.cos(angle), -np.sin(angle)
        if 2 * f in (0, size):  # real
            taps.append(real)
            near.append(real)
            inverse.append(np.cos(turn) / size)
        else:
            taps += [real - imaginary, real, imaginary]
            near += [real, imaginary - real, imaginary + real]
            inverse += [2 * (np.cos(turn) - np.sin(turn)) / size, -2 * np.sin(turn) / size, 2 * np.cos(turn) / size]
    return np.array(taps)[:, :block], np.array(near), np.array(inverse).T


def whole_groups(lanes: int) -> int:
    """Next multiple of `LANES`."""
    return -(-lanes // LANES) * LANES
