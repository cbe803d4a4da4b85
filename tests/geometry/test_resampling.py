"""Finer grids, and volumes of light on the voxels of another grid."""

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage

from lfpiv import Grid, volume_on

TOLERANCE_LIGHT = 1e-3  # the spline around a single voxel reaches four voxels, beyond which it is cut
GRID = Grid.from_extent(centre_mm=(0.3, -0.2, 1.0), size_mm=(2.2, 1.8, 1.4), voxel_mm=0.1)


def volume_of(grid, values, **coordinates):
    named = {name: (("z", "y", "x"), value) for name, value in coordinates.items()}
    return xr.DataArray(values, dict(grid.coordinates()) | named, ("z", "y", "x"), attrs={"voxel_mm": grid.voxel_mm})


def blobs_on(grid, sigma_mm, seed=0, count=12, margin_mm=0.5):
    """Return the light of Gaussian particles at random places in voxels of a grid, by the density at their centres."""
    rng = np.random.default_rng(seed)
    half = np.array(GRID.shape[::-1]) * GRID.voxel_mm / 2 - margin_mm
    at = GRID.centre_mm + rng.uniform(-1, 1, (count, 3)) * half
    profiles = [np.exp(-((grid.axis_mm(k) - at[:, 2 - k, None]) ** 2) / (2 * sigma_mm**2)) for k in range(3)]
    return np.einsum("nz,ny,nx->zyx", *profiles) * grid.voxel_mm**3


@pytest.mark.parametrize("factor", [1.0, 1.2, 1.35, 2.0, 3.7])
def test_a_finer_grid_covers_the_volume_around_the_same_centre(factor):
    fine = GRID.refined(factor)
    assert fine.voxel_mm == pytest.approx(GRID.voxel_mm / factor)
    np.testing.assert_allclose(fine.centre_mm, GRID.centre_mm, atol=1e-12)
    for own, finer in zip(GRID.shape, fine.shape, strict=True):
        assert 0 <= finer / factor - own + 1e-9 < 1 / factor + 1e-9
    assert (fine == GRID) == (factor == 1)


@pytest.mark.parametrize("factor", [0.5, float("nan"), float("inf")])
def test_a_factor_that_refines_nothing_is_refused(factor):
    with pytest.raises(ValueError, match="factor"):
        GRID.refined(factor)


def test_the_nearest_voxels_of_a_finer_grid_lie_in_their_own_voxel():
    fine, flags = GRID.refined(1.3), np.random.default_rng(1).random(GRID.shape) < 0.5
    np.testing.assert_array_equal(flags[fine.nearest_in(GRID)][GRID.nearest_in(fine)], flags)
    np.testing.assert_array_equal(flags[GRID.nearest_in(GRID)], flags)


def test_voxels_of_the_same_size_are_cut_out_as_they_are():
    padded = GRID.padded(((1, 2), (0, 3), (2, 1)))
    values = np.random.default_rng(2).random(padded.shape).astype(np.float32)
    found = volume_on(volume_of(padded, values, views=np.full(padded.shape, 2, np.uint8)), GRID)
    np.testing.assert_array_equal(found.values, values[GRID.within(padded)])
    assert found.values.flags.c_contiguous and found.coords["views"].values.flags.c_contiguous
    np.testing.assert_allclose(found.z, GRID.axis_mm(0))
    assert "reconstruction_voxel_mm" not in found.attrs


def exact_light(sigma_mm):
    """Integrals over the voxels, by the midpoint rule on finer ones."""
    nz, ny, nx = GRID.shape
    return blobs_on(GRID.refined(9), sigma_mm).reshape(nz, 9, ny, 9, nx, 9).sum((1, 3, 5))


