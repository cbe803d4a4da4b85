"""Normalised 3D cross-correlation of many overlapping windows, and their sub-voxel peaks.

A window of the first volume is correlated with an equally large window of the second one at every lag of the search
range, so each lag uses the full window ("extended search area"): nothing wraps around and nothing is lost at large
lags. Two ways to the sums of products:

- *direct*: windows that overlap share voxels, so the sums are formed once for blocks (the greatest common divisor of
  window and step) and added up per window: an eighth of the work at 50 % overlap. Along z a transform as long as block
  and lags together replaces most products where there are many lags (`products_along_z`);
- *fft*: zero-padded transforms, window by window, cheaper for large windows with a large search range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
import warp as wp
from numpy.lib.stride_tricks import sliding_window_view

from . import correlation_kernels as kernels
from . import runtime, window_kernels
from .correlation_kernels import LANES
from .correlation_plan import Plan, make_plan, products_along_z, whole_groups, window_grid
from .window_kernels import ROW, Row

__all__ = ["WindowPeaks", "box_sum", "correlate_windows", "window_grid"]

SIGNAL_FLOOR = 1e-4
"""A window whose variance is below this part of the whole volume's variance holds no signal."""

_SLAB_BYTES = 1 << 25
"""Correlation sums held at a time; larger problems run in slabs of window layers."""
_SCORE_BYTES = 1 << 20
"""Coefficients a CPU thread holds at a time."""


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
    rows = -(-volume.size // ROW)
    part = _factor(width)  # sums of sums: part + width / part terms
    taken, written = (np.zeros(rows * ROW + width * pitch + ROW, np.float32) for _ in range(2))
    taken[: volume.size] = volume.ravel()
    taken, written = _to_device(taken), _to_device(written)
    batch = 1 if runtime.device().kind == "cuda" else 64  # a CPU task costs as much as adding several rows
    for terms, spacing in ((part, pitch), (width // part, part * pitch)):
        if terms > 1:
            rows_out = wp.array(ptr=written.ptr, dtype=Row, shape=(rows,), device=written.device)
            _launch(
                window_kernels._box_sum,
                -(-rows // batch),
                (),
                [_overlapping(taken), spacing, terms, rows, batch],
                [rows_out],
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
        If shapes differ, values are not finite, a window does not fit, `search` is below 2 or the method is unknown.
    """
    plan, method = make_plan(first.shape, second.shape, window, step, search, method)
    for name, volume in (("first", first), ("second", second)):
        flat = np.ravel(volume)
        if not math.isfinite(float(np.dot(flat, flat))):
            raise ValueError(f"{name}: expected finite values whose squares add up to a float32, got others.")
    sides = _Side(plan, first, search if symmetric else (0, 0, 0)), _Side(plan, second, search)
    peaks = _measure(plan, sides, symmetric, method)
    return WindowPeaks(
        displacement=np.ascontiguousarray(np.moveaxis(peaks[:3], 0, -1)),
        second_displacement=np.ascontiguousarray(np.moveaxis(peaks[3:6], 0, -1)),
        correlation=np.ascontiguousarray(peaks[6]),
        rival=np.ascontiguousarray(peaks[7]),
        measured=np.isfinite(peaks[0]),
    )


class _Side:
    """One volume as the kernels take it: split by phase, with the statistics of its windows at every lag."""

    def __init__(self, plan: Plan, volume: np.ndarray, search: tuple[int, int, int]):
        self.volume, self.search = np.ascontiguousarray(volume, np.float32), search
        self.lags = tuple(2 * r + 1 for r in search)
        reach = tuple(b + n - 1 for b, n in zip(plan.block, self.lags, strict=True))
        corner = tuple(o - r for o, r in zip(plan.origin, search, strict=True))
        self.voxels = _Split.empty(plan, reach)
        phases, lanes = wp.vec2i(*self.voxels.shape[1:3]), self.voxels.shape[3]
        layout = [wp.vec3i(*plan.shape), wp.vec3i(*corner), wp.vec2i(*plan.stride[1:]), phases, plan.pitch, lanes]
        inputs = [_to_device(self.volume.ravel()), *layout]
        _launch(kernels._split, self.voxels.shape[0], (), inputs, [self.voxels.flat])
        self.mean, self.scale = _statistics(plan, self.volume, search)


@dataclass(frozen=True)
class _Split:
    """Values at the lattice of blocks and at every offset from it, (plane, phase y, phase x, lane)."""

    shape: tuple[int, int, int, int]
    array: wp.array
    offsets: tuple[wp.array, wp.array]
    """Distance in memory for every offset in voxels along y and x."""

    @classmethod
    def empty(cls, plan: Plan, reach: tuple[int, int, int]) -> _Split:
        """Room for the offsets 0 to ``reach - 1``."""
        phases = tuple(min(s, r) for s, r in zip(plan.stride, reach, strict=True))
        past = [(r - 1) // s for r, s in zip(reach, plan.stride, strict=True)]
        lanes = whole_groups(plan.lanes + past[1] * plan.pitch + past[2] + LANES)
        shape = ((plan.block_grid[0] - 1) * plan.stride[0] + reach[0], phases[1], phases[2], lanes)
        y, x = (np.arange(r) for r in reach[1:])
        along_y = y % plan.stride[1] * phases[2] * lanes + y // plan.stride[1] * plan.pitch
        along_x = x % plan.stride[2] * lanes + x // plan.stride[2]
        where = runtime.device().warp
        offsets = tuple(wp.array(o.astype(np.int32), dtype=int, device=where) for o in (along_y, along_x))
        return cls(shape, _new(shape), offsets)

    @property
    def flat(self) -> wp.array:
        """The array as the kernels index it."""
        return self.array.flatten()

    @property
    def plane(self) -> int:
        """Elements per plane."""
        return math.prod(self.shape[1:])


def _statistics(plan: Plan, volume: np.ndarray, search: tuple[int, int, int]) -> tuple[_Split, _Split]:
    """Mean of the windows at every lag, and 1 / sqrt(sum of squared deviations), 0 where there is no signal."""
    window, shape, where = wp.vec3i(*plan.window), wp.vec3i(*plan.shape), runtime.device()
    on_cpu = where.kind == "cpu"
    sums = tuple(n + 2 * r - w + 1 for n, r, w in zip(plan.shape, search, plan.window, strict=True))
    rows = plan.shape[0], *sums[1:]
    total, square = (_new(rows) for _ in range(2))
    part = [_factor(edge) for edge in plan.window[1:]]
    padded = plan.shape[1] + 2 * search[1], plan.shape[2] + 2 * search[2]
    scratch_pitch = 3 * padded[1] + sums[2] * (2 * plan.shape[1] + padded[0])
    scratch = _new(((runtime.CHUNKS if on_cpu else plan.shape[0]) * scratch_pitch,))
    inputs = [_to_device(volume.ravel()), shape, wp.vec3i(*search), window, wp.vec2i(*part)]
    outputs = [array.flatten() for array in (scratch, total, square)]
    _launch(window_kernels._sum_planes, plan.shape[0], (), inputs, outputs, slots=True, after_slot=[scratch_pitch])
    flat = volume.ravel()
    variance = float(np.dot(flat, flat)) / flat.size - float(flat.mean()) ** 2
    floor = SIGNAL_FLOOR * math.prod(plan.window) * variance + float(np.finfo(np.float32).tiny)
    lags = tuple(2 * r + 1 for r in search)
    mean, scale = (_Split.empty(plan, lags) for _ in range(2))
    phases = wp.vec3i(*(min(s, n) for s, n in zip(plan.stride, lags, strict=True)))
    layout = [wp.vec3i(*rows), search[0], window, floor, wp.vec3i(*plan.origin), wp.vec3i(*plan.stride), phases]
    inputs = [*outputs[1:], *layout, mean.shape[0], plan.pitch, mean.shape[3]]
    _launch(window_kernels._window_statistics, sums[1], (), inputs, [mean.flat, scale.flat])
    return mean, scale


def _slab_depth(plan: Plan, symmetric: bool) -> int:
    """Layers of windows whose correlation sums fit `_SLAB_BYTES`."""
    layer_bytes = 4 * (1 + symmetric) * math.prod(plan.lags) * plan.lanes
    return min(plan.count[0], max(1, (_SLAB_BYTES // layer_bytes - plan.block_count[0]) // plan.block_step[0] + 1))


def _factor(edge: int) -> int:
    """Largest factor that is no larger than its counterpart."""
    return max(n for n in range(1, math.isqrt(edge) + 1) if edge % n == 0)


def _measure(plan: Plan, sides: tuple[_Side, _Side], symmetric: bool, method: str) -> np.ndarray:
    """Two displacements (z, y, x), highest coefficient and its rival of all windows, (8, z, y, x)."""
    on_cpu = runtime.device().kind == "cpu"
    lags, step, depth = math.prod(plan.lags), plan.block_step[0], _slab_depth(plan, symmetric)
    ring = (depth - 1) * step + plan.block_count[0]
    spare = plan.block_count[1] * plan.pitch + plan.block_count[2] + 2 * LANES  # read by lanes that hold no window
    sums = [_new((ring * lags * plan.lanes + spare,)) for _ in range(1 + symmetric)]
    group = 1
    if on_cpu:
        group = LANES * max(1, min(4, _SCORE_BYTES // (4 * LANES * lags)))
    groups = -(-plan.lanes // group)
    slot_pitch = lags * group + group + plan.block_count[2] + LANES
    scratch = _new((runtime.CHUNKS * slot_pitch if on_cpu else depth * groups * lags,))
    peaks = _new((8, plan.count[0], plan.lanes))
    work = _Work.empty(plan, sides, ring if method == "direct" else 0)
    first, second = sides
    statistics = [first.mean.flat, first.scale.flat, second.mean.flat, second.scale.flat]
    offsets = [*first.mean.offsets, *second.mean.offsets]
    pitches = wp.vec2i(first.mean.plane, second.mean.plane)
    gathered = on_cpu and min(plan.block_count[1:]) > 2  # windows that share rows of blocks add them up once
    done = 0
    for begin in range(0, plan.count[0], depth):
        end = min(begin + depth, plan.count[0])
        layers = range(done, (end - 1) * step + plan.block_count[0])
        done = layers.stop
        for sum_, (a, b) in zip(sums, (sides, sides[::-1]), strict=False):
            if method == "fft":
                _transform_layers(plan, a, b, layers, ring, sum_)
            else:
                _correlate_layers(plan, a, b, layers, ring, work, sum_)
            if gathered:
                layout = [*plan.block_count[1:], plan.pitch, plan.lanes, lags, ring, layers.start]
                _launch(kernels._gather_blocks, len(layers) * lags, (), layout, [sum_])
        layout = [
            pitches,
            wp.vec3i(*first.search),
            plan.stride[0],
            math.prod(plan.window),
            wp.vec3i(*((plan.block_count[0], 1, 1) if gathered else plan.block_count)),
            step,
            wp.vec3i(*plan.lags),
            begin,
            ring,
            groups,
            group,
            plan.pitch,
            plan.lanes,
        ]
        inputs = [sums[0], sums[-1], int(symmetric), *statistics, *offsets, *layout]
        size = (end - begin) * groups
        _launch(
            window_kernels._find_peaks,
            size,
            (),
            inputs,
            [scratch, peaks.flatten()],
            slots=True,
            after_slot=[slot_pitch, group if on_cpu else size, plan.count[0] * plan.lanes],
        )
    lattice = peaks.numpy()[:, :, : plan.block_grid[1] * plan.pitch].reshape(8, plan.count[0], -1, plan.pitch)
    along_y, along_x = (slice(0, (c - 1) * m + 1, m) for c, m in zip(plan.count[1:], plan.block_step[1:], strict=True))
    return lattice[:, :, along_y, along_x]


@dataclass(frozen=True)
class _Work:
    """Memory that `_correlate_layers` works in, the same for every slab."""

    taps: wp.array
    near: wp.array
    scratch: wp.array
    scratch_pitch: int

    @classmethod
    def empty(cls, plan: Plan, sides: tuple[_Side, _Side], layers: int) -> _Work:
        """Room for some layers of blocks."""
        depth = 1 if plan.products else plan.block[0]
        reach = math.prod(b + n - 1 for b, n in zip(plan.block[1:], plan.lags[1:], strict=True))
        kept = plan.products * -(-plan.lags[1] * plan.lags[2] // 3) * 3
        pitch = LANES * (depth * (math.prod(plan.block[1:]) + reach) + kept)
        plane = max(side.voxels.plane for side in sides)
        taps, near = (_new((max(1, layers * plan.products * plane),)) for _ in range(2))
        on_cpu = runtime.device().kind == "cpu"
        return cls(taps, near, _new((runtime.CHUNKS * pitch if on_cpu else 1,)), pitch)


def _correlate_layers(
    plan: Plan, first: _Side, second: _Side, layers: range, ring: int, work: _Work, sums: wp.array
) -> None:
    """Sum the products of the blocks of some layers at all lags."""
    on_cpu = runtime.device().kind == "cpu"
    group, parts = (LANES, 1) if on_cpu else (1, plan.lags[0])
    groups = plan.lanes // group
    taps, near = _shifted(first, first.search), second.voxels.flat
    inverse = np.zeros((1, 1))
    if plan.products:
        *matrices, inverse = products_along_z(plan.block[0], plan.lags[0])
        start, stride = layers.start * plan.stride[0], plan.stride[0]
        _combine(matrices[0], taps[0], start, stride, len(layers), first.voxels.plane, work.taps)
        _combine(matrices[1], near, start, stride, len(layers), second.voxels.plane, work.near)
        taps, near = (work.taps, *taps[1:]), work.near
    inputs = [taps[0], near, *taps[1:], *second.voxels.offsets]
    inputs += [wp.vec2i(first.voxels.plane, second.voxels.plane), plan.stride[0], wp.vec3i(*plan.block)]
    inputs += [wp.vec3i(*plan.lags), layers.start, ring, groups, group, parts, plan.products, *_padded(inverse.T)]
    size = len(layers) * groups * parts
    _launch(kernels._correlate_blocks, size, (), [*inputs, work.scratch_pitch], [work.scratch, sums], slots=True)


def _combine(
    matrix: np.ndarray, volume: wp.array, start: int, stride: int, layers: int, plane: int, out: wp.array
) -> None:
    """Combine the planes of each layer, (layer, row of the matrix, element of a plane)."""
    rows, terms = matrix.shape
    part = 256  # so that the planes' parts stay in the fastest cache
    inputs = [volume, *_padded(matrix.T), terms, rows, start, stride, plane, part]
    _launch(kernels._transform_planes, layers * -(-plane // part), (), inputs, [out])


def _padded(matrix: np.ndarray) -> tuple[wp.array, int]:
    """Flat matrix with rows of whole sixes, and their length."""
    columns = -(-matrix.shape[1] // 6) * 6
    padded = np.zeros((len(matrix), columns), np.float32)
    padded[:, : matrix.shape[1]] = matrix
    return wp.array(padded.ravel(), dtype=float, device=runtime.device().warp), columns


def _shifted(side: _Side, search: tuple[int, int, int]) -> tuple[wp.array, wp.array, wp.array]:
    """Voxels of a side and offsets, counted from its blocks instead of from the farthest lag."""
    voxels = side.voxels
    flat = voxels.flat
    start = search[0] * voxels.plane
    planes = wp.array(ptr=flat.ptr + 4 * start, dtype=float, shape=(flat.size - start,), device=flat.device)
    planes._owner = flat  # the view must not outlive the memory
    return planes, *(offsets[r:] for offsets, r in zip(voxels.offsets, search[1:], strict=True))


def _transform_layers(plan: Plan, first: _Side, second: _Side, layers: range, ring: int, sums: wp.array) -> None:
    """Do what `_correlate_layers` does, for whole windows, by zero-padded transforms."""
    shape = plan.transform_shape()
    reach = tuple(w + n - 1 for w, n in zip(plan.window, plan.lags, strict=True))
    padded = np.pad(second.volume, [(r, r) for r in plan.search])
    corner = [o + s * np.arange(c) for o, s, c in zip(plan.origin, plan.step, plan.count, strict=True)]
    batch = max(1, (1 << 22) // math.prod(shape))
    lags = math.prod(plan.lags)
    host = sums.numpy()[: ring * lags * plan.lanes].reshape(ring, lags, plan.lanes)
    grid = (len(layers), *plan.count[1:])

    def transform(chunk: int, begin: int, end: int) -> None:
        for start in range(begin, end, batch):
            layer, row, column = np.unravel_index(np.arange(start, min(start + batch, end)), grid)
            layer = layer + layers.start
            z, y, x = (c[i] for c, i in zip(corner, (layer, row, column), strict=True))
            a = sliding_window_view(first.volume, plan.window)[z, y, x]
            b = sliding_window_view(padded, reach)[z, y, x]
            spectrum = scipy.fft.rfftn(b, shape, axes=(1, 2, 3))
            spectrum *= scipy.fft.rfftn(a, shape, axes=(1, 2, 3)).conj()
            product = scipy.fft.irfftn(spectrum, shape, axes=(1, 2, 3))[
                :, : plan.lags[0], : plan.lags[1], : plan.lags[2]
            ]
            host[layer % ring, :, row * plan.pitch + column] = product.reshape(len(z), lags)

    runtime.run_chunks(math.prod(grid), transform)
    if runtime.device().kind != "cpu":
        wp.copy(sums, wp.array(host.ravel(), dtype=float, device=sums.device), count=host.size)


def _new(shape: tuple[int, ...]) -> wp.array:
    """Uninitialised float array on the running device; on the CPU NumPy's, which asks for large pages."""
    where = runtime.device()
    if where.kind == "cpu":
        return wp.array(np.empty(shape, np.float32), dtype=float, device=where.warp, copy=False)
    return wp.empty(shape, dtype=float, device=where.warp)


def _to_device(values: np.ndarray) -> wp.array:
    """Float array on the running device; on the CPU a view that keeps its owner."""
    where = runtime.device()
    return wp.array(values, dtype=float, device=where.warp, copy=where.kind != "cpu")


def _overlapping(flat: wp.array) -> wp.array:
    """View a flat float array as rows of `ROW` that start at every element; the caller keeps it alive."""
    count = flat.shape[0] - ROW + 1
    return wp.array(ptr=flat.ptr, dtype=Row, shape=(count,), strides=(4,), device=flat.device)


def _launch(kernel, size, inner, inputs, outputs, *, slots=False, after_slot=()) -> None:
    """Launch over (size, *inner), threaded on the CPU; the kernel's last input is the first index of its part.

    With `slots` the input before says which scratch memory is the part's own; -1 on CUDA.
    """
    where = runtime.device()
    wp.load_module(kernel.module, device=where.warp)  # before threads start: compilation is not thread-safe

    def part(chunk: int, begin: int, end: int) -> None:
        own = [chunk if where.kind == "cpu" else -1] if slots else []
        arguments = [*inputs, *own, *after_slot, begin]
        wp.launch(kernel, dim=(end - begin, *inner), inputs=arguments, outputs=outputs, device=where.warp)

    runtime.run_chunks(size, part)
