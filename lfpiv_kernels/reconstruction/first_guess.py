"""SMART's first guess on the device: exp(sum_i w log(1 + I / b) / sum_i w) - 1, scaled to the light of the images.

On the CPU NumPy computes logarithms and exponentials, because it vectorises them; on a GPU Warp does. Each is the twin
of the other.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.reconstruction import sums
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.update import Comparison
from lfpiv_kernels.reconstruction.voxels import FEWEST_VOXELS, sweep
from lfpiv_kernels.transfer import empty, to_device, to_host

wp.set_module_options(native.quiet_options())

FEWEST_PIXELS = 8192
"""Least number of pixels whose logarithms a thread of the CPU takes."""
SMALL = 1e-3
"""Below this log(1 + x) and exp(x) - 1 are series, since 1 + x loses digits of x."""


@wp.func
def _log1p(x: float):
    if x < wp.static(SMALL):
        return x * (1.0 - x * (0.5 - x / 3.0))
    return wp.log(1.0 + x)


@wp.func
def _expm1(x: float):
    if x < wp.static(SMALL):
        return x * (1.0 + x * (0.5 + x / 6.0))
    return wp.exp(x) - 1.0


@wp.kernel
def _logarithm(
    # in
    pixel: wp.array(dtype=int),  # of the sensor, per lit pixel
    image: wp.array(dtype=float),  # per lit pixel [counts]
    gain: wp.array(dtype=float),  # per lit pixel
    floor: float,  # [counts]
    first_pixel: int,
    # out
    logarithm_out: wp.array(dtype=float),  # per pixel of the sensor
):
    k = first_pixel + wp.tid()
    logarithm_out[pixel[k]] = gain[k] * _log1p(image[k] / floor)


@wp.kernel
def _exponentiate(
    # in
    column_sum: wp.array(dtype=float),
    lit: wp.array(dtype=float),
    first_voxel: int,
    # out
    guess_out: wp.array(dtype=float),  # in: the weights' sum of logarithms
):
    voxel = first_voxel + wp.tid()
    guess_out[voxel] = wp.where(lit[voxel] > 0.0, _expm1(guess_out[voxel] / column_sum[voxel]), 0.0)


@wp.kernel
def _raise_to_faintest(
    # in
    lit: wp.array(dtype=float),
    largest: wp.array(dtype=float),  # largest value of the guess, (1,)
    faintest: float,  # least value of lit voxels over the largest
    first_voxel: int,
    # out
    guess_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    guess_out[voxel] = wp.where(lit[voxel] > 0.0, wp.max(guess_out[voxel], faintest * largest[0]), 0.0)


@wp.kernel
def _multiply_as_doubles(
    # in
    one: wp.array(dtype=float),
    other: wp.array(dtype=float),
    first: int,
    # out
    product_out: wp.array(dtype=wp.float64),
):
    k = first + wp.tid()
    product_out[k] = wp.float64(one[k]) * wp.float64(other[k])


@wp.kernel
def _rescale(
    # in
    totals: wp.array(dtype=wp.float64),  # light of the images, and of the guess's projections
    first_voxel: int,
    # out
    guess_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    guess_out[voxel] = guess_out[voxel] * float(totals[0] / totals[1])


def add_logarithms(comparison: Comparison, floor: float, out: wp.array, ray_sets: Sequence[int]) -> None:
    """Add the back projection of gain * log(1 + image / floor) by sets of rays to `out`, shape (voxel,).

    `floor` is in counts.
    """
    image = empty(comparison.size)
    pixel = comparison.projector.map.rays.pixel
    if runtime.device().form == "cpu":
        counts, gain, place, logarithm = (to_host(array) for array in (comparison.image, comparison.gain, pixel, image))

        def fill(_: int, first: int, last: int) -> None:
            logarithm[place[first:last]] = gain[first:last] * np.log1p(counts[first:last] / floor)

        runtime.run_chunks(pixel.size, fill, chunks=parts_of(pixel.size, FEWEST_PIXELS))
    else:
        inputs = [pixel, comparison.image, comparison.gain, float(floor)]
        launch(Call(_logarithm, pixel.size, inputs, [image]))
    comparison.projector.back_project(image, out, *ray_sets)


def exponentiate(logarithm: wp.array, column_sum: wp.array, lit: wp.array, faintest: float) -> wp.array:
    """Return exp(logarithm / column_sum) - 1, at least `faintest` of the largest, shape (voxel,); 0 where not lit.

    A GPU overwrites `logarithm` by it.
    """
    if runtime.device().form == "cpu":
        total, where = to_host(column_sum), to_host(lit) > 0
        guess = np.expm1(np.divide(to_host(logarithm), total, out=np.zeros_like(total), where=where))
        return to_device(np.where(where, np.maximum(guess, faintest * guess.max()), np.float32(0)), float)
    sweep(_exponentiate, lit.size, [column_sum, lit], [logarithm])
    sweep(_raise_to_faintest, lit.size, [lit, sums.largest(logarithm), float(faintest)], [logarithm])
    return logarithm


def scale_to_images(
    guess: wp.array, column_sum: wp.array, comparisons: Sequence[Comparison], shown: Sequence[wp.array]
) -> None:
    """Scale a volume so that its projections have the light of the images where it lights them.

    The light of all its projections is the sum of guess * column_sum, so nothing is projected.

    Parameters
    ----------
    guess, column_sum : array, shape (voxel,), float32
        The volume, above 0 where voxels are lit, and the sum of each voxel's weights with gain.
    shown : sequence of array, shape (lit pixel,), float32
        1 for pixels that a lit voxel lights, else 0, of each image.
    """
    totals = Totals(2)
    for comparison, seen in zip(comparisons, shown, strict=True):
        _add_product(totals, 0, comparison.image, seen)
    _add_product(totals, 1, guess, column_sum)
    sweep(_rescale, guess.size, [totals.values], [guess])


def _add_product(totals: Totals, place: int, one: wp.array, other: wp.array) -> None:
    """Add the sum of one * other to the total at `place`."""
    product = empty(one.size, wp.float64)
    launch(Call(_multiply_as_doubles, one.size, [one, other], [product]), parts=parts_of(one.size, FEWEST_VOXELS))
    totals.add(place, product)
