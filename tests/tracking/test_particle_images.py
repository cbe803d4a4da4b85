"""Images of single particles against their slow twin and the simulator, and their products against dense matrices."""

import numpy as np
import pytest
from support.tracking_rig import SIGMA_VOXEL, VOXEL_MM, TrackingRig

from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import rendered
from lfpiv.weights.blocks import PackedCamera
from lfpiv_kernels import reference
from lfpiv_kernels.rays.lattice import cell_rectangles
from lfpiv_kernels.reconstruction.particle_normal import pair_blocks

POINTS = np.array([[0.31, -0.22, 0.35], [-0.4, 0.28, -0.12], [-0.3, 0.2, -0.1]])


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def rig(request, device):
    return TrackingRig((0.0, 40.0), request.param)


@pytest.fixture(scope="module")
def model(rig):
    return ParticleImages(cameras=rig.cameras, voxel_mm=VOXEL_MM, sigma_voxel=SIGMA_VOXEL)


def dense(lists, model, camera):
    """All values of a camera's lists, shape (particle, 4, pixel)."""
    count, pixels = len(lists.first) - 1, np.diff(model.first_pixel)[camera]
    values = np.zeros((count, 4, pixels))
    particle = np.repeat(np.arange(count), np.diff(lists.first))
    for number in range(4):
        np.add.at(values[:, number], (particle, lists.pixel), lists.values[:, number])
    return values


def test_images_equal_their_twin(rig, model):
    for number, (lists, camera) in enumerate(zip(model.lists(POINTS[:1]), rig.cameras.values(), strict=True)):
        packed = PackedCamera.from_camera(camera)
        twin = reference.gaussian_image(
            camera.map,
            POINTS[0],
            SIGMA_VOXEL * VOXEL_MM,
            optics=camera.optics,
            lattice=camera.lattice,
            microimages=camera.microimages,
            frame=packed.frame,
            rectangles=cell_rectangles(camera.lattice.layout),
        )
        image = dense(lists, model, number)[0, 3]
        assert twin.sum() == pytest.approx(1.0, abs=0.01)
        assert np.linalg.norm(image - twin) < 0.01 * np.linalg.norm(twin)


def test_images_equal_rendered_ones(rig, model):
    images = rig.images(POINTS, 3, noise=False)
    for number, (name, lists) in enumerate(zip(rig.cameras, model.lists(POINTS), strict=True)):
        ours, seen = dense(lists, model, number)[:, 3].sum(0), images[name].reshape(-1)
        light = (ours * seen).sum() / (ours * ours).sum()
        assert np.linalg.norm(seen - light * ours) < 0.12 * np.linalg.norm(seen)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivatives_are_those_of_the_images(model, axis):
    step = 0.02 * VOXEL_MM * np.eye(3)[axis]
    light = np.ones((len(POINTS), 2))
    ahead, back = (rendered(model, model.lists(POINTS + sign * step), light) for sign in (1, -1))
    ours = np.concatenate(
        [dense(lists, model, number)[:, axis].sum(0) for number, lists in enumerate(model.lists(POINTS))]
    )
    numeric = (ahead - back) / 0.04
    assert np.linalg.norm(ours - numeric) < 0.04 * np.linalg.norm(numeric)


def test_pair_blocks_are_products_of_dense_matrices(model):
    lists = model.lists(POINTS)[0]
    values = dense(lists, model, 0)
    rng = np.random.default_rng(1)
    weight, residual = rng.uniform(0.5, 2, (2, values.shape[2])).astype(np.float32)
    pairs = pair_blocks(lists, weight, residual)
    found = np.zeros((3, 3, 4, 4))
    found[pairs.row, pairs.column] = pairs.block
    expected = np.einsum("aip,p,bjp->abij", values, weight, values)
    assert np.allclose(found, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())
    right = np.einsum("aip,p->ai", values, weight * residual)
    assert np.allclose(pairs.right, right, rtol=1e-3, atol=1e-5 * np.abs(right).max())
    assert (found[1, 2] != 0).any()  # two of the particles overlap
