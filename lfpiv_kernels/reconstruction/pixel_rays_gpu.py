"""The map between rays and pixels on a GPU, a lane for each pixel; CPU form: ``pixel_rays`` and ``update``.

Neighbouring lanes have neighbouring pixels, whose rays are neighbours in memory.
"""

from collections.abc import Sequence

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.lanes import lanes_of_warp
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction.pixel_layout import PixelRays

wp.set_module_options(native.options("pixel_rays_gpu.h"))

WARPS: int = native.constant("pixel_rays_gpu.h", "PIXEL_WARPS")
"""Warps that go through the pixels of a camera."""


@native.kernel("lfpiv::collect_pixels(map, warp, rays.data, image_out.data);", "warp", "_lane")
def _collect(
    # in
    map: PixelRays,
    rays: wp.array(dtype=float),
    first_warp: int,
    # out
    image_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::spread_pixels(map, warp, image.data, rays_out.data);", "warp", "_lane")
def _spread(
    # in
    map: PixelRays,
    image: wp.array(dtype=float),
    first_warp: int,
    # out
    rays_out: wp.array(dtype=float),
): ...


@native.kernel(
    """
    lfpiv::compare_pixels(
        map, warp, image.data, gain.data, floor, rays.data, rays_out.data, squares_out.data, divergence_out.data
    );
    """,
    "warp",
    "_lane",
)
def _compare(
    # in
    map: PixelRays,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
    rays: wp.array(dtype=float),
    first_warp: int,
    # out
    rays_out: wp.array(dtype=float),
    squares_out: wp.array(dtype=wp.float64),  # per warp
    divergence_out: wp.array(dtype=wp.float64),
): ...


def collect(map: PixelRays, rays: wp.array, image_out: wp.array) -> None:
    """Sum the rays of every pixel, each times its share. Pixels without rays do not change."""
    launch(Call(_collect, WARPS, [map, rays], [image_out], inner=lanes_of_warp()))


def spread(map: PixelRays, image: wp.array, rays_out: wp.array) -> None:
    """Write each pixel's light, times their shares, on its rays."""
    launch(Call(_spread, WARPS, [map, image], [rays_out], inner=lanes_of_warp()))


def compare(inputs: Sequence[object], outputs: Sequence[wp.array]) -> int:
    """Write the corrections on the rays and the misfit's sums of each warp, see ``update.Comparison.compare``.

    Inputs and outputs are those of the kernel. Return the number of warps.
    """
    launch(Call(_compare, WARPS, inputs, outputs, inner=lanes_of_warp()))
    return WARPS
