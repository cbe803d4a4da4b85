"""Weights of nodes on planes across the line of sight: the map R against its twin, its images against footprints."""

from itertools import permutations

import numpy as np
import pytest
from scipy import ndimage
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation, two_cameras

import lfpiv
from lfpiv.weights.checks import compare_with_count, estimate_memory
from lfpiv.weights.forms import nodes as nodes_form
from lfpiv.weights.forms import shared_profiles
from lfpiv.weights.forms.image_errors import PARTICLE_ERROR, PARTICLE_VOXEL, Sample, blobs_about
from lfpiv.weights.forms.line_shares import BEFORE, LINES, VARIANCE_VOXEL, line_shares
from lfpiv.weights.forms.node_grid import NodeGrid, line_of_sight
from lfpiv.weights.forms.nodes import VOXEL_ERROR, choose_nodes, interpolation_errors
from lfpiv.weights.ray_fit import ray_models
from lfpiv.weights.storage import open_weights, save_weights
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.depth_planes import DepthPlanes
from lfpiv_kernels.reconstruction.node_projector import NodeProjector

TOLERANCE_TWIN = 2e-6  # float32 sums of up to 64 shares
TOLERANCE_ADJOINT = 1e-5  # as of the operator
TOLERANCE_COUNT = 1e-4  # footprints of a few voxels and of a row of them, float32
TOLERANCE_PITCH = 5e-4  # interpolated fits, 3e-4, and a second derivative over a voxel, half a squared one over 200 mm
GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 0.8, 1.4), voxel_mm=0.05)
CAMERAS = {
    "45": rotation(45),
    "-44, rolled": rotation(-44, 0.5, 3),
    "from above": rotation(1, 45),
}
BETWEEN = {"30": rotation(30), "-60, rolled": rotation(-60, 0.5, 3), "35 and 20": rotation(35, 20)}
"""Cameras whose line of sight follows no lattice direction."""


@pytest.fixture(scope="module", autouse=True)
def without_shared_profiles():
    """Do not let planes share profiles, which would serve these rigs, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_profiles, "FEWEST_VOXELS", np.inf)
        yield


@pytest.fixture
def for_small_volumes(monkeypatch):
    """Use nodes however small the volume and the gain are."""
    monkeypatch.setattr(nodes_form, "FEWEST_VOXELS", 0)
    monkeypatch.setattr(nodes_form, "LEAST_GAIN", 0.0)


def rig_of(*yaws_deg):
    return IdealRig({f"cam{n}": IdealCamera(f"cam{n}", rotation(yaw, 0.2 * n)) for n, yaw in enumerate(yaws_deg, 1)})


@pytest.fixture(scope="module")
def between(device):
    """Return the weights of cameras at 30 and -60 degrees with nodes and those of all voxels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nodes_form, "FEWEST_VOXELS", 0)
        patch.setattr(nodes_form, "LEAST_GAIN", 0.0)
        nodes = lfpiv.build_weights(rig_of(30, -60), GRID, particle_voxel=PARTICLE_VOXEL)
    return nodes, lfpiv.build_weights(rig_of(30, -60), GRID, planes=False)


