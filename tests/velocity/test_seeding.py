"""Space without particles is found, and dim or sparsely seeded space is not taken for it."""

import numpy as np
import pytest
from support import plain_steps
from support.particle_volumes import blobs

from lfpiv.velocity.coverage import LEAST_SEEDED
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.velocity.seeding import unseeded_voxels

pytestmark = pytest.mark.usefixtures("device")

SHAPE = (24, 48, 52)
DISPLACEMENT = np.array([0.4, 1.2, -0.7])
EDGE = 4.0
"""Largest distance of the edge that is found from the true one [voxel]: about a particle distance."""


def pair_of(seeded, *, density=0.017, brightness=None, ghosts=0.0, seed=0, shape=SHAPE):
    """Two volumes of particles where `seeded(position)` is true, and faint ghosts everywhere."""
    rng, margin = np.random.default_rng(seed), 6
    room = np.array(shape) + 2 * margin
    position = rng.random((int(density * room.prod()), 3)) * room - margin
    position = position[seeded(position)]
    light = rng.lognormal(0, 0.5, len(position)) * (1 if brightness is None else brightness(position))
    pair = []
    for sign in (-0.5, 0.5):
        volume = blobs(position + sign * DISPLACEMENT, light, shape)
        faint = rng.random((int(density * room.prod()), 3)) * room - margin
        pair.append(volume + blobs(faint, np.full(len(faint), ghosts), shape))
    return pair


def everywhere(position):
    return np.ones(len(position), bool)


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("ghosts", [0.0, 0.02])
def test_an_empty_half_is_found_up_to_its_edge(axis, ghosts):
    middle = SHAPE[axis] / 2
    empty = unseeded_voxels(pair_of(lambda position: position[:, axis] < middle, ghosts=ghosts))
    along = empty.mean(tuple(other for other in range(3) if other != axis))
    assert (along[: int(middle - EDGE)] == 0).all() and (along[int(np.ceil(middle + EDGE)) :] == 1).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("density", [0.002, 0.017])
def test_sparse_seeding_has_no_holes(density, seed):
    assert unseeded_voxels(pair_of(everywhere, density=density, seed=seed)) is None


def test_the_edge_of_a_light_sheet_is_dim_and_not_empty():
    middle, sigma = (SHAPE[0] - 1) / 2, SHAPE[0] / 4
    pair = pair_of(everywhere, brightness=lambda position: np.exp(-0.5 * ((position[:, 0] - middle) / sigma) ** 2))
    assert unseeded_voxels(pair) is None


def test_a_reflection_does_not_make_the_rest_empty():
    pair = pair_of(everywhere)
    for volume in pair:
        volume[:, 20:23, 20:23] += 100 * volume.max()
    assert unseeded_voxels(pair) is None


@pytest.mark.slow
def test_an_empty_layer_of_a_large_volume_is_found():
    """Local maxima are sought in some planes of it, and means of the first volume over coarse cells come first."""
    shape, thickness = (64, 72, 72), 12
    empty = unseeded_voxels(pair_of(lambda position: position[:, 0] >= thickness, shape=shape))
    along = empty.mean((1, 2))
    assert (along[: int(thickness - EDGE)] == 1).all() and (along[int(thickness + EDGE) :] == 0).all()
    assert unseeded_voxels(pair_of(everywhere, shape=shape)) is None
    assert unseeded_voxels(pair_of(everywhere, shape=shape, density=0.0015)) is None


def test_solid_space_is_left_out_of_the_means():
    solid = np.zeros(SHAPE, bool)
    solid[..., :20] = True
    pair = pair_of(lambda position: position[:, 2] >= 20)
    assert unseeded_voxels(pair, solid) is None and unseeded_voxels(pair) is not None


@pytest.mark.parametrize("shape", [(24, 24, 24), (2, 24, 24)])
def test_no_light_is_no_statement(shape):
    assert unseeded_voxels([np.zeros(shape, np.float32)] * 2) is None


def test_vectors_without_particles_are_not_valid_and_the_verdict_leaves_them_out():
    pair = pair_of(lambda position: position[:, 2] < 30, ghosts=0.02)
    result = plain_steps.correlate(*pair, dt_s=1e-3, voxel_mm=1.0, windows=(16, 12, 12))
    valid, share = result["valid"].values, result["seeded_share"].values
    assert not valid[share < LEAST_SEEDED].any() and valid[share >= LEAST_SEEDED].mean() > 0.9
    assert (
        not valid[..., result["x"].values - 5.5 >= 29].any() and valid[..., result["x"].values + 5.5 < 30].mean() > 0.9
    )
    assert not result["masked"].any() and np.isfinite(result["u"]).all()  # replaced, not masked
    assert result.attrs["verdict"] == Verdict.GOOD.value and result.attrs["valid_fraction"] < 0.8
    assert abs(result.attrs["unseeded_fraction"] - 22 / 52) < EDGE / 52
    np.testing.assert_allclose(result.attrs["measurable_fraction"], (share >= LEAST_SEEDED).mean())
    full = plain_steps.correlate(*pair_of(everywhere), dt_s=1e-3, voxel_mm=1.0, windows=(16, 12, 12))
    assert full.attrs["unseeded_fraction"] == 0 and full.attrs["measurable_fraction"] == 1
