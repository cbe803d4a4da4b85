"""Sums over all windows of a volume, of any edge and at every voxel."""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import filters_gpu
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.correlation.plan import Triple, largest_factor, whole_groups
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import Values, as_given, to_device, to_host

wp.set_module_options(native.options("windows.h"))

PART = 512
"""Sums that a CPU task forms."""


@native.kernel("""
    const int64_t begin = (int64_t)task * part;
    const int count = size - begin < part ? size - begin : part;
    lfpiv::sum_terms(source.data + begin, distance, terms, count, sum_out.data + begin);
""")
def _box_sum(
    # in
    source: wp.array(dtype=float),  # flat volume, and padding that the last sums read
    distance: int,  # of the terms [element]
    terms: int,
    size: wp.int64,  # sums
    part: int,  # sums per thread
    first_task: int,
    # out
    sum_out: wp.array(dtype=float),
): ...


def box_sum(volume: Values, window: Triple, keep: tuple[slice, ...] | None = None) -> Values:
    """Sum over windows: ``out[p]`` is the sum over the window whose first voxel is p, 0 if it leaves the volume.

    Parameters
    ----------
    volume : array, shape (z, y, x), float32
    window : tuple of int
        Window edges, order (z, y, x) [voxel].
    keep : tuple of slice, optional
        The p wanted per axis; default: all of the volume.

    Returns
    -------
    array, float32
        Of the volume's shape, or of `keep`'s. On the device if the volume is.
    """
    keep = keep or (slice(None),) * 3
    if runtime.device().form == "gpu":
        origin, step, count = _layout(keep, volume.shape)
        taps = tuple(np.ones(edge) for edge in window)
        return as_given(filters_gpu.window_sums(on_device(volume), origin, step, count, taps), volume)
    sums = to_host(volume)
    for axis in (2, 1, 0):  # dropping unwanted sums along x first saves most of the work along y and z
        sums = _sum_along(sums, axis, window[axis])
        sums[(slice(None),) * axis + (slice(sums.shape[axis] - window[axis] + 1, None),)] = 0
        sums = np.ascontiguousarray(sums[(slice(None),) * axis + (keep[axis],)])
    return as_given(sums, volume)


def _layout(keep: tuple[slice, ...], shape: Triple) -> tuple[Triple, Triple, Triple]:
    """Return first place, distance and number of the places that slices keep."""
    kept = [range(*places.indices(n)) for places, n in zip(keep, shape, strict=True)]
    return tuple(places.start for places in kept), tuple(places.step for places in kept), tuple(map(len, kept))


def _sum_along(volume: np.ndarray, axis: int, width: int) -> np.ndarray:
    """Sum `width` neighbours along an axis from each voxel on; the last ``width - 1`` sums are not valid. CPU only."""
    pitch = math.prod(volume.shape[axis + 1 :])
    factor = largest_factor(width)  # sums of sums: factor + width / factor terms
    source, sums = (np.zeros(whole_groups(volume.size) + width * pitch, np.float32) for _ in range(2))
    source[: volume.size] = volume.ravel()
    source, sums = to_device(source, float), to_device(sums, float)
    for terms, distance in ((factor, pitch), (width // factor, factor * pitch)):
        if terms > 1:
            launch(Call(_box_sum, -(-volume.size // PART), [source, distance, terms, volume.size, PART], [sums]))
            source, sums = sums, source
    return to_host(source)[: volume.size].reshape(volume.shape)
