"""Vectors from links: the process through them is a flow's, and its means are the windows' of a known flow."""

import numpy as np
import pytest
import xarray as xr

import lfpiv
from lfpiv.tracking.flow_process import FlowCovariance, FlowProcess

DEPTH_ERROR, LATERAL_ERROR = 0.2, 0.02
"""Errors of a link that one camera shows [voxel]."""
SHEAR_ERROR, SHEAR_LEFT = 0.5, 0.45
"""Error of depth [voxel], and what may be left of the shear; a straight line through 45 links leaves 0.25."""
WITHIN = 0.85
"""Least share of components within two stated standard deviations; the flow is no realisation of the process."""


def flow(places):
    """Displacement of an Arnold-Beltrami-Childress flow [voxel]: free of divergence, 1 voxel, waves of 40 voxels."""
    x, y, z = places.T * (2 * np.pi / 40)
    return np.stack([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)], axis=1)


def links(count, seed, *, false=0.0):
    """Places, displacements and standard errors of links in 40 x 40 x 24 voxels.

    Some share is false: they lead to another particle along the line of sight, as validation leaves them.
    """
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5, 0.5, (count, 3)) * (40, 40, 24)
    error = np.tile([LATERAL_ERROR, LATERAL_ERROR, DEPTH_ERROR], (count, 1))
    moved = flow(places) + error * rng.standard_normal((count, 3))
    wrong = rng.random(count) < false
    moved[wrong, 2] += rng.uniform(-2, 2, wrong.sum())
    return places, moved, error


def table(places, moved, error, *, found=None):
    """A table of links as `link_particles` returns it, of voxels of 0.1 mm."""
    named = {"": places * 0.1, "displacement_": moved, "uncertainty_": error}
    columns = {name + axis: values[:, k] for name, values in named.items() for k, axis in enumerate("xyz")}
    columns["valid"] = np.ones(len(places), bool)
    return xr.Dataset(
        {name: ("particle", values) for name, values in columns.items()},
        attrs={"voxel_mm": 0.1, "linked": len(places), "found": [found or len(places)] * 2},
    )


@pytest.fixture(scope="module")
def correlated():
    """Vectors of two volumes that show nothing of the flow, in windows of 12 voxels."""
    noise = np.random.default_rng(0).random((2, 24, 40, 40), np.float32)
    coordinates = {axis: (np.arange(n) - (n - 1) / 2) * 0.1 for axis, n in zip("zyx", (24, 40, 40), strict=True)}
    return lfpiv.correlate(
        *(xr.DataArray(one, coordinates, ("z", "y", "x")) for one in noise), dt_s=1e-3, windows=(12, 12)
    )


def test_depth_that_alone_moves_is_not_held_by_the_other_components():
    """A shear along the line of sight: links of one camera show still components 25 times more precisely."""
    errors = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        places = rng.uniform(-0.5, 0.5, (45, 3)) * (32, 32, 20)
        error = np.tile([LATERAL_ERROR, LATERAL_ERROR, SHEAR_ERROR], (45, 1))
        true = np.stack([np.zeros(45), np.zeros(45), 0.07 * places[:, 0]], axis=1)
        process = FlowProcess.fitted(places, true + error * rng.standard_normal((45, 3)), error)
        found, _ = process.means(places, np.zeros(3))
        errors.append(np.sqrt(np.mean((found - true)[:, 2] ** 2)) / true[:, 2].std())
    assert np.median(errors) < SHEAR_LEFT, errors


def true_means(vectors):
    """The flow's means over windows of 12 voxels, shape (window, 3)."""
    centres = np.stack(np.meshgrid(*(vectors[axis].values / 0.1 for axis in "zyx"), indexing="ij"), -1)[..., ::-1]
    steps = (np.arange(12) + 0.5) - 6
    cube = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    return np.array([flow(centre + cube).mean(0) for centre in centres.reshape(-1, 3)])


