"""Light of particles: as bright as a volume is, and none where it is dark, whatever the size of its voxels."""

import numpy as np
import pytest

import lfpiv
from lfpiv.damping.particle_light import LightField

EDGE_MM = 3.2


def grid(voxel_mm):
    return lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(EDGE_MM,) * 3, voxel_mm=voxel_mm)


def on(grid, light):
    """Values of a function of points (x, y, z) [mm] at the voxels."""
    return light(grid.centres_mm()).reshape(grid.shape)


def line(*, z=0.0, count=17):
    """Points along x through the centre, at a depth [mm]."""
    x = np.linspace(-1.2, 1.2, count)
    return np.stack([x, 0 * x, 0 * x + z], 1)


def test_light_is_even_and_ends_with_the_grid_without_a_volume():
    assert LightField(grid(0.1))(np.array([[0.0, 0.0, 0.0], [1.65, 0.0, 0.0]])).tolist() == [1.0, 0.0]
    dark = LightField(grid(0.1), np.zeros(grid(0.1).shape))
    assert dark(line()).tolist() == [1.0] * 17


def test_light_follows_the_volume_and_ends_with_the_grid():
    volume = np.ones(grid(0.1).shape)
    volume[: len(volume) // 2] = 3.0
    light = LightField(grid(0.1), volume)
    low, high, beyond = light(np.array([[0.0, 0.0, -1.5], [0.0, 0.0, 1.5], [0.0, 0.0, 1.65]]))
    assert low > 1.5 * high > 0 and beyond == 0


@pytest.mark.parametrize("voxel_mm", [0.1, 0.08])
def test_a_dark_rim_stays_dark_and_what_is_within_is_even(voxel_mm):
    some = grid(voxel_mm)
    light = LightField(some, on(some, lambda points: (np.abs(points) < 1.3).all(1).astype(float)))
    rim, within = light(np.array([[0.0, 0.0, -1.5], [1.5, 0.0, 0.0], [0.0, -1.5, 0.0]])), light(line())
    assert np.abs(rim).max() < 1e-6
    assert np.ptp(within) < 0.01 * within.mean()


def test_the_light_of_a_sheet_does_not_depend_on_the_voxels():
    def sheet(points):
        return np.exp(-((points[:, 2] / 0.8) ** 2))

    coarse, fine = (LightField(grid(edge), on(grid(edge), sheet)) for edge in (0.1, 0.064))
    depths = np.stack([0 * np.arange(9.0), 0 * np.arange(9.0), np.linspace(-1.4, 1.4, 9)], 1)
    assert np.allclose(fine(depths), coarse(depths), rtol=0.05, atol=0.02)
    assert coarse(depths)[4] > 3 * coarse(depths)[0]


def test_chance_of_single_particles_hardly_shows():
    some, rng = grid(0.1), np.random.default_rng(0)
    volume = np.zeros(some.shape)
    volume.ravel()[rng.choice(volume.size, 600, replace=False)] = 1.0
    light = LightField(some, volume)(rng.uniform(-1.2, 1.2, (500, 3)))
    assert light.std() < 0.2 * light.mean()
