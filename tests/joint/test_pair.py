"""Joint fit of both frames: a third of the error, a wrong start forgotten, and correlation where frames disagree."""

import math

import numpy as np
import pytest
import xarray as xr
from support import plain_steps
from support.ideal_rig import optics, two_cameras

import lfpiv
from lfpiv import metrics
from lfpiv.joint.field import WIDENED
from lfpiv.joint.pair import MOVED, UNSHARED, Estimate, PairSolver
from lfpiv.joint.vectors import compare, joint_vectors
from lfpiv.simulation.flows import Swirl, window_mean

GRID = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(2.4, 2.2, 2.0), voxel_mm=0.1)
WINDOWS = (16, 12, 12)
CORRELATION = {"windows": WINDOWS}
BLOB = 0.7
EDGE_VOXELS = 2.0
"""Largest error of the edge of a region without particles [voxel]: it is found from a mean over 64 particles."""
BETWEEN_NODES_MM = 1e-3
"""Largest error of a displacement that is interpolated between voxels, and beyond them by a spline [mm]."""
GAIN = 0.7
"""Largest share of the correlation's error that is left; 0.61 here, in a volume of few windows."""


@pytest.fixture(scope="module")
def weights(device):
    return lfpiv.build_weights(two_cameras(optics=optics(440, 640)), GRID)


def images_of(weights, positions, seed, unlike=0.0):
    """Return images of blobs, unlike bright in each camera, as the weights have them, with shot and read noise."""
    rng, images, light = np.random.default_rng(seed), {}, np.random.default_rng(4)
    for name in weights.cameras:
        bright = np.exp(unlike * light.standard_normal(len(positions)))
        image = weights(metrics.truth_volume(positions, bright, GRID, BLOB).values * np.float32(3e5))[name]
        images[name] = (image + rng.standard_normal(image.shape) * np.sqrt(0.4 * image + 4)).astype(np.float32)
    return images


def recorded(weights, unlike=0.0):
    """Return a flow, and images of both frames of a densely seeded pair."""
    flow, rng = Swirl(peak_mm=0.15, core_mm=0.8, axial_mm=0.08), np.random.default_rng(3)
    middle = np.array([0.1, -0.1, 0.2]) + rng.uniform(-0.5, 0.5, (240, 3)) * np.array([2.4, 2.2, 2.0])
    moved = flow(middle)
    return flow, [images_of(weights, middle + side * moved / 2, [3, k], unlike) for k, side in enumerate((-1, 1))]


@pytest.fixture(scope="module")
def pair(weights):
    return recorded(weights)


@pytest.fixture(scope="module")
def fitted(weights, pair):
    seen = []
    volumes = lfpiv.reconstruct_pair(
        weights, pair[1], estimate="joint", correlation=None, sieve_voxel=0.7, progress=seen.append
    )
    return volumes, seen


def errors(vectors, flow):
    z, y, x = np.meshgrid(*(vectors[axis].values for axis in "zyx"), indexing="ij")
    exact = window_mean(flow, np.stack([x, y, z], -1).reshape(-1, 3), WINDOWS[-1] * GRID.voxel_mm)
    found = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], -1)
    return np.linalg.norm(found - exact.reshape(*x.shape, 3) / GRID.voxel_mm, axis=-1)


def test_both_frames_fitted_together_measure_better(pair, fitted):
    volumes, seen = fitted
    assert [volume.attrs["estimate"] for volume in volumes] == [Estimate.JOINT.value] * 2
    vectors = joint_vectors(volumes, dt_s=1e-3, **CORRELATION)
    alone = lfpiv.correlate(*(volume.copy(data=volume[UNSHARED].values) for volume in volumes), **CORRELATION)
    valid = vectors["valid"].values
    assert errors(vectors, pair[0])[valid].mean() < GAIN * errors(alone, pair[0])[valid].mean()
    assert vectors.attrs["joint_fraction"] == pytest.approx(vectors["joint"].values[valid].mean())
    velocity = vectors["displacement_x"].values * GRID.voxel_mm * 1e-3 / 1e-3
    np.testing.assert_allclose(vectors["u"].values, velocity, rtol=1e-4, atol=1e-6)
    assert seen == sorted(seen) and seen[-1] == 1.0
    assert vectors.attrs["error_correlation_voxel"] == pytest.approx([math.sqrt(5.9**2 + 12**2 / 3)] * 3, abs=0.05)


