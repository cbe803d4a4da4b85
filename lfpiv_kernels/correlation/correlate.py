"""Normalised 3D cross-correlation of many overlapping windows, and their sub-voxel peaks.

A window of the first volume is correlated with a window of the second volume of the same size at every lag of the
search range. Each lag uses the full window ("extended search area"): nothing wraps around, and large lags lose no
voxels. `plan` chooses how the sums of products are formed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lfpiv_kernels.correlation.blocks import DirectProducts, gather, is_gathered
from lfpiv_kernels.correlation.memory import free_memory, new_array, on_device
from lfpiv_kernels.correlation.peaks import PeakFinder
from lfpiv_kernels.correlation.plan import LANES, Plan, Triple, make_plan, window_grid
from lfpiv_kernels.correlation.sides import Side, make_sides
from lfpiv_kernels.correlation.spectra import SpectralProducts
from lfpiv_kernels.correlation.sums import means_and_squares
from lfpiv_kernels.transfer import Values

__all__ = ["WindowPeaks", "correlate_by_plan", "correlate_windows", "window_grid"]

PEAK_REACH = 2
"""Lags around the highest coefficient that belong to its peak, for particles of about a voxel."""
SLAB_BYTES = 1 << 26
"""Memory for sums of products [byte]. Larger problems are split into slabs of window layers."""


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
    """Highest coefficient beyond the reach of the highest peak, a peak of its own or not; at least 0."""
    measured: np.ndarray
    """True where the window holds signal and its highest peak lies inside the search range, not on its border."""


def correlate_windows(
    first: Values,
    second: Values,
    *,
    window: Triple,
    step: Triple,
    search: Triple,
    symmetric: bool = False,
    reach: int = PEAK_REACH,
) -> WindowPeaks:
    """Correlate all windows of two volumes and find the two highest peaks of each.

    The coefficient at lag L is ``sum((a - mean a) (b_L - mean b_L)) / sqrt(sum (a - mean a)^2 sum (b_L - mean b_L)^2)``
    with a the window of `first` and b_L the window of `second` moved by L. Outside the volume `second` counts as 0, so
    the background of both volumes should be 0. Particles cut by the edge of a but whole in b_L disturb the peak. The
    symmetric coefficient is the mean of this one and of its counterpart, the window of `second` with `first` moved by
    -L. It does
    not have this error around L = 0, and swapping the volumes negates its displacements.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
        Finite volumes of equal shape.
    window, step : tuple of int
        Window edges and their distance, order (z, y, x) [voxel].
    search : tuple of int
        Largest lag per axis, >= 2; peaks are found up to ``search - 1`` [voxel].
    symmetric : bool
        Use the symmetric coefficient, at twice the cost.
    reach : int
        Lags around the highest coefficient that belong to its peak, >= 1: the rival lies farther along some axis, the
        second peak at least as far.

    Returns
    -------
    WindowPeaks
        On the grid of `window_grid`.

    Raises
    ------
    ValueError
        If shapes differ, values are not finite, a window does not fit, `search` is below 2, or `reach` below 1.
    """
    if first.shape != second.shape or first.ndim != 3:
        shapes = f"{first.shape} and {second.shape}"
        raise ValueError(f"second: expected two volumes of equal shape (z, y, x), got {shapes}.")
    if reach < 1:
        raise ValueError(f"reach: expected a whole number >= 1, got {reach}.")
    plan = make_plan(first.shape, window, step, search)
    return correlate_by_plan(plan, first, second, symmetric=symmetric, reach=reach)


def correlate_by_plan(
    plan: Plan, first: Values, second: Values, *, symmetric: bool, reach: int = PEAK_REACH
) -> WindowPeaks:
    """Do what `correlate_windows` does, by a given plan for the volumes' shape."""
    volumes = on_device(first), on_device(second)
    moments = means_and_squares(volumes)
    for name, (_, total) in zip(("first", "second"), moments, strict=True):
        if not math.isfinite(total):
            raise ValueError(f"{name}: expected finite values whose squares add up to a float32, got others.")
    free_memory()
    searches = (plan.search if symmetric else (0, 0, 0)), plan.search
    peaks = _find_peaks(plan, make_sides(plan, volumes, moments, searches), symmetric, reach)
    return WindowPeaks(
        displacement=np.moveaxis(peaks[:3], 0, -1).copy(),
        second_displacement=np.moveaxis(peaks[3:6], 0, -1).copy(),
        correlation=peaks[6].copy(),
        rival=peaks[7].copy(),
        measured=np.isfinite(peaks[0]),
    )


def _find_peaks(plan: Plan, sides: tuple[Side, Side], symmetric: bool, reach: int) -> np.ndarray:
    """Two displacements (z, y, x), highest coefficient and its rival of all windows, (8, z, y, x)."""
    depth = _slab_depth(plan, symmetric)
    ring = (depth - 1) * plan.block_step[0] + plan.block_count[0]
    past = plan.block_count[1] * plan.pitch + plan.block_count[2] + 2 * LANES  # read by lanes that hold no window
    sums = [new_array(ring * math.prod(plan.lags) * plan.lanes + past) for _ in range(1 + symmetric)]
    finder = PeakFinder.prepare(plan, sides, symmetric, reach, ring, depth)
    if plan.spectral:
        products = SpectralProducts.prepare(plan, ring, max(side.surroundings.plane for side in sides))
    else:
        products = DirectProducts.prepare(plan, ring)
    for windows, blocks in _slabs(plan, depth):
        for direction, (first, second) in zip(sums, (sides, sides[::-1]), strict=False):
            products.sum(first.blocks, second.surroundings, blocks, direction)
            if is_gathered(plan):
                gather(plan, blocks, ring, direction)
        finder.find(sums[0], sums[-1], windows)
    return finder.values()


def _slab_depth(plan: Plan, symmetric: bool) -> int:
    """Layers of windows whose sums of products fit into `SLAB_BYTES`; at least 1."""
    layer_bytes = 4 * (1 + symmetric) * math.prod(plan.lags) * plan.lanes
    return min(plan.count[0], max(1, (SLAB_BYTES // layer_bytes - plan.block_count[0]) // plan.block_step[0] + 1))


def _slabs(plan: Plan, depth: int) -> Iterator[tuple[range, range]]:
    """Layers of windows of each slab, and the layers of blocks that they need and no slab before them did."""
    done, step = 0, plan.block_step[0]
    for begin in range(0, plan.count[0], depth):
        end = min(begin + depth, plan.count[0])
        blocks = range(max(done, begin * step), (end - 1) * step + plan.block_count[0])
        yield range(begin, end), blocks
        done = blocks.stop
