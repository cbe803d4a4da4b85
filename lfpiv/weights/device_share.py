"""Memory of a GPU: what volumes, images and correlation take of it, and what is left for the weights.

A GPU holds the weights of all cameras; the volumes that SMART works on, and the images;
then the volumes, the spline coefficients and a batch of windows of the correlation.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lfpiv.errors import InputError
from lfpiv.files import MIB, size_text
from lfpiv.geometry.grid import Grid
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction import projector_gpu
from lfpiv_kernels.reconstruction.depth_planes import PlaneShares
from lfpiv_kernels.reconstruction.projector import Blocks, Projector
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector
from lfpiv_kernels.reconstruction.separable_gpu import device_bytes
from lfpiv_kernels.reconstruction.separable_weights import PARTS, SeparableWeights

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

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
    """Of the weights of each camera."""
    beside: int
    """Of volumes, images and all else."""

    @property
    def whole(self) -> int:
        """Of all at once."""
        return self.beside + sum(self.cameras)


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

    def holds(self, sizes: Iterable[int]) -> bool:
        """Return whether the weights of all cameras [byte] fit; those of the CPU always do."""
        return self._left is None or sum(sizes) <= self._left

    def separable(self, name: str, weights: SeparableWeights, sets: int) -> SeparableProjector:
        """Make the projector of the next camera from profiles of planes; exceptions as of `projector`."""
        _, planes, columns = weights.shape
        lines, rays = (planes * weights.strips, columns), weights.ray_rows * weights.rays_of_row
        self._require(name, device_bytes(weights.nbytes, weights.level.size // PARTS, lines, rays, weights.ray_rows))
        projector = SeparableProjector(weights, sets)
        self._take(projector.device_bytes)
        return projector

    def projector(self, name: str, blocks: Blocks, planes: PlaneShares | None = None) -> Projector:
        """Make the projector of the next camera.

        Raises
        ------
        InputError
            If the weights do not fit into the memory that is left.
        """
        counts, edge = (len(blocks.scale), len(blocks.ray), len(blocks.value)), blocks.microimages.edge
        self._require(name, projector_gpu.device_bytes(blocks.form, *counts, edge=edge), projector_gpu.MOST_BYTES)
        projector = Projector(blocks, planes)
        self._take(projector.device_bytes)
        return projector

    def _require(self, name: str, size: int, most: float = math.inf) -> None:
        """Refuse weights of a camera [byte] that do not fit."""
        if self._left is not None and size > (left := min(self._left, most)):
            raise InputError(
                f"weights: those of camera {name!r} take {size_text(size)} of the GPU's memory, of which "
                f"{size_text(max(left, 0))} are left. Raise volume.voxel_mm, shrink volume.size_mm, use fewer workers "
                "per GPU, or --device cpu."
            )

    def _take(self, size: int) -> None:
        if self._left is not None:
            self._left -= size
