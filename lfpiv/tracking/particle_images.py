"""Images of single particles at any place, through the ray models of the calibrated cameras, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from lfpiv.weights.blocks import PackedCamera
from lfpiv.weights.ray_fit import ray_models
from lfpiv_kernels.rays.lattice import cell_rectangles
from lfpiv_kernels.weights.gaussian import GaussianImages, ImageLists

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

LEAST_SIGMA_VOXEL = 0.1
"""Least standard deviation of a particle in the model [voxel]."""


@dataclass(frozen=True, kw_only=True)
class ParticleImages:
    """Model of the images of Gaussian particles of one size. Pixels of all cameras are numbered one after the other."""

    cameras: Mapping[str, CalibratedCamera]
    """Cameras by name."""
    voxel_mm: float
    """Edge of a voxel, the unit of sizes and derivatives [mm]."""
    sigma_voxel: float
    """Standard deviation of a particle [voxel]."""
    kernels: Mapping[str, GaussianImages] = field(default_factory=dict)
    """Camera name -> its kernel, made when first needed and shared by models of other sizes."""

    @cached_property
    def first_pixel(self) -> np.ndarray:
        """Number of the first pixel of each camera, and the end of the last, shape (camera + 1,)."""
        sizes = [int(np.prod(camera.optics.sensor_shape)) for camera in self.cameras.values()]
        return np.concatenate([[0], np.cumsum(sizes)])

    def of_size(self, sigma_voxel: float) -> ParticleImages:
        """Return the model of particles of another size."""
        return replace(self, sigma_voxel=max(sigma_voxel, LEAST_SIGMA_VOXEL), kernels=self._kernels)

    @cached_property
    def _kernels(self) -> Mapping[str, GaussianImages]:
        return self.kernels or {name: _kernel(camera) for name, camera in self.cameras.items()}

    def lists(self, positions_mm: np.ndarray) -> list[ImageLists]:
        """Return for each camera the pixels of particles of unit light with derivatives by the position [1 / voxel].

        Parameters
        ----------
        positions_mm : ndarray, shape (particle, 3)
            Positions (x, y, z) [mm].
        """
        sigma = max(self.sigma_voxel, LEAST_SIGMA_VOXEL)
        return [
            self._kernels[name](ray_models(camera, positions_mm, self.voxel_mm), sigma)
            for name, camera in self.cameras.items()
        ]

    def matrices(self, positions_mm: np.ndarray) -> list[sparse.csr_array]:
        """Return for each camera the images of particles of unit light, shape (particle, pixel), float64.

        Parameters
        ----------
        positions_mm : ndarray, shape (particle, 3)
            Positions (x, y, z) [mm].
        """
        found = []
        for own, pixels in zip(self.lists(positions_mm), np.diff(self.first_pixel), strict=True):
            shape = len(positions_mm), int(pixels)
            found.append(sparse.csr_array((own.values[:, 3].astype(float), own.pixel, own.first), shape=shape))
        return found


def _kernel(camera: CalibratedCamera) -> GaussianImages:
    packed = PackedCamera.from_camera(camera)
    rectangles = cell_rectangles(camera.lattice.layout)
    return GaussianImages(
        packed.camera,
        packed.lattice,
        camera.microimages,
        frame=packed.frame,
        rectangles=rectangles,
        gain=camera.gain,
    )
