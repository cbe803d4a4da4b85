"""`ParticleImager`: images of Gaussian particles at any place, through the calibrated mapping of every camera.

A particle is a few small cubes whose brightnesses follow a Gaussian. The kernels that integrate the weights of voxels
integrate the footprint of each cube, so that particles need not lie at the centres of voxels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from lfpiv.weights.blocks import PackedCamera, blocks_of
from lfpiv.weights.operator import Images, Weights
from lfpiv.weights.ray_fit import ray_models
from lfpiv_kernels.reconstruction.projector import Projector

EDGE_SIGMA = math.sqrt(2)
"""Edge of a particle's cubes, as a multiple of its standard deviation. Three of them along an axis make a particle."""
OUTER_LIGHT = (1 / EDGE_SIGMA**2 - 1 / 12) / 2
"""Light of each outer cube along an axis, so that the variance is that of the particle."""
POINT_VOXEL = 0.5
"""Edge of the single cube of particles that are smaller than voxels [voxel]."""
LEAST_SIGMA_VOXEL = 0.3
"""Least standard deviation of a particle of several cubes [voxel]."""
CUBES = 200_000
"""Cubes whose footprints are in memory at once."""


class ParticleImager:
    """Images of particles of one size in the cameras of an operator.

    Parameters
    ----------
    weights : Weights
        The operator: its cameras, its voxels' edge and the form of its footprints are used.
    sigma_voxel : float
        Standard deviation of the particles [voxel]. Below `LEAST_SIGMA_VOXEL` they are cubes of `POINT_VOXEL`.
    """

    def __init__(self, weights: Weights, sigma_voxel: float):
        voxel_mm = weights.grid.voxel_mm
        if sigma_voxel < LEAST_SIGMA_VOXEL:
            self._edge_mm, self._steps, self._light = POINT_VOXEL * voxel_mm, np.zeros((1, 3)), np.ones(1)
        else:
            self._edge_mm = EDGE_SIGMA * sigma_voxel * voxel_mm
            self._steps = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
            self._light = np.where(self._steps == 0, 1 - 2 * OUTER_LIGHT, OUTER_LIGHT).prod(axis=1)
        self._cameras = {name: (PackedCamera.from_camera(camera), camera) for name, camera in weights.cameras.items()}
        self._forms = weights.forms

    def __call__(self, positions_mm: np.ndarray, light: np.ndarray) -> Images:
        """Return the image of every camera without noise, shape (rows, columns), float32.

        Parameters
        ----------
        positions_mm : ndarray, shape (particle, 3)
            Centres (x, y, z) [mm].
        light : ndarray, shape (particle,)
            Light of each particle, in the unit of the images divided by the weights.
        """
        images = {}
        for name, (packed, camera) in self._cameras.items():
            image = np.zeros(camera.optics.sensor_shape, np.float32)
            part = np.empty(image.size, np.float32)
            for some in self._batches(len(positions_mm)):
                models = _shifted(ray_models(camera, positions_mm[some], self._edge_mm, self._forms[name]), self._steps)
                cubes = Projector(blocks_of(packed, [models], self._forms[name]))
                values = (light[some, None] * self._light).astype(np.float32).ravel()
                image += cubes.project(values, part).reshape(image.shape)
            images[name] = np.multiply(image, camera.gain, out=image)
        return images

    def _batches(self, count: int) -> Iterator[slice]:
        """Yield slices of the particles whose cubes are in memory at once."""
        step = max(1, CUBES // len(self._light))
        for first in range(0, count, step):
            yield slice(first, first + step)


def _shifted(models: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the ray models of cubes `steps` (cube, 3) edges away from each model's, shape (model * cube, 38).

    A model holds the differences of the mapping between opposite faces of its cube, which is one edge wide.
    """
    every = np.repeat(models, len(steps), axis=0).reshape(len(models), len(steps), -1)
    fits = every[..., :12].reshape(*every.shape[:2], 2, 6)
    points = models[:, 12:18].reshape(-1, 3, 2)  # axis of the world, axis of the lens array
    slopes = models[:, 18:30].reshape(-1, 3, 2, 2)
    fits[..., 0] += np.einsum("ca,mas->mcs", steps, points)
    fits[..., 1:3] += np.einsum("ca,masp->mcsp", steps, slopes)
    every[..., :12] = fits.reshape(*every.shape[:2], 12)
    return np.ascontiguousarray(every.reshape(-1, models.shape[1]), np.float32)
