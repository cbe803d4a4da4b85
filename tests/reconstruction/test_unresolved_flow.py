"""Waves that windows do not show: their strength, their means over windows, and how strong they must be."""

import numpy as np
import pytest
import xarray as xr

from lfpiv.reconstruction.unresolved_flow import UnresolvedFlow, needed_rms
from lfpiv.velocity.settings import CorrelationSettings

VOXEL_MM, EDGE = 0.1, 12


@pytest.fixture(scope="module")
def vectors():
    axes = {axis: 0.6 * (np.arange(count) - (count - 1) / 2) for axis, count in (("z", 4), ("y", 5), ("x", 6))}
    settings = CorrelationSettings(
        windows=((EDGE,) * 3,), overlap=0.5, max_displacement_voxel=None, smoothing_voxel=0.5, intensity_power=0.5
    )
    return xr.Dataset(coords=axes, attrs={"voxel_mm": [VOXEL_MM] * 3, "settings": settings.to_json()})


def test_most_of_the_strength_is_left_and_hardly_any_shows_in_windows(vectors):
    flows = [UnresolvedFlow(vectors, 0.3, np.random.default_rng(seed)) for seed in range(8)]
    points = np.random.default_rng(1).uniform(-1, 1, (2000, 3)) * (2.1, 1.8, 1.5)  # where windows are
    strength = np.sqrt(np.mean([(one(points) / VOXEL_MM) ** 2 for one in flows]))
    assert abs(strength / 0.3 - 1) < 0.05
    assert np.sqrt(np.mean([one.window_means**2 for one in flows])) < 0.05 * strength


def test_means_over_windows_are_those_of_the_field(vectors):
    flow = UnresolvedFlow(vectors, 1.0, np.random.default_rng(2))
    centre = np.array([vectors[axis].values[1] for axis in "xyz"])
    inside = centre + np.random.default_rng(3).uniform(-0.5, 0.5, (40_000, 3)) * EDGE * VOXEL_MM
    assert np.allclose(flow(inside).mean(0)[::-1] / VOXEL_MM, flow.window_means[1, 1, 1], atol=0.03)


def test_they_raise_the_deviation_to_that_of_recorded_pairs():
    growth, without = 0.2, 0.12

    def deviation(rms):
        return float(np.sqrt(without**2 + growth * rms**2))

    done = [(0.0, deviation(0.0))]
    for _ in range(4):
        done.append((rms := needed_rms(0.18, done, 0.5), deviation(rms)))
    assert abs(done[-1][1] - 0.18) < 0.01
    assert needed_rms(0.18, [], 0.5) == 0.0  # unknown before a pilot
    assert needed_rms(0.10, done, 0.5) == 0.0  # simulated pairs are harder already
    assert needed_rms(9.0, done, 0.5) == 0.5 and needed_rms(0.18, done, 0.0) == 0.0
