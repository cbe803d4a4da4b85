"""Intensities of volumes: smoothed, raised to a power, less their local mean, relative to their mean."""

import numpy as np
import warp as wp
from scipy import ndimage

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import filters_gpu
from lfpiv_kernels.correlation.memory import empty_volume, on_device
from lfpiv_kernels.correlation.plan import Triple
from lfpiv_kernels.correlation.sums import means_and_squares
from lfpiv_kernels.filters import blur
from lfpiv_kernels.launch import over_voxels
from lfpiv_kernels.transfer import Given, as_given, to_host

TINY = float(np.finfo(np.float32).tiny)
"""Least mean that light is divided by."""


wp.set_module_options(native.quiet_options())


@wp.kernel
def _as_power(
    # in
    volume: wp.array3d(dtype=float),
    exponent: float,
    begin: int,
    # out
    power_out: wp.array3d(dtype=float),  # negative intensities as 0
):
    layer, y, x = wp.tid()
    z = begin + layer
    value = wp.max(volume[z, y, x], 0.0)
    if exponent != 1.0:
        value = wp.pow(value, exponent)
    power_out[z, y, x] = value


@wp.kernel
def _subtract(
    # in
    one: wp.array3d(dtype=float),
    other: wp.array3d(dtype=float),
    begin: int,
    # out
    difference_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    difference_out[z, y, x] = one[z, y, x] - other[z, y, x]


@wp.kernel
def _share_light(
    # in
    one: wp.array3d(dtype=float),
    other: wp.array3d(dtype=float),
    scale_one: float,
    scale_other: float,
    begin: int,
    # out
    least_out: wp.array3d(dtype=float),
    mean_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    first = one[z, y, x] * scale_one
    second = other[z, y, x] * scale_other
    least_out[z, y, x] = wp.min(first, second)
    mean_out[z, y, x] = (first + second) / 2.0


def smoothed(volume: Given, sigma: float) -> Given:
    """Smooth a volume by a Gaussian of a standard deviation [voxel]; voxels outside count as 0."""
    if runtime.device().form == "gpu":
        return as_given(filters_gpu.smoothed(on_device(volume), sigma), volume)
    values = np.ascontiguousarray(to_host(volume), np.float32)
    return as_given(blur.smoothing(sigma, values.shape)(values.ravel()).reshape(values.shape), volume)


def powered(volume: Given, exponent: float | np.floating) -> Given:
    """Raise the intensities of a volume to a power, negative ones as 0."""
    if runtime.device().form == "gpu":
        values = on_device(volume)
        power = empty_volume(values.shape)
        over_voxels(_as_power, [values, float(exponent)], power)
        return as_given(power, volume)
    return as_given(np.maximum(to_host(volume), 0) ** exponent, volume)


def fluctuation(volume: Given, window: Triple) -> Given:
    """Return a volume less its mean over a window around each voxel; it is continued by its image in its faces."""
    if runtime.device().form == "gpu":
        values = on_device(volume)
        mean = filters_gpu.local_mean(values, window, filters_gpu.REFLECTED)
        difference = empty_volume(values.shape)
        over_voxels(_subtract, [values, mean], difference)
        return as_given(difference, volume)
    values = to_host(volume)
    return as_given(values - ndimage.uniform_filter(values, window), volume)


def shared_light(first: Given, second: Given) -> tuple[Given, Given]:
    """Return the lesser and the mean of both volumes, each relative to its mean, negative intensities as 0."""
    if runtime.device().form == "gpu":
        both = [on_device(powered(on_device(volume), 1.0)) for volume in (first, second)]
        scales = [1 / max(mean, TINY) for mean, _ in means_and_squares(both)]
        least, mean = (empty_volume(both[0].shape) for _ in range(2))
        over_voxels(_share_light, [*both, *scales], least, mean)
        return as_given(least, first), as_given(mean, first)
    lights = (np.maximum(to_host(volume), 0) for volume in (first, second))
    one, other = (light / max(float(light.mean()), TINY) for light in lights)
    return as_given(np.minimum(one, other), first), as_given((one + other) / 2, first)