@pytest.mark.slow
def test_vectors_of_particles_that_are_unlike_bright_in_the_cameras_are_less_certain(weights, pair, fitted):
    """Such errors are the same in both frames, so only the cameras tell."""
    other = lfpiv.reconstruct_pair(weights, recorded(weights, unlike=1.0)[1], estimate="joint", sieve_voxel=0.7)
    unlike, alike = other[0].attrs["unlike"], fitted[0][0].attrs["unlike"]
    assert unlike > 3 * alike > 0
    vectors = joint_vectors(other, **CORRELATION)
    assert vectors.attrs["unlike"] == unlike
    less = joint_vectors([one.assign_attrs(unlike=0.0) for one in other], **CORRELATION)
    told = (vectors["joint"] & vectors["valid"]).values
    assert told.any() and (vectors["uncertainty"].values > less["uncertainty"].values)[told].all()


def test_the_field_is_finer_than_its_vectors(pair, fitted):
    """Where vectors are near, errors at single places are as large as stated, and the divergence is small."""
    vectors = joint_vectors(fitted[0], dt_s=1e-3, **CORRELATION)
    field = lfpiv.joint_field(fitted[0], vectors)
    z, y, x = np.meshgrid(*(field[axis].values for axis in "zyx"), indexing="ij")
    exact = pair[0](np.stack([x, y, z], -1).reshape(-1, 3)).reshape(*x.shape, 3) / GRID.voxel_mm
    found, stated = (
        np.stack([field[f"{name}_{axis}"].values for axis in "xyz"], -1) for name in ("displacement", "uncertainty")
    )
    error = np.abs(found - exact)[field.valid.values]
    assert np.linalg.norm(error, axis=-1).mean() < WIDENED * errors(vectors, pair[0]).mean()
    assert (error < 2 * stated[field.valid.values]).mean() > 0.9
    assert float(np.abs(field.divergence).mean()) < 0.5 * float(np.abs(field.vorticity_y).mean())


@pytest.mark.slow
def test_volumes_of_a_joint_fit_come_on_other_voxels_by_the_grid(weights, pair, fitted):
    """A displacement is no light: it is not resampled as such, and its unit is the edge of the new voxels."""
    larger = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(2.25, 2.0, 1.75), voxel_mm=0.125)
    with pytest.raises(ValueError, match=r"found a volume of a joint fit.* Give the grid to `reconstruct_pair`"):
        lfpiv.volume_on(fitted[0][0], larger)
    first = lfpiv.reconstruct_pair(weights, pair[1], estimate="joint", sieve_voxel=0.7, grid=larger)[0]
    moved, known = (
        first[MOVED["x"]],
        fitted[0][0][MOVED["x"]].interp_like(first, method="cubic", kwargs={"fill_value": None}),
    )
    np.testing.assert_allclose(moved.values * larger.voxel_mm, known.values * GRID.voxel_mm, atol=BETWEEN_NODES_MM)


