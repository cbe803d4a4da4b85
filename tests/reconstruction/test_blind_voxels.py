"""Voxels that light hardly any pixel but dead ones."""

import numpy as np
import pytest
from support.ideal_rig import IdealCamera, IdealRig, rotation

import lfpiv

BRIGHTER = 1.5
"""Most light of the brightest voxel, relative to that without dead pixels."""


@pytest.mark.parametrize("lit", [0.02, 0.01])
def test_a_voxel_seen_by_almost_no_pixel_gets_no_light(lit):
    """Its few dim pixels say nothing of it, so noise would make it the brightest voxel."""
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.4, 1.2), voxel_mm=0.1)
    whole, partly = (IdealCamera("cam", rotation(30, 0.3)) for _ in range(2))
    alive = lfpiv.build_weights(IdealRig({"cam": whole}), grid)
    place, only = (6, 7, 8), np.zeros(grid.shape, np.float32)
    only[place] = 1
    image = alive(only)["cam"]
    partly.gain[image > lit * image.max()] = 0
    blind = lfpiv.build_weights(IdealRig({"cam": partly}), grid)
    rng, particles = np.random.default_rng(5), np.zeros(grid.size, np.float32)
    particles[rng.choice(grid.size, 60, replace=False)] = 2e4
    noise = rng.normal(0, 1.5, whole.gain.shape)
    found = []
    for weights in (alive, blind):
        image = weights(particles.reshape(grid.shape))["cam"] + noise
        found.append(lfpiv.reconstruct(weights, {"cam": np.maximum(image, 0)}).values)
    assert found[0][place] > 0 and found[1][place] == 0
    assert found[1].max() < BRIGHTER * found[0].max()
