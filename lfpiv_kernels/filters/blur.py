"""Warp: the same blur of a volume along each of its three axes. Twin: ``scipy.ndimage.correlate1d``.

Each thread blurs planes of the outermost axis, so its intermediate results stay in the caches. The loops are C++, see
``blur.h``. A GPU has ``blur_gpu``.
"""

from functools import lru_cache

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.filters import blur_gpu
from lfpiv_kernels.filters.blur_layout import Axis
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.transfer import Given, as_given, empty, to_device

wp.set_module_options(native.options("blur.h", contract="fast"))

BORDERS = ("constant", "nearest")
"""Beyond the volume: zero, or its outermost voxels continued."""
REACH = 4.0
"""Reach of the Gaussian that smooths volumes [standard deviation]: SciPy's."""
FEWEST_VOXELS = 8192
"""Smallest part of a launch: a smaller one takes less time than the launch itself."""


@native.kernel("""
    const lfpiv::AxisBlur along = lfpiv::axis_blur(middle);
    const int64_t area = (int64_t)along.size * length;
    const lfpiv::RowBlur inner{row.data, (int)row.shape[0], nearest};
    lfpiv::blur_plane(lfpiv::axis_blur(outer), along, inner, length, plane, volume.data,
                      work_out.data + (int64_t)slot * work_out.shape[1], blurred_out.data + plane * area);
""")
def _blur(
    # in
    outer: Axis,
    middle: Axis,
    row: wp.array(dtype=float),  # weights along the innermost axis
    nearest: bool,
    length: int,  # of a row
    volume: wp.array(dtype=float),
    slot: int,
    first_plane: int,
    # out
    work_out: wp.array2d(dtype=float),
    blurred_out: wp.array(dtype=float),
): ...


class Blur:
    """Symmetric filter of flat volumes of one shape, the same along each axis.

    Parameters
    ----------
    profile : ndarray, shape (tap,)
        Its weights, odd in number and symmetric.
    shape : tuple of int
        Voxel counts, the axis of neighbours in memory last.
    border : {"constant", "nearest"}
        Light beyond the volume: none, or that of its outermost voxels. With "constant" the filter is its own adjoint.

    Raises
    ------
    ValueError
        If `border` is neither.
    """

    def __init__(self, profile: np.ndarray, shape: tuple[int, int, int], *, border: str):
        if border not in BORDERS:
            raise ValueError(f"border: expected one of {', '.join(BORDERS)}, got {border!r}.")
        self.shape = shape
        self._axes = [_axis(profile, size, border) for size in shape]
        self._row, self._nearest = profile.astype(np.float32), border == "nearest"

    def __call__(self, volume: Given) -> Given:
        """Return the blurred volume, on the device if `volume` is; both float32, C-contiguous, shape (voxel,)."""
        source, blurred = to_device(volume, float), empty(volume.size)
        if runtime.device().form == "gpu":
            blur_gpu.blur(self._axes, source, empty(volume.size), blurred)
        else:
            (outer, middle, _), (planes, rows, length) = self._axes, self.shape
            memory = rows * length + length + self._row.size - 1  # a plane, and a row continued beyond its ends
            work = empty(runtime.CHUNKS * memory).reshape((runtime.CHUNKS, memory))
            inputs = [outer, middle, to_device(self._row, float), self._nearest, length, source]
            call = Call(_blur, planes, inputs, [work, blurred], scratch=True)
            launch(call, parts=parts_of(volume.size, FEWEST_VOXELS))
        return as_given(blurred, volume)


class GaussianBlur(Blur):
    """Gaussian blur of flat volumes of one shape. Twin: ``scipy.ndimage.gaussian_filter``.

    Parameters
    ----------
    sigma_voxel : float
        Standard deviation, above 0 [voxel].
    shape, border
        As of `Blur`.
    truncate : float
        Reach of the Gaussian [standard deviation].
    """

    def __init__(self, sigma_voxel: float, shape: tuple[int, int, int], *, truncate: float, border: str):
        radius = int(truncate * sigma_voxel + 0.5)
        profile = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma_voxel**2))
        super().__init__(profile / profile.sum(), shape, border=border)


@lru_cache(maxsize=4)
def smoothing(sigma_voxel: float, shape: tuple[int, int, int]) -> GaussianBlur:
    """Return the blur that smooths volumes before they are compared; it reaches `REACH` and adds no light beyond."""
    return GaussianBlur(sigma_voxel, shape, truncate=REACH, border="constant")


def _axis(profile: np.ndarray, size: int, border: str) -> Axis:
    """Return the weights along an axis of `size` voxels. Those beyond the border are added to the outermost voxel's."""
    radius, taps = len(profile) // 2, min(len(profile), size)
    first = np.clip(np.arange(size) - radius, 0, size - taps)
    weight = np.zeros((size, taps))
    for voxel in range(size):
        source = voxel + np.arange(-radius, radius + 1)
        inside = (source >= 0) & (source < size)
        share = np.where(inside | (border == "nearest"), profile, 0)
        np.add.at(weight[voxel], np.clip(source, 0, size - 1) - first[voxel], share)
    axis = Axis()
    axis.first, axis.weight = to_device(first.astype(np.int32)), to_device(weight.astype(np.float32).ravel())
    axis.taps, axis.begin, axis.end = taps, min(radius, size), max(size - radius, 0)
    return axis
