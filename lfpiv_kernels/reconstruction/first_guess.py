"""SMART's first guess on the device: exp(sum_i w log(1 + I / b) / sum_i w) - 1, and its light beside the images'.

Logarithms and exponentials are NumPy's on the CPU, where they are vectors, and Warp's on a GPU: twins of each other.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction import sums
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.update import Comparison
from lfpiv_kernels.reconstruction.voxels import FEWEST_VOXELS, parts_of, sweep
from lfpiv_kernels.transfer import empty, to_device, to_host, zeros

wp.set_module_options(native.quiet_options())

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
    pixel: wp.array(dtype=int),
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
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
def _lift(
    # in
    lit: wp.array(dtype=float),
    largest: wp.array(dtype=float),
    faintest: float,
    first_voxel: int,
    # out
    guess_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    guess_out[voxel] = wp.where(lit[voxel] > 0.0, wp.max(guess_out[voxel], faintest * largest[0]), 0.0)


@wp.kernel
def _compare_light(
    # in
    pixel: wp.array(dtype=int),
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    projected: wp.array(dtype=float),
    first_pixel: int,
    # out
    seen_out: wp.array(dtype=wp.float64),
    light_out: wp.array(dtype=wp.float64),
):
    k = first_pixel + wp.tid()
    modelled = gain[k] * projected[pixel[k]]
    seen_out[k] = wp.where(modelled > 0.0, wp.float64(image[k]), wp.float64(0.0))
    light_out[k] = wp.float64(modelled)


@wp.kernel
def _rescale(
    # in
    totals: wp.array(dtype=wp.float64),
    first_voxel: int,
    # out
    guess_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    guess_out[voxel] = guess_out[voxel] * float(totals[0] / totals[1])


def add_logarithms(comparison: Comparison, floor: float, out: wp.array) -> None:
    """Add the back projection of gain * log(1 + image / floor) to `out`, shape (voxel,)."""
    image = empty(comparison.size)
    pixel = comparison.projector.map.rays.pixel
    if runtime.device().form == "cpu":
        counts, gain = to_host(comparison.image), to_host(comparison.gain)
        to_host(image)[to_host(pixel)] = gain * np.log1p(counts / floor)
    else:
        inputs = [pixel, comparison.image, comparison.gain, float(floor)]
        launch(Call(_logarithm, pixel.size, inputs, [image]))
    comparison.projector.back_project(image, out)


def exponentiate(logarithm: wp.array, column_sum: wp.array, lit: wp.array, faintest: float) -> wp.array:
    """Overwrite `logarithm` by exp(logarithm / column_sum) - 1, at least `faintest` of the largest; 0 where not lit.

    Return it.
    """
    if runtime.device().form == "cpu":
        total, where = to_host(column_sum), to_host(lit) > 0
        guess = np.expm1(np.divide(to_host(logarithm), total, out=np.zeros_like(total), where=where))
        return to_device(np.where(where, np.maximum(guess, faintest * guess.max()), np.float32(0)), float)
    sweep(_exponentiate, lit.size, [column_sum, lit], [logarithm])
    sweep(_lift, lit.size, [lit, sums.largest(logarithm), float(faintest)], [logarithm])
    return logarithm


def give_light(guess: wp.array, comparisons: Sequence[Comparison]) -> None:
    """Scale a volume so that its projections have the light of the images where it lights them."""
    totals = Totals(2)
    for comparison in comparisons:
        image, pixel = zeros(comparison.size), comparison.projector.map.rays.pixel
        comparison.projector.project(guess, image)
        light = [empty(pixel.size, wp.float64) for _ in range(2)]
        call = Call(_compare_light, pixel.size, [pixel, comparison.image, comparison.gain, image], light)
        launch(call, parts=parts_of(pixel.size, FEWEST_VOXELS))
        for place, one in enumerate(light):
            totals.add(place, one)
    sweep(_rescale, guess.size, [totals.values], [guess])
