"""Masks: windows use their fluid, walls pull no vector, and masked vectors hold nothing."""

import numpy as np
import pytest
import xarray as xr
from support import plain_steps
from support.particle_volumes import blobs, shear, uniform

from lfpiv import derived, statistics
from lfpiv.velocity.coverage import LEAST_FLUID
from lfpiv.velocity.windows import Windows

pytestmark = pytest.mark.usefixtures("device")

SHAPE, WINDOW = (28, 36, 44), 12
BIAS = 0.05
"""Largest mean error of windows at a wall [voxel], at displacements of 3 voxels."""


def wall_pair(flow, solid, *, seed=0, density=0.017):
    """Two volumes of particles that are nowhere in the solid, a function of positions."""
    rng, margin = np.random.default_rng(seed), 8
    room = np.array(SHAPE) + 2 * margin
    position = rng.random((int(density * room.prod()), 3)) * room - margin
    moved = [position + sign * flow(position) / 2 for sign in (-1, 1)]
    return [blobs(at[~solid(at)], np.ones((~solid(at)).sum()), SHAPE) for at in moved]


def mask_of(solid):
    return solid(np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), -1).astype(float))


def at_x(place):
    return lambda position: position[..., 2] < place


def oblique(position):
    return position @ np.array([0.3, 0.5, 1.0]) < 28


def correlate(pair, **options):
    return plain_steps.correlate(*pair, dt_s=1e-3, voxel_mm=1.0, windows=(16, WINDOW, WINDOW), **options)


def error_of(result, flow):
    """Error of the vectors against the flow at the windows' centres, which is linear [voxel], (z, y, x, 3)."""
    centres = np.stack(np.meshgrid(*(result[axis].values for axis in "zyx"), indexing="ij"), -1)
    return np.stack([result[f"displacement_{axis}"].values for axis in "zyx"], -1) - flow(centres)


@pytest.mark.parametrize(
    ("flow", "solid"),
    [
        (uniform(0, 0, 3.3), at_x(16)),
        (uniform(0, 0, -3.3), at_x(16)),
        (uniform(0, 3.3, 0), at_x(16)),
        (uniform(0.5, 2.2, -1.4), oblique),
        (shear(SHAPE), at_x(16)),
    ],
    ids=["away from the wall", "into the wall", "along the wall", "oblique", "shear"],
)
def test_a_wall_pulls_no_vector(flow, solid):
    result = correlate(wall_pair(flow, solid), mask=mask_of(solid))
    share = result["fluid_share"].values
    near = (share < 1) & ~result["masked"].values
    assert near.sum() >= 8 and result["valid"].values[near].mean() > 0.9
    error = error_of(result, flow)[near & result["valid"].values]
    assert np.abs(error.mean(0)).max() < BIAS
    assert np.linalg.norm(error, axis=-1).mean() < 3 * BIAS


