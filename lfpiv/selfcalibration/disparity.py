"""Disparity: distance between the positions at which two cameras show the same particles, in parts of a volume.

The volume reconstructed from the images of a single camera shows every particle, elongated along the camera's line of
sight. The displacement at which the volumes of two cameras correlate best is their disparity. Input: weights and
particle images of some instants. Output: a `Disparity` per pair of cameras and part of the volume.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter

from lfpiv.progress import StepProgress
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver

if TYPE_CHECKING:
    from lfpiv.geometry.grid import Grid
    from lfpiv.weights.operator import Weights

ITERATIONS = 10
"""SMART iterations of the volume of a single camera."""
SMOOTHING_VOXEL = 1.0
"""Standard deviation of the Gaussian that smooths volumes before they are correlated [voxel]."""
SEARCH_VOXEL = 16
"""Largest disparity along each axis [voxel]."""
MIDDLE_VOXEL = 128
"""Largest edge of the middle part of the volume, which is correlated first [voxel]."""
NEAR_VOXEL = 4
"""Largest distance of a window's disparity from that of the middle part along each axis [voxel]. Peaks farther away are
chance peaks."""
WINDOW_VOXEL, MOST_WINDOWS = 12, 3
"""Least edge of the windows into which the volume is cut [voxel], and their largest number along an axis."""
LEAST_OVERLAP = 0.6
"""Least share of a window that must lie within the other volume at a lag."""
FIT_REACH = 2
"""Lags on either side of the highest one to which a peak's paraboloid is fitted."""
SIGNIFICANT = 1.5
"""Least ratio of a peak to the highest coefficient with one volume mirrored, which is due to chance."""


@dataclass(frozen=True, kw_only=True)
class Disparity:
    """Disparity of two cameras in one part of the volume."""

    cameras: tuple[str, str]
    centre_mm: np.ndarray
    """Centre of the part, shape (3,) [mm]."""
    shift_mm: np.ndarray
    """Position in the second camera's volume of a particle at 0 in the first camera's, shape (3,) [mm]."""
    sharpness: np.ndarray
    """Curvature of the peak over its height, shape (3, 3) [1/mm^2]: small along the lines of sight, large across."""
    peak: float
    """Correlation coefficient."""
    rival: float
    """Highest coefficient with one volume mirrored."""

    @property
    def weight(self) -> np.ndarray:
        """Weight of each direction in a fit, at most 1, shape (3, 3): the square of the relative sharpness.

        The error of a peak grows faster than its width, because elongated particles disturb each other's peaks.
        """
        relative = self.sharpness / np.linalg.eigvalsh(self.sharpness)[-1]
        weight: np.ndarray = relative @ relative
        return weight

    def observable_mm(self, shift_mm: np.ndarray) -> float:
        """Return the length of the part of a shift that the cameras can observe [mm]."""
        return float(np.sqrt(shift_mm @ self.weight @ shift_mm))


def disparities(
    weights: Weights,
    images: Sequence[Mapping[str, np.ndarray]],
    progress: StepProgress | None = None,
) -> tuple[Disparity, ...]:
    """Measure the disparities of all pairs of cameras in the parts of a volume that have a clear peak.

    Parameters
    ----------
    weights : Weights
        The operator of two or more cameras.
    images : sequence of dict
        Particle images of some instants, camera name -> image (rows, columns), background removed.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    tuple of Disparity
        Empty if no two cameras show the same particles in any part of the volume.
    """
    names, grid = list(weights.cameras), weights.grid
    by_camera: dict[str, list[np.ndarray]] = {}
    for number, name in enumerate(names):
        solver, by_camera[name] = SmartSolver(weights.of_camera(name), SmartSettings(iterations=ITERATIONS)), []
        for place, instant in enumerate(images):
            if progress is not None:
                progress((number + place / len(images)) / len(names))
            volume = solver.solve({name: instant[name]}).volume
            by_camera[name].append(gaussian_filter(volume, SMOOTHING_VOXEL, mode="constant"))
    found = []
    middle = tuple(slice((n - m) // 2, (n + m) // 2) for n in grid.shape for m in [min(n, MIDDLE_VOXEL)])
    for pair in combinations(names, 2):
        volumes = by_camera[pair[0]], by_camera[pair[1]]
        in_middle = _disparity(volumes, middle, grid, pair)
        if in_middle is not None:
            parts = [_disparity(volumes, window, grid, pair, near_mm=in_middle.shift_mm) for window in _windows(grid)]
            found += [part for part in parts if part is not None] or [in_middle]
    return tuple(found)


def unlinked(found: Sequence[Disparity], cameras: Iterable[str]) -> list[str]:
    """Name the cameras that share no particles with any other one."""
    linked = {name for one in found for name in one.cameras}
    return [name for name in cameras if name not in linked]


def _windows(grid: Grid) -> list[tuple[slice, ...]]:
    """Cut the volume into windows, (z, y, x)."""
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
    """Measure the disparity of two cameras' volumes in a window; None if there is no clear peak.

    `near_mm` limits the search to `NEAR_VOXEL` around another disparity.
    """
    first, second = volumes
    coefficient = masked_correlation(first, second, window)
    mirrored = masked_correlation(first, [volume[:, ::-1] for volume in second], _mirror(window, grid.shape[1]))
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
    """Return the window of the same voxels in a volume that is mirrored along y."""
    z, y, x = window
    return z, slice(edge - y.stop, edge - y.start), x


def masked_correlation(
    first: Sequence[np.ndarray], second: Sequence[np.ndarray], window: tuple[slice, ...]
) -> np.ndarray:
    """Correlate a window of volumes with other volumes at every lag: masked normalised cross-correlation [1]_.

    At each lag only voxels inside both volumes count.

    Parameters
    ----------
    first, second : sequence of ndarray, shape (z, y, x)
        Volumes of some instants. Their products are summed over the instants.
    window : tuple of slice
        Voxels of `first`.

    Returns
    -------
    ndarray, shape (2 SEARCH_VOXEL + 1,) * 3
        Correlation coefficients, lag -`SEARCH_VOXEL` first; 0 where less than `LEAST_OVERLAP` of the window counts.

    References
    ----------
    .. [1] D. Padfield, "Masked object registration in the Fourier domain", IEEE Trans. Image Process. 21 (2012)
       2706-2718, doi:10.1109/TIP.2011.2181402.
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
