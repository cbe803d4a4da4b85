"""Blobs in a small volume, and their noisy images."""

import numpy as np
from support.ideal_rig import optics, two_cameras

import lfpiv
from lfpiv.reconstruction.sieve import Sieve

NOISE = 8.0  # counts


def noisy_blobs(count):
    """Weights of a volume of 10 x 16 x 16 voxels, so many blobs in it, and their noisy images by camera."""
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.6, 1.0), voxel_mm=0.1)
    weights = lfpiv.build_weights(two_cameras(optics=optics(rows=400, columns=440)), grid, form="profiles")
    rng = np.random.default_rng(3)
    coefficients = np.zeros(grid.size, np.float32)
    coefficients[rng.choice(grid.size, count, replace=False)] = 4e5
    truth = Sieve(0.6, grid.shape)(coefficients).reshape(grid.shape)
    noisy = {
        name: (image + rng.normal(0, NOISE, image.shape)).astype(np.float32) for name, image in weights(truth).items()
    }
    return weights, truth, noisy
