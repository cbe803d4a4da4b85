"""Normalised 3D cross-correlation of many overlapping windows, and their sub-voxel peaks.

A window of the first volume is correlated with an equally large window of the second one at every lag of the search
range, so each lag uses the full window ("extended search area"): nothing wraps around and nothing is lost at large
lags. Two ways to the sums of products:

- *direct*: windows that overlap share voxels, so the sums are formed once for blocks (the greatest common divisor of
  window and step) and added up per window: an eighth of the work at 50 % overlap;
- *fft*: zero-padded transforms, window by window, cheaper for large windows with a large search range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import warp as wp
from numpy.lib.stride_tricks import sliding_window_view

from . import correlation_kernels as kernels
from . import runtime
from .correlation_kernels import LANES, Row

METHODS = ("auto", "direct", "fft")
SIGNAL_FLOOR = 1e-4
"""A window whose variance is below this part of the whole volume's variance holds no signal."""

_SLAB_BYTES = 1 << 26
"""Correlation sums held at a time; larger problems run in slabs of window layers."""
_DIRECT_SECONDS = 6.5e-11
"""Cost of one multiply-add of the direct kernel, all lanes counted (measured, one core, AVX2)."""
_SUM_SECONDS = 2.5e-10
"""Cost of adding one block's lag to its window (measured, as above)."""
_FFT_SECONDS = 1.1e-9
"""Cost of a transform per point and log2(points), three transforms a window, copies included (measured, as above)."""


@dataclass(frozen=True)
class WindowPeaks:
    """Highest correlation peaks of all windows; leading axes (z, y, x) of the window grid."""

    displacement: np.ndarray
    """Displacement of the highest peak, order (z, y, x) [voxel], shape (..., 3); NaN where `measured` is false."""
    second_displacement: np.ndarray
    """The same for the second peak; NaN where there is none."""
    correlation: np.ndarray
    """Correlation coefficient at the highest peak, -1..1."""
    rival: np.ndarray
    """Highest coefficient more than two lags away from the highest peak, a peak of its own or not; at least 0."""
    measured: np.ndarray
    """True where the window holds signal and its highest peak lies inside the search range, not on its border."""


