"""Warp: the light of a sensor's pixels as rays, block by block of microimages, and back.

A pixel at the edge of two microimages sees two parts of the pupil through two lenses; its rays are kept apart, each
with the share of the pixel's cell that lies inside the pupil. So a voxel's weights need no coverage of their own, and a
microimage lies in one piece of memory. Twin: ``reference.dense``.
"""

import sys
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse

from lfpiv_kernels import runtime

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@dataclass(frozen=True, kw_only=True)
class Microimages:
    """How the rays of a camera's lenses lie in memory: blocks of edge x edge pixels, row by row.

    Every row of lenses comes in layers, of which each holds a block per lens, see ``footprint_source.LAYERS``.
    """

    first_lens: tuple[int, int]
    """Lattice indices (i, j) of the first lens; i runs fastest."""
    corner: np.ndarray
    """First pixel (column, row) of each lens's block, shape (lenses along j, lenses along i, 2), int32."""
    edge: int
    """Pixels along each side of a block."""
    pixel: np.ndarray
    """Sensor pixel of each ray, row by row; -1 outside the sensor. Shape (ray,), int32, some rays more than blocks."""
    share: np.ndarray
    """Fraction of the pixel's cell inside the pupil, shape (ray,), float32."""
    sensor_shape: tuple[int, int]
    """Rows and columns of the sensor [pixel]."""

    @property
    def size(self) -> int:
        """Number of rays, padding included."""
        return len(self.pixel)


@wp.kernel
def _spread(
    # in
    first_ray: int,
    pixel: wp.array(dtype=int),
    share: wp.array(dtype=float),
    image: wp.array(dtype=float),
    # out
    rays_out: wp.array(dtype=float),
):
    ray = first_ray + wp.tid()
    light = float(0.0)
    if share[ray] > 0.0:
        light = share[ray] * image[pixel[ray]]
    rays_out[ray] = light


@wp.kernel
def _collect(
    # in
    first_pixel: int,
    first: wp.array(dtype=int),
    ray: wp.array(dtype=int),
    share: wp.array(dtype=float),
    rays: wp.array(dtype=float),
    # out
    image_out: wp.array(dtype=float),
):
    pixel = first_pixel + wp.tid()
    light = float(0.0)
    for k in range(first[pixel], first[pixel + 1]):
        light += share[ray[k]] * rays[ray[k]]
    image_out[pixel] = light


class RayMap:
    """The linear map from rays to pixels and its adjoint on the running device."""

    def __init__(self, microimages: Microimages):
        device = runtime.device().warp
        lit = np.flatnonzero(microimages.share > 0).astype(np.int32)
        rows, columns = microimages.sensor_shape
        by_pixel = sparse.csr_array(
            (np.ones(len(lit), np.uint8), (microimages.pixel[lit], lit)), shape=(rows * columns, microimages.size)
        )
        self._pixels = rows * columns
        self._rays = microimages.size
        share = wp.array(microimages.share, device=device, copy=False)
        self._spread = [wp.array(microimages.pixel, device=device, copy=False), share]
        self._collect = [
            *(wp.array(np.asarray(array, np.int32), device=device) for array in (by_pixel.indptr, by_pixel.indices)),
            share,
        ]
        wp.load_module(sys.modules[__name__], device=device)  # before threads use it

    def spread(self, image: wp.array, rays_out: wp.array) -> None:
        """Give every ray its pixel's light times its share: the adjoint of `collect`."""
        self._launch(_spread, self._rays, [*self._spread, image], rays_out)

    def collect(self, rays: wp.array, image_out: wp.array) -> None:
        """Sum the rays of every pixel, each times its share."""
        self._launch(_collect, self._pixels, [*self._collect, rays], image_out)

    def _launch(self, kernel, size, inputs, out) -> None:
        where = runtime.device().warp

        def launch(_, first, last):
            wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=[out], device=where)

        runtime.run_chunks(size, launch)