def test_a_displacement_that_the_frames_contradict_is_not_taken(fitted):
    volumes, _ = fitted
    first = volumes[0]
    wrong = first[MOVED["x"]].values + 1.0 * (np.arange(first.sizes["x"]) < first.sizes["x"] // 2)
    changed = first.assign_coords({MOVED["x"]: (first.dims, wrong.astype("f4"))})
    vectors, sound = (joint_vectors((one, volumes[1]), **CORRELATION) for one in (changed, first))
    left = vectors["x"].values < 0.1 - 0.5
    assert not vectors["joint"].values[..., left].any() and sound["joint"].values[..., left].mean() > 0.5
    own = lfpiv.correlate(*(volume.copy(data=volume[UNSHARED].values) for volume in volumes), **CORRELATION)
    np.testing.assert_array_equal(vectors["displacement_x"].values[..., left], own["displacement_x"].values[..., left])


def test_a_vector_is_the_mean_over_the_fluid_in_its_window(fitted):
    """Beside a wall the fit has no images to follow, so its displacement there counts in no mean."""
    volumes, wall = fitted[0], 9
    solid = np.broadcast_to(np.arange(GRID.shape[2]) < wall, GRID.shape)
    masked = [volume.assign_coords(masked=(volume.dims, solid)) for volume in volumes]
    alone = [volume.copy(data=np.where(solid, 0, volume[UNSHARED].values).astype("f4")) for volume in masked]
    ramp = 0.01 * np.broadcast_to(np.arange(GRID.shape[2], dtype="f4"), GRID.shape)
    masked[0] = masked[0].assign_coords({MOVED["x"]: (volumes[0].dims, np.where(solid, 5, ramp).astype("f4"))})
    vectors = lfpiv.correlate(*alone, **CORRELATION)
    evidence = compare(vectors, masked, alone)
    found = evidence.fitted[..., 2]
    for column, centre in enumerate((vectors["x"].values - GRID.axis_mm(2)[0]) / GRID.voxel_mm):
        whole = np.clip((WINDOWS[-1] + 1) / 2 - np.abs(np.arange(GRID.shape[2]) - centre), 0, 1)
        part = whole * ~solid[0, 0]
        np.testing.assert_allclose(found[..., column], (ramp[0, 0] * part).sum() / part.sum(), rtol=1e-5)
        np.testing.assert_allclose(evidence.part[..., column, 0], part.sum() / whole.sum(), rtol=1e-5)
    assert not evidence.edge.any(), "a wall that is stated has no error"
    assert 0 < vectors["fluid_share"].values.min() < 1, "a window beside the wall"


def test_where_no_particles_are_found_the_displacement_does_not_count_and_the_edge_is_uncertain():
    """As beside a wall that is not stated; its edge is known to a voxel."""
    grid, window, gradient = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(4, 4, 4), voxel_mm=0.1), 12, 0.1
    positions = np.random.default_rng(7).uniform((0, -2, -2), 2, (2000, 3))  # all beyond x = 0
    light = metrics.truth_volume(positions, np.ones(len(positions)), grid, BLOB)
    ramp = np.broadcast_to(gradient / grid.voxel_mm * grid.axis_mm(2).astype("f4"), grid.shape)
    moved = {MOVED[axis]: (light.dims, ramp if axis == "x" else np.zeros_like(ramp)) for axis in "zyx"}
    volume = light.assign_coords({UNSHARED: (light.dims, light.values)} | moved)
    vectors = lfpiv.correlate(light, light, windows=[window])
    evidence = compare(vectors, (volume, volume), (light, light))
    centre = vectors["x"].values / grid.voxel_mm
    lit, beside = centre > window / 2 + EDGE_VOXELS, np.abs(centre) < 1
    assert beside.any() and lit.any()
    np.testing.assert_allclose(evidence.part[..., lit, 0], 1, rtol=1e-6)
    assert np.abs(evidence.edge[..., lit, :]).max() < 1e-6
    middle = gradient * (centre + window / 2)[beside] / 2
    assert np.abs(evidence.fitted[..., beside, 2] - middle).max() < gradient * EDGE_VOXELS / 2
    assert np.abs(evidence.edge[..., beside, 2] - gradient / 2).max() < gradient / 4


def test_frames_by_themselves_are_correlated_as_ever(weights, pair):
    volumes = plain_steps.reconstruct_pair(weights, pair[1], estimate="correlation", iterations=2)
    assert UNSHARED not in volumes[0].coords and volumes[0].attrs["estimate"] == Estimate.ALONE.value
    xr.testing.assert_identical(joint_vectors(volumes, **CORRELATION), lfpiv.correlate(*volumes, **CORRELATION))


def test_frames_without_common_particles_start_no_fit(weights, pair):
    strangers = [pair[1][0], images_of(weights, np.random.default_rng(9).uniform(-0.9, 0.9, (240, 3)), 5)]
    volumes = lfpiv.reconstruct_pair(weights, strangers, estimate="joint", iterations=4)
    assert volumes[0].attrs["estimate"] == Estimate.NOT_STARTED.value
    vectors = joint_vectors(volumes, **CORRELATION)
    assert vectors.attrs["estimate"] == Estimate.NOT_STARTED.value and not vectors.joint.any()


def test_a_volume_thinner_than_the_nodes_is_not_fitted(weights, pair):
    """Its spline would lose light at the faces: 0.073 voxel of error for 0.061 of the correlation, in five voxels."""
    thin = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(2.4, 2.2, 0.5), voxel_mm=0.1)
    thinner = lfpiv.build_weights(two_cameras(optics=optics(440, 640)), thin)
    volumes = lfpiv.reconstruct_pair(thinner, pair[1], estimate="joint", iterations=2)
    assert volumes[0].attrs["estimate"] == Estimate.TOO_THIN.value and UNSHARED not in volumes[0].coords


def test_wrong_arguments_are_named(weights, pair):
    one = weights.of_camera("cam1")
    for given, settings, message in (
        (weights, {"estimate": "both"}, "estimate: expected 'auto', 'correlation' or 'joint'"),
        (one, {"estimate": "joint"}, "needs two or more cameras"),
        (weights, {"first": np.ones(GRID.shape)}, "first: expected no first guess"),
    ):
        with pytest.raises(ValueError, match=message):
            lfpiv.reconstruct_pair(given, pair[1], **settings)
    with pytest.raises(ValueError, match="expected two frames"):
        PairSolver(weights, lfpiv.reconstruction.settings.SmartSettings()).solve(pair[1][:1], (None,))
