"""Means over windows of a volume, and the middle of what they hold, brought to the host: a value per window."""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import filters_gpu
from lfpiv_kernels.correlation.fluid import as_numbers, flags_on_device
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.correlation.plan import Triple
from lfpiv_kernels.transfer import Values, to_host


def window_means(values: Values, window: Triple, origin: Triple, step: Triple, count: Triple) -> np.ndarray:
    """Return the mean over each window, of flags the share, shape `count`, float64.

    Parameters
    ----------
    values : array, shape (z, y, x), of bool or float32
    window, origin, step, count : tuple of int
        Window edges, first voxel of the first window, distance and number of windows, order (z, y, x).
    """
    if runtime.device().form == "gpu":
        taps = tuple(np.ones(edge) for edge in window)
        sums = to_host(filters_gpu.window_sums(_numbers(values), origin, step, count, taps))
        return sums.astype(float) / math.prod(window)
    mean = to_host(values).astype(float)
    for axis, (edge, start) in enumerate(zip(window, _first_voxels(origin, step, count), strict=True)):
        below = np.insert(mean.cumsum(axis), 0, 0, axis)
        mean = (below.take(start + edge, axis) - below.take(start, axis)) / edge
    return mean


def window_middles(flags: Values, window: Triple, origin: Triple, step: Triple, count: Triple) -> np.ndarray:
    """Return the mean place of the flagged voxels of each window, shape (*count, 3) [voxel].

    It is NaN for windows without any. Parameters are those of `window_means`.
    """
    layout = window, origin, step, count
    share = window_means(flags, *layout)
    if runtime.device().form == "gpu":
        numbers = _numbers(flags)
        moments = [_moment(numbers, axis, *layout) for axis in range(3)]
    else:
        known = to_host(flags)
        moments = [window_means(known * _places(known.shape, axis), *layout) for axis in range(3)]
    with np.errstate(invalid="ignore", divide="ignore"):
        middles = np.stack(moments, -1) / share[..., None]
    return np.where(share[..., None] > 0, middles, np.nan)


def _moment(numbers: wp.array, axis: int, window: Triple, origin: Triple, step: Triple, count: Triple) -> np.ndarray:
    """Return the mean over each window of numbers times their place along an axis."""
    taps = [np.ones(edge) for edge in window]
    inside = window_means(numbers, window, origin, step, count)
    taps[axis] = np.arange(window[axis])  # from the window's first voxel on: whole numbers that floats hold
    sums = to_host(filters_gpu.window_sums(numbers, origin, step, count, tuple(taps))).astype(float)
    first = _first_voxels(origin, step, count)[axis].reshape([-1 if k == axis else 1 for k in range(3)])
    return sums / math.prod(window) + first * inside


def _numbers(values: Values) -> wp.array:
    """Return values on the device as float32."""
    if values.dtype == (wp.bool if isinstance(values, wp.array) else bool):
        return on_device(as_numbers(flags_on_device(values)))
    return on_device(values)


def _places(shape: tuple[int, ...], axis: int) -> np.ndarray:
    return np.arange(shape[axis]).reshape([-1 if k == axis else 1 for k in range(3)])


def _first_voxels(origin: Triple, step: Triple, count: Triple) -> list[np.ndarray]:
    return [first + apart * np.arange(number) for first, apart, number in zip(origin, step, count, strict=True)]
