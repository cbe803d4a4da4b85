"""Memory that is left for the weights, and what volumes, images and correlation take of a GPU.

A GPU holds the weights of all cameras; the volumes that SMART works on, and the images;
then the volumes, the spline coefficients and a batch of windows of the correlation.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.errors import InputError
from lfpiv.files import MIB, size_text
from lfpiv.geometry.grid import Grid
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.ray_projector import RayProjector

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.choice import Choice

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


class MemoryLeft:
    """Memory that is left for the weights of a grid, on the host and on the running GPU.

    Parameters
    ----------
    cameras : collection of CalibratedCamera
        All cameras of the grid.
    limit_bytes : float
        Memory that the weights may take on the host [byte]; default: no limit.
    """

    def __init__(self, cameras: Collection[CalibratedCamera], grid: Grid, limit_bytes: float = math.inf):
        free = runtime.free_bytes()
        self._host, self._shape = limit_bytes, grid.shape
        self._device = None if free is None else free - beside_bytes(cameras, grid)

    def holds(self, host: int, device: int) -> bool:
        """Return whether weights of some sizes fit [byte]; weights of the CPU need no memory of a device."""
        return host <= self._host and (self._device is None or device <= self._device)

    def require(self, name: str, choice: Choice, host: int) -> None:
        """Raise InputError if the weights of a camera do not fit on the host [byte]."""
        if host <= self._host:
            return
        voxels, other = " x ".join(map(str, self._shape)), ""
        if choice.profile_errors and choice.form == "pixels":
            percent = 100 * np.mean(choice.profile_errors)
            other = f", or set compute.weights_form to 'profiles', {percent:.0f} % from counted rays here"
        raise InputError(
            f"volume: the weights of {voxels} voxels (z, y, x) on camera {name!r} need {host / 2**30:.1f} GiB as "
            f"{choice.form}, {max(self._host, 0) / 2**30:.1f} GiB are left. Raise volume.voxel_mm, shrink "
            f"volume.size_mm{other}."
        )

    def require_device(self, name: str, size: int, most: float = math.inf) -> None:
        """Raise InputError if the weights of a camera do not fit into the GPU [byte], or are more than `most`."""
        if self._device is None or size <= min(self._device, most):
            return
        left = max(int(min(self._device, most)), 0)
        raise InputError(
            f"weights of camera {name!r} take {size_text(size)} of the GPU's memory, of which {size_text(left)} "
            "are left. Raise volume.voxel_mm, shrink volume.size_mm, use fewer workers per GPU, or --device cpu."
        )

    def take(self, projector: RayProjector) -> None:
        """Count the memory of built weights as taken."""
        self._host -= projector.nbytes
        if self._device is not None:
            self._device -= projector.device_bytes
