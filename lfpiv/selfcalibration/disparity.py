"""Disparity: how far apart two cameras show the same particles, in parts of a volume.

Each camera alone shows every particle, drawn out along its own view; where two cameras' volumes match best is their
disparity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter

from lfpiv.reconstruction.volume import reconstruct

if TYPE_CHECKING:
    from lfpiv.geometry.grid import Grid
    from lfpiv.weights.operator import Weights

ITERATIONS = 10
"""SMART iterations of each camera's own volume: lateral positions are there after a few."""
SMOOTHING_VOXEL = 1.0
"""Standard deviation of the Gaussian that volumes are smoothed by before they are correlated [voxel]."""
SEARCH_VOXEL = 16
"""Largest disparity searched for along each axis [voxel]."""
MIDDLE_VOXEL = 128
"""Largest edge of the middle of the volume, which is asked first, all of it where it is smaller."""
NEAR_VOXEL = 4
"""Largest distance of a window's disparity from that of the middle along each axis: a chance peak elsewhere is no match
[voxel]."""
WINDOW_VOXEL, MOST_WINDOWS = 12, 3
"""Least edge of the windows into which the volume is cut, and how many there are along an axis at most: a rigid
movement needs no more."""
LEAST_OVERLAP = 0.6
"""Least part of a window that must lie within the other volume at a lag."""
FIT_REACH = 2
"""Lags to either side of the highest one that a peak's paraboloid is fitted to."""
SIGNIFICANT = 1.5
"""Least height of a peak over the highest one where one volume is mirrored, which no particle explains."""


@dataclass(frozen=True, kw_only=True)
class Disparity:
    """Disparity of two cameras in one part of the volume."""

    cameras: tuple[str, str]
    centre_mm: np.ndarray
    """Centre of the part, shape (3,) [mm]."""
    shift_mm: np.ndarray
    """Where the second camera shows what the first one shows at 0, shape (3,) [mm]."""
    sharpness: np.ndarray
    """Curvature of the peak over its height, shape (3, 3) [1/mm^2]: large where the views cross, small along both."""
    peak: float
    """Correlation coefficient."""
    rival: float
    """Highest coefficient with one volume mirrored."""

    @cached_property
    def weight(self) -> np.ndarray:
        """What a direction counts for, at most 1, shape (3, 3).

        The error of a peak grows with its width, and faster: along the views particles disturb each other's.
        """
        relative = self.sharpness / np.linalg.eigvalsh(self.sharpness)[-1]
        weight: np.ndarray = relative @ relative
        return weight

    def told_mm(self, shift_mm: np.ndarray) -> float:
        """Length of the part of a shift that the views tell [mm]."""
        return float(np.sqrt(shift_mm @ self.weight @ shift_mm))


