"""Warp: the light of a sensor's pixels as rays, and back, for those rays that voxels light.

A pixel at the edge of two microimages sees two parts of the pupil through two lenses; its rays are kept apart, each
with the share of the pixel's cell that lies inside the pupil. So a voxel's weights need no coverage of their own, and a
microimage lies in one piece of memory. The loops are C++: as Warp's they take three times as long on the CPU. Twin:
``reference.dense``.
"""

import sys
from collections.abc import Sequence

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.weights.microimages import Microimages

wp.set_module_options(native.options("pixel_rays.h"))

RUN = native.constant("pixel_rays.h", "RUN")
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


@wp.func_native("lfpiv::collect(lfpiv::pixel_run(map, run), rays.data, image_out.data);")
def _collect_run(run: int, map: Rays, rays: wp.array(dtype=float), image_out: wp.array(dtype=float)): ...


@wp.func_native("lfpiv::spread(lfpiv::pixel_run(map, run), image.data, rays_out.data);")
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


@wp.func_native("""
    lfpiv::number_pixels(
        {light.data, parts.data, (int)parts.shape[0], starts.data, pixel.data, share.data},
        number_out.data, pixel_out.data, first_out.data, count_out.data
    );
""")
def _number(
    light: wp.array(dtype=float),
    parts: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    share: wp.array(dtype=float),
    number_out: wp.array(dtype=int),
    pixel_out: wp.array(dtype=int),
    first_out: wp.array(dtype=int),
    count_out: wp.array(dtype=int),
): ...


@wp.func_native("""
    lfpiv::sort_rays(
        {light.data, parts.data, (int)parts.shape[0], starts.data, pixel.data, share.data},
        number.data, first_out.data, place_out.data, share_out.data, dark_out.data
    );
""")
def _sort(
    light: wp.array(dtype=float),
    parts: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    share: wp.array(dtype=float),
    number: wp.array(dtype=int),
    first_out: wp.array(dtype=int),
    place_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
    dark_out: wp.array(dtype=int),
): ...


@wp.kernel
def _number_pixels(
    # in
    light: wp.array(dtype=float),
    parts: wp.array(dtype=int),  # where each part's rays begin in `light`, and the end of the last
    starts: wp.array(dtype=int),  # the first ray of each part
    pixel: wp.array(dtype=int),  # of each ray
    share: wp.array(dtype=float),
    # out
    number_out: wp.array(dtype=int),  # (sensor pixel,): 1, 2, ... as light comes to them; 0 in the dark
    pixel_out: wp.array(dtype=int),
    first_out: wp.array(dtype=int),  # (sensor pixel + 2,): where the rays of each number begin
    count_out: wp.array(dtype=int),  # pixels, rays, dark places
):
    _number(light, parts, starts, pixel, share, number_out, pixel_out, first_out, count_out)


@wp.kernel
def _sort_rays(
    # in
    light: wp.array(dtype=float),
    parts: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    share: wp.array(dtype=float),
    number: wp.array(dtype=int),
    # out
    first_out: wp.array(dtype=int),  # where the rays of each number end, that is those of the next begin
    place_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
    dark_out: wp.array(dtype=int),
):
    _sort(light, parts, starts, pixel, share, number, first_out, place_out, share_out, dark_out)


class RayMap:
    """The linear map from rays to pixels and its adjoint on the running device.

    Parameters
    ----------
    microimages : Microimages
        All rays of the camera.
    light : ndarray, shape (place,), float32
        Light of the rays where they lie in memory, part after part; those that voxels light are not zero.
    parts : sequence of int
        Where each part's rays begin, and the end of the last.
    starts : sequence of int
        The first ray of each part; one ray may lie in several parts, whose light adds up.
    """

    def __init__(self, microimages: Microimages, light: np.ndarray, parts: Sequence[int], starts: Sequence[int]):
        device = runtime.device().warp
        for where in {"cpu", device}:
            wp.load_module(sys.modules[__name__], device=where)  # before threads use it
        size = int(np.prod(microimages.sensor_shape))
        rays = [light, *(np.array(ends, np.int32) for ends in (parts, starts)), microimages.pixel, microimages.share]
        number, seen, first, count = (np.zeros(length, np.int32) for length in (size, size, size + 2, 3))
        _on_cpu(_number_pixels, rays, [number, seen, first, count])
        pixels, lit, darks = (int(n) for n in count)
        place, share, dark = np.empty(lit, np.int32), np.empty(lit, np.float32), np.empty(darks, np.int32)
        _on_cpu(_sort_rays, [*rays, number], [first, place, share, dark])
        self.pixel: np.ndarray = seen[:pixels].copy()
        """Sensor pixels that voxels light, in the order of their first rays, shape (pixel,), int32."""
        self.rays = Rays()
        arrays = {
            "pixel": self.pixel,
            "first": first[: pixels + 1].copy(),
            "place": place,
            "share": share,
            "dark": dark,
        }
        for name, array in arrays.items():
            setattr(self.rays, name, wp.array(array, device=device, copy=False))
        self.rays.runs = -(-max(pixels, min(darks, 1)) // RUN)

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


def _on_cpu(kernel, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
    """Run a kernel once on arrays in the CPU's memory."""
    inputs, outputs = ([wp.array(array, device="cpu", copy=False) for array in some] for some in (inputs, outputs))
    wp.launch(kernel, dim=1, inputs=inputs, outputs=outputs, device="cpu")
