"""Separable filters of volumes on a GPU: sums of voxels times taps, along one axis after the other.

A GPU has a thread for every voxel: neighbouring threads read neighbouring voxels along each axis.
"""

import functools
import math

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.memory import empty_volume
from lfpiv_kernels.correlation.plan import Triple
from lfpiv_kernels.filters import blur, spline
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_device

wp.set_module_options(native.quiet_options() | {"max_unroll": 0})

ZEROS = wp.constant(0)
"""Voxels outside the volume count as 0."""
WHOLE = wp.constant(1)
"""A sum that leaves the volume is 0."""
REFLECTED = wp.constant(2)
"""The volume is continued by its image in its faces, as by SciPy's mode "reflect"."""


@wp.func
def _folded(at: int, size: int, border: int):
    """Return the voxel whose value stands at a place outside the volume; the place itself if none does."""
    place = at
    if border == REFLECTED:
        place = at % (2 * size)
        if place < 0:
            place += 2 * size
        place = wp.min(place, 2 * size - 1 - place)
    return place


@wp.kernel
def _filter(
    # in
    source: wp.array3d(dtype=float),  # the axis that is filtered is the middle one; a thread per sum
    taps: wp.array(dtype=float),
    first: int,  # place of the first tap for sum 0, counted from the first voxel of the margin
    step: int,  # distance of the sums [voxel]
    margin: int,  # zeros on either side of the volume
    border: int,
    begin: int,
    # out
    sum_out: wp.array3d(dtype=float),
):
    layer, k, column = wp.tid()
    row = begin + layer
    size = source.shape[1] + 2 * margin
    start = first + k * step
    inside = start >= 0 and start + taps.shape[0] <= size
    total = float(0.0)
    if inside or border != WHOLE:
        for t in range(taps.shape[0]):
            at = start + t
            if not inside and (at < 0 or at >= size):
                at = _folded(at, size, border)
            at -= margin
            if at >= 0 and at < source.shape[1]:
                total += taps[t] * source[row, at, column]
    sum_out[row, k, column] = total


def filter_along(
    volume: wp.array,
    axis: int,
    taps: np.ndarray,
    first: int,
    *,
    border: int = ZEROS,
    step: int = 1,
    count: int | None = None,
    margin: int = 0,
    out: wp.array | None = None,
) -> wp.array:
    """Sum voxels times taps along one axis of a volume on the device.

    Parameters
    ----------
    volume : wp.array, shape (z, y, x), float32
    taps : ndarray, shape (tap,)
    first : int
        Voxel of the first tap for sum 0; negative in the margin or outside.
    border : int
        `ZEROS`, `WHOLE` or `REFLECTED`.
    step, count : int
        Distance and number of the sums; default: one at each voxel.
    margin : int
        Zeros on either side, within the border, along the axis.
    out : wp.array, optional
        Where to write.
    """
    count = volume.shape[axis] if count is None else count
    shape = (*volume.shape[:axis], count, *volume.shape[axis + 1 :])
    out = empty_volume(shape) if out is None else out
    before, behind = math.prod(shape[:axis]), math.prod(shape[axis + 1 :])
    inputs = [volume.reshape((before, volume.shape[axis], behind)), _on_device(tuple(map(float, taps)))]
    inputs += [first + margin, step, margin, border]
    launch(Call(_filter, before, inputs, [out.reshape((before, count, behind))], inner=(count, behind)))
    return out


@functools.lru_cache
def _on_device(taps: tuple[float, ...]) -> wp.array:
    return to_device(np.array(taps, np.float32), float)


def spline_coefficients(volume: wp.array, margin: int) -> wp.array:
    """Return the cubic B-spline coefficients of a volume with zeros around it."""
    for axis in (2, 1, 0):
        count = volume.shape[axis] + 2 * margin
        first = -spline.REACH - margin
        volume = filter_along(volume, axis, spline.PROFILE, first, count=count, margin=margin)
    return volume


def smoothed(volume: wp.array, sigma: float) -> wp.array:
    """Return a volume smoothed by a Gaussian; voxels outside count as 0."""
    reach = int(blur.REACH * sigma + 0.5)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    for axis in range(3):
        volume = filter_along(volume, axis, taps / taps.sum(), -reach)
    return volume


def local_mean(volume: wp.array, window: Triple, border: int) -> wp.array:
    """Return the mean over a window around each voxel; an even window reaches farther to lower indices."""
    for axis, edge in enumerate(window):
        volume = filter_along(volume, axis, np.full(edge, 1 / edge), -(edge // 2), border=border)
    return volume


def window_sums(
    volume: wp.array,
    origin: Triple,
    step: Triple,
    count: Triple,
    taps: tuple[np.ndarray, np.ndarray, np.ndarray],
    out: wp.array | None = None,
) -> wp.array:
    """Return the sums of voxels times taps over windows, shape `count`; along x first, which leaves least to do."""
    for axis in (2, 1, 0):
        layout = {"step": step[axis], "count": count[axis], "border": WHOLE}
        volume = filter_along(volume, axis, taps[axis], origin[axis], **layout, out=out if axis == 0 else None)
    return volume