@dataclass(frozen=True)
class _Plan:
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

    @property
    def lags(self) -> tuple[int, int, int]:
        """Lags per axis."""
        return tuple(2 * r + 1 for r in self.search)

    @property
    def groups(self) -> tuple[int, int]:
        """Groups of lags along y and x, `LANES` each."""
        return -(-self.lags[1] // LANES), -(-self.lags[2] // LANES)

    @property
    def lag_shape(self) -> tuple[int, int, int]:
        """Lags per axis as stored, padded to whole groups."""
        return self.lags[0], LANES * self.groups[0], LANES * self.groups[1]

    @property
    def padded_shape(self) -> tuple[int, int, int]:
        """Second volume with room for every lag that is stored."""
        return (
            self.shape[0] + 2 * self.search[0],
            self.shape[1] + self.lag_shape[1] + 1,
            self.shape[2] + self.lag_shape[2],
        )

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

    def direct_seconds(self) -> float:
        """Predict the time of the direct way on one CPU core."""
        lags = math.prod(self.lag_shape)
        products = math.prod(self.block_grid) * math.prod(self.block) * lags
        sums = math.prod(self.count) * math.prod(self.block_count) * lags
        return products * _DIRECT_SECONDS + sums * _SUM_SECONDS

    def fft_seconds(self) -> float:
        """Predict the time of the transforms on one CPU core."""
        points = math.prod(self.transform_shape())
        return math.prod(self.count) * points * math.log2(points) * _FFT_SECONDS

    def transform_shape(self) -> tuple[int, int, int]:
        """Zero-padded transform that holds a window and every lag without wrapping around."""
        return tuple(scipy.fft.next_fast_len(w + n - 1, real=True) for w, n in zip(self.window, self.lags, strict=True))

    def mirrored(self) -> _Plan:
        """Place the same windows in the mirrored volume, in backward order."""
        origin = tuple(
            n - o - (c - 1) * s - w
            for n, o, c, s, w in zip(self.shape, self.origin, self.count, self.step, self.window, strict=True)
        )
        return replace(self, origin=origin)

    def slabs(self):
        """Parts of whole window layers whose correlation sums fit `_SLAB_BYTES`, as (slice of windows, plan)."""
        per_layer = math.prod(self.count[1:])
        blocks_per_layer = self.block_step[0] * math.prod(self.block_grid[1:])
        layer_bytes = 4 * math.prod(self.lag_shape) * (per_layer + blocks_per_layer)
        depth = max(1, _SLAB_BYTES // layer_bytes)
        for layer in range(0, self.count[0], depth):
            part = min(depth, self.count[0] - layer)
            origin = (self.origin[0] + layer * self.step[0], *self.origin[1:])
            windows = slice(layer * per_layer, (layer + part) * per_layer)
            yield windows, replace(self, origin=origin, count=(part, *self.count[1:]))


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


def box_sum(volume: np.ndarray, window: tuple[int, int, int], keep: tuple[slice, ...] | None = None) -> np.ndarray:
    """Sum over windows: ``out[p]`` adds the window whose first voxel is p; 0 where it would leave the volume.

    Parameters
    ----------
    volume : ndarray, shape (z, y, x), float32
    window : tuple of int
        Window edges, order (z, y, x) [voxel].
    keep : tuple of slice, optional
        The p wanted per axis; default: all of the volume.

    Returns
    -------
    ndarray, float32
        Of the volume's shape, or what `keep` takes of it.
    """
    keep = keep or (slice(None),) * 3
    for axis in (2, 1, 0):  # dropping what is not wanted along x first saves most of the work along y and z
        volume = _sum_along(volume, axis, window[axis])
        volume[(slice(None),) * axis + (slice(volume.shape[axis] - window[axis] + 1, None),)] = 0
        volume = np.ascontiguousarray(volume[(slice(None),) * axis + (keep[axis],)])
    return volume


def _sum_along(volume: np.ndarray, axis: int, width: int) -> np.ndarray:
    """Sum `width` neighbours along an axis, starting at each voxel; the last ``width - 1`` sums mean nothing."""
    pitch = math.prod(volume.shape[axis + 1 :])
    rows = -(-volume.size // LANES)
    part = max(n for n in range(1, math.isqrt(width) + 1) if width % n == 0)  # sums of sums: part + width / part terms
    taken, written = (np.zeros(rows * LANES + width * pitch + LANES, np.float32) for _ in range(2))
    taken[: volume.size] = volume.ravel()
    taken, written = _to_device(taken), _to_device(written)
    batch = 1 if runtime.device().kind == "cuda" else 64  # a CPU task costs as much as adding several rows
    for terms, spacing in ((part, pitch), (width // part, part * pitch)):
        if terms > 1:
            rows_out = wp.array(ptr=written.ptr, dtype=Row, shape=(rows,), device=written.device)
            _launch(
                kernels._box_sum, -(-rows // batch), (), [_overlapping(taken), spacing, terms, rows, batch], [rows_out]
            )
            taken, written = written, taken
    return taken.numpy()[: volume.size].reshape(volume.shape)


def correlate_windows(
    first: np.ndarray,
    second: np.ndarray,
    *,
    window: tuple[int, int, int],
    step: tuple[int, int, int],
    search: tuple[int, int, int],
    symmetric: bool = False,
    method: str = "auto",
) -> WindowPeaks:
    """Correlate all windows of two volumes and find the two highest peaks of each.

    The coefficient at lag L is ``sum((a - mean a) (b_L - mean b_L)) / sqrt(sum (a - mean a)^2 sum (b_L - mean b_L)^2)``
    with a the window of `first` and b_L the window of `second` moved by L; outside the volume `second` counts as 0,
    so the background of both volumes should be 0. Particles cut by the edge of a but whole in b_L disturb the peak; the
    symmetric coefficient, the mean of this one and that of the window of `second` with `first` moved by -L, does not
    suffer from that around L = 0, and swapping the volumes negates its displacements.

    Parameters
    ----------
    first, second : ndarray, shape (z, y, x), float32
        Finite volumes of equal shape.
    window, step : tuple of int
        Window edges and their distance, order (z, y, x) [voxel].
    search : tuple of int
        Largest lag per axis, >= 2; peaks are found up to ``search - 1`` [voxel].
    symmetric : bool
        Use the symmetric coefficient, at twice the cost.
    method : {"auto", "direct", "fft"}
        How the sums of products are formed; "auto" takes the cheaper one by a cost model (always direct on CUDA).

    Returns
    -------
    WindowPeaks
        On the grid of `window_grid`.

    Raises
    ------
    ValueError
        If shapes differ, a window does not fit, `search` is below 2 or the method is unknown.
    """
    plan, method = _make_plan(first.shape, second.shape, window, step, search, method)
    sides = [_Side(plan, first, second)]
    if symmetric:  # mirroring turns the lag -L into L
        sides.append(_Side(plan.mirrored(), *(np.flip(volume) for volume in (second, first))))
    size = math.prod(plan.count)
    displacement = np.empty((size, 2, 3), np.float32)
    correlation, found = np.empty((size, 2), np.float32), np.empty((size, 2), np.int32)
    for windows, slab in plan.slabs():
        scores = sides[0].scores(slab, windows, method)
        if symmetric:
            backwards = slice(size - windows.stop, size - windows.start)
            sides[1].scores(slab.mirrored(), backwards, method, average_with=scores)
        displacement[windows], correlation[windows], found[windows] = _peaks(slab, scores)
    displacement[found == 0] = np.nan
    return WindowPeaks(
        displacement=displacement[:, 0].reshape(*plan.count, 3),
        second_displacement=displacement[:, 1].reshape(*plan.count, 3),
        correlation=correlation[:, 0].reshape(plan.count),
        rival=correlation[:, 1].reshape(plan.count),
        measured=found[:, 0].reshape(plan.count) > 0,
    )


class _Side:
    """The windows of one volume against the surroundings of these windows in the other."""

    def __init__(self, plan: _Plan, first: np.ndarray, second: np.ndarray):
        self.first = np.ascontiguousarray(first, np.float32)
        self.padded = np.zeros(plan.padded_shape, np.float32)
        self.padded[tuple(slice(r, r + n) for r, n in zip(plan.search, plan.shape, strict=True))] = second
        corners = tuple(
            slice(o, o + (c - 1) * s + 1, s) for o, c, s in zip(plan.origin, plan.count, plan.step, strict=True)
        )
        first_mean, first_scale = _window_statistics(self.first, plan.window, corners)
        self.first_sum, self.first_scale = math.prod(plan.window) * first_mean.ravel(), first_scale.ravel()
        self.device_first = _to_device(np.append(self.first.ravel(), np.zeros(plan.shape[2], np.float32)))
        volumes = (self.padded, *_window_statistics(self.padded, plan.window))
        self.device_second = [_to_device(volume.ravel()) for volume in volumes]

    def scores(self, plan: _Plan, windows: slice, method: str, *, average_with: wp.array | None = None) -> wp.array:
        """Correlation coefficients of the plan's windows, (window, lag z, lag y, lag x / 8) of `Row`."""
        if method == "fft":
            sums = _fft_sums(plan, self.first, self.padded)
        else:
            sums = _direct_sums(plan, self.device_first, self.device_second[0])
        count, where = math.prod(plan.count), runtime.device().warp
        scores = average_with
        if scores is None:
            scores = wp.empty((count, *sums.shape[1:]), dtype=Row, device=where)
        mean, scale = (_overlapping(values) for values in self.device_second[1:])
        statistics = [_to_device(values[windows]) for values in (self.first_sum, self.first_scale)]
        layout = [plan.count, plan.block_grid, plan.origin, plan.step, plan.block_step, plan.block_count]
        inputs = [sums, mean, scale, *statistics, _pitch(plan), plan.lags[1], *(wp.vec3i(*t) for t in layout)]
        mirrored = int(average_with is not None)
        _launch(kernels._normalise, count, (plan.lags[0], plan.groups[1]), [*inputs, mirrored], [scores])
        return scores


def _make_plan(shape, second_shape, window, step, search, method) -> tuple[_Plan, str]:
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
    whole = _Plan(shape, tuple(window), tuple(step), tuple(search), origin, count, tuple(window))
    shared = replace(whole, block=tuple(math.gcd(w, s) for w, s in zip(window, step, strict=True)))
    direct = min((whole, shared), key=_Plan.direct_seconds)
    if method == "auto":
        on_gpu = runtime.device().kind == "cuda"
        method = "direct" if on_gpu or direct.direct_seconds() <= whole.fft_seconds() else "fft"
    return (whole if method == "fft" else direct), method


def _window_statistics(
    volume: np.ndarray, window: tuple[int, int, int], keep: tuple[slice, ...] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of each window, and 1 / sqrt(sum of squared deviations), 0 where there is no signal; by first voxel."""
    voxels = np.float32(math.prod(window))
    mean = box_sum(volume, window, keep)
    deviation = box_sum(volume * volume, window, keep)
    deviation -= mean * mean / voxels
    mean /= voxels
    flat = volume.ravel()
    variance = float(np.dot(flat, flat)) / flat.size - float(flat.mean()) ** 2
    floor = np.float32(SIGNAL_FLOOR * voxels * variance + np.finfo(np.float32).tiny)
    scale = np.zeros_like(deviation)
    np.divide(1, np.sqrt(np.maximum(deviation, floor)), where=deviation > floor, out=scale)
    return mean, scale


def _direct_sums(plan: _Plan, first: wp.array, padded: wp.array) -> wp.array:
    """Sum the products of all blocks at all lags, (block, lag z, lag y, lag x / 8) of `Row`."""
    blocks, groups = math.prod(plan.block_grid), plan.groups
    where = runtime.device().warp
    sums = wp.empty((blocks, plan.lags[0], LANES * groups[0], groups[1]), dtype=Row, device=where)
    pitches = wp.vec2i(plan.shape[1] * plan.shape[2], plan.shape[2]), _pitch(plan)
    layout = [wp.vec3i(*triple) for triple in (plan.block_grid, plan.origin, plan.stride, plan.block)]
    _launch(
        kernels._correlate_blocks,
        blocks,
        (plan.lags[0], *groups),
        [first, _overlapping(padded), *pitches, *layout],
        [sums],
    )
    return sums


def _fft_sums(plan: _Plan, first: np.ndarray, padded: np.ndarray) -> wp.array:
    """Return what `_direct_sums` returns for whole windows, by zero-padded transforms."""
    sums = np.empty((math.prod(plan.count), *plan.lag_shape), np.float32)
    shape = plan.transform_shape()
    reach = tuple(w + n - 1 for w, n in zip(plan.window, plan.lags, strict=True))
    corner = [o + s * np.arange(c) for o, s, c in zip(plan.origin, plan.step, plan.count, strict=True)]
    batch = max(1, (1 << 22) // math.prod(shape))

    def transform(chunk: int, begin: int, end: int) -> None:
        for start in range(begin, end, batch):
            index = np.unravel_index(np.arange(start, min(start + batch, end)), plan.count)
            z, y, x = (c[i] for c, i in zip(corner, index, strict=True))
            a = sliding_window_view(first, plan.window)[z, y, x]
            b = sliding_window_view(padded, reach)[z, y, x]
            spectrum = scipy.fft.rfftn(b, shape, axes=(1, 2, 3))
            spectrum *= scipy.fft.rfftn(a, shape, axes=(1, 2, 3)).conj()
            lags = scipy.fft.irfftn(spectrum, shape, axes=(1, 2, 3))
            n = plan.lags
            sums[start : start + len(z), : n[0], : n[1], : n[2]] = lags[:, : n[0], : n[1], : n[2]]

    runtime.run_chunks(len(sums), transform)
    rows = sums.reshape(*sums.shape[:3], plan.groups[1], LANES)
    return wp.array(rows, dtype=Row, device=runtime.device().warp, copy=False)


def _peaks(plan: _Plan, scores: wp.array) -> list[np.ndarray]:
    """Displacement, coefficient and existence of the two highest peaks of the plan's windows."""
    windows, where = math.prod(plan.count), runtime.device().warp
    flat_scores = wp.array(ptr=scores.ptr, dtype=float, shape=(windows, *plan.lag_shape), device=where)
    peaks = [wp.zeros((windows, 2), dtype=kind, device=where) for kind in (wp.vec3, float, int)]
    _launch(kernels._find_peaks, windows, (), [flat_scores, wp.vec3i(*plan.search)], peaks)
    return [peak.numpy() for peak in peaks]


def _pitch(plan: _Plan) -> wp.vec2i:
    """Elements per layer and per row of the padded second volume."""
    return wp.vec2i(plan.padded_shape[1] * plan.padded_shape[2], plan.padded_shape[2])


def _to_device(values: np.ndarray) -> wp.array:
    """Float array on the running device; on the CPU a view that keeps its owner."""
    where = runtime.device()
    return wp.array(values, dtype=float, device=where.warp, copy=where.kind != "cpu")


def _overlapping(flat: wp.array) -> wp.array:
    """View a flat float array as rows of `LANES` that start at every element; the caller keeps it alive."""
    count = flat.shape[0] - LANES + 1
    return wp.array(ptr=flat.ptr, dtype=Row, shape=(count,), strides=(4,), device=flat.device)


def _launch(kernel: wp.Kernel, size: int, inner: tuple[int, ...], inputs: list, outputs: list) -> None:
    """Launch over (size, *inner), threaded on the CPU; the kernel's last input is the first index of its part."""
    where = runtime.device().warp
    wp.load_module(kernels, device=where)  # before threads start: compilation is not thread-safe

    def part(chunk: int, begin: int, end: int) -> None:
        wp.launch(kernel, dim=(end - begin, *inner), inputs=[*inputs, begin], outputs=outputs, device=where)

    runtime.run_chunks(size, part)