@pytest.mark.parametrize(
    ("strength", "incompressible"), [(0.7, False), (0.7, True), (np.array([0.1, 0.7, 2.0]), False)]
)
def test_covariance_is_positive_and_its_derivatives_are_right(strength, incompressible):
    places, _, error = links(12, 1)
    process = FlowProcess.fitted(places, flow(places), error)
    covariance = FlowCovariance(strength=strength, length=8.0, scatter=0.1, incompressible=incompressible)
    matrix, slopes = covariance(process.rows, eval_gradient=True)
    assert np.linalg.eigvalsh(matrix).min() > 0
    for k, step in enumerate(1e-5 * np.eye(len(covariance.theta))):
        high, low = (covariance.clone_with_theta(covariance.theta + sign * step)(process.rows) for sign in (1, -1))
        np.testing.assert_allclose(slopes[..., k], (high - low) / 2e-5, atol=1e-8)


def test_an_incompressible_flow_has_no_divergence():
    places, moved, error = links(60, 2)
    process = FlowProcess.fitted(places, moved, error)
    assert process.covariance.incompressible  # the evidence finds out
    step = 1e-3
    at = np.random.default_rng(3).uniform(-8, 8, (20, 3))
    gradient = np.stack(
        [
            (process.means(at + d, np.zeros(3))[0] - process.means(at - d, np.zeros(3))[0]) / (2 * step)
            for d in step * np.eye(3)
        ]
    )
    divergence = np.trace(gradient, axis1=0, axis2=2)
    assert np.abs(divergence).max() < 1e-6 * np.abs(gradient).max()


@pytest.mark.slow(but="4-0.0")
@pytest.mark.parametrize(("seed", "false"), [(4, 0.0), (5, 0.1)])
def test_depth_is_found_many_times_better_than_by_a_link(correlated, seed, false):
    vectors = lfpiv.vectors_from_links(correlated, table(*links(120, seed, false=false)))
    found = np.stack([vectors[f"displacement_{axis}"].values.ravel() for axis in "xyz"], axis=1)
    error = np.abs(found - true_means(vectors))
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < DEPTH_ERROR / 2
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 2 * LATERAL_ERROR
    stated = np.stack([vectors[f"uncertainty_{axis}"].values.ravel() for axis in "xyz"], axis=1)
    assert vectors.valid.all() and (error < 2 * stated).mean() > WITHIN
    np.testing.assert_allclose(vectors.w, vectors.displacement_z * 0.1e-3 / 1e-3, rtol=1e-6)
    assert '"incompressible"' in vectors.links


def test_few_or_unlinked_particles_leave_the_vectors_as_they_are(correlated):
    assert lfpiv.vectors_from_links(correlated, table(*links(15, 6))) is correlated
    assert lfpiv.vectors_from_links(correlated, table(*links(60, 6), found=150)) is correlated


@pytest.mark.slow
def test_many_links_are_solved_in_parts():
    """Parts take the nearest links; their means agree with a solution by all links to a part of the stated error."""
    places, moved, error = links(700, 7)
    process = FlowProcess.fitted(places, moved, error)
    centres = np.random.default_rng(8).uniform(-6, 6, (10, 3))
    mean, stated = process.means(centres, np.full(3, 12.0))
    whole = process.covariance(process.rows)
    solved = np.linalg.solve(whole, process.targets)
    points = centres[:, None] + (np.stack(np.meshgrid(*[np.arange(4) * 3 - 4.5] * 3, indexing="ij"), -1).reshape(-1, 3))
    for centre, one, error_of_one in zip(points, mean, stated, strict=True):
        at = np.column_stack([np.tile(centre, (3, 1)), np.repeat(np.arange(3.0), 64), np.zeros(192), np.ones(192)])
        exact = (process.covariance(at, process.rows) @ solved).reshape(3, 64).mean(1) + process.level
        assert (np.abs(one - exact) < error_of_one).all()


def test_links_of_other_voxels_are_refused(correlated):
    other = table(*links(30, 9)).assign_attrs(voxel_mm=0.2)
    with pytest.raises(ValueError, match=r"links: expected links in voxels of \[0.1, 0.1, 0.1\] mm"):
        lfpiv.vectors_from_links(correlated, other)
