"""Size of the particles, measured in images that rays trace: no weights, no simulator."""

import numpy as np
import pytest
from support import plain_steps
from support.ideal_rig import optics, two_cameras
from support.noisy_blobs import noisy_blobs

import lfpiv
from lfpiv.reconstruction import solver
from lfpiv.reconstruction.particle_size import SIEVE_STEP_VOXEL, ParticleSizer

TOLERANCE_SIZE = 0.08  # [voxel] some hundred particles: a tenth of their covariance, a twentieth of its root
SEEDS = range(3)


def traced_images(rig, positions, sigma_mm, seed, *, counts, noise=2.0, rays=1000):
    """Images of particles by tracing rays from points of Gaussian clouds, and noise: no weights, no simulator."""
    rng, images = np.random.default_rng(seed), {}
    for name, camera in rig.cameras.items():
        geometry = camera.optics
        rows, columns = geometry.sensor_shape
        points = np.repeat(positions, rays, axis=0)
        points = points + sigma_mm * rng.standard_normal(points.shape)
        radius, angle = geometry.pupil_radius_mm * np.sqrt(rng.random(len(points))), rng.random(len(points)) * 2 * np.pi
        pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        meets = camera.map(points, pupil)
        lens = camera.lattice.centres_mm(camera.lattice.nearest(meets))
        pixel = np.floor((lens + geometry.sensor_per_pupil * (meets - pupil)) / geometry.pixel_mm).astype(int)
        pixel += (columns // 2, rows // 2)
        inside = ((pixel >= 0) & (pixel < (columns, rows))).all(1)
        light = np.bincount(pixel[inside, 1] * columns + pixel[inside, 0], minlength=rows * columns)
        image = light * (250 * counts / rays) + noise * rng.standard_normal(rows * columns)  # 250 pixels a microimage
        images[name] = image.reshape(rows, columns).astype(np.float32)
    return images


@pytest.fixture(scope="module")
def small_volume():
    rig = two_cameras(optics=optics(rows=460, columns=600))
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.0, 2.0, 1.8), voxel_mm=0.1)
    return rig, lfpiv.build_weights(rig, grid)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma_voxel", "ppm", "counts"),
    [(0.7, 0.2, 200.0), (0.7, 1.0, 200.0), (0.7, 0.5, 8.0), (1.0, 0.5, 200.0), (0.0, 0.2, 200.0), (0.0, 1.0, 8.0)],
)
def test_images_tell_how_large_particles_are(small_volume, sigma_voxel, ppm, counts):
    """Whatever their number and brightness; the voxel's own variance of 1/12 is the weights' and does not count."""
    rig, weights = small_volume
    sizer, found = ParticleSizer(weights), []
    for seed in SEEDS:
        positions = np.random.default_rng(seed).uniform(-0.5, 0.5, (round(400 * ppm), 3)) * (2.0, 2.0, 1.8)
        images = traced_images(rig, positions, sigma_voxel * 0.1, seed, counts=counts)
        found.append(sizer.size(sizer.fluctuations(images)))
    assert np.mean(found) == pytest.approx(np.sqrt(max(sigma_voxel**2 - 1 / 12, 0)), abs=TOLERANCE_SIZE)
    volume = plain_steps.reconstruct(weights, images, iterations=1, sieve_voxel="auto")
    if sigma_voxel:
        assert volume.sieve_voxel == pytest.approx(np.sqrt(found[-1] ** 2 - 1 / 12), abs=SIEVE_STEP_VOXEL / 2)
    else:  # points: plain SMART, bit for bit
        assert volume.sieve_voxel == 0.0
        assert volume.values.tobytes() == plain_steps.reconstruct(weights, images, iterations=1).values.tobytes()


def test_images_of_noise_ask_for_no_sieve(small_volume):
    rig, weights = small_volume
    images = traced_images(rig, np.zeros((1, 3)), 0.1, 2, counts=0.0)
    sizer = ParticleSizer(weights)
    seen = sizer.fluctuations(images)
    assert sizer.size(seen) is None and sizer.matching_sieve(seen) == 0.0


@pytest.mark.slow
def test_faces_at_which_particles_end_do_not_enlarge_them():
    """Particles fill the volume to its faces, in weights with guard layers."""
    rig, size_mm = two_cameras(optics=optics(rows=480, columns=640)), (3.2, 2.4, 2.0)
    volume = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=size_mm, voxel_mm=0.1)
    weights = lfpiv.build_weights(rig, volume.padded(((1, 1),) * 3))
    weights.volume = volume
    sizer, found = ParticleSizer(weights), []
    for seed in SEEDS:
        at = np.random.default_rng(seed).uniform(-0.5, 0.5, (300, 3)) * size_mm
        found.append(sizer.size(sizer.fluctuations(traced_images(rig, at, 0.093, seed, counts=200.0, rays=2000))))
    assert np.mean(found) == pytest.approx(np.sqrt(0.93**2 - 1 / 12), abs=TOLERANCE_SIZE)


def test_solvers_of_the_same_weights_share_the_estimator(monkeypatch):
    weights, _, images = noisy_blobs(40)
    monkeypatch.setattr(weights, "derived", {})
    made = []
    monkeypatch.setattr(solver, "ParticleSizer", lambda weights: made.append(weights) or ParticleSizer(weights))
    for _ in range(2):
        lfpiv.reconstruct(weights, images, 1, sieve_voxel="auto")
    assert len(made) == 1
