"""Weights are one linear operator, whose columns are the shares of a voxel's rays that reach each pixel (Eq. 10)."""

import numpy as np
import pytest
from contract.ideal import Camera, Rig, matrix, pair_of_cameras, pixels

import lfpiv

ROUNDING = 1e-5
"""Sums of float32 over some thousand products, relative to the largest value."""
COUNTED = 0.04
"""Relative L2 difference of integrated weights and 200,000 counted rays: 2 % noise of the count, 2 % of the
integration."""
SHAPE = (4, 5, 6)
RIGS = {
    "profiles": Rig(pair_of_cameras(), SHAPE, {"form": "profiles"}),
    "each voxel": Rig(pair_of_cameras(), SHAPE, {"form": "profiles", "planes": False}),
    "pixels": Rig(pair_of_cameras(), SHAPE, {"form": "pixels"}),
    "hexagonal": Rig(pair_of_cameras(layout="hexagonal"), SHAPE),
    "rolled": Rig(pair_of_cameras(roll_deg=5.0), SHAPE, {"form": "profiles"}),
    "counted": Rig(pair_of_cameras(), SHAPE, {"method": "count", "rays": 65536}),
}
every_rig = pytest.mark.parametrize("name", RIGS)


@every_rig
def test_operator_is_its_matrix_and_its_adjoint_the_transpose(name):
    weights, rng = RIGS[name].weights, np.random.default_rng(0)
    explicit = matrix(weights)
    volume = rng.random(SHAPE, np.float32)
    seen = weights(volume)
    expected = explicit @ volume.ravel()
    assert np.abs(pixels(seen) - expected).max() <= ROUNDING * expected.max()
    images = {key: rng.standard_normal(image.shape).astype(np.float32) for key, image in seen.items()}
    expected = explicit.T @ pixels(images)
    assert np.abs(weights.T(images).ravel() - expected).max() <= ROUNDING * np.abs(explicit.T).sum(axis=1).max()
    sums = explicit.sum(axis=0)
    np.testing.assert_allclose(weights.column_sum.ravel(), sums, rtol=ROUNDING)


def counted_rays(camera, grid, voxel, rays=200_000):
    """Return the share of a voxel's rays that reach each pixel, by Eqs. 9 and 10 with random rays."""
    rng, optics = np.random.default_rng(5), camera.optics
    centre = np.array([grid.axis_mm(axis)[index] for axis, index in enumerate(voxel)])[::-1]
    points = centre + grid.voxel_mm * rng.uniform(-0.5, 0.5, (rays, 3))
    radius, angle = optics.pupil_radius_mm * np.sqrt(rng.random(rays)), rng.uniform(0, 2 * np.pi, rays)
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    met = camera.map(points, pupil)
    lens = camera.lattice.centres_mm(camera.lattice.nearest(met))
    place = lens + optics.microlens_focal_length_mm / optics.image_distance_mm * (met - pupil)
    rows, columns = optics.sensor_shape
    column, row = (place / optics.pixel_mm + [columns / 2, rows / 2]).T
    found, _, _ = np.histogram2d(row, column, bins=(rows, columns), range=((0, rows), (0, columns)))
    return camera.gain * found / rays


@every_rig
def test_column_is_what_counted_rays_show(name):
    rig, voxel = RIGS[name], (1, 3, 2)
    for camera in rig.cameras:
        expected = counted_rays(camera, rig.weights.grid, voxel)
        found = rig.weights.image(camera.name, voxel)
        assert np.linalg.norm(found - expected) < COUNTED * np.linalg.norm(expected)
        unit = np.zeros(SHAPE, np.float32)
        unit[voxel] = 1
        seen = rig.weights(unit)[camera.name]
        assert np.abs(seen - found).max() <= ROUNDING * found.max()


def test_dark_pixels_take_no_part_and_memory_is_reused():
    cameras = pair_of_cameras()
    rig = Rig(cameras, SHAPE, {"form": "pixels"})
    before = rig.weights(np.ones(SHAPE))["left"]
    cameras[0].gain[:100] = 0
    rig = Rig(cameras, SHAPE, {"form": "pixels"})
    out = {camera.name: np.full(camera.optics.sensor_shape, 7.0, np.float32) for camera in cameras}
    images = rig.weights(np.ones(SHAPE), out=out)
    assert images["left"] is out["left"]
    assert not images["left"][:100].any()
    np.testing.assert_array_equal(images["left"][100:], before[100:])


def test_wrong_arguments_are_named():
    weights = RIGS["pixels"].weights
    with pytest.raises(ValueError, match="method"):
        lfpiv.build_weights(lfpiv.Calibration(dict(weights.cameras)), weights.grid, "guess")
    with pytest.raises(ValueError, match="volume"):
        weights(np.ones((2, 2, 2)))
    with pytest.raises(ValueError, match="centre"):
        weights.image("centre", (0, 0, 0))
    with pytest.raises(ValueError, match="hexagonal"):
        _ = Rig((Camera("one", 0.0, layout="hexagonal"),), SHAPE, {"form": "profiles"}).weights
