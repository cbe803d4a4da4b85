"""Particles found in rendered images: positions, standard errors, ghosts, and arguments that cannot be used."""

import numpy as np
import pytest
import xarray as xr
from support.ideal_rig import IdealRig
from support.tracking_rig import LIGHT, READ_NOISE, SIGMA_VOXEL, VOXEL_MM, TrackingRig

from lfpiv import build_weights, find_particles
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.metrics.particles import match_particles
from lfpiv.tracking.candidates import volume_peaks
from lfpiv.tracking.fit import Fit
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import CHI2_MEDIAN, Cloud, Scene, light_scatter, refine, rendered
from lfpiv.tracking.size_fit import fit_size

TOO_SMALL = 0.9
"""Size to begin with, relative to the true one."""
FITTED = 0.03
"""Relative error of the fitted size; it is 0.045 where the light of weak particles is not given back."""


@pytest.fixture(scope="module")
def rig(device):
    return TrackingRig()


@pytest.fixture(scope="module")
def thin(rig):
    """A volume of 0.05 particles per microlens, and what is found in it."""
    true = rig.random(13, 5)
    return true, find_particles(rig.weights, rig.images(true, 1), noise=READ_NOISE, sigma_voxel=SIGMA_VOXEL)


def test_thin_seeding_is_found_whole_and_within_a_tenth_of_a_voxel(thin):
    true, found = thin
    pairs = match_particles(found.positions_mm, true, VOXEL_MM)
    assert len(pairs) == len(true) == len(found)
    miss = (found.positions_mm[pairs[:, 0]] - true[pairs[:, 1]]) / VOXEL_MM
    assert np.sqrt((miss**2).sum(1).mean()) < 0.1


def test_standard_errors_are_those_of_the_positions(thin):
    true, found = thin
    pairs = match_particles(found.positions_mm, true, VOXEL_MM)
    miss = (found.positions_mm[pairs[:, 0]] - true[pairs[:, 1]]) / found.errors_mm[pairs[:, 0]]
    assert 0.4 < np.median(np.abs(miss)) / 0.6745 < 1.6


def test_light_and_figures(rig, thin):
    _, found = thin
    radius_px = 12.5 * 0.8 / 200 / 0.011
    assert np.median(found.light) == pytest.approx(LIGHT * np.pi * radius_px**2, rel=0.05)
    assert found.explained > 0.98
    assert found.per_microlens == pytest.approx(len(found) / 18**2, rel=1e-6)
    assert np.all(found.residual < 3)


def test_light_that_one_camera_does_not_confirm_is_no_particle(rig):
    true = np.array([[0.2, 0.1, -0.1], [-0.4, 0.3, 0.2]])
    images = rig.images(true, 2)
    ghost = rig.images(np.array([[0.45, -0.45, 0.3]]), 3, cameras=("cam0",))
    images["cam0"] = images["cam0"] + ghost["cam0"]
    found = find_particles(rig.weights, images, noise=READ_NOISE, sigma_voxel=SIGMA_VOXEL)
    assert len(found) == 2
    assert len(match_particles(found.positions_mm, true, VOXEL_MM)) == 2


def test_noise_holds_no_particles(rig):
    found = find_particles(rig.weights, rig.images(np.zeros((0, 3)), 4), noise=READ_NOISE, rounds=1)
    assert len(found) == 0 and found.explained == 0.0


def test_light_of_unlike_cameras_keeps_its_scatter(rig):
    """The prior that holds the light of the cameras together must not shrink the scatter that it is made from."""
    images = ParticleImages(cameras=rig.cameras, voxel_mm=VOXEL_MM, sigma_voxel=SIGMA_VOXEL)
    rng = np.random.default_rng(8)
    light = 2e4 * np.exp(0.3 * rng.standard_normal((20, 2)))
    cloud = Cloud(positions_mm=rig.random(20, 9), light=light)
    counts = rendered(images, images.lists(cloud.positions_mm), light)
    scene = Scene(counts=counts, read_variance=np.full_like(counts, READ_NOISE**2))
    scatter = 0.1
    for _ in range(6):
        cloud, normal = refine(images, scene, cloud, iterations=3, scatter=scatter)
        scatter = light_scatter(normal, cloud.light, scatter)
    ratio = light / light.mean(1, keepdims=True)
    exact = np.sqrt(np.median(np.square(ratio - 1).sum(1)) / CHI2_MEDIAN)
    assert scatter == pytest.approx(exact, rel=0.1)


@pytest.mark.slow
def test_voxels_that_no_camera_sees_hold_no_candidates(rig):
    wide = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(6.0, 1.6, 1.2), voxel_mm=VOXEL_MM)
    weights = build_weights(IdealRig(rig.cameras), wide)
    values = np.where(weights.views == 0, 1e6, 0.0)
    assert values[:, :, 0].any()
    values[6, 8, 30] = 1.0
    far = xr.DataArray(values, wide.coordinates(), AXES, attrs={"voxel_mm": VOXEL_MM})
    peaks = volume_peaks(weights, far)
    assert len(peaks) == 1


@pytest.mark.slow
def test_size_is_fitted(rig):
    found = find_particles(rig.weights, rig.images(rig.random(10, 7), 1), noise=READ_NOISE)
    assert found.sigma_voxel == pytest.approx(SIGMA_VOXEL, abs=0.08)


@pytest.mark.slow
def test_size_is_fitted_although_weak_particles_explain_what_too_small_a_size_leaves(rig):
    """Each particle has a weak one beside it, so hardly any is without overlap. Their light belongs to it."""
    rng, places = np.random.default_rng(12), np.array([-0.55, 0.0, 0.55])
    true = np.stack(np.meshgrid(places, places, [0.0]), -1).reshape(-1, 3) + rng.uniform(-0.05, 0.05, (9, 3))
    beside = true + 2 * VOXEL_MM * rng.choice([-1.0, 1.0], (9, 3))
    images = ParticleImages(cameras=rig.cameras, voxel_mm=VOXEL_MM, sigma_voxel=TOO_SMALL * SIGMA_VOXEL)
    counts = np.concatenate([image.ravel() for image in rig.images(true, 1).values()])
    light = np.repeat([[2e4], [2e3]], (9, 9), axis=0) * np.ones(2)
    fit = Fit(
        model=images,
        scene=Scene(counts=counts, read_variance=np.full_like(counts, READ_NOISE**2)),
        cloud=Cloud(positions_mm=np.concatenate([true, beside]), light=light),
        images={},
        noise={},
        whole={},
        standing={},
        largest_voxel=2 * SIGMA_VOXEL,
    )
    fit.refine(4)
    fit_size(fit)
    assert fit.model.sigma_voxel == pytest.approx(SIGMA_VOXEL, rel=FITTED)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"rounds": 0}, "rounds"),
        ({"weakest": 1.0}, "weakest"),
        ({"sigma_voxel": 0.0}, "sigma_voxel"),
        ({"noise": {"cam0": 1.0}}, "noise"),
        ({"images": {}}, "images"),
    ],
)
def test_bad_arguments_are_named(rig, arguments, name):
    images = {camera: np.ones((220, 260), np.float32) for camera in rig.cameras}
    with pytest.raises(ValueError, match=name):
        find_particles(rig.weights, **({"images": images} | arguments))
