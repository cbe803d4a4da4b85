"""Sums over all windows of a volume, of any edge and at every voxel."""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation.memory import Call, launch, to_device
from lfpiv_kernels.correlation.plan import largest_factor

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

ROW = 8
"""Neighbours along x that box sums add at once."""
Row = wp.types.vector(length=ROW, dtype=float)


@wp.kernel
def _box_sum(
    # in
    source: wp.array(dtype=Row),  # overlapping rows of a flat volume
    pitch: int,  # distance of the terms [element]
    terms: int,
    rows: int,  # rows of `sum_out`
    batch: int,  # rows per thread
    first_batch: int,
    # out
    sum_out: wp.array(dtype=Row),  # every eighth overlapping row: [i] holds floats 8 i .. 8 i + 7
):
    begin = (first_batch + wp.tid()) * batch
    for index in range(begin, wp.min(begin + batch, rows)):
        total = source[8 * index]
        for k in range(1, terms):
            total += source[8 * index + k * pitch]
        sum_out[index] = total


def box_sum(volume: np.ndarray, window: tuple[int, int, int], keep: tuple[slice, ...] | None = None) -> np.ndarray:
    """Sum over windows: ``out[p]`` adds the window whose first voxel is p; 0 where it would leave the volume.

    Parameters
    ----------
    volume : ndarray, shape (z, y, x), float32
    window : tuple of int
        Window edges, order (z, y, x) [voxel].
    keep : tuple of slice, optional
        The p wanted per axis; default: all of the volume.

    Returns
    -------
    ndarray, float32
        Of the volume's shape, or what `keep` takes of it.
    """
    keep = keep or (slice(None),) * 3
    for axis in (2, 1, 0):  # dropping what is not wanted along x first saves most of the work along y and z
        volume = _sum_along(volume, axis, window[axis])
        volume[(slice(None),) * axis + (slice(volume.shape[axis] - window[axis] + 1, None),)] = 0
        volume = np.ascontiguousarray(volume[(slice(None),) * axis + (keep[axis],)])
    return volume


def _sum_along(volume: np.ndarray, axis: int, width: int) -> np.ndarray:
    """Sum `width` neighbours along an axis, starting at each voxel; the last ``width - 1`` sums mean nothing."""
    pitch = math.prod(volume.shape[axis + 1 :])
    rows = -(-volume.size // ROW)
    part = largest_factor(width)  # sums of sums: part + width / part terms
    taken, written = (np.zeros(rows * ROW + width * pitch + ROW, np.float32) for _ in range(2))
    taken[: volume.size] = volume.ravel()
    taken, written = to_device(taken), to_device(written)
    batch = 1 if runtime.device().kind == "cuda" else 64  # a CPU task costs as much as adding several rows
    for terms, spacing in ((part, pitch), (width // part, part * pitch)):
        if terms > 1:
            rows_out = wp.array(ptr=written.ptr, dtype=Row, shape=(rows,), device=written.device)
            launch(Call(_box_sum, -(-rows // batch), [_overlapping(taken), spacing, terms, rows, batch], [rows_out]))
            taken, written = written, taken
    return taken.numpy()[: volume.size].reshape(volume.shape)


def _overlapping(flat: wp.array) -> wp.array:
    """View a flat float array as rows of `ROW` that start at every element; the caller keeps it alive."""
    count = flat.shape[0] - ROW + 1
    return wp.array(ptr=flat.ptr, dtype=Row, shape=(count,), strides=(4,), device=flat.device)
