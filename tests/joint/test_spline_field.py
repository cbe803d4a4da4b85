"""Displacement on spline nodes: adjoint maps, and vectors of windows whose means the nodes return."""

import json

import numpy as np
import pytest
import xarray as xr

import lfpiv
from lfpiv.joint.spline_field import SplineField, window_shares
from lfpiv.settings.processing import Correlation

GRID = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(2.0, 2.4, 1.5), voxel_mm=0.1)
WINDOW = 8
ROUNDING = 1e-5
"""float32 values of sums of double precision."""
FIT_VOXEL = 0.01
"""Error of a fit with second differences as a weak prior."""


def linear(points_zyx):
    """Return a displacement that is linear in place, shape (..., 3)."""
    z, y, x = np.moveaxis(points_zyx, -1, 0)
    return np.stack([0.3 + 0.2 * x, -0.5 + 0.1 * z, 0.4 * y], -1)


def vectors_of(step=4):
    nodes = [axis[WINDOW // 2 : -WINDOW // 2 : step] - 0.05 for axis in GRID.axes_mm]
    moved = linear(np.stack(np.meshgrid(*nodes, indexing="ij"), -1))
    settings = Correlation().model_dump() | {"windows": [[WINDOW] * 3]}
    variables = {f"displacement_{axis}": ("zyx", moved[..., k]) for k, axis in enumerate("zyx")}
    variables = {name: (tuple(dims), values) for name, (dims, values) in variables.items()}
    valid = {"valid": (("z", "y", "x"), np.ones(moved.shape[:3], bool))}
    attributes = {"voxel_mm": [0.1] * 3, "settings": json.dumps(settings)}
    return xr.Dataset(variables | valid, dict(zip("zyx", nodes, strict=True)), attributes)


def test_values_and_their_adjoint_agree():
    field, rng = SplineField(GRID), np.random.default_rng(2)
    nodes, weight = rng.standard_normal((3, *field.count)), rng.standard_normal((3, *GRID.shape))
    assert np.vdot(field.values(nodes), weight) == pytest.approx(np.vdot(nodes, field.adjoint(weight)), rel=ROUNDING)
    assert np.vdot(nodes, field.penalty(nodes)) > 0


def test_a_linear_flow_is_found_from_vectors_and_has_no_roughness():
    field, vectors = SplineField(GRID), vectors_of()
    nodes = field.fitted_to(vectors)
    z, y, x = np.meshgrid(*GRID.axes_mm, indexing="ij")
    np.testing.assert_allclose(field.values(nodes), np.moveaxis(linear(np.stack([z, y, x], -1)), -1, 0), atol=FIT_VOXEL)
    assert np.vdot(nodes, field.penalty(nodes)) < FIT_VOXEL


def test_masked_vectors_do_not_count():
    vectors = vectors_of()
    wrong = vectors["displacement_x"].values.copy()
    wrong[0, 0, 0] = np.nan
    field, masked = SplineField(GRID), vectors.assign(displacement_x=vectors["displacement_x"].copy(data=wrong))
    np.testing.assert_allclose(field.fitted_to(masked), field.fitted_to(vectors), atol=0.1)


def test_displacements_on_other_voxels_keep_their_length_in_mm():
    field, coarse = SplineField(GRID.refined(1.25)), GRID
    nodes = np.broadcast_to(np.array([0.4, -0.2, 0.1])[:, None, None, None], (3, *field.count))
    found = field.values_on(nodes, coarse)
    assert found.shape == (3, *coarse.shape)
    for axis, value in enumerate((0.4, -0.2, 0.1)):
        np.testing.assert_allclose(found[axis], value / 1.25, rtol=1e-4)


def test_window_shares_are_means():
    share = window_shares(np.arange(10.0), np.array([2.5, 5.0]), 4.0)
    np.testing.assert_allclose(share.sum(1), 1)
    np.testing.assert_allclose(share @ np.arange(10.0), [2.5, 5.0])
    assert (share[0] > 0).sum() == 4
