"""Systematic part of the uncertainty: what light that volumes do not explain adds."""

import numpy as np
import pytest
import xarray as xr

from lfpiv.velocity.systematic import (
    DAMPING,
    POINT_SHARE,
    RANDOM_SHARE,
    UNLIKE_SHARE,
    systematic_share,
    with_systematic,
)

ROUNDING = 1e-12
"""Float64 sums of a few terms of order one."""


def field_of(slope=0.0):
    x = np.indices((3, 5, 6))[2]
    one = slope * (x - 2.0)
    return np.stack([one, 0 * one, 2 * one], -1)


def test_volumes_that_explain_all_light_add_nothing():
    random = np.full((3, 5, 6, 3), 0.1)
    valid = np.ones(random.shape[:3], bool)
    assert np.array_equal(with_systematic(random, field_of(0.3), valid, 0.0), random)
    none = with_systematic(np.full_like(random, np.nan), field_of(), ~valid, 0.5)
    assert np.isnan(none).all()


@pytest.mark.parametrize("share", [0.4, 3.0])
def test_it_grows_with_share_and_typical_scatter_in_each_component_apart(share):
    random = np.broadcast_to([0.05, 0.1, 0.2], (3, 5, 6, 3)).copy()
    random[1, 2, 3] *= 10  # one window does not set what is typical
    valid = np.ones(random.shape[:3], bool)
    added = with_systematic(random, field_of(), valid, share) ** 2 - random**2
    assert np.allclose(added, share * np.square([0.05, 0.1, 0.2]))


def test_gradients_that_ghosts_damp_make_vectors_unsure():
    random = np.full((3, 5, 6, 3), 0.1)
    valid = np.ones(random.shape[:3], bool)
    level = with_systematic(random, field_of() + 3.0, valid, 0.4)
    shear = with_systematic(random, field_of(slope=0.5), valid, 0.4)
    added = np.sqrt(shear**2 - level**2)
    assert np.ptp(level) < ROUNDING  # a uniform flow is not damped
    assert np.allclose(added[..., 0], DAMPING * np.abs(field_of(slope=0.5)[..., 0] - 0.25))
    assert np.allclose(added[..., 2], 2 * added[..., 0]) and np.array_equal(shear[..., 1], level[..., 1])


def test_replaced_vectors_are_no_neighbours():
    random = np.full((3, 5, 6, 3), 0.1)
    valid = np.ones(random.shape[:3], bool)
    valid[1, 2, 2] = False
    random[~valid] = np.nan
    field = field_of()
    field[~valid] = 100.0
    stated = with_systematic(random, field, valid, 0.4)
    assert np.isnan(stated[~valid]).all() and np.ptp(stated[valid]) < ROUNDING


def test_the_largest_final_residual_counts():
    volume = xr.DataArray(np.zeros((2, 2, 2)), dims=("z", "y", "x")).assign_attrs(sieve_voxel=0.6)
    first, second = volume.assign_attrs(residual=[0.9, 0.3]), volume.assign_attrs(residual=np.array([0.8, 0.4]))
    assert systematic_share(first, second) == systematic_share(second, first) == RANDOM_SHARE * 0.4
    assert systematic_share(first, volume) == RANDOM_SHARE * 0.3
    assert systematic_share(first.assign_attrs(residual=0.5), volume) == RANDOM_SHARE * 0.5
    assert systematic_share(np.zeros((2, 2, 2)), volume) == 0.0


def test_light_that_cameras_ask_for_counts_beside_the_residual():
    volume = xr.DataArray(np.zeros((2, 2, 2)), dims=("z", "y", "x")).assign_attrs(sieve_voxel=0.6, residual=0.4)
    asked = systematic_share(volume, volume.assign_attrs(unlike=0.05))
    assert asked == pytest.approx(RANDOM_SHARE * 0.4 + UNLIKE_SHARE * 0.05**2)
    assert systematic_share(volume.assign_attrs(unlike=0.1), volume) > asked > systematic_share(volume, volume)


def test_the_residual_of_particles_smaller_than_voxels_counts_less():
    volume = xr.DataArray(np.zeros((2, 2, 2)), dims=("z", "y", "x")).assign_attrs(residual=0.4)
    points, blobs = (volume.assign_attrs(sieve_voxel=sieve) for sieve in (0.0, 0.6))
    assert systematic_share(points, points) == systematic_share(volume, volume) == POINT_SHARE * 0.4
    assert systematic_share(blobs, blobs) > systematic_share(points, points) > 0


def test_a_residual_that_was_not_measured_counts_as_the_one_before():
    volume = xr.DataArray(np.zeros((2, 2, 2)), dims=("z", "y", "x")).assign_attrs(sieve_voxel=0.6)
    assert systematic_share(volume.assign_attrs(residual=[0.9, 0.3, np.nan])) == pytest.approx(0.3 * RANDOM_SHARE)
    assert systematic_share(volume.assign_attrs(residual=[np.nan])) == 0
