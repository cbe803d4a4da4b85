"""Part of a volume that holds no particles, found from the light of both volumes.

The mean light about a place, taken over many particles, is compared with that where most of the moving light is, so
that a reflection that outshines the particles does not make their places dark. A place counts as empty only if it is
nearly dark: the edge of a light sheet is dimmer than its middle, not empty. Ghost particles beside the seeded region
have some percent of its light.

Means of the first volume over coarse cells come first. Where there is light in all of them, no finer look is needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

PARTICLES = 64
"""Number of particles over which light is averaged. At a corner of the volume an eighth of them is left."""
DARK = 0.05
"""Largest mean light of an empty place, as a share of that where most of the moving light is."""
EDGE, REACH = 0.5, 2.0
"""Largest mean light of an empty place around nearly dark ones, and its largest distance from them [standard deviation
of the Gaussian mean]. At a straight edge the mean falls to a half, and to `DARK` 1.645 standard deviations beyond it,
or farther where ghosts stand beside the edge."""
BRIGHT = 95
"""Percentile of the local maxima to which intensities are limited, so that reflections weigh little."""
CELLS = 2.0
"""Least standard deviation of the mean, in cells of the grid on which it is taken."""
SURE = 4.0
"""Least mean light of the first volume over coarse cells that shows particles everywhere, as a multiple of `DARK` of
the brightest mean. The mean of both volumes is then above twice `DARK`."""
SAMPLE, FEWEST_PLANES, FEWEST_PEAKS = 1 << 16, 4, 256
"""Local maxima are sought in so many voxels first, and in so many planes at least. All voxels are searched if fewer
maxima than the third value are found there."""
_TINY = float(np.finfo(np.float32).tiny)


def unseeded_voxels(volumes: Sequence[np.ndarray], without: np.ndarray | None = None) -> np.ndarray | None:
    """Find the voxels of a pair of volumes around which there are no particles.

    Parameters
    ----------
    volumes : sequence of ndarray, shape (z, y, x)
        Both volumes without background; negative intensities count as 0.
    without : ndarray of bool, shape (z, y, x), optional
        Voxels that hold no fluid or are not seen. They are left out of the means.

    Returns
    -------
    ndarray of bool, shape (z, y, x), or None
        True where there are no particles; None if there are some everywhere, or no light at all.
    """
    shape = volumes[0].shape
    if min(shape) < 3:
        return None
    usable = None if without is None else (~without).astype(np.float32)
    inner = (slice(1, -1),) * 3  # where peaks are
    extent = float(math.prod(n - 2 for n in shape) if usable is None else usable[inner].sum())
    lights, counts = [], []
    for volume in volumes:
        light = volume if usable is None else volume * usable
        limit, count = _particles(light)
        if not count:
            return None
        lights.append(np.clip(light, 0, limit))
        counts.append(count)
        if len(lights) == 1 and _lit_everywhere(lights[0], usable, _averaging(extent, count)):
            return None
    sigma = _averaging(extent, min(counts))
    cell = max(1, int(sigma / CELLS))
    binned = [_binned(light, cell) for light in lights]
    room = np.ones_like(binned[0]) if usable is None else _binned(usable, cell)
    moving = _binned(_moving(lights), cell)
    level = _level(binned, moving, room, sigma / cell)
    filled = float((level * room).sum() ** 2 / (level**2 * room).sum() / room.sum())
    sigma = _averaging(extent * filled, min(counts))  # particles are closer where they do not fill the volume
    level = _level(binned, moving, room, sigma / cell)
    core = (level < DARK) & (room > 0)
    if not core.any():
        return None
    empty = (level < EDGE) & (ndimage.distance_transform_edt(~core) <= REACH * sigma / cell)
    nearest = (np.minimum(np.arange(n) // cell, m - 1) for n, m in zip(shape, empty.shape, strict=True))
    return empty[np.ix_(*nearest)]


def _particles(light: np.ndarray) -> tuple[np.float32, float]:
    """Return the limit of intensities, and the number of particles of equal light; 0 without any."""
    planes = light.shape[0] - 2
    step = max(1, min(light.size // SAMPLE, planes // FEWEST_PLANES))
    peaks = _peaks(light, step)
    if peaks.size < FEWEST_PEAKS and step > 1:
        step, peaks = 1, _peaks(light, 1)
    if not peaks.size:
        return np.float32(0), 0.0
    limit = np.float32(np.percentile(peaks, BRIGHT))
    peaks = np.minimum(peaks, limit).astype(float)
    return limit, float(peaks.sum() ** 2 / np.square(peaks).sum()) * planes / len(range(step // 2, planes, step))


def _peaks(light: np.ndarray, step: int) -> np.ndarray:
    """Return the intensities above 0 that none of the 26 neighbours exceeds, shape (peak,), of every `step`th plane.

    There are none at the border.
    """
    first = 1 + step // 2
    middle = light[first:-1:step]
    peak = np.zeros(middle.shape, bool)
    peak[:, 1:-1, 1:-1] = middle[:, 1:-1, 1:-1] > 0
    peak &= (middle >= light[first - 1 : -2 : step]) & (middle >= light[first + 1 :: step])  # most voxels fail here
    for axis in (1, 2):
        along, values = np.moveaxis(peak, axis, 0), np.moveaxis(middle, axis, 0)
        along[1:] &= values[1:] >= values[:-1]
        along[:-1] &= values[:-1] >= values[1:]
    plane, within = np.divmod(np.flatnonzero(peak), math.prod(light.shape[1:]))
    at = (first + step * plane) * math.prod(light.shape[1:]) + within
    steps = [np.ravel_multi_index(near, (3,) + light.shape[1:]) for near in np.ndindex(3, 3, 3)]
    flat = light.ravel()
    found: np.ndarray = flat[at]
    highest = np.all([found >= flat[at + step - steps[13]] for step in steps], axis=0)
    return found[highest]


def _lit_everywhere(light: np.ndarray, usable: np.ndarray | None, sigma: float) -> bool:
    """Return whether the mean over coarse cells is well above `DARK` of the brightest mean in every usable cell."""
    cell = max(1, int(sigma))
    room = None if usable is None else _binned(usable, cell)
    mean = _mean(_binned(light, cell), room, sigma / cell)
    if room is not None:
        mean = mean[room > 0]
    return bool(mean.size and mean.min() >= SURE * DARK * mean.max())


def _averaging(extent: float, count: float) -> float:
    """Return the standard deviation of a Gaussian mean that holds `PARTICLES` of `count` in `extent` voxels [voxel]."""
    return float(np.cbrt(PARTICLES * extent / count)) / math.sqrt(4 * math.pi)


def _moving(lights: Sequence[np.ndarray]) -> np.ndarray:
    """Return the difference of both volumes, each relative to its sum; their mean if they are equal."""
    one, other = (light / max(float(light.sum(dtype=np.float64)), _TINY) for light in lights)
    difference: np.ndarray = np.abs(one - other)
    return difference if difference.any() else one


def _level(lights: Sequence[np.ndarray], moving: np.ndarray, room: np.ndarray, sigma: float) -> np.ndarray:
    """Return the mean light about each cell relative to that where most of the moving light is, mean of the volumes."""
    level = np.zeros_like(room)
    for light in lights:
        mean = _mean(light, room, sigma)
        level += mean / _weighted_median(mean, moving) / len(lights)
    return level


def _mean(light: np.ndarray, room: np.ndarray | None, sigma: float) -> np.ndarray:
    """Return the Gaussian mean about each cell over its usable part, `room`; None: all of it."""
    mean: np.ndarray = ndimage.gaussian_filter(light, sigma, mode="nearest")
    return mean if room is None else mean / np.maximum(ndimage.gaussian_filter(room, sigma, mode="nearest"), _TINY)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value below which half of the weight lies."""
    order = np.argsort(values, axis=None)
    below = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order[np.searchsorted(below, below[-1] / 2)]])


def _binned(values: np.ndarray, cell: int) -> np.ndarray:
    """Return the means over cells of `cell` voxels along each axis; the last one of an axis may be longer."""
    for axis, n in enumerate(values.shape):
        parts = np.split(values, cell * np.arange(1, max(n // cell, 1)), axis)
        values = np.stack([part.mean(axis) for part in parts], axis)
    return values