def disparities(
    weights: Weights,
    images: Sequence[Mapping[str, np.ndarray]],
    progress: Callable[[float], None] | None = None,
) -> tuple[Disparity, ...]:
    """Measure the disparities of all pairs of cameras in the parts of a volume, but for those that nothing tells.

    Parameters
    ----------
    weights : Weights
        Of two cameras or more.
    images : sequence of dict
        Particle images of some instants, camera name -> image (rows, columns), background removed.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    tuple of Disparity
        Empty where no part of the volume shows the same particles in any two cameras.
    """
    names, grid = list(weights.cameras), weights.grid
    alone: dict[str, list[np.ndarray]] = {}
    for number, name in enumerate(names):
        one, alone[name] = weights.of_camera(name), []
        for place, instant in enumerate(images):
            if progress is not None:
                progress((number + place / len(images)) / len(names))
            volume = reconstruct(one, {name: instant[name]}, ITERATIONS).values
            alone[name].append(gaussian_filter(volume, SMOOTHING_VOXEL, mode="constant"))
    found = []
    middle = tuple(slice((n - m) // 2, (n + m) // 2) for n in grid.shape for m in [min(n, MIDDLE_VOXEL)])
    for pair in combinations(names, 2):
        volumes = alone[pair[0]], alone[pair[1]]
        of_all = _disparity(volumes, middle, grid, pair)
        if of_all is not None:
            parts = [_disparity(volumes, window, grid, pair, near_mm=of_all.shift_mm) for window in _windows(grid)]
            found += [part for part in parts if part is not None] or [of_all]
    return tuple(found)


def unlinked(found: Sequence[Disparity], cameras: Iterable[str]) -> list[str]:
    """Name the cameras that show no particles of any other one."""
    linked = {name for one in found for name in one.cameras}
    return [name for name in cameras if name not in linked]


def _windows(grid: Grid) -> list[tuple[slice, ...]]:
    """Parts of the volume, (z, y, x)."""
    counts = [int(np.clip(edge // WINDOW_VOXEL, 1, MOST_WINDOWS)) for edge in grid.shape]
    edges = [np.linspace(0, edge, count + 1).astype(int) for edge, count in zip(grid.shape, counts, strict=True)]
    return [
        tuple(slice(int(edge[i]), int(edge[i + 1])) for edge, i in zip(edges, place, strict=True))
        for place in np.ndindex(*counts)
    ]


def _disparity(
    volumes: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
    window: tuple[slice, ...],
    grid: Grid,
    cameras: tuple[str, str],
    near_mm: np.ndarray | None = None,
) -> Disparity | None:
    """Disparity of two cameras' volumes in a window, near another one where given; None where no peak tells it."""
    first, second = volumes
    coefficient = _coefficients(first, second, window)
    mirrored = _coefficients(first, [volume[:, ::-1] for volume in second], _mirror(window, grid.shape[1]))
    low, high = np.zeros(3, int), np.full(3, 2 * SEARCH_VOXEL)
    if near_mm is not None:
        centre = np.rint(near_mm[::-1] / grid.voxel_mm).astype(int) + SEARCH_VOXEL
        low, high = np.maximum(centre - NEAR_VOXEL, low), np.minimum(centre + NEAR_VOXEL, high)
    searched = tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))
    place = low + np.unravel_index(int(coefficient[searched].argmax()), coefficient[searched].shape)
    peak, rival = float(coefficient[tuple(place)]), float(mirrored[searched].max())
    if not peak >= SIGNIFICANT * rival or not ((place > low) & (place < high)).all():
        return None
    middle = np.clip(place, FIT_REACH, 2 * SEARCH_VOXEL - FIT_REACH)
    around = coefficient[tuple(slice(i - FIT_REACH, i + FIT_REACH + 1) for i in middle)]
    steps = np.indices(around.shape).reshape(3, -1) - FIT_REACH
    z, y, x = steps
    design = np.stack([np.ones(steps.shape[1]), z, y, x, z * z, y * y, x * x, z * y, z * x, y * x], axis=1)
    _, *slope, zz, yy, xx, zy, zx, yx = np.linalg.lstsq(design, around.ravel(), rcond=None)[0]
    curvature = -np.array([[2 * xx, yx, zx], [yx, 2 * yy, zy], [zx, zy, 2 * zz]])  # order x, y, z from here on
    if not np.linalg.eigvalsh(curvature)[0] > 0:
        return None
    offset = np.linalg.solve(curvature, slope[::-1])
    lag = middle[::-1] - SEARCH_VOXEL + np.clip(offset, -FIT_REACH, FIT_REACH)
    corner = [grid.axis_mm(axis)[part.start : part.stop] for axis, part in enumerate(window)]
    return Disparity(
        cameras=cameras,
        centre_mm=np.array([values.mean() for values in reversed(corner)]),
        shift_mm=lag * grid.voxel_mm,
        sharpness=curvature / peak / grid.voxel_mm**2,
        peak=peak,
        rival=rival,
    )


def _mirror(window: tuple[slice, ...], edge: int) -> tuple[slice, ...]:
    """Window on the same voxels of a volume that is mirrored along y."""
    z, y, x = window
    return z, slice(edge - y.stop, edge - y.start), x


def _coefficients(first: Sequence[np.ndarray], second: Sequence[np.ndarray], window: tuple[slice, ...]) -> np.ndarray:
    """Correlation coefficient of a window of some volumes with others at every lag, shape (z, y, x).

    Outside the volume nothing is known: each lag counts the voxels only that both know (masked normalised
    cross-correlation, Padfield 2012).
    """
    reach = SEARCH_VOXEL
    inner = tuple(part.stop - part.start for part in window)
    shape = [scipy.fft.next_fast_len(n + 2 * reach, real=True) for n in inner]

    def around(volume: np.ndarray) -> np.ndarray:
        out = np.zeros([n + 2 * reach for n in inner])
        low = [max(part.start - reach, 0) for part in window]
        high = [min(part.stop + reach, n) for part, n in zip(window, volume.shape, strict=True)]
        at = [a - (part.start - reach) for a, part in zip(low, window, strict=True)]
        to = tuple(slice(p, p + b - a) for p, a, b in zip(at, low, high, strict=True))
        out[to] = volume[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        return out

    def spectrum(values: np.ndarray) -> np.ndarray:
        transformed: np.ndarray = scipy.fft.rfftn(values, shape)
        return transformed

    def summed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        lags: np.ndarray = scipy.fft.irfftn(a.conj() * b, shape)
        return lags[tuple(slice(0, 2 * reach + 1) for _ in shape)]

    whole, known = spectrum(np.ones(inner)), spectrum(around(np.ones(second[0].shape)))
    count = np.maximum(summed(whole, known), 1.0)
    products, spread, other = (np.zeros(count.shape) for _ in range(3))
    for one, two in zip(first, second, strict=True):
        a = one[window].astype(float)
        b = around(two)
        a, b = a / max(a.std(), np.finfo(float).tiny), b / max(b.std(), np.finfo(float).tiny)
        a_, b_ = spectrum(a), spectrum(b)
        sum_a, sum_b = summed(a_, known), summed(whole, b_)
        products += summed(a_, b_) - sum_a * sum_b / count
        spread += summed(spectrum(a * a), known) - sum_a**2 / count
        other += summed(whole, spectrum(b * b)) - sum_b**2 / count
    scale = np.sqrt(np.maximum(spread, 0) * np.maximum(other, 0))
    enough = (count >= LEAST_OVERLAP * count.max()) & (scale > 1e-9 * scale.max())
    coefficient: np.ndarray = np.divide(products, scale, out=np.zeros_like(scale), where=enough)
    return coefficient
