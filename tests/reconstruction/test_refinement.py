"""Refinement by the size of particles, and what finer voxels are good for."""

import numpy as np
import pytest
from support import plain_steps
from support.ideal_rig import optics, two_cameras

import lfpiv
from lfpiv import metrics
from lfpiv.reconstruction.refinement import LARGEST, measure_size, needed_refinement

TOLERANCE_SIZE = 0.12  # [voxel] some hundred particles in one instant
GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.8, 1.6, 1.4), voxel_mm=0.1)


@pytest.fixture(scope="module")
def rig():
    return two_cameras(optics=optics(400, 480))


def images_of(rig, sigma_voxel, seed, count=80):
    """Images of Gaussian particles, through voxels of half the size, with noise."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(-0.5, 0.5, (count, 3)) * (1.8, 1.6, 1.4)
    fine = GRID.padded(((2, 2),) * 3).refined(2)
    truth = metrics.truth_volume(at, None, fine, 2 * sigma_voxel)
    images = lfpiv.build_weights(rig, fine)(truth.values)
    noise = 0.01 * max(image.max() for image in images.values())
    return at, {name: image + rng.normal(0, noise, image.shape) for name, image in images.items()}


@pytest.mark.parametrize(
    ("size", "factor"),
    [(None, 1.0), (0.0, LARGEST), (0.4, LARGEST), (0.5, 1.85), (0.75, 1.25), (0.93, 1.0), (1.5, 1.0)],
)
def test_small_particles_need_finer_voxels(size, factor):
    assert needed_refinement(size) == factor


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.7, 1.0])
def test_the_size_is_measured_before_there_are_weights(rig, sigma):
    found = measure_size(rig, GRID, [images_of(rig, sigma, seed=1)[1]])
    assert found == pytest.approx(np.sqrt(sigma**2 - 1 / 12), abs=TOLERANCE_SIZE)


@pytest.mark.slow
def test_finer_voxels_and_padding_show_small_particles_better(rig):
    at, images = images_of(rig, 0.7, seed=3)
    quality = {}
    for factor in (1.0, 1.3):
        fine = GRID.padded(((1, 1),) * 3 if factor > 1 else ((0, 0),) * 3).refined(factor)
        weights = lfpiv.build_weights(rig, fine)
        volume = lfpiv.volume_on(plain_steps.reconstruct(weights, images, 30, sieve_voxel=0.6 * factor), GRID)
        assert volume.attrs["sieve_voxel"] == pytest.approx(0.6) and volume.shape == GRID.shape
        quality[factor] = metrics.reconstruction_quality(volume, metrics.truth_volume(at, None, GRID, 0.7))
    assert quality[1.3] > quality[1.0] + 0.015
