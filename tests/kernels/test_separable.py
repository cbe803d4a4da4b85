"""Weights as profiles that planes of voxels share: the loops against their twin, and the map as a linear operator."""

import numpy as np
import pytest
from support.ideal_rig import IdealCamera, lattice, optics, rotation

from lfpiv.geometry.grid import Grid
from lfpiv.weights.forms.camera_profiles import CameraProfiles
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import reference
from lfpiv_kernels.reconstruction import projector_separable, separable_gpu
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector
from lfpiv_kernels.reconstruction.separable_gpu import LinesProjector
from lfpiv_kernels.transfer import to_device, to_host, zeros

ROUNDING = 2e-6
"""Largest difference of float32 sums of some hundred terms, as a part of the largest value."""
SETS = 3
"""Sets of rays; no divisor of the number of ray rows."""
RIGS = {
    "upright": (rotation(40.0), 0.0, (6, 9, 7)),
    "turned camera and array": (rotation(-35.0, 2.0, 1.0), 0.4, (6, 9, 7)),
    "columns apart in memory": (rotation(8.0), 0.2, (7, 6, 19)),
}
"""Pose, roll of the array [degree], voxels (z, y, x)."""


def made(name):
    """Return the grid, the camera and its weights."""
    pose, roll_deg, shape = RIGS[name]
    grid = Grid.from_extent(centre_mm=(0.1, 0.0, -0.05), size_mm=[0.13 * n for n in shape[::-1]], voxel_mm=0.13)
    camera = IdealCamera("one", pose, optics(140, 160), lattice(roll_deg=roll_deg))
    stored = StoredGrid.for_cameras(grid, [camera], columns_inmost=name != "columns apart in memory")
    planes = CameraProfiles(stored, camera)
    assert planes.possible
    return planes, planes.weights(lambda part: None)


@pytest.fixture(scope="module", params=RIGS)
def case(request):
    """Return the planes, the weights, the projector and the twin's matrix."""
    planes, weights = made(request.param)
    return planes, weights, SeparableProjector(weights, SETS), reference.separable(weights)


def rows_of(weights, ray_set):
    """Return which rays belong to a set."""
    row = np.arange(weights.ray_rows)[:, None] % SETS
    return np.broadcast_to(row == ray_set, (weights.ray_rows, weights.rays_of_row)).ravel()


@pytest.mark.slow
def test_rigs_are_what_they_say():
    moved = {name: made(name)[0].axes[2] != 2 for name in RIGS}
    assert moved == {"upright": False, "turned camera and array": False, "columns apart in memory": True}


@pytest.mark.slow(but="upright")
def test_light_on_rays_is_that_of_the_twin(case):
    _, weights, projector, matrix = case
    volume = np.random.default_rng(1).random(matrix.shape[1]).astype(np.float32)
    expected = matrix @ volume
    with projector.reserved():
        projector.scatter(volume)
        found = projector.rays.numpy().copy()
        np.testing.assert_allclose(found, expected, atol=ROUNDING * expected.max())
        for ray_set in range(SETS):
            projector.rays.zero_()
            projector.scatter(volume, ray_set)
            some = rows_of(weights, ray_set)
            np.testing.assert_array_equal(projector.rays.numpy()[some], found[some])
            assert not projector.rays.numpy()[~some].any()


@pytest.mark.slow(but="upright")
def test_voxels_gather_the_adjoint(case):
    _, weights, projector, matrix = case
    rays = np.random.default_rng(2).standard_normal(len(matrix)).astype(np.float32)
    before = np.random.default_rng(3).random(matrix.shape[1]).astype(np.float32)
    for ray_set in (ALL, *range(SETS)):
        some = np.ones(len(rays), bool) if ray_set == ALL else rows_of(weights, ray_set)
        expected = matrix[some].T @ rays[some]
        with projector.reserved():
            projector.returned.assign(rays)
            found = projector.gather(before.copy(), ray_set=ray_set)
        atol = ROUNDING * np.abs(matrix.T @ np.abs(rays)).max()
        np.testing.assert_allclose(found, before + expected, atol=atol)


