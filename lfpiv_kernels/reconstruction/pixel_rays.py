"""Warp: the linear map between the rays of a camera and the pixels of its sensor, for those rays that voxels light.

A pixel at the edge of two microimages sees two parts of the pupil through two lenses. It has a ray for each, with the
share of the pixel's cell that lies inside the pupil: image[p] = sum of share[r] * light[r] over the rays r of pixel p.
The rays of a microimage are neighbours in memory. The loops are C++, see ``pixel_rays.h``; a GPU has those of
``pixel_rays_gpu``. Twin: ``reference.dense``.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction import pixel_rays_gpu
from lfpiv_kernels.reconstruction.pixel_layout import PixelRays
from lfpiv_kernels.transfer import to_device
from lfpiv_kernels.weights.microimages import LAYERS, Microimages

wp.set_module_options(native.options("pixel_rays.h"))

ALL = -1
"""In place of the number of a set: the rays of all sets."""
MOST_SETS: int = native.constant("pixel_rays.h", "MOST_SETS")
"""Sets of rays at most."""
RUN: int = native.constant("pixel_rays.h", "RUN")
"""Pixels that a thread goes through."""


@wp.struct
class PlacedRays:
    """Rays in memory, part after part, and what each ray of the camera belongs to."""

    light: wp.array(dtype=float)
    """Per place; not zero where voxels light the ray."""
    parts: wp.array(dtype=int)
    """Where each part's rays begin in `light`, and the end of the last."""
    starts: wp.array(dtype=int)
    """The first ray of each part."""
    pixel: wp.array(dtype=int)
    """Sensor pixel of each ray."""
    share: wp.array(dtype=float)
    """Fraction of the pixel's cell that each ray stands for."""
    size: int
    """Pixels of the sensor."""
    set_of: wp.array(dtype=wp.uint8)
    """Set of each group of rays."""
    group: int
    """Rays of a group."""
    sets: int


