"""Put two particles in place of one that the images do not fit.

Two particles closer than their images are wide give one candidate between them. Its image is brighter than theirs
beside their middles and darker at their ends, and its light is that of both. No round of the search mends that: where
it is removed, its light gives the same candidate again. So pairs are tried along directions all around it, at some
distances. The light of a pair in each camera follows from linear least squares, and the pair that explains most is
taken if the images tell it from one particle.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy import sparse

from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Normal, Scene

HALF_DISTANCES = 0.6, 1.0
"""Distances of a pair's particles from the one that they replace [voxel]."""
DIRECTIONS = np.array(
    [
        at / np.linalg.norm(at)
        for at in np.array(list(itertools.product((-1, 0, 1), repeat=3)), float)
        if tuple(at) > (0, 0, 0)
    ]
)
"""Directions of a cube's neighbours, of two opposite directions the first, shape (direction, 3)."""
LEAST_GAIN = 25.0
"""Least squared residual that a pair must explain beyond one particle [noise^2]."""
GAIN_SHARE = 0.5
"""The same, as a share of what one particle leaves beyond noise."""


def split(images: ParticleImages, scene: Scene, cloud: Cloud, normal: Normal, chosen: np.ndarray) -> Cloud:
    """Return pairs of particles in place of some of those whose images one particle does not explain.

    Parameters
    ----------
    images : ParticleImages
        Model of the images.
    chosen : ndarray, shape (particle,), bool
        Particles to replace.

    Returns
    -------
    Cloud
        Two particles for each chosen one that a pair replaces. None for the others.
    """
    apart = np.concatenate([distance * DIRECTIONS for distance in HALF_DISTANCES]) * images.voxel_mm
    steps = np.concatenate([np.zeros((1, 3)), apart, -apart])
    residual, variance = scene.residual(normal.model), scene.variance(normal.model)
    weight = scene.known(normal.model) / variance
    positions, lights = [], []
    for number in np.flatnonzero(chosen):
        gain, excess, light = np.zeros(len(apart)), 0.0, []
        for camera, values in enumerate(images.matrices(cloud.positions_mm[number] + steps)):
            span = slice(*images.first_pixel[camera : camera + 2])
            one = values[[0]]
            there = one.indices
            target = residual[span].astype(float)
            left = weight[span][there] * np.square(target[there])
            excess += float((left - 1).sum())
            target[there] += cloud.light[number, camera] * one.data
            of_pair, explained = fit_pairs(values, weight[span], target)
            gain += explained
            light.append(of_pair)
        best = int(np.argmax(gain))
        if gain[best] > max(LEAST_GAIN, GAIN_SHARE * excess):
            positions += [cloud.positions_mm[number] + sign * apart[best] for sign in (1, -1)]
            lights += list(np.stack([each[best] for each in light], axis=1))
    if not positions:
        return cloud[np.zeros(len(cloud), bool)]
    return Cloud(positions_mm=np.array(positions), light=np.array(lights))


def fit_pairs(values: sparse.csr_array, weight: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the light of pairs to an image of one camera.

    `values` are the images of one particle, of the first and of the second ones of all pairs. Return the light, shape
    (pair, 2), >= 0, and the squared residual that a pair explains beyond the one particle [noise^2], shape (pair,).
    """
    pairs = (values.shape[0] - 1) // 2
    first, second = values[1 : 1 + pairs], values[1 + pairs :]
    shown, square = values @ (weight * target), values.power(2) @ weight
    both = first.multiply(second) @ weight
    square = np.maximum(square, 1e-30)
    alone = np.maximum(shown, 0) ** 2 / square
    a, b, aa, bb = shown[1 : 1 + pairs], shown[1 + pairs :], square[1 : 1 + pairs], square[1 + pairs :]
    determinant = np.maximum(aa * bb - both**2, 1e-12 * aa * bb)
    light = np.stack([(bb * a - both * b) / determinant, (aa * b - both * a) / determinant], axis=1)
    better = alone[1 : 1 + pairs] >= alone[1 + pairs :]
    single = np.stack([np.where(better, a / aa, 0), np.where(better, 0, b / bb)], axis=1)
    both_lit = np.minimum(light[:, 0], light[:, 1]) > 0
    light = np.where(both_lit[:, None], light, np.maximum(single, 0))
    explained = (light * np.stack([a, b], axis=1)).sum(1)
    return light, explained - alone[0]
