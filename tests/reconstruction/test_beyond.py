"""Light beyond the volume: found where particles are, not where ghosts are; and the grids of guard layers."""

import numpy as np
import pytest

import lfpiv
from lfpiv.calibration.camera import Calibration
from lfpiv.geometry.grid import NO_LAYERS, Grid
from lfpiv.reconstruction.beyond import light_beyond

HALF_MM = 0.3
"""Half the depth of the volume [mm]."""
REACH_MM = 0.3
"""Distance by which the particles of a thick sheet reach beyond the upper face [mm]."""
SHARE = 0.004
"""Voxels that hold a particle."""
PAIRS = 5
VOLUME = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.6, 2 * HALF_MM), voxel_mm=0.05)


@pytest.fixture(scope="module")
def calibration(small_run):
    return lfpiv.load_calibration(small_run.out / "calibration.h5")


@pytest.fixture(scope="module")
def weights(calibration):
    around = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.6, 4 * HALF_MM), voxel_mm=0.05)
    return lfpiv.build_weights(calibration, around, form="profiles")


def images_of(weights, low_mm, high_mm, *, seed=0, static=0.0, pairs=PAIRS, share=SHARE):
    """Images of particles between two depths [mm], pairs of one frame; `static` light is in all of them."""
    rng, z = np.random.default_rng(seed), weights.grid.axis_mm(0)
    lit = ((z > low_mm) & (z < high_mm))[:, None, None]
    found = []
    for _ in range(pairs):
        light = 1e4 * lit * (rng.random(weights.grid.shape) < share) * rng.random(weights.grid.shape)
        images = weights(light.astype(np.float32))
        wall = {name: static * (np.arange(image.shape[1]) % 97 < 9) for name, image in images.items()}
        found.append([{name: image + wall[name] + rng.normal(0, 0.5, image.shape) for name, image in images.items()}])
    return found


@pytest.mark.slow
def test_particles_beyond_a_face_are_found_and_only_there(calibration, weights):
    found = light_beyond(calibration, VOLUME, images_of(weights, -HALF_MM, HALF_MM + REACH_MM))
    assert [(face.axis, face.side) for face in found] == [(0, 1)]
    assert found[0].reach_mm >= REACH_MM / 2 and found[0].guard_mm >= found[0].reach_mm and found[0].share > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("static", [0.0, 30.0])
def test_ghosts_beyond_the_faces_are_no_light(calibration, weights, static):
    assert light_beyond(calibration, VOLUME, images_of(weights, -HALF_MM, HALF_MM, static=static)) == ()


@pytest.mark.slow
def test_few_particles_at_the_faces_of_single_pairs_are_no_light_beyond(calibration, weights):
    single = [images_of(weights, -HALF_MM, HALF_MM, seed=seed, pairs=1, share=SHARE / 8) for seed in range(5, 9)]
    assert [light_beyond(calibration, VOLUME, pairs) for pairs in single] == [()] * len(single)


@pytest.mark.slow
def test_one_camera_shows_no_depth(calibration, weights):
    left = {"left": calibration.cameras["left"]}
    assert light_beyond(Calibration(left), VOLUME, images_of(weights, -HALF_MM, 2 * HALF_MM)) == ()
    with pytest.raises(ValueError, match="at least one frame"):
        light_beyond(calibration, VOLUME, [])


def test_a_padded_grid_holds_the_grid():
    layers = ((1, 2), (0, 3), (4, 0))
    padded = VOLUME.padded(layers)
    assert padded.shape == tuple(n + low + high for n, (low, high) in zip(VOLUME.shape, layers, strict=True))
    for axis, part in enumerate(VOLUME.within(padded)):
        assert np.allclose(padded.axis_mm(axis)[part], VOLUME.axis_mm(axis))
    assert VOLUME.padded(NO_LAYERS) == VOLUME
    assert VOLUME.layers((0.0, 0.01, 0.1)) == ((2, 2), (1, 1), (0, 0))
    with pytest.raises(ValueError, match="layers"):
        VOLUME.padded(((-1, 0), (0, 0), (0, 0)))
