"""Normalised 3D cross-correlation of many overlapping windows, and their sub-voxel peaks.

A window of the first volume is correlated with an equally large window of the second one at every lag of the search
range, so each lag uses the full window ("extended search area"): nothing wraps around and nothing is lost at large
lags. Two ways to the sums of products:

- *direct*: windows that overlap share voxels, so the sums are formed once for blocks (the greatest common divisor of
  window and step) and added up per window: an eighth of the work at 50 % overlap. Where there are many lags, transforms
  along z and y, as long as block and lags together, replace most products (`spectral_kernels`);
- *fft*: zero-padded transforms, window by window, cheaper for large windows with a large search range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
import warp as wp
from numpy.lib.stride_tricks import sliding_window_view

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import blocks as kernels
from lfpiv_kernels.correlation import peaks as peak_kernels
from lfpiv_kernels.correlation import planes as plane_kernels
from lfpiv_kernels.correlation import spectra as spectral_kernels
from lfpiv_kernels.correlation.blocks import LANES
from lfpiv_kernels.correlation.memory import Call, free_memory, launch, new_array
from lfpiv_kernels.correlation.plan import GROUP, Plan, make_plan, whole_groups, window_grid
from lfpiv_kernels.correlation.sides import Side, make_sides
from lfpiv_kernels.correlation.spectra import ROWS
from lfpiv_kernels.correlation.transforms import Planes, Spectrum

__all__ = ["WindowPeaks", "correlate_windows", "window_grid"]

_SLAB_BYTES = 1 << 26
"""Correlation sums held at a time; larger problems run in slabs of window layers."""
_SCORE_BYTES = 1 << 23
"""Coefficients a CPU task holds: long rows of neighbouring windows are worth more than fast memory."""
_PART = 1 << 10
"""Elements of a plane that a task transforms along z: long rows, and what it holds stays in a core's own cache."""


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
    flat = first.ravel(), second.ravel()
    squares = [float(np.dot(values, values)) for values in flat]
    for name, total in zip(("first", "second"), squares, strict=True):
        if not math.isfinite(total):
            raise ValueError(f"{name}: expected finite values whose squares add up to a float32, got others.")
    free_memory()
    searches = (search if symmetric else (0, 0, 0)), search
    peaks = _measure(plan, make_sides(plan, (first, second), squares, searches), symmetric, method)
    return WindowPeaks(
        displacement=np.moveaxis(peaks[:3], 0, -1).copy(),
        second_displacement=np.moveaxis(peaks[3:6], 0, -1).copy(),
        correlation=peaks[6].copy(),
        rival=peaks[7].copy(),
        measured=np.isfinite(peaks[0]),
    )


