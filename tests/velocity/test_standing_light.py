"""Vectors at rest on light that stays in place are not valid; slow flow is."""

import numpy as np
import pytest
from support import plain_steps

from lfpiv.velocity.standing_light import on_standing_light
from lfpiv.velocity.windows import Windows

SHAPE = (24, 40, 40)
WINDOWS = {"windows": (16, 12, 12), "overlap": 0.5}


def particles(points, brightness):
    """Gaussian blobs of 0.8 voxel at points (n, 3), order (z, y, x)."""
    volume = np.zeros(SHAPE)
    axes = [np.arange(n) for n in SHAPE]
    for point, light in zip(points, brightness, strict=True):
        blob = [np.exp(-0.5 * ((axis - at) / 0.8) ** 2) for axis, at in zip(axes, point, strict=True)]
        volume += light * np.einsum("i,j,k->ijk", *blob)
    return volume


def volumes(shift, seed=1, count=700):
    """Two volumes of the same particles, moved by `shift(points)`, which returns (n, 3)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, np.array(SHAPE) + 3, (count, 3))
    light = rng.lognormal(0, 0.5, len(points))
    half = shift(points) / 2
    return particles(points - half, light), particles(points + half, light)


def uniform(points):
    return np.broadcast_to([0.4, 1.2, 1.6], points.shape)


def boundary_layer(points):
    """Flow along x that is at rest in half of the volume."""
    return np.stack([0 * points[:, 0], 0 * points[:, 0], 2.5 * np.clip(points[:, 1] - 18, 0, 10) / 10], 1)


@pytest.fixture(scope="module")
def bar():
    """A bright, rough bar along y."""
    z, _, x = np.indices(SHAPE)
    rough = np.random.default_rng(2).gamma(0.5, size=SHAPE)
    return 20 * rough * np.exp(-0.5 * (((z - 11) / 4.0) ** 2 + ((x - 10) / 3.0) ** 2))


def test_a_bright_bar_at_rest_makes_no_valid_vectors(bar):
    first, second = volumes(uniform)
    pure = plain_steps.correlate(first, second, dt_s=1.0, voxel_mm=1.0, intensity_power=0.5, **WINDOWS)
    lit = plain_steps.correlate(first + bar, second + 0.9 * bar, dt_s=1.0, voxel_mm=1.0, intensity_power=0.5, **WINDOWS)

    def at_rest(vectors):
        return np.sqrt(sum(vectors[f"displacement_{axis}"] ** 2 for axis in "xyz")).values < 0.5

    assert pure["valid"].values.mean() > 0.95 and not at_rest(pure).any()
    assert (lit["valid"].values & at_rest(lit)).mean() < 0.01 and lit["valid"].values.mean() < 0.95
    assert lit["valid"].values[:, :, 3:].all()  # away from the bar


def test_slow_flow_stays_valid():
    vectors = plain_steps.correlate(*volumes(boundary_layer), dt_s=1.0, voxel_mm=1.0, intensity_power=0.5, **WINDOWS)
    speed = np.abs(vectors["displacement_x"].values)
    assert (speed < 0.3).mean() > 0.3 and (speed > 1).mean() > 0.25
    assert vectors["valid"].values[speed < 0.3].mean() > 0.95


THIN = 120  # particles: some three to a window, so that one in eight windows at rest holds twice the median


@pytest.mark.parametrize("seed", range(1, 6))
def test_windows_that_hold_more_of_few_particles_at_rest_are_no_standing_light(seed):
    windows = Windows.covering(SHAPE, (12, 12, 12), (6, 6, 6))
    still = volumes(lambda points: 0 * points, seed, THIN)
    field = np.zeros((*windows.count, 3))
    field[..., 2] = np.where(np.arange(windows.count[2]) < 3, 0.0, 2.0)
    valid = np.ones(windows.count, bool)
    at_rest = (slice(None), slice(None), slice(0, 3))
    assert on_standing_light(*still, windows, field, valid)[at_rest].mean() < 0.05


def test_what_light_is_standing(bar):
    windows = Windows.covering(SHAPE, (12, 12, 12), (6, 6, 6))
    rng = np.random.default_rng(3)
    first, second = (rng.gamma(0.5, size=SHAPE) + bar for _ in range(2))
    field = np.zeros((*windows.count, 3))
    field[..., 2] = np.where(np.arange(windows.count[2]) < 3, 0.0, 2.0)  # at rest around the bar
    valid = np.ones(windows.count, bool)
    found = on_standing_light(first, second, windows, field, valid)
    assert found[:, :, :2].all() and not found[:, :, 3:].any()
    assert np.array_equal(
        found, on_standing_light(3 * second, first, windows, -field, valid)
    )  # light, order do not matter
    assert not on_standing_light(first, second, windows, 0 * field, valid).any()  # all at rest: nothing to compare with
    assert not on_standing_light(first, second, windows, field, ~valid).any()
    assert not on_standing_light(first - bar, second - bar, windows, field, valid).any()
