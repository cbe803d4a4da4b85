"""Sums over windows for the uncertainty on a GPU; host functions and CPU form: ``uncertainty``.

Products of voxels are not stored: the first sum forms them. It goes along z: neighbouring threads read neighbours.
"""

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation import filters_gpu
from lfpiv_kernels.correlation.memory import empty_volume
from lfpiv_kernels.correlation.plan import Triple
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_host

wp.set_module_options(native.quiet_options() | {"max_unroll": 0})


@wp.func
def _value(volume: wp.array3d(dtype=float), z: int, y: int, x: int):
    """Return a voxel's value, 0 behind the volume."""
    if z >= volume.shape[0] or y >= volume.shape[1] or x >= volume.shape[2]:
        return float(0.0)
    return volume[z, y, x]


@wp.kernel
def _sum_products(
    # in
    one: wp.array3d(dtype=float),
    other: wp.array3d(dtype=float),
    lag: wp.vec3i,  # of the other volume, >= 0
    window: int,  # voxels along z per sum
    origin: int,  # first voxel of sum 0
    step: int,  # distance of the sums [voxel]
    begin: int,
    # out
    sum_out: wp.array3d(dtype=float),  # a thread per sum
):
    layer, y, x = wp.tid()
    k = begin + layer
    first = origin + k * step
    total = float(0.0)
    for z in range(first, first + window):
        total += one[z, y, x] * _value(other, z + lag[0], y + lag[1], x + lag[2])
    sum_out[k, y, x] = total


@wp.kernel
def _sum_differences(
    # in
    one: wp.array3d(dtype=float),
    other: wp.array3d(dtype=float),
    lag: wp.vec3i,  # >= 0 [voxel]
    window: int,  # voxels along x per sum
    before: int,  # voxels of a sum before the one that it belongs to
    begin: int,
    # out
    sum_out: wp.array3d(dtype=float),  # of products at a lag of the other volume less those at a lag of the first
):
    layer, y, k = wp.tid()
    z = begin + layer
    first = k - before
    total = float(0.0)
    for x in range(wp.max(first, 0), wp.min(first + window, one.shape[2])):
        ahead = one[z, y, x] * _value(other, z + lag[0], y + lag[1], x + lag[2])
        total += ahead - _value(one, z + lag[0], y + lag[1], x + lag[2]) * other[z, y, x]
    sum_out[z, y, k] = total


@wp.kernel
def _square(
    # in
    values: wp.array3d(dtype=float),
    begin: int,
    # out
    square_out: wp.array3d(dtype=float),
):
    layer, y, x = wp.tid()
    z = begin + layer
    square_out[z, y, x] = values[z, y, x] * values[z, y, x]


def window_sums(
    first: wp.array, second: wp.array, window: Triple, origin: Triple, step: Triple, count: Triple, reach: int
) -> tuple[list[np.ndarray], list[list[np.ndarray]]]:
    """Return the sums of both volumes, of their products, and of the terms of each axis; see ``uncertainty``."""
    taps = tuple(np.ones(edge) for edge in window)
    sums = empty_volume((20, *count))

    def product_sums(one: wp.array, other: wp.array, lag: wp.vec3i, out: wp.array) -> None:
        volume = empty_volume((count[0], *one.shape[1:]))
        inputs = [one, other, lag, window[0], origin[0], step[0]]
        launch(Call(_sum_products, count[0], inputs, [volume], inner=tuple(one.shape[1:])))
        for axis, filtered in ((1, None), (2, out)):
            layout = {"step": step[axis], "count": count[axis], "border": filters_gpu.WHOLE}
            volume = filters_gpu.filter_along(volume, axis, taps[axis], origin[axis], **layout, out=filtered)

    for k, volume in enumerate((first, second)):
        filters_gpu.window_sums(volume, origin, step, count, taps, sums[k])
    for k, (one, other) in enumerate(((first, second), (first, first), (second, second))):
        product_sums(one, other, wp.vec3i(0, 0, 0), sums[2 + k])
    for axis in range(3):
        lag = wp.vec3i(*(int(k == axis) for k in range(3)))
        place = 5 + 5 * axis
        for k, (one, other) in enumerate(((first, second), (second, first), (first, first), (second, second))):
            product_sums(one, other, lag, sums[place + k])
        squares = _squared_cubes(first, second, lag, reach)
        filters_gpu.window_sums(squares, origin, step, count, taps, sums[place + 4])
    found = to_host(sums).astype(float)
    terms = [
        [plus, minus, plus - minus, squares, own_first + own_second]
        for plus, minus, own_first, own_second, squares in found[5:].reshape(3, 5, *count)
    ]
    return [*found[:3], found[3] + found[4]], terms


def _squared_cubes(first: wp.array, second: wp.array, lag: wp.vec3i, reach: int) -> wp.array:
    """Return the squares of the sums of differences over the cube around each voxel; those outside the volume are 0."""
    cubes = empty_volume(first.shape)
    inputs = [first, second, lag, reach, reach // 2]
    launch(Call(_sum_differences, first.shape[0], inputs, [cubes], inner=tuple(first.shape[1:])))
    for axis in (1, 0):
        cubes = filters_gpu.filter_along(cubes, axis, np.ones(reach), -(reach // 2))
    launch(Call(_square, first.shape[0], [cubes], [cubes], inner=tuple(first.shape[1:])))
    return cubes
