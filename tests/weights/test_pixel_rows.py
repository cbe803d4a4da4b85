"""Rows of pixels under every lens as sets of rays of weights that are stored voxel by voxel."""

import numpy as np
import pytest
from scipy import ndimage
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation
from support.pixel_rows import assert_rows_see_all_light_once

import lfpiv
from lfpiv.reconstruction.ordered_subsets import Subset
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights.forms import nodes as nodes_form
from lfpiv.weights.forms.shared_profiles import FEWEST_VOXELS, ray_sets
from lfpiv.weights.operator import Weights
from lfpiv.weights.storage import open_weights, save_weights
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.node_projector import NodeProjector
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import Projector

GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.5, 1.4, 1.3), voxel_mm=0.05)
SMALL = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.0, 1.0, 0.9), voxel_mm=0.05)
ROOM = 1.5
"""Room for blocks that has none for rows: these take about twice the memory of the blocks."""
ROUNDED = 1e-3
"""Largest relative difference of images by rows of profiles from those by whole blocks: products are rounded to a 255th
of the largest one."""


@pytest.fixture(scope="module", autouse=True)
def on_processor(device):
    if runtime.device().form == "gpu":
        pytest.skip("a GPU takes halves of the lenses")


def rig(layout, roll_deg=0.0):
    cameras = {
        name: IdealCamera(name, rotation(yaw, 0.2), optics(250, 270, layout), lattice(layout, roll_deg))
        for name, yaw in (("one", 45), ("two", -45))
    }
    return IdealRig(cameras)


@pytest.fixture(scope="module")
def turned(device):
    """Weights of cameras with turned arrays of square microlenses: profiles that planes cannot share."""
    return lfpiv.build_weights(rig("square", roll_deg=1.5), GRID)


@pytest.fixture(scope="module")
def hexagonal(device):
    """Weights of cameras with hexagonal microlenses, which are stored pixel by pixel."""
    return lfpiv.build_weights(rig("hexagonal"), GRID)


def test_rows_are_taken_alone_where_all_weights_of_a_large_volume_are_pixel_by_pixel(hexagonal):
    assert set(hexagonal.forms.values()) == {"pixels"} and GRID.size >= FEWEST_VOXELS > SMALL.size
    assert hexagonal.rows == ray_sets(hexagonal.cameras) > 4
    assert lfpiv.build_weights(rig("hexagonal"), SMALL).rows == 1
    assert lfpiv.build_weights(rig("hexagonal"), GRID, planes=False).rows == 1
    assert len(SmartSolver(hexagonal, SmartSettings()).subsets) == hexagonal.rows


def test_rows_of_pixels_see_all_of_the_light_once(hexagonal):
    assert_rows_see_all_light_once(hexagonal, least=0.8)


def test_profiles_of_turned_arrays_have_rows(turned):
    assert set(turned.forms.values()) == {"profiles"} and type(turned.projector("one")) is Projector
    assert turned.rows == len(SmartSolver(turned, SmartSettings()).subsets) == ray_sets(turned.cameras)
    assert_rows_see_all_light_once(turned, least=0.9)


def test_rows_of_profiles_have_together_the_image_of_the_blocks(turned):
    volume = ndimage.gaussian_filter(np.random.default_rng(6).random(GRID.shape) ** 20, 0.9).astype(np.float32).ravel()
    for name in turned.cameras:
        projector, dark = turned.projector(name), np.zeros(turned.gain(name).size, np.float32)
        of_rows = sum(projector.project(volume, dark.copy(), number) for number in range(turned.rows))
        whole = projector.project(volume, dark.copy())
        assert np.linalg.norm(of_rows - whole) < ROUNDED * np.linalg.norm(whole)


def test_rows_that_do_not_fit_the_memory_are_left_out(hexagonal):
    blocks = lfpiv.build_weights(rig("hexagonal"), GRID, planes=False)
    limit = ROOM * blocks.memory_bytes + sum(28 * one.microimages.size for one in hexagonal.cameras.values())
    assert limit < hexagonal.memory_bytes
    assert lfpiv.build_weights(rig("hexagonal"), GRID, limit_bytes=limit).rows == 1


def test_stored_rows_are_opened_as_they_were(hexagonal, tmp_path):
    content = save_weights(hexagonal, tmp_path / "weights")
    opened = open_weights(tmp_path / "weights", hexagonal.cameras, content)
    image = np.random.default_rng(3).random(hexagonal.gain("one").size).astype(np.float32)
    assert opened.rows == hexagonal.rows and opened.memory_bytes == hexagonal.memory_bytes
    for number in (0, 3, ALL):
        found, expected = (
            one.projector("one").back_project(image, np.zeros(GRID.size, np.float32), number)
            for one in (opened, hexagonal)
        )
        np.testing.assert_array_equal(found, expected)


def test_cameras_with_rows_beside_others_are_subsets_as_wholes(hexagonal):
    blocks = lfpiv.build_weights(rig("hexagonal"), GRID, planes=False)
    projectors = {"one": hexagonal.projector("one"), "two": blocks.projector("two")}
    mixed = Weights(hexagonal.stored, hexagonal.cameras, projectors, "footprint")
    assert SmartSolver(mixed, SmartSettings()).subsets == (Subset(((0, ALL),)), Subset(((1, ALL),)))


def test_nodes_have_rows_as_well(hexagonal, monkeypatch):
    monkeypatch.setattr(nodes_form, "FEWEST_VOXELS", 0)
    weights = lfpiv.build_weights(rig("hexagonal"), GRID, particle_voxel=1.0)
    volume = ndimage.gaussian_filter(np.random.default_rng(5).random(GRID.shape), 1.0).astype(np.float32).ravel()
    assert weights.rows == hexagonal.rows
    for name in weights.cameras:
        nodes, voxels = weights.projector(name), hexagonal.projector(name)
        assert isinstance(nodes, NodeProjector) and type(voxels) is Projector
        light = [one.project(volume, np.zeros(weights.gain(name).size, np.float32), 2) for one in (nodes, voxels)]
        assert np.linalg.norm(light[0] - light[1]) < 0.03 * np.linalg.norm(light[1])


@pytest.mark.slow
def test_particles_are_found_by_rows_better_than_by_halves_of_the_lenses(hexagonal):
    halves = lfpiv.build_weights(rig("hexagonal"), GRID, planes=False)
    rng, truth = np.random.default_rng(4), np.zeros(GRID.shape, np.float32)
    for z, y, x in rng.integers(4, np.array(GRID.shape) - 4, (50, 3)):
        truth[z, y, x] += rng.uniform(50, 100)
    truth = ndimage.gaussian_filter(truth, 0.9, mode="constant")
    images, alike = halves(truth), []
    for weights in (hexagonal, halves):
        volume = lfpiv.reconstruct(weights, images, floor=0.01, sieve_voxel=0.7)
        alike.append(np.corrcoef(volume.values.ravel(), truth.ravel())[0, 1])
    assert alike[0] > alike[1] and alike[0] > 0.85


def test_where_a_camera_needs_pixels_all_cameras_take_them_and_have_rows(device):
    square = {"two": IdealCamera("two", rotation(-45), optics(250, 270), lattice())}
    mixed = IdealRig({"one": rig("hexagonal").cameras["one"], **square})
    assert set(lfpiv.build_weights(IdealRig(square), GRID).forms.values()) == {"profiles"}
    weights = lfpiv.build_weights(mixed, GRID)
    assert set(weights.forms.values()) == {"pixels"} and weights.rows == ray_sets(mixed.cameras)