@pytest.fixture(scope="module")
def both(device):
    """Return the weights of two cameras with nodes and those of all voxels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nodes_form, "FEWEST_VOXELS", 0)
        patch.setattr(nodes_form, "LEAST_GAIN", 0.0)
        nodes = lfpiv.build_weights(two_cameras(), GRID)
    return nodes, lfpiv.build_weights(two_cameras(), GRID, planes=False)


def shares_matrix(shares):
    matrix = np.zeros((shares.size, int(np.prod(shares.voxels))))
    for voxel in range(matrix.shape[1]):
        node, share = shares.nodes_of(voxel)
        np.add.at(matrix[:, voxel], node, share)
    return matrix


@pytest.mark.parametrize("pose", [*CAMERAS.values(), rotation(2, 1), *BETWEEN.values()])
@pytest.mark.parametrize("order", [*permutations(range(3))])
def test_voxels_are_shared_among_nodes_as_stated(pose, order, device):
    stored = StoredGrid(lfpiv.Grid(shape=(9, 7, 8), voxel_mm=0.1, first_centre_mm=(0.0, 0.0, 0.0)), order)
    nodes = NodeGrid.for_camera(stored, IdealCamera("one", pose), 3, lines=(True, True))
    planes, matrix = DepthPlanes(nodes.shares), shares_matrix(nodes.shares)
    rng = np.random.default_rng(0)
    volume = rng.standard_normal(stored.size).astype(np.float32)
    light = rng.standard_normal(nodes.size).astype(np.float32)
    np.testing.assert_allclose(planes.spread(volume), matrix @ volume, atol=TOLERANCE_TWIN * 10)
    np.testing.assert_allclose(planes.spread(volume, absolute=True), np.abs(matrix) @ volume, atol=TOLERANCE_TWIN * 10)
    np.testing.assert_allclose(planes.collect(light), matrix.T @ light, atol=TOLERANCE_TWIN * 10)


@pytest.mark.parametrize("name", [*CAMERAS, *BETWEEN])
def test_shares_keep_light_and_lie_about_the_voxel_along_its_line_of_sight(name):
    camera, among = IdealCamera("one", (CAMERAS | BETWEEN)[name]), name in BETWEEN
    stored = StoredGrid.for_cameras(GRID, [camera])
    nodes = NodeGrid.for_camera(stored, camera, 4, lines=(among, among))
    assert any(nodes.lines) == among
    sight = line_of_sight(camera, GRID.centre_mm)
    for voxel in np.random.default_rng(1).choice(stored.size, 20):
        node, share = nodes.shares.nodes_of(int(voxel))
        away = nodes.centres_mm(node) - stored.centres_mm(np.array([voxel]))
        assert share.sum() == pytest.approx(1, abs=1e-5 if among else 1e-6)
        np.testing.assert_allclose(share @ away, 0, atol=1e-6)
        across = np.linalg.norm(away - (away @ sight)[:, None] * sight, axis=1)
        if among:
            assert across.max() < 3 * np.sqrt(2) * GRID.voxel_mm  # three lines on either side
        else:
            assert across[np.abs(share) > 0.2].max() < 2 * GRID.voxel_mm
            assert len(node) == 1 or np.abs(away @ sight).max() > 3 * GRID.voxel_mm  # else it lies on a plane


def test_shares_among_lines_interpolate_blobs_better_than_a_polynomial():
    place = np.linspace(0, 1, 11)
    share, lines = line_shares(place), np.arange(LINES) - BEFORE
    np.testing.assert_allclose(share[[0, -1]], np.eye(LINES)[[BEFORE, BEFORE + 1]], atol=1e-9)
    np.testing.assert_allclose(share, line_shares(1 - place)[:, ::-1], atol=1e-9)
    blobs = np.exp(-((np.linspace(-8, 8, 321) - lines[:, None]) ** 2) / (2 * VARIANCE_VOXEL))
    polynomial = lagrange_shares(place, lines)
    for at, ours, theirs in zip(place[1:-1], share[1:-1], polynomial[1:-1], strict=True):
        exact = np.exp(-((np.linspace(-8, 8, 321) - at) ** 2) / (2 * VARIANCE_VOXEL))
        assert np.linalg.norm(ours @ blobs - exact) < np.linalg.norm(theirs @ blobs - exact)


def lagrange_shares(place, lines):
    factors = [[(place - other) / (line - other) for other in lines if other != line] for line in lines]
    return np.prod(factors, axis=1).T


@pytest.mark.parametrize("pose", BETWEEN.values(), ids=BETWEEN)
@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0)])
def test_models_of_nodes_are_those_of_their_places(pose, order):
    camera = IdealCamera("one", pose)
    nodes = NodeGrid.for_camera(StoredGrid(GRID, order), camera, 4, lines=(True, True))
    found = np.concatenate(list(nodes.models(camera)))
    expected = ray_models(camera, nodes.centres_mm(np.arange(nodes.size)), GRID.voxel_mm)
    radius, pitch = camera.optics.pupil_radius_mm, camera.lattice.pitch_mm
    for place in (0, 6):
        np.testing.assert_allclose(found[:, place], expected[:, place], atol=TOLERANCE_PITCH * pitch)
        slopes = (found - expected)[:, place + 1 : place + 3]
        assert np.abs(slopes).max() * radius < TOLERANCE_PITCH * pitch
    assert np.abs(found - expected)[:, 12:18].max() < TOLERANCE_PITCH * pitch


@pytest.mark.parametrize("pose", CAMERAS.values(), ids=CAMERAS)
def test_images_between_nodes_are_those_of_voxels(pose, for_small_volumes):
    camera = IdealCamera("one", pose, lattice=lattice(roll_deg=0.5))
    stored = StoredGrid.for_cameras(GRID, [camera])
    nodes = choose_nodes(stored, camera, "pixels")
    voxels = np.random.default_rng(2).choice(stored.size, 40)
    sample = Sample(camera, voxels[:, None], np.ones((40, 1)), "pixels")
    own = sample.own_images(stored)
    error = np.sqrt(np.mean(np.square(interpolation_errors(nodes, sample, own))))
    assert error < 1.4 * VOXEL_ERROR  # of other voxels than those by which the distance was chosen
    wide = NodeGrid.for_camera(stored, camera, 3 * nodes.distance)
    assert np.mean(interpolation_errors(wide, sample, own)) > 2 * error


def assert_adjoint(nodes, every, rng):
    """Assert <W v, p> = <v, W.T p>, and sums of the columns as of all voxels."""
    images = {name: rng.standard_normal(camera.gain.shape).astype(np.float32) for name, camera in nodes.cameras.items()}
    volume = rng.standard_normal(GRID.shape).astype(np.float32)
    projected, back = nodes(volume), nodes.T(images)
    left = sum(np.vdot(projected[name].astype(float), images[name]) for name in images)
    assert left == pytest.approx(np.vdot(volume.astype(float), back), rel=TOLERANCE_ADJOINT, abs=1e-3)
    np.testing.assert_allclose(nodes.column_sum, every.column_sum, rtol=0.01)


def test_operator_with_nodes_is_that_of_all_voxels(both):
    nodes, every = both
    assert all(isinstance(nodes.projector(name), NodeProjector) for name in nodes.cameras)
    assert nodes.memory_bytes < 0.7 * every.memory_bytes
    rng = np.random.default_rng(3)
    sparse = np.zeros(GRID.shape, np.float32)
    sparse[tuple(rng.integers(0, n, 40) for n in GRID.shape)] = 1.0
    blobs = ndimage.gaussian_filter(sparse, 0.9)
    for volume, largest in ((sparse, 0.02), (blobs, 0.01)):
        found, expected = nodes(volume), every(volume)
        for name in nodes.cameras:
            assert np.linalg.norm(found[name] - expected[name]) < largest * np.linalg.norm(expected[name])
    assert_adjoint(nodes, every, rng)
    assert nodes.largest == pytest.approx(every.largest, rel=0.05)
    apart = np.abs(nodes.affected_pixels / every.affected_pixels - 1)  # a weighted mean of whole numbers
    assert apart.mean() < 0.04 and apart.max() < 0.4


@pytest.mark.slow
def test_operator_with_lines_of_sight_is_that_of_all_voxels(between):
    nodes, every = between
    assert all(nodes.projector(name).shares.column_share.shape[1] == LINES for name in nodes.cameras)
    rng = np.random.default_rng(9)
    sparse = np.zeros(GRID.shape, np.float32)
    sparse[tuple(rng.integers(0, n, 40) for n in GRID.shape)] = 1.0
    found, expected = (weights(ndimage.gaussian_filter(sparse, 0.9)) for weights in between)
    for name in nodes.cameras:
        assert np.linalg.norm(found[name] - expected[name]) < PARTICLE_ERROR * np.linalg.norm(expected[name])
    assert_adjoint(nodes, every, rng)
    unit = np.zeros(GRID.shape, np.float32)
    unit[13, 5, 9] = 1.0
    for name, image in nodes(unit).items():
        np.testing.assert_allclose(nodes.image(name, (13, 5, 9)), image, atol=1e-6 * image.max())


def test_voxels_without_part_do_not_change(both):
    projector = both[0].projector("cam2")
    rng = np.random.default_rng(5)
    active = (rng.random(GRID.size) < 0.02).astype(np.float32)
    projector.scatter(rng.random(GRID.size).astype(np.float32))
    every = projector.gather(np.zeros(GRID.size, np.float32))
    some = projector.gather(np.full(GRID.size, 7.0, np.float32), active)
    assert (some[active == 0] == 7).all()
    np.testing.assert_allclose(some[active > 0] - 7, every[active > 0], atol=1e-5 * np.abs(every).max())


@pytest.mark.parametrize("weights", ["both", "between"])
def test_stored_weights_keep_their_nodes(weights, tmp_path, request):
    nodes, _ = request.getfixturevalue(weights)
    content = save_weights(nodes, tmp_path)
    opened = open_weights(tmp_path, nodes.cameras, content)
    volume = np.random.default_rng(6).random(GRID.shape).astype(np.float32)
    for (name, image), again in zip(nodes(volume).items(), opened(volume).values(), strict=True):
        np.testing.assert_array_equal(again, image, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["both", "between"])
def test_volumes_are_as_good_as_with_the_weights_of_all_voxels(weights, request):
    both = request.getfixturevalue(weights)
    every = both[1]
    rng = np.random.default_rng(8)
    truth = np.zeros(GRID.shape, np.float32)
    truth[tuple(rng.integers(3, n - 3, 60) for n in GRID.shape)] = 1e4
    truth = ndimage.gaussian_filter(truth, 0.9)
    images = {name: image + rng.normal(0, 1, image.shape) for name, image in every(truth).items()}
    alike = []
    for weights in both:
        volume = lfpiv.reconstruct(weights, images, iterations=12, subsets="auto", sieve_voxel=0.8)
        assert (volume.values >= 0).all()
        alike.append(np.corrcoef(volume.values.ravel(), truth.ravel())[0, 1])
    assert alike[0] > alike[1] - 0.01


def test_memory_with_nodes_is_estimated(monkeypatch):
    monkeypatch.setattr(shared_profiles, "are_possible", lambda *_: False)  # they would be stored in place of nodes
    rig = two_cameras(optics=optics(rows=60, columns=80))
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.4, 2.4, 2.4), voxel_mm=0.05)
    nothing = lfpiv.Grid(shape=(1, 1, 1), voxel_mm=0.05, first_centre_mm=(0.0, 50.0, 0.0))
    weights = lfpiv.build_weights(rig, grid, form="profiles")
    assert all(isinstance(weights.projector(name), NodeProjector) for name in weights.cameras)
    estimate = estimate_memory(rig, grid, "profiles") - estimate_memory(rig, nothing, "profiles")
    assert estimate == pytest.approx(weights.memory_bytes, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pose", "lines"),
    [
        (rotation(33), (False, True)),
        (rotation(1, -60), (True, False)),
        (rotation(31.4, 2.5), (False, True)),  # a camera meant to look along a row is never quite there
    ],
    ids=["33", "-60 from above", "31 and 2.5"],
)
def test_cameras_between_lattice_directions_share_voxels_among_lines_of_sight(pose, lines, for_small_volumes):
    camera = IdealCamera("one", pose)
    stored = StoredGrid.for_cameras(GRID, [camera])
    nodes = choose_nodes(stored, camera, "profiles", particle_voxel=PARTICLE_VOXEL)
    sample = Sample(camera, *blobs_about(stored, np.random.default_rng(10).choice(stored.size, 12)), "profiles")
    error = np.sqrt(np.mean(np.square(interpolation_errors(nodes, sample, sample.own_images(stored)))))
    assert nodes.lines == lines and error < 1.4 * PARTICLE_ERROR  # of other particles than those by which it was chosen


def test_planes_lie_farther_apart_for_particles_than_for_points(for_small_volumes):
    camera = IdealCamera("one", rotation(45))
    stored = StoredGrid.for_cameras(GRID, [camera])
    points, particles = (choose_nodes(stored, camera, "profiles", particle_voxel=size) for size in (0, PARTICLE_VOXEL))
    assert particles.distance > points.distance and particles.size < points.size


def test_counted_rays_are_compared_with_the_voxels_own_footprints_where_nodes_serve_particles(between):
    nodes, every = between
    expected = compare_with_count(every)
    for name, errors in compare_with_count(nodes).items():
        assert errors == pytest.approx(expected[name], rel=TOLERANCE_COUNT)


def test_voxels_are_not_shared_among_lines_of_sight_for_small_particles(for_small_volumes):
    camera = IdealCamera("one", rotation(33))
    stored = StoredGrid.for_cameras(GRID, [camera])
    assert choose_nodes(stored, camera, "profiles", particle_voxel=0.6) is None


def test_small_volumes_and_cameras_that_see_nothing_store_all_voxels():
    camera = IdealCamera("one", rotation(45))
    assert choose_nodes(StoredGrid.for_cameras(GRID, [camera]), camera, "profiles") is None
    far = lfpiv.Grid(shape=(50, 50, 50), voxel_mm=0.05, first_centre_mm=(0.0, 500.0, 0.0))
    assert choose_nodes(StoredGrid.for_cameras(far, [camera]), camera, "profiles") is None
    weights = lfpiv.build_weights(IdealRig({"one": camera}), GRID)
    assert not isinstance(weights.projector("one"), NodeProjector)
