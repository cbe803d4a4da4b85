"""Warp: SMART's steps on pixels and voxels, each in one sweep. Twin: ``reference.smart``."""

import sys

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.reconstruction.pixel_rays import Rays
from lfpiv_kernels.reconstruction.projector import Projector

wp.set_module_options(native.options("update.h"))

LEAST_RUNS, LEAST_VOXELS = 256, 16384
"""Least work of a chunk: below, the launch takes longer."""
LARGEST_LEAP = 50.0
"""Largest ratio of two iterates that momentum repeats, and the inverse of the smallest one."""
SMALLEST = float(np.finfo(np.float32).tiny)
"""Least light of an active voxel under momentum: below, float32 is slow, and a zero would never come back."""


@wp.func_native("""
    lfpiv::compare(
        lfpiv::pixel_run(map, run), image.data, gain.data, floor, rays_out.data, squares_out.data, divergence_out.data
    );
""")
def _compare_run(
    run: int,
    map: Rays,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
    rays_out: wp.array(dtype=float),
    squares_out: wp.array(dtype=wp.float64),
    divergence_out: wp.array(dtype=wp.float64),
): ...


@wp.kernel
def _compare(
    # in
    first_run: int,
    map: Rays,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
    # out
    rays_out: wp.array(dtype=float),
    squares_out: wp.array(dtype=wp.float64),
    divergence_out: wp.array(dtype=wp.float64),
):
    _compare_run(first_run + wp.tid(), map, image, gain, floor, rays_out, squares_out, divergence_out)


@wp.kernel
def _update(
    # in
    first_voxel: int,
    exponent: wp.array(dtype=float),
    step: wp.array(dtype=float),
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    volume_out[voxel] = volume_out[voxel] * wp.exp(step[voxel] * exponent[voxel])


@wp.kernel
def _extrapolate(
    # in
    first_voxel: int,
    exponent: float,
    # out
    volume_out: wp.array(dtype=float),
    last_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    last = last_out[voxel]
    if last > 0.0:
        light = wp.max(volume_out[voxel], SMALLEST)
        volume_out[voxel] = light
        ratio = wp.clamp(light / last, 1.0 / LARGEST_LEAP, LARGEST_LEAP)
        last_out[voxel] = wp.max(light * wp.pow(ratio, exponent), SMALLEST)


class Comparison:
    """One camera's image beside the projections of volumes: Eq. 5's logarithm of their ratio, and their misfit.

    Only pixels that voxels light count: what the others recorded, no volume can explain.

    Parameters
    ----------
    projector : Projector
        The camera's weights.
    image, gain : ndarray, shape (pixel,), float32
        Counts >= 0, zero where the gain is; what a pixel records per unit of light.
    floor : float
        Noise floor [counts].
    """

    def __init__(self, projector: Projector, image: np.ndarray, gain: np.ndarray, floor: float):
        self.projector = projector
        self._floor = float(floor)
        pixels, where = projector.map.pixel, runtime.device()
        self._image, self._gain = (
            wp.array(array[pixels], dtype=float, device=where.warp, copy=False) for array in (image, gain)
        )
        self._sums = [wp.zeros(projector.map.rays.runs, dtype=wp.float64, device=where.warp) for _ in range(2)]
        wp.load_module(sys.modules[__name__], device=where.warp)

    def compare(self, volume: np.ndarray) -> tuple[float, float]:
        """Project `volume`, shape (voxel,), and leave gain * log((image + floor) / (projection + floor)) on the rays.

        Returns
        -------
        float
            Sum of (image - projection)^2, the projection with gain [counts^2].
        float
            Sum of P log(P / I) - P + I with P the projection and I the image, both plus floor [counts].
        """
        where, runs = runtime.device().warp, self.projector.map.rays.runs
        self.projector.scatter(volume)

        def launch(_, first, last):
            wp.launch(
                _compare,
                dim=last - first,
                inputs=[first, self.projector.map.rays, self._image, self._gain, self._floor],
                outputs=[self.projector.rays, *self._sums],
                device=where,
            )

        runtime.run_chunks(runs, launch, chunks=_chunks(runs, LEAST_RUNS))
        squares, divergence = (float(sums.numpy().sum()) for sums in self._sums)
        return squares, divergence


def update(volume, exponent, step):
    """SMART's step volume *= exp(step * exponent), in place; float32, shape (voxel,); returns `volume`."""
    _sweep(_update, [exponent, step], [volume])
    return volume


def extrapolate(volume, last, exponent):
    """Overwrite `last` by volume * (volume / last)^exponent; both float32, shape (voxel,); returns `last`.

    Zeros of `last` stay zero; the others, `volume`'s included, are kept above zero.
    """
    _sweep(_extrapolate, [float(exponent)], [volume, last])
    return last


def _sweep(kernel, inputs, outputs):
    """Launch a kernel on all voxels; arrays are used in place, or written back."""
    where = runtime.device().warp

    def put(value):
        return value if isinstance(value, float) else wp.array(value, dtype=float, device=where, copy=False)

    inputs, written = [put(value) for value in inputs], [put(value) for value in outputs]
    wp.load_module(sys.modules[__name__], device=where)

    def launch(_, first, last):
        wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=written, device=where)

    runtime.run_chunks(len(outputs[0]), launch, chunks=_chunks(len(outputs[0]), LEAST_VOXELS))
    if where != "cpu":
        for host, array in zip(outputs, written, strict=True):
            host[:] = array.numpy()


def _chunks(size, least):
    return min(runtime.CHUNKS, 1 + size // least)
