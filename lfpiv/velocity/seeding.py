"""Part of a volume that holds no particles, found from the light of both volumes.

The mean light about a place, taken over many particles, is compared with that where most of the moving light is, so
that a reflection that outshines the particles does not make their places dark. A place counts as empty only if it is
nearly dark: the edge of a light sheet is dimmer than its middle, not empty. Ghost particles beside the seeded region
have some percent of its light.
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
EDGE = 1.645
"""Distance from a straight edge at which a Gaussian mean falls to `DARK`, as a multiple of its standard deviation."""
BRIGHT = 95
"""Percentile of the local maxima to which intensities are limited, so that reflections weigh little."""
CELLS = 2.0
"""Least standard deviation of the mean, in cells of the grid on which it is taken."""


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
    usable = np.ones(shape, np.float32) if without is None else (~without).astype(np.float32)
    lights, counts = [], []
    for volume in volumes:
        light = np.maximum(volume, 0) if without is None else np.maximum(volume, 0) * usable
        peaks = _peaks(light)
        if not peaks.size:
            return None
        limit = np.float32(np.percentile(peaks, BRIGHT))
        peaks = np.minimum(peaks, limit).astype(float)
        lights.append(np.minimum(light, limit))
        counts.append(float(peaks.sum() ** 2 / np.square(peaks).sum()))  # particles of equal light
    extent = float(usable[1:-1, 1:-1, 1:-1].sum())  # where peaks are
    sigma = _averaging(extent, min(counts))
    cell = max(1, int(sigma / CELLS))
    binned, room = [_binned(light, cell) for light in lights], _binned(usable, cell)
    moving = _binned(_moving(lights), cell)
    level = _level(binned, moving, room, sigma / cell)
    filled = float((level * room).sum() ** 2 / (level**2 * room).sum() / room.sum())
    sigma = _averaging(extent * filled, min(counts))  # particles are closer where they do not fill the volume
    core = (_level(binned, moving, room, sigma / cell) < DARK) & (room > 0)
    if not core.any():
        return None
    empty = ndimage.distance_transform_edt(~core) <= EDGE * sigma / cell
    nearest = (np.minimum(np.arange(n) // cell, m - 1) for n, m in zip(shape, empty.shape, strict=True))
    flags: np.ndarray = empty[np.ix_(*nearest)]
    return flags


def _peaks(light: np.ndarray) -> np.ndarray:
    """Return the intensities above 0 that none of the 26 neighbours exceeds, shape (peak,); none at the border."""
    peak = np.zeros(light.shape, bool)
    inner = (slice(1, -1),) * 3
    peak[inner] = light[inner] > 0
    for axis in range(3):  # most voxels fail here, without the cost of 26 comparisons
        along, values = np.moveaxis(peak, axis, 0), np.moveaxis(light, axis, 0)
        along[1:] &= values[1:] >= values[:-1]
        along[:-1] &= values[:-1] >= values[1:]
    at = np.flatnonzero(peak)
    steps = [np.ravel_multi_index(near, (3,) + light.shape[1:]) for near in np.ndindex(3, 3, 3)]
    flat = light.ravel()
    found: np.ndarray = flat[at]
    highest = np.all([found >= flat[at + step - steps[13]] for step in steps], axis=0)
    peaks: np.ndarray = found[highest]
    return peaks


def _averaging(extent: float, count: float) -> float:
    """Return the standard deviation of a Gaussian mean that holds `PARTICLES` of `count` in `extent` voxels [voxel]."""
    return float(np.cbrt(PARTICLES * extent / count)) / math.sqrt(4 * math.pi)


def _moving(lights: Sequence[np.ndarray]) -> np.ndarray:
    """Return the difference of both volumes, each relative to its sum; their mean if they are equal."""
    one, other = (light / max(float(light.sum(dtype=np.float64)), np.finfo(np.float32).tiny) for light in lights)
    difference: np.ndarray = np.abs(one - other)
    return difference if difference.any() else one


def _level(lights: Sequence[np.ndarray], moving: np.ndarray, room: np.ndarray, sigma: float) -> np.ndarray:
    """Return the mean light about each cell relative to that where most of the moving light is, mean of the volumes."""
    share = np.maximum(ndimage.gaussian_filter(room, sigma, mode="nearest"), np.finfo(np.float32).tiny)
    level = np.zeros_like(room)
    for light in lights:
        mean = ndimage.gaussian_filter(light, sigma, mode="nearest") / share
        level += mean / _weighted_median(mean, moving) / len(lights)
    return level


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value below which half of the weight lies."""
    order = np.argsort(values, axis=None)
    below = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order[np.searchsorted(below, below[-1] / 2)]])


def _binned(values: np.ndarray, cell: int) -> np.ndarray:
    """Return the means over cells of `cell` voxels along each axis; the last one of an axis may be longer."""
    for axis, n in enumerate(values.shape):
        count = max(n // cell, 1)
        own = np.minimum(np.arange(n) // cell, count - 1) == np.arange(count)[:, None]  # (cell, voxel)
        mean = (own / own.sum(1, keepdims=True)).astype(np.float32)
        values = np.moveaxis(np.tensordot(mean, values, (1, axis)), 0, axis)
    return values