@pytest.mark.parametrize(
    "flow", [uniform(0, 0, 3.3), uniform(0, 0, 0.3)], ids=["with the body", "slower than the body"]
)
def test_a_body_that_moves_pulls_no_vector(flow):
    """Windows that the body touches in either frame use what is fluid in both."""
    step = np.array([0, 0, 3.3])
    bodies = [lambda at, sign=sign: np.abs((at - sign * step / 2)[..., 2] - 22) < 3 for sign in (-1, 1)]
    masks = [mask_of(body) for body in bodies]
    volumes = [moved[number] for number, moved in enumerate(wall_pair(flow, body) for body in bodies)]
    axes = dict(zip("zyx", map(np.arange, SHAPE), strict=True))
    given = [
        xr.DataArray(volume, axes | {"masked": (tuple("zyx"), mask)}, tuple("zyx"))
        for volume, mask in zip(volumes, masks, strict=True)
    ]
    result = plain_steps.correlate(*given, dt_s=1e-3, windows=(16, WINDOW, WINDOW))
    windows = Windows.covering(SHAPE, (WINDOW,) * 3, (WINDOW // 2,) * 3)
    share = windows.means(~(masks[0] | masks[1]))
    np.testing.assert_array_equal(result["masked"].values, share < LEAST_FLUID - 1e-9)
    near = (share < 1) & ~result["masked"].values & result["valid"].values
    assert near.sum() >= 8
    error = error_of(result, flow)[near]
    assert np.abs(error.mean(0)).max() < BIAS and np.linalg.norm(error, axis=-1).mean() < 3 * BIAS


def test_masked_vectors_are_told_from_replaced_ones():
    solid = mask_of(oblique)
    result = correlate(wall_pair(uniform(0, 1, 0), oblique), mask=solid)
    windows = Windows.covering(SHAPE, (WINDOW,) * 3, (WINDOW // 2,) * 3)
    share = windows.means(~solid)
    assert {True, False} == set((share < LEAST_FLUID).ravel().tolist())
    np.testing.assert_array_equal(result["masked"].values, share < LEAST_FLUID - 1e-9)
    np.testing.assert_allclose(result["fluid_share"].values, share, atol=1e-6)
    masked = result["masked"].values
    assert not result["valid"].values[masked].any()
    for name in ("u", "v", "w", "displacement_x", "uncertainty", "peak_ratio", "correlation"):
        assert np.isnan(result[name].values[masked]).all()
        assert name == "uncertainty" or np.isfinite(result[name].values[~masked]).all()
    assert result.attrs["masked_fraction"] == masked.mean()
    assert result.attrs["valid_fraction"] == result["valid"].values[~masked].mean() > 0.9


def test_what_a_volume_holds_in_the_mask_has_no_effect():
    solid = mask_of(oblique)
    pair = wall_pair(uniform(0.4, 1, 2), oblique)
    plain = correlate(pair, mask=solid)
    spoiled = [np.where(solid, value, volume) for value, volume in zip((7.0, np.nan), pair, strict=True)]
    xr.testing.assert_identical(correlate(spoiled, mask=solid.astype(float)), plain)
    axes = {axis: np.arange(n, dtype=float) for axis, n in zip("zyx", SHAPE, strict=True)}
    dims = tuple(axes)
    arrays = [xr.DataArray(volume, axes, dims).assign_coords(masked=(dims, solid)) for volume in spoiled]
    options = {"dt_s": 1e-3, "windows": (16, WINDOW, WINDOW)}
    xr.testing.assert_identical(plain_steps.correlate(*arrays, **options), plain)
    bare = [one.drop_vars("masked") for one in arrays]
    xr.testing.assert_identical(plain_steps.correlate(*bare, mask=xr.DataArray(solid, axes, dims), **options), plain)


def test_a_mask_of_nothing_is_no_mask():
    pair = wall_pair(uniform(0.4, 1, 2), lambda position: np.zeros(len(position), bool))
    plain = correlate(pair)
    assert not plain["masked"].any() and (plain["fluid_share"] == 1).all()
    xr.testing.assert_identical(correlate(pair, mask=np.zeros(SHAPE)), plain)


def test_swapping_the_volumes_reverses_the_vectors_at_a_wall():
    first, second = wall_pair(uniform(0.4, 1, 2), oblique)
    there, back = (correlate(pair, mask=mask_of(oblique)) for pair in ((first, second), (second, first)))
    assert float(np.abs(there["u"] + back["u"]).max()) < 5e-3 * float(np.abs(there["u"]).max())


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.zeros((3, 3, 3), bool), "a voxel for each of the volume"),
        (np.full(SHAPE, 255), "numbers from 255 to 255"),
        (np.where(np.arange(44) < 3, np.nan, np.zeros(SHAPE)), "not finite"),
        (np.full(SHAPE, "wall"), "true"),
        (np.ones(SHAPE, bool), "inverted"),
        (xr.DataArray(np.zeros(SHAPE), dims=("x", "y", "z")), "dims"),
        (xr.DataArray(np.zeros(SHAPE), {"z": np.arange(28) + 0.5}, ("z", "y", "x")), "coordinates z"),
    ],
)
def test_a_wrong_mask_is_named(mask, words):
    pair = [np.random.default_rng(seed).random(SHAPE, np.float32) for seed in (0, 1)]
    with pytest.raises(ValueError, match="mask: expected") as error:
        correlate(pair, mask=mask)
    assert words in str(error.value)


def test_derivatives_and_means_do_not_cross_a_mask():
    solid = mask_of(at_x(22))
    pairs = [correlate(wall_pair(shear(SHAPE), at_x(22), seed=seed), mask=solid) for seed in (0, 1)]
    vectors = pairs[0].assign_coords({axis: pairs[0][axis] for axis in "zyx"})
    curl = derived.vorticity(vectors)["vorticity_z"]
    beside = vectors["masked"].values[..., :-1] & ~vectors["masked"].values[..., 1:]
    assert beside.any() and np.isnan(curl.values[..., 1:][beside]).all()
    assert not curl["valid"].values[np.isnan(curl.values)].any() and np.isfinite(curl.values).any()
    average = statistics.mean(xr.concat(pairs, "pair", combine_attrs="override").assign_coords(pair=[0, 1]))
    assert np.isnan(average["u"].values[vectors["masked"].values]).all()
    assert np.isfinite(average["u"].values[vectors["valid"].values]).all()
