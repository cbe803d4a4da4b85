"""Images of particles and of single voxels by their own footprints, to judge the images of a form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from lfpiv.weights.blocks import WHOLE, Cuts, PackedCamera, blocks_of
from lfpiv.weights.ray_fit import ray_models
from lfpiv.weights.stored_grid import StoredGrid

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

PARTICLE_ERROR, WORST_PARTICLE_ERROR = 0.03, 0.04
"""Largest root mean square, and largest, of the relative L2 differences of images of particles from those by the
voxels' own footprints."""
PARTICLE_VOXEL = 0.85
"""Standard deviation of the particles whose images are compared, and of the smallest ones that are large enough
[voxel]."""
PARTICLES = 8
"""Number of particles whose images are compared."""
VOXELS_AT_A_TIME = 400
"""Voxels whose images are compared at a time: more take more memory."""
SEEDS = (1, 2, 3, 4)
"""Seeds of the samples of voxels whose images are compared."""


@dataclass(frozen=True)
class Sample:
    """Groups of voxels, such as particles, whose images are compared."""

    camera: CalibratedCamera
    voxels: np.ndarray
    """Indices of the voxels, shape (group, voxel)."""
    light: np.ndarray
    """Their light, shape (group, voxel)."""
    form: str
    """Form of the weights, "profiles" or "pixels"."""
    cuts: Cuts = WHOLE
    """Parts of a voxel along x, y, z."""

    @property
    def parts(self) -> list[slice]:
        """Groups that are compared at a time: those of some `VOXELS_AT_A_TIME` voxels."""
        groups, each = self.voxels.shape
        step = max(1, VOXELS_AT_A_TIME // each)
        return [slice(first, first + step) for first in range(0, groups, step)]

    def images(self, centres_mm: np.ndarray, voxel_mm: float, light: sparse.csr_array) -> sparse.csr_array:
        """Return sums of the images of cubes at some places with the light (group, cube), shape (group, pixel)."""
        models = ray_models(self.camera, centres_mm, voxel_mm, self.form)
        found = (
            light
            @ blocks_of(PackedCamera.from_camera(self.camera), [models], self.form, cuts=self.cuts).pixel_weights()
        )
        found.sum_duplicates()  # sorts the pixels, without which a difference takes time for each pixel of the sensor
        return found

    def own_images(self, stored: StoredGrid) -> list[sparse.csr_array]:
        """Return the images of each part of the groups by the voxels' own footprints, shapes (group, pixel)."""
        found = []
        for part in self.parts:
            voxels, light = self.voxels[part], self.light[part]
            each = np.arange(voxels.size + 1)
            groups = sparse.csr_array((light.ravel(), each[:-1], each[:: voxels.shape[1]]))
            found.append(self.images(stored.centres_mm(voxels.ravel()), stored.voxel_mm, groups))
        return found


def blobs_about(stored: StoredGrid, voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gaussian particles about some voxels, moved by parts of a voxel: indices and light, (particle, voxel)."""
    reach = math.ceil(3 * PARTICLE_VOXEL)
    steps = np.arange(-reach, reach + 1)
    last = np.array(stored.shape) - 1
    middle = np.stack(np.unravel_index(voxels, stored.shape), axis=1)
    middle = np.clip(middle, np.minimum(reach, last // 2), np.maximum(last - reach, last // 2))
    places, light = [], []
    for at, part in zip(middle, np.random.default_rng(SEEDS[0]).uniform(-0.5, 0.5, (len(voxels), 3)), strict=True):
        along = [np.clip(at[axis] + steps, 0, last[axis]) for axis in range(3)]
        places.append(np.ravel_multi_index(np.meshgrid(*along, indexing="ij"), stored.shape).ravel())
        of_axes = np.exp(-((steps - part[:, None]) ** 2) / (2 * PARTICLE_VOXEL**2))
        light.append(np.einsum("a,b,c->abc", *of_axes).ravel())
    return np.array(places), np.array(light)
