"""Reconstruction with a mask: voxels without fluid are no unknowns, and correlation reads the mask from the volume."""

import numpy as np
import pytest
import xarray as xr
from support import plain_steps
from support.ideal_rig import two_cameras

import lfpiv
from lfpiv import metrics
from lfpiv.results import netcdf

pytestmark = pytest.mark.usefixtures("device")

GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 1.2, 1.2), voxel_mm=0.1)
SHIFT = 0.08  # [mm]
TOLERANCE_LIGHT = 1e-5  # relative: float32 sums of the same terms in another order


@pytest.fixture(scope="module")
def recorded():
    """Weights, mask, and images of both frames of particles beside the solid."""
    weights = lfpiv.build_weights(two_cameras(), GRID)
    solid = np.zeros(GRID.shape, bool)
    solid[:, :, :5] = True  # x < -0.1
    positions = np.random.default_rng(0).uniform(-0.55, 0.55, (60, 3))
    positions[:, 0] = np.abs(positions[:, 0]) * 0.9 - 0.05
    moved = positions + np.array([0, SHIFT, 0])
    volumes = [metrics.truth_volume(at, None, GRID, 0.07) for at in (positions, moved)]
    return weights, solid, [weights(volume) for volume in volumes]


@pytest.mark.parametrize("sieve_voxel", [0.0, 0.6])
def test_voxels_without_fluid_stay_dark_and_the_rest_explains_the_images(recorded, sieve_voxel):
    weights, solid, (images, _) = recorded
    options = {"iterations": 12, "sieve_voxel": sieve_voxel}
    volume = plain_steps.reconstruct(weights, images, mask=solid, **options)
    assert (volume.values[solid] == 0).all() and (volume.values[~solid] > 0).mean() > 0.99
    np.testing.assert_array_equal(volume["masked"].values, solid)
    free = plain_steps.reconstruct(weights, images, **options)
    assert "masked" not in free.coords and free.values[solid].sum() > 0.02 * free.values.sum()  # ghosts
    assert volume.attrs["residual"][-1] < 1.2 * free.attrs["residual"][-1]


def test_a_mask_is_a_first_guess_without_light_there(recorded):
    weights, solid, (images, _) = recorded
    first = plain_steps.reconstruct(weights, images, iterations=0, mask=solid)
    zeros = plain_steps.reconstruct(weights, images, iterations=8, first=first.values)
    masked = plain_steps.reconstruct(weights, images, iterations=8, first=first.values, mask=solid)
    np.testing.assert_array_equal(masked.values, zeros.values)


def test_the_first_guess_has_the_light_of_the_images_where_it_lights_them(recorded):
    weights, solid, (images, _) = recorded
    for mask in (None, solid):
        guess = plain_steps.reconstruct(weights, images, iterations=0, mask=mask, intensity_cap=0.0)
        images_of_guess = weights(guess.values)
        gains = dict(zip(images_of_guess, guess.attrs["camera_gain"], strict=True))
        projected = {name: np.float32(gains[name]) * image for name, image in images_of_guess.items()}
        light = sum(one.sum(dtype=np.float64) for one in projected.values())
        seen = sum(np.maximum(images[name], 0)[one > 0].sum(dtype=np.float64) for name, one in projected.items())
        assert light == pytest.approx(seen, rel=TOLERANCE_LIGHT)


def test_a_mask_is_given_as_flags_numbers_or_with_coordinates(recorded):
    weights, solid, (images, _) = recorded
    expected = plain_steps.reconstruct(weights, images, iterations=2, mask=solid)
    array = xr.DataArray(solid, {axis: GRID.axis_mm(k) for k, axis in enumerate("zyx")}, ("z", "y", "x"))
    for mask in (solid.astype(np.uint8), array, array * 0.7):
        xr.testing.assert_identical(plain_steps.reconstruct(weights, images, iterations=2, mask=mask), expected)
    with pytest.raises(ValueError, match="mask: expected a voxel for each"):
        plain_steps.reconstruct(weights, images, mask=solid[1:])
    with pytest.raises(ValueError, match="inverted"):
        plain_steps.reconstruct(weights, images, mask=np.ones(GRID.shape))


def test_each_frame_of_a_pair_may_have_its_own_mask(recorded):
    weights, solid, images = recorded
    masks = (solid, np.roll(solid, 1, axis=2))
    pair = plain_steps.reconstruct_pair(weights, images, estimate="correlation", iterations=4, mask=masks)
    for volume, mask, frame in zip(pair, masks, images, strict=True):
        alone = plain_steps.reconstruct(weights, frame, iterations=4, mask=mask)
        np.testing.assert_array_equal(volume["masked"].values, mask)
        np.testing.assert_array_equal(volume.values, alone.values)


def test_correlation_reads_the_mask_from_stored_volumes(recorded, tmp_path):
    weights, solid, images = recorded
    options = {"dt_s": 1.0, "windows": (8, 6)}
    volumes = plain_steps.reconstruct_pair(weights, images, iterations=6, mask=solid)
    vectors = plain_steps.correlate(*volumes, **options)
    assert vectors["masked"].values.any() and not vectors["masked"].values.all()
    np.testing.assert_array_equal(vectors["masked"].values, vectors["fluid_share"].values < 0.5)
    for frame, volume in zip("ab", volumes, strict=True):
        netcdf.write_volume(volume, tmp_path / f"{frame}.nc", attributes={})
    read = [netcdf.read_volume(tmp_path / f"{frame}.nc") for frame in "ab"]
    xr.testing.assert_equal(plain_steps.correlate(*read, **options), vectors)