@native.kernel("lfpiv::collect(lfpiv::pixel_run(map, run), rays.data, image_out.data);")
def _collect(
    # in
    map: PixelRays,
    rays: wp.array(dtype=float),
    first_run: int,
    # out
    image_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::spread(lfpiv::pixel_run(map, run), image.data, rays_out.data);")
def _spread(
    # in
    map: PixelRays,
    image: wp.array(dtype=float),
    first_run: int,
    # out
    rays_out: wp.array(dtype=float),
): ...


@native.kernel("""
    lfpiv::number_pixels(lfpiv::placed_rays(placed), number_out.data, pixel_out.data, first_out.data, count_out.data);
""")
def _number_pixels(
    # in
    placed: PlacedRays,
    # out
    number_out: wp.array(dtype=int),  # (sensor pixel,): 1, 2, ... in their order; 0 without light
    pixel_out: wp.array(dtype=int),  # sensor pixel of each number
    first_out: wp.array(dtype=int),  # (sensor pixel + 2,): where the rays of each number begin
    count_out: wp.array(dtype=int),  # ends of the pixels of each set and of all; rays, dark places
): ...


@native.kernel("""
    lfpiv::sort_rays(
        lfpiv::placed_rays(placed), number.data, first_out.data, place_out.data, share_out.data, dark_out.data
    );
""")
def _sort_rays(
    # in
    placed: PlacedRays,
    number: wp.array(dtype=int),
    # out
    first_out: wp.array(dtype=int),  # in: of `_number_pixels`; out: where the rays of each number end
    place_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
    dark_out: wp.array(dtype=int),
): ...


class Rays(Protocol):
    """All rays of a camera."""

    pixel: np.ndarray
    """Sensor pixel of each ray, shape (ray,), int32: -1 outside the sensor."""
    share: np.ndarray
    """Fraction of the pixel's cell that each ray stands for, shape (ray,), float32."""
    sensor_shape: tuple[int, int]
    """Rows and columns of the sensor [pixel]."""


@dataclass(frozen=True)
class RaySets:
    """Rays divided into sets that can be taken alone."""

    of_group: np.ndarray
    """Set of each group of rays, from 0 on, shape (group,), uint8."""
    group: int
    """Number of rays of a group; they are neighbours in memory."""
    count: int
    """Number of sets, at most `MOST_SETS`."""

    @classmethod
    def single(cls, rays: int) -> "RaySets":
        """Return one set of all rays."""
        return cls(np.zeros(1, np.uint8), max(rays, 1), 1)

    @classmethod
    def of_lenses(cls, microimages: Microimages) -> "RaySets":
        """Return the rays of even and of odd lenses. Neighbours in a row or column of lenses differ."""
        group, lenses = microimages.edge**2, microimages.lenses
        row, lens = np.divmod(np.arange(-(-microimages.size // group)), lenses)
        return cls(((lens + row // LAYERS) % 2).astype(np.uint8), group, 2)

    @classmethod
    def of_rows(cls, microimages: Microimages, count: int) -> "RaySets":
        """Return the rays of every `count`-th row of pixels under each lens."""
        edge = microimages.edge
        return cls((np.arange(-(-microimages.size // edge)) % edge % count).astype(np.uint8), edge, count)


class RayMap:
    """The linear map from rays to pixels and its adjoint on the running device.

    Parameters
    ----------
    camera_rays : Rays
        All rays of the camera.
    light : ndarray, shape (place,), float32
        Light of the rays where they lie in memory, part after part. It is not zero where voxels light a ray.
    parts : sequence of int
        Where each part's rays begin, and the end of the last.
    starts : sequence of int
        The first ray of each part. A ray may lie in several parts; their light adds up.
    darken : bool
        Whether `spread` writes zero on rays that voxels light but no pixel of the set sees.
    places : callable, optional
        Where rays lie in the device's memory by their place in `light`. Default: at the same place.
    """

    def __init__(
        self,
        camera_rays: Rays,
        light: np.ndarray,
        parts: Sequence[int],
        starts: Sequence[int],
        *,
        sets: RaySets,
        darken: bool = True,
        places: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        size = int(np.prod(camera_rays.sensor_shape))
        placed = PlacedRays()
        placed.light, placed.pixel, placed.share = map(_on_cpu, (light, camera_rays.pixel, camera_rays.share))
        placed.parts, placed.starts = (_on_cpu(np.array(ends, np.int32)) for ends in (parts, starts))
        placed.size, placed.sets = size, sets.count
        placed.set_of, placed.group = _on_cpu(sets.of_group), sets.group
        number, seen, first, count = (np.zeros(length, np.int32) for length in (size, size, size + 2, sets.count + 3))
        _run_once(_number_pixels, [placed], [number, seen, first, count])
        *ends, pixels, lit, darks = count.tolist()
        place, share, dark = np.empty(lit, np.int32), np.empty(lit, np.float32), np.empty(darks, np.int32)
        _run_once(_sort_rays, [placed, _on_cpu(number)], [first, place, share, dark])
        if places is not None:
            place, dark = places(place), places(dark)
        if not darken:
            dark = dark[:0]
        self.pixel: np.ndarray = seen[:pixels].copy()
        """Sensor pixels that voxels light, in the order of `PixelRays`, shape (pixel,), int32."""
        arrays = {
            "pixel": self.pixel,
            "first": first[: pixels + 1].copy(),
            "place": place,
            "share": share,
            "dark": dark,
        }
        on_device = {name: to_device(array) for name, array in arrays.items()}
        self.rays = _pixels(on_device, 0, pixels, pixels)
        """The rays of all pixels."""
        aside = ends[-1] if darken else pixels
        self.of_sets = tuple(_pixels(on_device, a, b, aside) for a, b in itertools.pairwise([0, *ends]))
        """For each set the rays of the pixels that see this set only."""

    def rays_of(self, number: int) -> PixelRays:
        """Return the rays of the pixels that see one set only, or of all pixels for `ALL`."""
        return self.rays if number == ALL else self.of_sets[number]

    def spread(self, image: wp.array, rays_out: wp.array) -> None:
        """Write each pixel's light, times their shares, on its rays: the adjoint of `collect`."""
        if runtime.device().form == "gpu":
            pixel_rays_gpu.spread(self.rays, image, rays_out)
            return
        launch(Call(_spread, self.rays.runs, [self.rays, image], [rays_out]), parts=runtime.CHUNKS)

    def collect(self, rays: wp.array, image_out: wp.array) -> None:
        """Sum the rays of every pixel, each times its share. Pixels without rays do not change."""
        if runtime.device().form == "gpu":
            pixel_rays_gpu.collect(self.rays, rays, image_out)
            return
        launch(Call(_collect, self.rays.runs, [self.rays, rays], [image_out]), parts=runtime.CHUNKS)


def _pixels(arrays: dict[str, wp.array], start: int, end: int, aside: int) -> PixelRays:
    """Return the rays of the pixels from `start` to `end`. Those of pixels from `aside` on stay dark."""
    rays = PixelRays()
    for name, array in arrays.items():
        setattr(rays, name, array)
    rays.start, rays.end, rays.aside, rays.asides = start, end, aside, arrays["pixel"].size
    rays.runs = -(-max(end - start, min(arrays["dark"].size + rays.asides - aside, 1)) // RUN)
    return rays


def _on_cpu(array: np.ndarray) -> wp.array:
    return to_device(array, device="cpu")


def _run_once(kernel: wp.Kernel, inputs: list[object], outputs: list[np.ndarray]) -> None:
    """Run one thread of a kernel on arrays in the CPU's memory: the work is bound by memory."""
    runtime.device()
    wp.launch(kernel, dim=1, inputs=inputs, outputs=[_on_cpu(array) for array in outputs], device="cpu")