@pytest.mark.slow(but="upright")
def test_projection_and_back_projection_are_adjoint(case):
    _, weights, projector, matrix = case
    rng, pixels = np.random.default_rng(5), int(np.prod(weights.sensor_shape))
    volume, image = rng.random(matrix.shape[1]).astype(np.float32), rng.random(pixels).astype(np.float32)
    for ray_set in (ALL, *range(SETS)):
        projected = projector.project(volume, np.zeros(pixels, np.float32), ray_set).astype(float)
        returned = projector.back_project(image, np.zeros(len(volume), np.float32), ray_set).astype(float)
        assert projected @ image == pytest.approx(returned @ volume, rel=1e-5)
    share = np.where(weights.pixel >= 0, weights.share, 0.0)
    expected = np.bincount(np.maximum(weights.pixel, 0), share * (matrix @ volume), pixels)
    found = projector.project(volume, np.zeros(pixels, np.float32))
    np.testing.assert_allclose(found, expected, atol=2 * ROUNDING * expected.max())


@pytest.mark.slow(but="upright")
@pytest.mark.parametrize("rays_at_once", [1, 5000, 30_000])
def test_light_does_not_depend_on_how_the_work_is_cut(case, rays_at_once, monkeypatch):
    _, weights, projector, matrix = case
    rng = np.random.default_rng(6)
    sizes = matrix.shape[1], int(np.prod(weights.sensor_shape))
    volume, image = (rng.random(size).astype(np.float32) for size in sizes)

    def light(of, ray_set):
        projected = of.project(volume, np.zeros_like(image), ray_set)
        return projected, of.back_project(image, np.zeros_like(volume), ray_set)

    whole = [light(projector, ray_set) for ray_set in (ALL, 1)]
    small = {"LEAST_TASKS": 100, "FEWEST_RAYS": 1, "FEWEST_LENSES": 1, "TURNED_RAYS": rays_at_once}
    for constant, value in small.items():
        monkeypatch.setattr(projector_separable, constant, value)  # short segments, many launches of many parts
    cut = SeparableProjector(weights, SETS)
    for ray_set, expected in zip((ALL, 1), whole, strict=True):
        for found, one in zip(light(cut, ray_set), expected, strict=True):
            np.testing.assert_array_equal(found, one)


@pytest.mark.slow(but="upright")
@pytest.mark.parametrize("at_once", ["all ray rows", "one ray row"])
def test_loops_for_a_gpu_give_the_light_of_those_for_the_cpu(case, at_once, monkeypatch):
    _, weights, projector, matrix = case
    if at_once == "one ray row":
        monkeypatch.setattr(separable_gpu, "LINES_BYTES", 0)
    lines, rng = LinesProjector(weights), np.random.default_rng(8)
    volume, light = (rng.random(size).astype(np.float32) for size in matrix.shape[::-1])
    for ray_set, ray_rows in ((ALL, range(weights.ray_rows)), (1, range(1, weights.ray_rows, SETS))):
        rays, gathered = zeros(len(light)), zeros(len(volume))
        lines.scatter(to_device(volume), ray_rows, rays)
        lines.gather(to_device(light), ray_rows, gathered)
        with projector.reserved():
            projector.rays.zero_()
            projector.scatter(volume, ray_set)
            projector.returned.assign(light)
            expected = to_host(projector.rays), projector.gather(np.zeros_like(volume), ray_set=ray_set)
        for found, one in zip((rays, gathered), expected, strict=True):
            np.testing.assert_allclose(to_host(found), one, atol=ROUNDING * one.max())
    np.testing.assert_array_equal(lines.count_lit(), projector.count_lit())


@pytest.mark.slow(but="upright")
def test_entries_are_columns_of_the_matrix(case):
    _, _, projector, matrix = case
    for voxel in (0, matrix.shape[1] // 2):
        rays, weight = projector.entries(voxel)
        dense = np.zeros(len(matrix))
        dense[rays] = weight
        np.testing.assert_allclose(dense, matrix[:, voxel], atol=ROUNDING * matrix.max())


@pytest.mark.slow(but="upright")
def test_count_of_lit_rays_is_that_of_profiles(case):
    _, weights, projector, _ = case
    plain = SeparableProjector(_without_turns(weights), SETS)
    lit = reference.separable(plain.weights) > 0
    expected = lit[(weights.share > 0)].sum(0)
    np.testing.assert_array_equal(projector.count_lit(), expected)


@pytest.mark.slow(but="upright")
def test_largest_weight_bounds_those_of_rays(case):
    _, weights, projector, matrix = case
    plain = reference.separable(_without_turns(weights))
    assert plain.max() <= projector.largest_weight() * (1 + 1e-6)
    assert projector.largest_weight() <= 1.3 * matrix.max()  # both profiles are largest nearly in the same voxel


def _without_turns(weights):
    from dataclasses import replace

    return replace(weights, turn=np.zeros_like(weights.turn), rim=np.zeros_like(weights.rim))
