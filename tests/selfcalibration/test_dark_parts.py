"""Parts of a sensor that are dark although the other cameras see particles there."""

from dataclasses import replace

import numpy as np
import pytest

import lfpiv
from lfpiv.lightfield.standing_light import nothing
from lfpiv.runs.frame_light import frame_light, read_darks
from lfpiv.selfcalibration.dark_parts import find
from lfpiv.weights.operator import Weights

PARTICLES = 2e-2
"""Particles per voxel."""
SEEDED = 0.6
"""Part of the volume's width that holds particles."""
FEW, MANY, SETS = 8, 100, 6
"""Numbers of particles in an image, and number of images with few of them that are judged one by one."""
WIDER = 1.5
"""Width of a volume that particles do not fill, over their own."""


@pytest.fixture(scope="module")
def rig(small_run):
    experiment = lfpiv.open_experiment(small_run.experiment)
    return experiment, lfpiv.load_calibration(small_run.out / "calibration.h5")


@pytest.fixture(scope="module")
def weights(rig):
    return lfpiv.build_weights(rig[1], rig[0].grid)


@pytest.fixture(scope="module")
def pairs(rig, weights):
    experiment, darks = rig[0], read_darks(rig[0])
    frames = [
        [frame_light(experiment, weights.cameras, darks, one).images for one in experiment.pair_frames(pair)]
        for pair in (0, 1, 2)
    ]
    return frames


def darkened(pairs, name, part):
    made = [[dict(images) for images in pair] for pair in pairs]
    for images in (images for pair in made for images in pair):
        images[name] = images[name].copy()
        images[name][part] = 0
    return made


@pytest.mark.parametrize(
    ("name", "part", "rows", "columns"),
    [
        ("left", np.s_[:, 267:], (0, 399), (267, 399)),
        ("right", np.s_[:133], (0, 132), (0, 399)),
    ],
    ids=["columns", "rows"],
)
def test_a_dark_third_of_a_sensor_is_found(weights, pairs, name, part, rows, columns):
    (found,) = find(weights, darkened(pairs, name, part))
    cell = 3 * weights.cameras[name].optics.microimage_pitch_px
    assert found.camera == name
    for (first, last), (low, high) in ((found.rows, rows), (found.columns, columns)):
        assert low - cell < first < last < high + cell and last - first > 2 * cell


def test_a_part_that_repeats_one_count_is_dark_although_its_pixels_count_as_unusable(weights, pairs):
    part, camera = np.s_[:, 267:], weights.cameras["left"]
    unusable = np.zeros(camera.optics.sensor_shape, bool)
    unusable[part] = True
    standing = replace(nothing(camera.decoder), unusable=unusable, found=True)
    cameras = {**weights.cameras, "left": camera.with_standing(standing)}
    stuck = Weights(weights.stored, cameras, {name: weights.projector(name) for name in cameras}, weights.method)
    assert [one.camera for one in find(stuck, darkened(pairs, "left", part))] == ["left"]


def test_sound_images_have_no_dark_part_even_in_a_volume_that_they_do_not_fill(rig, weights, pairs):
    assert not find(weights, pairs) and not find(weights, pairs[:1])
    grid = rig[0].grid
    wide = grid.padded(grid.layers((0.0, 0.0, (WIDER - 1) / 2 * np.ptp(grid.axis_mm(2)))))
    assert not find(lfpiv.build_weights(rig[1], wide), pairs)


def test_a_part_of_the_volume_without_particles_is_not_dark_although_other_views_smear_into_it(weights):
    rng, shape = np.random.default_rng(1), weights.grid.shape
    frames = []
    for _ in range(2):
        lit = rng.random(shape) < PARTICLES
        lit[:, :, int(SEEDED * shape[2]) :] = False
        frames.append({name: 1e3 * image for name, image in weights(lit.astype(np.float32)).items()})
    assert not find(weights, [frames])


def test_a_region_that_few_particles_miss_by_chance_is_not_dark(weights):
    """Few particles leave a tenth of a sensor without light by chance. A dark third is still found by three pairs."""
    rng = np.random.default_rng(7)

    def shown(particles):
        places = rng.integers(0, weights.grid.shape, (particles, 3))
        lit = np.zeros(weights.grid.shape, np.float32)
        lit[tuple(places.T)] = 1
        return {name: 1e3 * image for name, image in weights(lit).items()}

    assert not any(find(weights, [[shown(FEW)]]) for _ in range(SETS))
    (found,) = find(weights, darkened([[shown(MANY)] for _ in range(3)], "left", np.s_[:, 267:]))
    assert found.camera == "left"
