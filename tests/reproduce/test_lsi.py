"""Averages of the injector's flow in `lfpiv reproduce lsi`."""

import numpy as np
import pytest

from lfpiv.reproduce import lsi, lsi_twin


def test_profiles_between_layers_are_not_smoothed():
    twin = lsi_twin.Twin(lsi.SIZES["small"], seed=1)
    axes = [np.linspace(-6, 6, 9), np.linspace(-3, 3, 5), np.array([-1.0, 0.0, 1.0])]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    field = np.stack([z**3 - z + y, 2 - z**2 + x], axis=-1)
    found = lsi.along_profiles(twin, axes, field)
    depth, y = np.meshgrid(twin.depths_mm, axes[1], indexing="ij")
    expected = np.stack([depth**3 - depth + y, 2 - depth**2 + twin.profile_x_mm], axis=-1)
    np.testing.assert_allclose(found, expected, atol=1e-9)  # a cubic, at depths between the layers
    field[4, 2] = np.nan  # a window that no pair measured, in the layer at z = 0
    found = lsi.along_profiles(twin, axes, field)
    lost = np.isnan(found).any(-1)
    assert lost[1, 2] and lost.sum() == 1


def test_error_by_pairs_tells_chance_from_bias():
    twin = lsi_twin.Twin(lsi.SIZES["small"], seed=1)
    axes = [np.linspace(-6, 6, 60), np.linspace(-3, 3, 40), np.array([-1.0, 0.0, 1.0])]
    rng, pairs, bias, spread = np.random.default_rng(2), 40, 0.2, 0.1
    each = rng.standard_normal((pairs, 1, 40, 1, 3)) * spread * np.ones((1, 60, 1, 3, 1))
    each[..., 1] += bias
    reference = np.ones((3, 40, 2)) / 1000 / twin.dt_s  # as large as a displacement of 1 mm
    told = lsi.error_by_pairs(twin, {"axes_mm": axes, "departures_mm": each}, reference)
    assert told["pairs"] == [1, 2, 5, 10, 20, 40]
    for count, error, chance in zip(told["pairs"], told["error"], told["chance"], strict=True):
        expected = spread * np.sqrt(2 / np.pi / count)
        assert chance == pytest.approx([expected] * 2, rel=0.1)  # forty pairs at forty heights
        assert error[0] == pytest.approx(expected, rel=0.5)  # forty heights of one average
    assert told["error"][-1][1] == pytest.approx(bias, rel=0.05)