@pytest.mark.parametrize("factor", [1.2, 1.35, 2.0])
def test_volumes_of_single_voxels_are_integrated_over_voxels(factor):
    fine = GRID.padded(((1, 1),) * 3).refined(factor)
    found, exact = volume_on(volume_of(fine, blobs_on(fine, 0.1)), GRID), exact_light(0.1)
    assert np.abs(found.values - exact).max() < 0.03 * exact.max()
    assert found.values.min() >= 0 and found.values.sum() == pytest.approx(exact.sum(), rel=0.01)


@pytest.mark.parametrize("factor", [1.2, 1.35, 2.0])
def test_smooth_volumes_are_sampled(factor):
    fine = GRID.padded(((1, 1),) * 3).refined(factor)
    given = volume_of(fine, blobs_on(fine, 0.1)).assign_attrs(sieve_voxel=0.6)
    found, exact = volume_on(given, GRID), blobs_on(GRID, 0.1)
    assert np.abs(found.values - exact).max() < 0.03 * exact.max()
    assert found.values.min() >= 0 and found.values.sum() == pytest.approx(exact_light(0.1).sum(), rel=0.02)


@pytest.mark.parametrize("factor", [1.2, 1.35])
def test_single_bright_voxels_keep_their_light_wherever_they_are(factor):
    fine = GRID.padded(((1, 1),) * 3).refined(factor)
    light = []
    for index in range(8):
        values = np.zeros(fine.shape, np.float32)
        values[tuple(n // 2 - 4 + index for n in fine.shape)] = 1
        found = volume_on(volume_of(fine, values), GRID)
        assert found.values.min() >= 0
        light.append(float(found.values.sum()))
    np.testing.assert_allclose(light, 1.0, rtol=TOLERANCE_LIGHT)


def test_lengths_in_voxels_and_flags_are_those_of_the_new_voxels():
    fine = GRID.padded(((1, 1),) * 3).refined(1.25)
    rng = np.random.default_rng(3)
    solid, views = rng.random(GRID.shape) < 0.2, rng.integers(1, 3, GRID.shape).astype(np.uint8)
    values = ndimage.gaussian_filter(rng.random(fine.shape), 1.0)
    nearest = fine.nearest_in(GRID)
    given = volume_of(fine, values, masked=solid[nearest], views=views[nearest], unshared=2 * values)
    found = volume_on(given.assign_attrs(sieve_voxel=0.75, stop="done"), GRID)
    assert found.attrs["sieve_voxel"] == pytest.approx(0.6)
    assert found.attrs["voxel_mm"] == GRID.voxel_mm and found.attrs["stop"] == "done"
    assert found.attrs["reconstruction_voxel_mm"] == pytest.approx(0.08)
    np.testing.assert_array_equal(found.coords["masked"], solid)
    np.testing.assert_array_equal(found.coords["views"], views)
    np.testing.assert_allclose(found.coords["unshared"], 2 * found.values, rtol=1e-5)
    assert (found.values[solid] == 0).all() and (found.values[~solid] > 0).mean() > 0.99


def test_beyond_the_given_volume_there_is_no_light():
    small = Grid.from_extent(centre_mm=(0.3, -0.2, 1.0), size_mm=(0.84, 0.7, 0.56), voxel_mm=0.1)
    found = volume_on(volume_of(small, np.ones(small.shape)), GRID)
    inside = np.zeros(GRID.shape, bool)
    inside[5:9, 6:12, 8:14] = True  # wholly within the given volume
    assert found.values[inside].min() > 0.5 * found.values.max()
    assert found.values[0].max() == 0 and found.values[:, 0].max() == 0 and found.values[..., -1].max() == 0


def test_volumes_without_even_coordinates_are_refused():
    with pytest.raises(ValueError, match="coordinates"):
        volume_on(xr.DataArray(np.ones((4, 4, 4)), dims=("z", "y", "x")), GRID)
    uneven = volume_of(GRID, np.ones(GRID.shape))
    with pytest.raises(ValueError, match="evenly spaced"):
        volume_on(uneven.assign_coords(z=uneven.z.values**2), GRID)