def _slab_depth(plan: Plan, symmetric: bool) -> int:
    """Layers of windows whose correlation sums fit `_SLAB_BYTES`."""
    layer_bytes = 4 * (1 + symmetric) * math.prod(plan.lags) * plan.lanes
    return min(plan.count[0], max(1, (_SLAB_BYTES // layer_bytes - plan.block_count[0]) // plan.block_step[0] + 1))


def _measure(plan: Plan, sides: tuple[Side, Side], symmetric: bool, method: str) -> np.ndarray:
    """Two displacements (z, y, x), highest coefficient and its rival of all windows, (8, z, y, x)."""
    on_cpu = runtime.device().kind == "cpu"
    lags, step, depth = math.prod(plan.lags), plan.block_step[0], _slab_depth(plan, symmetric)
    ring = (depth - 1) * step + plan.block_count[0]
    spare = plan.block_count[1] * plan.pitch + plan.block_count[2] + 2 * LANES  # read by lanes that hold no window
    sums = [new_array(ring * lags * plan.lanes + spare) for _ in range(1 + symmetric)]
    group = 1
    if on_cpu:
        group = LANES * min(-(-plan.lanes // LANES), max(1, _SCORE_BYTES // (4 * LANES * lags)))
    groups = -(-plan.lanes // group)
    rows = lags + math.prod(plan.lags[:2])  # coefficients, and the highest of each row of lags
    slot_pitch = rows * group + group + plan.block_count[2] + LANES
    scratch = new_array(runtime.CHUNKS * slot_pitch if on_cpu else depth * groups * rows)
    peaks = new_array(8 * plan.count[0] * plan.lanes)
    work = _Work.empty(plan, sides, ring if method == "direct" else 0)
    first, second = sides
    statistics = [first.mean.values, first.scale.values, second.mean.values, second.scale.values]
    offsets = [*first.mean.offsets, *second.mean.offsets]
    pitches = wp.vec2i(first.mean.plane, second.mean.plane)
    gathered = on_cpu and min(plan.block_count[1:]) > 2  # windows that share rows of blocks add them up once
    done = 0
    for begin in range(0, plan.count[0], depth):
        end = min(begin + depth, plan.count[0])
        layers = range(max(done, begin * step), (end - 1) * step + plan.block_count[0])  # none that no window needs
        done = layers.stop
        for sum_, (a, b) in zip(sums, (sides, sides[::-1]), strict=False):
            if method == "fft":
                _transform_layers(plan, a, b, layers, ring, sum_)
            else:
                _correlate_layers(plan, a, b, layers, ring, work, sum_)
            if gathered:
                layout = [*plan.block_count[1:], plan.pitch, plan.lanes, lags, ring, layers.start]
                launch(Call(kernels._gather_blocks, len(layers) * lags, layout, [sum_]))
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
        after_slot = [slot_pitch, group if on_cpu else size, plan.count[0] * plan.lanes]
        launch(Call(peak_kernels._find_peaks, size, inputs, [scratch, peaks], after_slot))
    windows = peaks.numpy().reshape(8, plan.count[0], -1)[..., : plan.block_grid[1] * plan.pitch]
    lattice = windows.reshape(8, plan.count[0], -1, plan.pitch)
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
    def empty(cls, plan: Plan, sides: tuple[Side, Side], layers: int) -> _Work:
        """Room for some layers of blocks."""
        spectra = 0
        if plan.spectral:
            spectrum = Spectrum.of(plan.block, plan.search)
            spectra = layers * spectrum.size[0] * max(side.voxels.plane for side in sides)
            taps, near = (len(quads) for quads in spectrum.folds)
            reach, half = plan.block[2] + plan.lags[2] - 1, spectrum.size[1] // 2 + 1
            wide = min(plan.stride[2], reach) * whole_groups(GROUP + _lanes_past(plan))
            pitch = GROUP * plan.block[2] * (8 * taps + 6 * ROWS) + wide * (8 * near + 6 * ROWS)
            pitch += GROUP * plan.lags[2] * (4 * half + (spectrum.size[0] + 2) * plan.lags[1]) + whole_groups(reach)
            pitch = max(pitch, *(len(planes.quads) * _PART for planes in spectrum.planes))
        else:
            edges = zip(plan.block[1:], plan.lags[1:], strict=True)
            pitch = LANES * plan.block[0] * (math.prod(plan.block[1:]) + math.prod(b + n - 1 for b, n in edges))
        taps, near = (new_array(max(1, spectra)) for _ in range(2))
        on_cpu = runtime.device().kind == "cpu"
        return cls(taps, near, new_array(runtime.CHUNKS * pitch if on_cpu else 1), pitch)


def _lanes_past(plan: Plan) -> int:
    """Lanes behind a group's last whose voxels it reaches."""
    return (plan.block[2] + plan.lags[2] - 2) // plan.stride[2]


def _correlate_layers(
    plan: Plan, first: Side, second: Side, layers: range, ring: int, work: _Work, sums: wp.array
) -> None:
    """Sum the products of the blocks of some layers at all lags."""
    on_cpu = runtime.device().kind == "cpu"
    taps, near = _shifted(first, first.search), second.voxels.values
    pitches, lags = wp.vec2i(first.voxels.plane, second.voxels.plane), wp.vec3i(*plan.lags)
    if plan.spectral:
        spectrum = Spectrum.of(plan.block, plan.search)
        volumes = (taps[0], first.voxels.plane, work.taps), (near, second.voxels.plane, work.near)
        launch(
            *(
                _transform_planes(planes, *volume, layers, plan.stride[0], work)
                for planes, volume in zip(spectrum.planes, volumes, strict=True)
            )
        )
        quads, matrices = spectrum.arrays
        inputs = [work.taps, work.near, *taps[1:], *second.voxels.offsets, pitches, quads, wp.vec3i(*spectrum.counts)]
        inputs += [matrices, wp.vec2i(*spectrum.size), plan.stride[2], wp.vec3i(*plan.block)]
        groups = -(-plan.lanes // GROUP)
        inputs += [lags, layers.start, ring, groups, GROUP, _lanes_past(plan), plan.lanes, work.scratch_pitch]
        launch(Call(spectral_kernels._correlate_spectra, len(layers) * groups, inputs, [work.scratch, sums], []))
        return
    group, parts = (LANES, 1) if on_cpu else (1, plan.lags[0])
    groups = plan.lanes // group
    inputs = [taps[0], near, *taps[1:], *second.voxels.offsets, pitches, plan.stride[0], wp.vec3i(*plan.block), lags]
    inputs += [layers.start, ring, groups, group, parts]
    size = len(layers) * groups * parts
    launch(Call(kernels._correlate_blocks, size, [*inputs, work.scratch_pitch], [work.scratch, sums], []))


def _transform_planes(
    planes: Planes, volume: wp.array, plane: int, out: wp.array, layers: range, stride: int, work: _Work
) -> Call:
    """Transform the planes of each layer, (layer, row, element of a plane)."""
    quads, rows, matrix = planes.arrays
    layout = [layers.start * stride, stride, plane, _PART]
    inputs = [volume, quads, len(planes.quads) // 4, rows, wp.vec4i(*planes.counts), matrix, *layout]
    size = len(layers) * -(-plane // _PART)
    return Call(plane_kernels._transform_planes, size, inputs, [work.scratch, out], after_slot=[work.scratch_pitch])


def _shifted(side: Side, search: tuple[int, int, int]) -> tuple[wp.array, wp.array, wp.array]:
    """Voxels of a side and offsets, counted from its blocks instead of from the farthest lag."""
    voxels = side.voxels
    flat = voxels.values
    start = search[0] * voxels.plane
    planes = wp.array(ptr=flat.ptr + 4 * start, dtype=float, shape=(flat.size - start,), device=flat.device)
    planes._owner = flat  # the view must not outlive the memory
    return planes, *(offsets[r:] for offsets, r in zip(voxels.offsets, search[1:], strict=True))


def _transform_layers(plan: Plan, first: Side, second: Side, layers: range, ring: int, sums: wp.array) -> None:
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
