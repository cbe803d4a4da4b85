"""Weights as profiles that planes of voxels share: when they are used, and how near they are to voxels' footprints."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation
from support.pixel_rows import assert_rows_see_all_light_once

import lfpiv
from lfpiv.errors import InputError
from lfpiv.files import MIB
from lfpiv.lightfield.microimage_layout import microimage_centres
from lfpiv.reconstruction.ordered_subsets import Subset
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights.checks import compare_with_count, estimate_device_need, estimate_memory
from lfpiv.weights.choice import Choice
from lfpiv.weights.counting import draw_seen
from lfpiv.weights.forms.camera_profiles import CameraProfiles
from lfpiv.weights.forms.form import Rig
from lfpiv.weights.forms.image_errors import (
    PARTICLE_ERROR,
    PARTICLES,
    SEEDS,
    WORST_PARTICLE_ERROR,
    Sample,
    blobs_about,
)
from lfpiv.weights.forms.shared_profiles import SharedProfiles, particle_errors, ray_sets
from lfpiv.weights.memory_left import MemoryLeft, beside_bytes
from lfpiv.weights.storage import open_weights, save_weights
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector
from lfpiv_kernels.reconstruction.separable_weights import STRIP

TOLERANCE_SUMS = 0.02
"""Sums of the weights of voxels that are wholly seen, as a part: profiles have 8 bits and are the same for a plane."""
TOLERANCE_ESTIMATE = 0.15
"""Memory: taps are those of some voxels, and lenses are taken for seen by every plane."""
GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.5, 1.4), voxel_mm=0.05)


def rig_of(*cameras):
    return IdealRig({camera.name: camera for camera in cameras})


def camera(name="one", yaw_deg=45.0, roll_deg=0.0, layout="square"):
    return IdealCamera(name, rotation(yaw_deg, 0.2), optics(260, 280, layout), lattice(layout, roll_deg))


def profiles_of(cameras, limit_bytes=np.inf):
    """Return shared profiles of cameras whose footprints are products of profiles."""
    stored, memory = StoredGrid.for_cameras(GRID, cameras.values()), MemoryLeft(cameras.values(), GRID, limit_bytes)
    choices = {name: Choice(form="profiles") for name in cameras}
    return SharedProfiles(Rig(stored=stored, cameras=cameras, memory=memory, choices=choices), cameras)


@pytest.fixture(scope="module")
def both(device):
    """Return the weights of two cameras by shared profiles and by those of all voxels."""
    rig = rig_of(camera("one", 40, 0.05), camera("two", -48, -0.08))
    return lfpiv.build_weights(rig, GRID), lfpiv.build_weights(rig, GRID, planes=False)


def test_profiles_are_shared_where_rows_of_lenses_are_level(both):
    shared, every = both
    assert shared.rows > every.rows == 1
    assert shared.forms == every.forms == {"one": "profiles", "two": "profiles"}
    assert shared.memory_bytes < 0.7 * every.memory_bytes


@pytest.mark.slow
@pytest.mark.parametrize(
    "cameras",
    [
        (camera("upright"), camera("turned", -45, 3.0)),
        (camera("hexagonal", layout="hexagonal"),),
    ],
    ids=["one array turned", "hexagonal"],
)
def test_profiles_are_not_shared_where_one_camera_does_not_suit(cameras, device):
    rig = rig_of(*cameras)
    assert set(lfpiv.build_weights(rig, GRID).forms.values()) == {"pixels"}
    assert not profiles_of(rig.cameras).build(lambda name: lambda part: None)


def test_profiles_are_not_shared_beyond_the_memory_that_is_left(both):
    assert profiles_of(both[0].cameras).suits and not profiles_of(both[0].cameras, 1e6).suits


def test_profiles_are_shared_only_where_a_gpu_holds_them(both, tmp_path, monkeypatch):
    shared, _ = both
    cameras = shared.cameras
    rig, beside = rig_of(*cameras.values()), beside_bytes(cameras.values(), GRID)
    need = estimate_device_need(rig, GRID)
    planes = [CameraProfiles(shared.stored, one) for one in cameras.values()]
    assert need.beside == beside and need.cameras == pytest.approx([one.device_bytes for one in planes], rel=0.05)
    monkeypatch.setattr(runtime, "free_bytes", lambda: need.whole)
    assert profiles_of(cameras).suits == tuple(cameras)
    monkeypatch.setattr(runtime, "free_bytes", lambda: need.whole - 20 * MIB)
    assert not profiles_of(cameras).suits
    assert estimate_device_need(rig, GRID).cameras != need.cameras
    content = save_weights(shared, tmp_path / "weights")
    monkeypatch.setattr(runtime, "free_bytes", lambda: beside + sum(need.cameras) // 4)
    with pytest.raises(InputError, match=r"camera 'one' take .* of the GPU's memory, of which .* are left"):
        open_weights(tmp_path / "weights", cameras, content)


def test_memory_of_a_gpu_is_estimated(both):
    shared, _ = both
    if runtime.device().form != "gpu":
        pytest.skip("the arrays of the CPU are those of the host")
    for name, camera in shared.cameras.items():
        estimate = CameraProfiles(shared.stored, camera).device_bytes
        found = shared.projector(name).device_bytes
        assert (1 - TOLERANCE_ESTIMATE) * found < estimate < 1.5 * found  # levels that are 0 are left out


def test_small_volumes_store_all_voxels(device):
    grid = lfpiv.Grid(shape=(20, 20, 20), voxel_mm=0.05, first_centre_mm=(-0.5, -0.5, -0.5))
    assert lfpiv.build_weights(rig_of(camera()), grid).rows == 1


def test_images_of_other_particles_are_those_of_footprints(both):
    shared, every = both
    stored, rng = shared.stored, np.random.default_rng(10)
    voxels, light = blobs_about(stored, rng.choice(stored.size, 12))
    for name in shared.cameras:
        errors = []
        for at, bright in zip(voxels, light, strict=True):
            volume = np.zeros(stored.size, np.float32)
            np.add.at(volume, at, bright.astype(np.float32))
            volume = stored.restore(volume)
            found, expected = shared.of_camera(name)(volume)[name], every.of_camera(name)(volume)[name]
            errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
        assert np.sqrt(np.mean(np.square(errors))) < PARTICLE_ERROR / 2 and max(errors) < WORST_PARTICLE_ERROR / 2


def test_errors_of_particles_are_those_of_a_plain_comparison(both):
    shared = both[0]
    name, stored = "two", shared.stored
    errors = particle_errors(stored, shared.cameras[name], shared.projector(name))
    seen = np.unique(np.concatenate([draw_seen(stored, shared.cameras[name], seed) for seed in SEEDS]))
    voxels, light = blobs_about(stored, seen[:: len(seen) // PARTICLES + 1])
    sample = Sample(shared.cameras[name], voxels, light, "profiles")
    assert len(errors) == len(voxels) == sum(one.shape[0] for one in sample.own_images(stored))
    volume = np.zeros(stored.size, np.float32)
    np.add.at(volume, voxels[0], light[0].astype(np.float32))
    volume = stored.restore(volume)
    gain = shared.cameras[name].gain
    found, expected = (one.of_camera(name)(volume)[name] / gain for one in both)
    assert errors[0] == pytest.approx(np.linalg.norm(found - expected) / np.linalg.norm(expected), rel=0.02)


def test_sums_of_weights_are_those_of_footprints(both):
    shared, every = both
    for of_planes, of_voxels in zip(shared.camera_sums, every.camera_sums, strict=True):
        of_planes, of_voxels = shared.stored.restore(of_planes), every.stored.restore(of_voxels)
        wholly = of_voxels > 0.9 * of_voxels.max()
        assert wholly.mean() > 0.7
        np.testing.assert_allclose(of_planes[wholly], of_voxels[wholly], rtol=TOLERANCE_SUMS)
    assert shared.largest == pytest.approx(every.largest, rel=0.02)
    lit = every.affected_pixels
    some = lit > 0
    assert np.abs(shared.affected_pixels[some] / lit[some] - 1).mean() < 0.03


def test_rows_of_pixels_see_all_of_the_light_once(both):
    assert_rows_see_all_light_once(both[0], least=0.9)
    for name in both[0].cameras:
        assert both[0].projector(name).ray_sets == ray_sets(both[0].cameras)
        light = both[0].light_of_sets(name)
        assert light.min() > 0.1 * light.mean()


@pytest.mark.slow
def test_overlapping_microimages_are_not_taken_row_by_row(device):
    """Most pixels see rays of two lenses there, and so of two sets of rows: subsets are whole cameras."""
    wide = [
        IdealCamera(name, rotation(yaw), replace(optics(260, 280), f_number=2.8), lattice(roll_deg=0.05))
        for name, yaw in (("one", 45), ("two", -45))
    ]
    weights = lfpiv.build_weights(rig_of(*wide), GRID)
    assert weights.rows > 1  # profiles are shared all the same
    assert SmartSolver(weights, SmartSettings()).subsets == (Subset(((0, ALL),)), Subset(((1, ALL),)))
    with pytest.raises(ValueError, match=r"subsets: with these cameras expected one of 1, 2, got 4\."):
        _ = SmartSolver(weights, SmartSettings(subsets=4)).subsets


def test_stored_weights_are_opened_as_they_were(both, tmp_path):
    shared = both[0]
    content = save_weights(shared, tmp_path / "weights")
    opened = open_weights(tmp_path / "weights", shared.cameras, content)
    volume = np.random.default_rng(3).random(GRID.shape).astype(np.float32)
    assert opened.rows == shared.rows > 1 and opened.stored == shared.stored
    for name, image in shared(volume).items():
        assert isinstance(opened.projector(name), SeparableProjector)
        np.testing.assert_array_equal(opened(volume)[name], image)


def test_memory_is_estimated(both):
    shared = both[0]
    rays = sum(8 * one.rays.size + one.weights.pixel.nbytes for one in map(shared.projector, shared.cameras))
    estimate = estimate_memory(rig_of(*shared.cameras.values()), GRID)
    planes = [CameraProfiles(shared.stored, one) for one in shared.cameras.values()]
    assert sum(one.stored_bytes for one in planes) == pytest.approx(shared.memory_bytes, rel=TOLERANCE_ESTIMATE)
    assert estimate > shared.memory_bytes + rays


def test_counted_rays_are_compared_with_the_voxels_own_footprints(both):
    shared, every = both
    expected = compare_with_count(every)
    for name, errors in compare_with_count(shared).items():
        assert np.mean(errors) == pytest.approx(np.mean(expected[name]), rel=0.5)  # of other voxels


def test_particles_are_found_by_subsets_of_rows_as_well_as_by_those_of_lenses(both):
    every = both[1]
    rng, truth = np.random.default_rng(4), np.zeros(GRID.shape, np.float32)
    for z, y, x in rng.integers(4, np.array(GRID.shape) - 4, (60, 3)):
        truth[z, y, x] += rng.uniform(50, 100)
    truth = ndimage.gaussian_filter(truth, 0.9, mode="constant")
    alike = []
    for weights in both:
        images = every(truth)
        volume = lfpiv.reconstruct(weights, images, floor=0.01, sieve_voxel=0.7)
        alike.append(np.corrcoef(volume.values.ravel(), truth.ravel())[0, 1])
    assert alike[0] > alike[1] and alike[0] > 0.85


@pytest.mark.parametrize(
    ("yaw_deg", "pitch_deg", "roll_deg"), [(0, 0, 0), (10, 0, 0), (60, 0.5, 1), (88, 0, 0), (45, 5, 0)]
)
def test_profiles_serve_up_to_the_edges_of_the_sensor(yaw_deg, pitch_deg, roll_deg, device):
    """The last strip of lenses has few rows on the sensor here, and the middle of its second part lies beyond it."""
    seen = IdealCamera("one", rotation(yaw_deg, pitch_deg, roll_deg), optics(420, 460), lattice(roll_deg=0.05))
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.6, 2.6, 2.6), voxel_mm=0.074)
    stored = StoredGrid.for_cameras(grid, [seen], columns_inmost=True)
    weights = CameraProfiles(stored, seen).weights(lambda part: None)
    rows = microimage_centres(seen.optics, seen.lattice, 0)[1].shape[0]
    assert 0 < rows % STRIP < 12
    errors = particle_errors(stored, seen, SeparableProjector(weights, 8))
    assert np.sqrt(np.mean(np.square(errors))) < PARTICLE_ERROR / 2 and max(errors) < WORST_PARTICLE_ERROR
