"""Warp: the light of a sensor's pixels as rays, and back, for those rays that voxels light.

A pixel at the edge of two microimages sees two parts of the pupil through two lenses; its rays are kept apart, each
with the share of the pixel's cell that lies inside the pupil. So a voxel's weights need no coverage of their own, and a
microimage lies in one piece of memory. The loops are C++: as Warp's they take three times as long on the CPU. Twin:
``reference.dense``.
"""

import sys

import numpy as np
import warp as wp
from scipy import sparse

from lfpiv_kernels import runtime
from lfpiv_kernels.microimages import Microimages

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

RUN = 64
"""Pixels that a thread goes through."""


@wp.struct
class Rays:
    """The rays of every pixel, pixels in the order in which their first rays lie in memory."""

    pixel: wp.array(dtype=int)
    """Sensor pixel."""
    first: wp.array(dtype=int)
    """Index of its first ray, one more than pixels."""
    place: wp.array(dtype=int)
    """Where each ray lies."""
    share: wp.array(dtype=float)
    """Fraction of the pixel's cell that it stands for."""
    dark: wp.array(dtype=int)
    """Where rays lie that no pixel sees, though voxels light them: corners of blocks."""
    runs: int
    """Threads that go through all pixels."""


# `for_pixels(work)` calls work(first pixel, number) for a run's pixels: on the CPU for all at once, so that its vectors
# are full; on a GPU for each, and so that neighbouring threads have neighbouring pixels.
RAYS = (
    f"    const int RUN = {RUN};"
    + """
    const int pixels = map.pixel.shape[0];
#if defined(__CUDA_ARCH__)
    const int WIDTH = 1, begin = run, step = map.runs;
#else
    const int WIDTH = RUN, begin = run * RUN, step = RUN;
#endif
    const int* const first = map.first.data;
    const int* const place = map.place.data;
    const float* const share = map.share.data;
    auto collect = [&](const float* rays, int pixel) {
        float light = 0.0f;
        for (int n = first[pixel]; n < first[pixel + 1]; ++n) light += share[n] * rays[place[n]];
        return light;
    };
    auto spread = [&](float light, int pixel, float* rays) {
        for (int n = first[pixel]; n < first[pixel + 1]; ++n) rays[place[n]] = share[n] * light;
    };
    auto darken = [&](float* rays) {
        const long long darks = map.dark.shape[0];
        const int last = (int)(darks * (run + 1) / map.runs);
        for (int n = (int)(darks * run / map.runs); n < last; ++n) rays[map.dark.data[n]] = 0.0f;
    };
    auto for_pixels = [&](auto work) {
        for (int done = 0, pixel = begin; done < RUN && pixel < pixels; done += WIDTH, pixel += step)
            work(pixel, pixels - pixel < WIDTH ? pixels - pixel : WIDTH);
    };
"""
)

_COLLECT = (
    RAYS
    + """
    for_pixels([&](int start, int count) {
        for (int k = start; k < start + count; ++k) image_out.data[map.pixel.data[k]] = collect(rays.data, k);
    });
"""
)

_SPREAD = (
    RAYS
    + """
    for_pixels([&](int start, int count) {
        for (int k = start; k < start + count; ++k) spread(image.data[map.pixel.data[k]], k, rays_out.data);
    });
    darken(rays_out.data);
"""
)


@wp.func_native(_COLLECT)
def _collect_run(run: int, map: Rays, rays: wp.array(dtype=float), image_out: wp.array(dtype=float)): ...


@wp.func_native(_SPREAD)
def _spread_run(run: int, map: Rays, image: wp.array(dtype=float), rays_out: wp.array(dtype=float)): ...


@wp.kernel
def _collect(
    # in
    first_run: int,
    map: Rays,
    rays: wp.array(dtype=float),
    # out
    image_out: wp.array(dtype=float),
):
    _collect_run(first_run + wp.tid(), map, rays, image_out)


@wp.kernel
def _spread(
    # in
    first_run: int,
    map: Rays,
    image: wp.array(dtype=float),
    # out
    rays_out: wp.array(dtype=float),
):
    _spread_run(first_run + wp.tid(), map, image, rays_out)


class RayMap:
    """The linear map from rays to pixels and its adjoint on the running device.

    Parameters
    ----------
    microimages : Microimages
        All rays of the camera.
    place : ndarray, shape (ray,), int32
        Where in memory the rays lie that voxels light, ascending.
    ray : ndarray, shape (ray,), int32
        Which rays they are; one ray may lie in several places, whose light adds up.
    """

    def __init__(self, microimages: Microimages, place: np.ndarray, ray: np.ndarray):
        device = runtime.device().warp
        share, pixel = microimages.share[ray], microimages.pixel[ray]
        lit = share > 0
        dark, place, share, pixel = place[~lit], place[lit], share[lit], pixel[lit]
        entry = np.arange(len(pixel), dtype=np.int32)
        order = np.zeros(int(np.prod(microimages.sensor_shape)), np.int32)
        order[pixel[::-1]] = entry[::-1]  # the first entry of each pixel: it is assigned last
        self.pixel: np.ndarray = pixel[order[pixel] == entry]
        """Sensor pixels that voxels light, in the order of their first rays, shape (pixel,), int32."""
        order[self.pixel] = np.arange(len(self.pixel), dtype=np.int32)
        shape = len(self.pixel), int(place.max(initial=0)) + 1
        by_pixel = sparse.csr_array((share, (order[pixel], place)), shape=shape)
        self.rays = Rays()
        for name, array in (
            ("pixel", self.pixel),
            ("first", by_pixel.indptr),
            ("place", by_pixel.indices),
            ("dark", dark),
        ):
            setattr(self.rays, name, wp.array(np.asarray(array, np.int32), dtype=int, device=device, copy=False))
        self.rays.share = wp.array(by_pixel.data, dtype=float, device=device, copy=False)
        self.rays.runs = -(-max(len(self.pixel), min(len(dark), 1)) // RUN)
        wp.load_module(sys.modules[__name__], device=device)  # before threads use it

    def spread(self, image: wp.array, rays_out: wp.array) -> None:
        """Give every ray its pixel's light times its share: the adjoint of `collect`."""
        self._launch(_spread, [image], rays_out)

    def collect(self, rays: wp.array, image_out: wp.array) -> None:
        """Sum the rays of every pixel, each times its share; pixels without rays are left as they are."""
        self._launch(_collect, [rays], image_out)

    def _launch(self, kernel, inputs, out) -> None:
        where = runtime.device().warp

        def launch(_, first, last):
            wp.launch(kernel, dim=last - first, inputs=[first, self.rays, *inputs], outputs=[out], device=where)

        runtime.run_chunks(self.rays.runs, launch)
