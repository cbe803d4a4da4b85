"""Sums over all voxels of a volume on a GPU, in double precision and a fixed order."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.memory import empty_volume
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_host

wp.set_module_options(native.quiet_options() | {"max_unroll": 0})

PARTS = (1 << 17, 1 << 9, 1)
"""Threads of each stage of a sum. A thread of a stage with n threads adds up every n-th value of the stage before, so
that neighbouring threads read neighbouring values."""


@wp.kernel
def _sum_products(
    # in
    one: wp.array(dtype=float),  # flat volume; a thread per part of the sum
    other: wp.array(dtype=float),
    extent: wp.int64,  # consecutive voxels that have a partner
    period: wp.int64,  # elements from the first of them to the next first
    distance: wp.int64,  # of the partner in memory [elements]
    places: wp.int64,  # voxels that have a partner
    threads: int,
    begin: int,
    # out
    sum_out: wp.array(dtype=wp.float64),
):
    part = begin + wp.tid()
    total = wp.float64(0.0)
    place = wp.int64(part)
    while place < places:
        at = place // extent * period + place % extent
        total += wp.float64(one[at]) * wp.float64(other[at + distance])
        place += wp.int64(threads)
    sum_out[part] = total


@wp.kernel
def _sum_values(
    # in
    values: wp.array(dtype=float),  # flat volume; a thread per part of the sum
    places: wp.int64,  # voxels
    threads: int,
    begin: int,
    # out
    sum_out: wp.array(dtype=wp.float64),
):
    part = begin + wp.tid()
    total = wp.float64(0.0)
    place = wp.int64(part)
    while place < places:
        total += wp.float64(values[place])
        place += wp.int64(threads)
    sum_out[part] = total


@wp.kernel
def _add_parts(
    # in
    part: wp.array2d(dtype=wp.float64),  # (sum, part of the stage before)
    begin: int,
    # out
    sum_out: wp.array2d(dtype=wp.float64),  # (sum, part)
):
    row, column = wp.tid()
    row += begin
    total = wp.float64(0.0)
    for k in range(part.shape[1] // sum_out.shape[1]):
        total += part[row, k * sum_out.shape[1] + column]
    sum_out[row, column] = total


def moments(volumes: Sequence[wp.array]) -> np.ndarray:
    """Return the sum and the sum of squares of each volume, shape (volume, 2), float64."""
    calls = []
    for volume in volumes:
        flat = volume.flatten()
        calls.append((_sum_values, [flat, flat.size]))
        calls.append((_sum_products, [flat, flat, 1, 1, 0, flat.size]))
    return _add_up(calls).reshape(-1, 2)


def lag_products(volumes: Sequence[wp.array], lag: int, axes: Sequence[int]) -> np.ndarray:
    """Return the sum of products of voxels `lag` [voxel] apart along some axes, shape (volume, axis), float64."""
    calls = []
    for volume in volumes:
        flat = volume.flatten()
        for axis in axes:
            pitch = int(np.prod(volume.shape[axis + 1 :]))
            extent, period = (volume.shape[axis] - lag) * pitch, volume.shape[axis] * pitch
            places = flat.size // period * extent
            calls.append((_sum_products, [flat, flat, extent, period, lag * pitch, places]))
    return _add_up(calls).reshape(len(volumes), len(axes))


def _add_up(calls: Sequence[tuple[wp.Kernel, list[object]]]) -> np.ndarray:
    """Return the sums of kernels, shape (call,), float64. Calls state their inputs up to the number of places."""
    threads, *fewer = PARTS
    parts = empty_volume((len(calls), threads), wp.float64)
    launch(*(Call(kernel, threads, [*inputs, threads], [parts[k]]) for k, (kernel, inputs) in enumerate(calls)))
    for count in fewer:
        sums = empty_volume((len(calls), count), wp.float64)
        launch(Call(_add_parts, len(calls), [parts], [sums], inner=(count,)))
        parts = sums
    return to_host(parts)[:, 0]
