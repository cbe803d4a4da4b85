"""Errors of displacements behind main lenses: the mean over the valid vectors of each pair, and its scatter."""

import lenses
import numpy as np
import pytest
import xarray as xr

from lfpiv.simulation.flows import window_mean

OFF = (0.1, 0.3)  # of the vectors of each pair along x [voxel]


def test_error_is_the_mean_over_valid_vectors_with_the_scatter_of_the_pairs():
    flow = lenses.scene("double_gauss", 2, 1).flow
    axes = {"z": [-0.1, 0.1], "y": [-0.3, 0.0, 0.3], "x": [-0.2, 0.2]}
    z, y, x = np.meshgrid(*axes.values(), indexing="ij")
    centres = np.stack([x, y, z], -1).reshape(-1, 3)
    exact = window_mean(flow, centres, 0.1 * lenses.WINDOWS[-1][0]).reshape(*x.shape, 3) / 0.1
    found = np.stack([exact + (off, 0, 0) for off in OFF])
    valid = np.ones(found.shape[:-1], bool)
    found[:, 0, 0, 0], valid[:, 0, 0, 0] = 9.0, False
    dims = ("pair", "z", "y", "x")
    values = {f"displacement_{axis}": (dims, found[..., k]) for k, axis in enumerate("xyz")}
    vectors = xr.Dataset(values | {"valid": (dims, valid)}, axes, {"voxel_mm": [0.1, 0.1, 0.1]})
    mean, error = lenses.displacement_errors(vectors, flow)
    assert mean == pytest.approx(np.mean(OFF))
    assert error == pytest.approx(np.std(OFF, ddof=1) / np.sqrt(2))
