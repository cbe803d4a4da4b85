"""Volumes with solid voxels: find the fluid that two volumes share, and subtract the local mean of the fluid.

A function for arrays of either kind returns arrays on the GPU for arrays on the GPU, else of NumPy.
"""

import numpy as np
import warp as wp
from scipy import ndimage

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import filters_gpu
from lfpiv_kernels.correlation.memory import empty_volume, on_device
from lfpiv_kernels.correlation.plan import Triple
from lfpiv_kernels.launch import over_voxels
from lfpiv_kernels.transfer import Given, Values, as_given, to_device, to_host

TINY = float(np.finfo(np.float32).tiny)
"""Least share of fluid that a mean is divided by."""


wp.set_module_options(native.quiet_options())


@wp.kernel
def _invert(
    # in
    flag: wp.array3d(dtype=wp.bool),
    begin: int,
    # out
    flag_out: wp.array3d(dtype=wp.bool),
):
    layer, y, x = wp.tid()
    z = begin + layer
    flag_out[z, y, x] = not flag[z, y, x]


@wp.kernel
def _as_numbers(
    # in
    flag: wp.array3d(dtype=wp.bool),
    begin: int,
    # out
    number_out: wp.array3d(dtype=float),  # 1 where flagged
):
    layer, y, x = wp.tid()
    z = begin + layer
    number_out[z, y, x] = wp.where(flag[z, y, x], 1.0, 0.0)


@wp.func
def _differ(one: wp.array3d(dtype=float), other: wp.array3d(dtype=float), z: int, y: int, x: int):
    """Return whether just one of two volumes holds solid at a voxel; false outside."""
    if z < 0 or y < 0 or x < 0 or z >= one.shape[0] or y >= one.shape[1] or x >= one.shape[2]:
        return False
    return (one[z, y, x] > 0.5) != (other[z, y, x] > 0.5)


@wp.kernel
def _find_fluid(
    # in
    one: wp.array3d(dtype=float),  # solid: above 1/2
    other: wp.array3d(dtype=float),
    begin: int,
    # out
    fluid_out: wp.array3d(dtype=wp.bool),
):
    layer, y, x = wp.tid()
    z = begin + layer
    moved = _differ(one, other, z - 1, y, x) or _differ(one, other, z + 1, y, x)
    moved = moved or _differ(one, other, z, y - 1, x) or _differ(one, other, z, y + 1, x)
    moved = moved or _differ(one, other, z, y, x - 1) or _differ(one, other, z, y, x + 1)
    fluid_out[z, y, x] = not moved and one[z, y, x] <= 0.5 and other[z, y, x] <= 0.5


@wp.kernel
def _in_fluid(
    # in
    volume: wp.array3d(dtype=float),
    fluid: wp.array3d(dtype=wp.bool),
    begin: int,
    # out
    volume_out: wp.array3d(dtype=float),  # 0 elsewhere
):
    layer, y, x = wp.tid()
    z = begin + layer
    volume_out[z, y, x] = wp.where(fluid[z, y, x], volume[z, y, x], 0.0)


@wp.kernel
def _level(
    # in
    volume: wp.array3d(dtype=float),
    mean: wp.array3d(dtype=float),  # local mean of the volume, 0 outside the fluid
    share: wp.array3d(dtype=float),  # local mean of the fluid
    fluid: wp.array3d(dtype=wp.bool),
    least: float,
    begin: int,
    # out
    level_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    level = float(0.0)
    if fluid[z, y, x]:
        level = volume[z, y, x] - mean[z, y, x] / wp.max(share[z, y, x], least)
    level_out[z, y, x] = level


def flags_on_device(flags: Values) -> wp.array:
    """Return flags of voxels on the running device, as they are if they are there already."""
    return flags if isinstance(flags, wp.array) else to_device(np.ascontiguousarray(flags, bool), wp.bool)


def inverted(flags: Given) -> Given:
    """Return true where flags are false."""
    if runtime.device().form == "gpu":
        given = flags_on_device(flags)
        others = empty_volume(given.shape, wp.bool)
        over_voxels(_invert, [given], others)
        return as_given(others, flags)
    return as_given(~to_host(flags), flags)


def as_numbers(flags: Given) -> Given:
    """Return 1 where voxels are flagged, else 0, float32."""
    if runtime.device().form == "gpu":
        flagged = flags_on_device(flags)
        numbers = empty_volume(flagged.shape)
        over_voxels(_as_numbers, [flagged], numbers)
        return as_given(numbers, flags)
    return as_given(to_host(flags).astype(np.float32), flags)


def common_fluid(first: Given, second: Given) -> Given:
    """Return the voxels that hold fluid in both volumes, flags of shape (z, y, x).

    Both volumes are deformed by a predicted field. Where their solids then differ, the field carries particles across
    the wall: one volume shows particles cut by the edge of the other. So the face neighbours of voxels that differ are
    left out too.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
        Part of each voxel that is solid; above 1/2 it holds no fluid.
    """
    if runtime.device().form == "gpu":
        solids = on_device(first), on_device(second)
        fluid = empty_volume(first.shape, wp.bool)
        over_voxels(_find_fluid, [*solids], fluid)
        return as_given(fluid, first)
    one, other = to_host(first) > 0.5, to_host(second) > 0.5
    differ = one ^ other
    if differ.any():
        differ = ndimage.binary_dilation(differ)
    return as_given(~(one | other | differ), first)


def levelled(first: Given, second: Given, fluid: Values, window: Triple) -> tuple[Given, Given]:
    """Return both volumes less the local mean of their fluid, 0 where either of them holds none.

    The mean is taken over the fluid in a window around each voxel. Without it the edges of the fluid would correlate
    with each other, or the correlation would need the mean of each window's fluid at each lag.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
    fluid : array of bool, shape (z, y, x)
        Voxels that hold fluid in both volumes, such as from `common_fluid`.
    window : tuple of int
        Edges, order (z, y, x) [voxel].
    """
    if runtime.device().form == "gpu":
        flags = flags_on_device(fluid)
        share = filters_gpu.local_mean(as_numbers(flags), window, filters_gpu.ZEROS)
        levels = [_levelled(on_device(volume), flags, share, window) for volume in (first, second)]
    else:
        inside = to_host(fluid)
        share = np.maximum(_local_mean(inside.astype(np.float32), window), np.float32(TINY))
        levels = [
            np.where(inside, volume - _local_mean(np.where(inside, volume, 0), window) / share, 0).astype(np.float32)
            for volume in map(to_host, (first, second))
        ]
    return as_given(levels[0], first), as_given(levels[1], second)


def _levelled(volume: wp.array, fluid: wp.array, share: wp.array, window: Triple) -> wp.array:
    """Return a volume less the local mean of its fluid, on a GPU; `share` is the local mean of the flags."""
    inside, level = empty_volume(volume.shape), empty_volume(volume.shape)
    over_voxels(_in_fluid, [volume, fluid], inside)
    mean = filters_gpu.local_mean(inside, window, filters_gpu.ZEROS)
    over_voxels(_level, [volume, mean, share, fluid, TINY], level)
    return level


def _local_mean(values: np.ndarray, window: Triple) -> np.ndarray:
    """Return the mean over a window, which is 0 outside the volume."""
    return ndimage.uniform_filter(values, window, mode="constant")
