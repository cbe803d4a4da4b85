"""Memory of a GPU: what volumes, images and correlation take of it, and what is left for the weights.

A GPU holds the weights of all cameras, or the part of them that fits; the volumes that SMART works on, and the images;
then the volumes, the spline coefficients and a batch of windows of the correlation.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lfpiv.errors import InputError
from lfpiv.files import MIB, size_text
from lfpiv.geometry.grid import Grid
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.depth_planes import PlaneShares
from lfpiv_kernels.reconstruction.projector import Blocks, Projector
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector
from lfpiv_kernels.reconstruction.projector_streamed import SLAB_BYTES, least_bytes
from lfpiv_kernels.reconstruction.separable_gpu import device_bytes
from lfpiv_kernels.reconstruction.separable_weights import PARTS, SeparableWeights

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

VOLUMES, VOLUMES_PER_CAMERA = 10, 4
"""Largest number of volumes that SMART has on the GPU at once: coefficients, light, exponent, momentum, their sums and
those that are copied; for each camera the sums of its weights and of its subsets, and the steps of these."""
ARRAYS_PER_PIXEL = 7
"""The same of images per camera: image, gain, light that is held, logarithm, pixels that are shown, and those that are
copied."""
CORRELATED_BYTES, BATCH_BYTES = 100, 192 * MIB
"""Memory of the correlation per voxel, and beside that [byte]: both volumes, deformed and as splines, and windows with
their spectra. Counted in volumes of 48 to 128 voxels along each edge, with windows up to 48."""
VALUE_BYTES = 4
"""Memory of a voxel or a pixel in one array [byte]."""
BASE_BYTES = 1536 * MIB
"""Memory of the driver's context, the kernels, and 1 GiB that Taichi reserves at its start [byte]."""


@dataclass(frozen=True)
class DeviceNeed:
    """Memory that a process needs on its GPU [byte]."""

    cameras: tuple[int, ...]
    """Of the weights of each camera at once."""
    beside: int
    """Of all that cannot be streamed."""

    @property
    def weights(self) -> int:
        """Of the weights of all cameras at once."""
        return sum(self.cameras)

    @property
    def whole(self) -> int:
        """What is needed so that nothing is streamed. Each camera has room for the buffers at least."""
        return self.beside + sum(max(size, least_bytes()) for size in self.cameras)

    @property
    def least(self) -> int:
        """What is needed if the weights are streamed."""
        return self.beside + len(self.cameras) * least_bytes()

    def streamed(self, free: int) -> int:
        """Return the memory of the weights that each pass copies, and that the host holds for it, at a free memory."""
        return 0 if free >= self.whole else max(self.weights - max(free - self.least, 0), 0)

    def slabs(self, free: int) -> int:
        """Return the number of slabs that are streamed at a free memory [byte], about."""
        return -(-self.streamed(free) // SLAB_BYTES)


def rays_bytes(camera: CalibratedCamera) -> int:
    """Return the memory of a camera's rays and of the map between them and the pixels [byte]."""
    return 4 * (5 + 2) * camera.microimages.size + 24 * runtime.CHUNKS


def beside_bytes(cameras: Collection[CalibratedCamera], grid: Grid) -> int:
    """Return the memory that a process needs on its GPU for all but the weights [byte]."""
    pixels = sum(math.prod(camera.optics.sensor_shape) for camera in cameras)
    volumes = VALUE_BYTES * (VOLUMES + VOLUMES_PER_CAMERA * len(cameras)) * grid.size
    smart = volumes + VALUE_BYTES * ARRAYS_PER_PIXEL * pixels
    return BASE_BYTES + sum(map(rays_bytes, cameras)) + max(smart, BATCH_BYTES + CORRELATED_BYTES * grid.size)


class DeviceShare:
    """Free memory of the running GPU for the weights of a grid. The cameras take of it one after the other.

    Parameters
    ----------
    cameras : collection of CalibratedCamera
        All cameras of the grid.
    grid : Grid
        The voxels.
    """

    def __init__(self, cameras: Collection[CalibratedCamera], grid: Grid):
        free = runtime.free_bytes()
        self._left = None if free is None else free - beside_bytes(cameras, grid)
        self._to_come = len(cameras)
        self._shape = grid.shape

    def holds(self, sizes: Iterable[int]) -> bool:
        """Return whether the weights of all cameras [byte] fit at once; those of the CPU always do."""
        return self._left is None or sum(max(size, least_bytes()) for size in sizes) <= self._left

    def separable(self, name: str, weights: SeparableWeights, sets: int) -> SeparableProjector:
        """Make the projector of the next camera from profiles of planes, which are not streamed.

        Raises
        ------
        InputError
            If they do not fit into the memory that is left.
        """
        self._to_come -= 1
        _, planes, columns = weights.shape
        lines, rays = (planes * weights.strips, columns), weights.ray_rows * weights.rays_of_row
        size = device_bytes(weights.nbytes, weights.level.size // PARTS, lines, rays, weights.ray_rows)
        if self._left is not None and size > self._left:
            raise InputError(
                f"weights: those of camera {name!r} take {size_text(size)} of the GPU's memory, of which "
                f"{size_text(max(self._left, 0))} are left. Use fewer workers per GPU, or --device cpu."
            )
        projector = SeparableProjector(weights, sets)
        if self._left is not None:
            self._left -= projector.device_bytes
        return projector

    def projector(self, name: str, blocks: Blocks, planes: PlaneShares | None = None) -> Projector:
        """Make the projector of the next camera. Its weights are streamed where they do not fit.

        Raises
        ------
        InputError
            If volumes and images leave too little memory even for streamed weights.
        """
        self._to_come -= 1
        limit = None if self._left is None else self._left - self._to_come * least_bytes()
        try:
            projector = Projector(blocks, planes, limit)
        except MemoryError as error:
            voxels = " x ".join(map(str, self._shape))
            raise InputError(f"volume: {voxels} voxels (z, y, x) on camera {name!r}: {error}") from None
        if self._left is not None:
            self._left -= projector.device_bytes
        if (slabs := projector.streamed) is not None:
            there, back = slabs.pass_bytes
            log.info(
                "weights of camera %r are streamed: %d slabs, %d stay on the GPU; a projection copies %s, a back "
                "projection %s",
                *(name, slabs.count, slabs.resident, size_text(there), size_text(back)),
            )
        return projector
