"""Simulated pairs: images of particles anywhere, particles like the recorded ones, and the damping that they show."""

import numpy as np
import pytest
from support import plain_steps
from support.ideal_rig import lattice, optics, two_cameras

import lfpiv
from lfpiv.damping import particle_images
from lfpiv.damping.bootstrap import evenly_spread, measure_damping
from lfpiv.damping.particle_images import ParticleImager
from lfpiv.damping.synthetic_pair import RecordedImages, RecordedParticles, SyntheticPair, random_places

VOXEL_MM = 0.1
GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.0, 2.0, 1.6), voxel_mm=VOXEL_MM)
NOISE = {"cam1": 2.0, "cam2": 2.0}


@pytest.fixture(scope="module")
def weights():
    return lfpiv.build_weights(two_cameras(optics=optics(rows=500, columns=600), lattice=lattice()), GRID)


def even(points):
    return np.ones(len(points))


def blob(place_mm, sigma_voxel):
    """Gaussian of unit sum sampled at the voxels, whose cubes add 1/12 voxel^2."""
    square = ((GRID.centres_mm() - place_mm) ** 2).sum(1) / VOXEL_MM**2
    values = np.exp(-square / (2 * (sigma_voxel**2 - 1 / 12)))
    return (values / values.sum()).reshape(GRID.shape).astype(np.float32)


@pytest.mark.parametrize("place_mm", [(0.05, 0.05, 0.05), (0.07, -0.13, 0.21)])
def test_a_particle_looks_like_its_voxels(weights, place_mm):
    place = np.array([place_mm])
    known, found = weights(blob(place, 0.8)), ParticleImager(weights, 0.8)(place, np.array([1.0]))
    for name, image in known.items():
        assert abs(found[name].sum() / image.sum() - 1) < 0.02  # footprints are stored in 8 bits
        assert np.corrcoef(found[name].ravel(), image.ravel())[0, 1] > 0.99


def test_light_adds_up_in_any_number_of_batches(weights, monkeypatch):
    places = random_places(GRID, 20, np.random.default_rng(0))
    light = np.linspace(1, 3, 20)
    imager = ParticleImager(weights, 0.7)
    whole, half = imager(places, light), imager(places, light / 2)
    monkeypatch.setattr(particle_images, "CUBES", 27 * 6)
    parts = imager(places, light)
    for name, image in whole.items():
        assert image.max() > 0 and np.allclose(half[name], image / 2)
        assert np.allclose(parts[name], image, rtol=1e-4, atol=1e-5 * image.max())


@pytest.mark.slow(but="30-0.6")
@pytest.mark.parametrize(("count", "sigma"), [(30, 0.6), (150, 0.8)])
def test_number_and_size_of_particles_are_found_under_noise(weights, count, sigma):
    imager, instants = ParticleImager(weights, sigma), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        images = imager(random_places(GRID, count, rng), np.full(count, 4e4))
        instants.append({name: image + 2 * rng.standard_normal(image.shape) for name, image in images.items()})
    found = RecordedImages(weights, even).particles(instants, NOISE)
    assert abs(found.density * GRID.size / count - 1) < 0.2
    assert abs(found.sigma_voxel - sigma) < 0.08
    assert found.noise == NOISE


def test_points_whose_covariance_one_lens_away_is_negative_by_chance_are_particles(weights, monkeypatch):
    places = random_places(GRID, 200, np.random.default_rng(1))
    images = ParticleImager(weights, 0.0)(places, np.full(len(places), 4e4))
    recorded = RecordedImages(weights, even)
    ratios = recorded.ratios
    assert recorded.references.keys() == images.keys()  # made before the covariance of the images is changed
    monkeypatch.setattr(recorded, "ratios", lambda *image: ratios(*image) * [[1.0], [-0.1]])
    assert recorded.particles([images], NOISE).sigma_voxel == 0


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_images_without_particles_say_so(weights, sigma):
    rng = np.random.default_rng(0)
    noise = {name: sigma * rng.standard_normal(one.optics.sensor_shape) for name, one in weights.cameras.items()}
    with pytest.raises(ValueError, match="particles"):
        RecordedImages(weights, even).particles([noise], NOISE)


def test_simulated_images_have_light_and_noise_of_the_recorded_ones(weights):
    light = {"cam1": 3e5, "cam2": 1e5}
    full = {"cam1": 200.0, "cam2": 1e9}
    particles = RecordedParticles(density=0.01, sigma_voxel=0.7, light=light, noise=NOISE, full=full)
    pair = SyntheticPair(RecordedImages(weights, even), particles)
    frames = pair.images(lambda points: 0 * points + 0.05, np.random.default_rng(1))
    sums = [sum(float(frame[name].sum(dtype=float)) for frame in frames) / 2 for name in ("cam1", "cam2")]
    assert abs(sums[1] / light["cam2"] - 1) < 0.1 and sums[0] < 1.05 * light["cam1"]
    assert max(frame["cam1"].max() for frame in frames) <= 200.0
    dark = frames[0]["cam1"][:40, :40]  # sees no voxel
    assert abs(dark.std() / 2.0 - 1) < 0.1


def test_pairs_are_spread_evenly():
    assert evenly_spread(range(10), 2) == [2, 7] and evenly_spread([3, 5], 8) == [3, 5]


@pytest.mark.slow
def test_the_damping_of_a_rig_is_measured_and_the_same_each_time(weights):
    def measure(frames, noise):
        volumes = plain_steps.reconstruct_pair(weights, frames, floor=noise, iterations=12, sieve_voxel=0.6)
        return plain_steps.correlate(*volumes, dt_s=1e-3, windows=(12, 8))

    particles = RecordedParticles(
        density=0.01, sigma_voxel=0.7, light={"cam1": 4e6, "cam2": 4e6}, noise=NOISE, full={"cam1": 1e9, "cam2": 1e9}
    )

    def shear(points):
        return np.stack([0.08 * points[:, 2] / 0.8, 0 * points[:, 0], 0.06 * points[:, 0]], 1)

    rng = np.random.default_rng(0)
    frames = SyntheticPair(RecordedImages(weights, even), particles).images(shear, rng)
    vectors = measure(frames, (NOISE, NOISE))
    done = []
    found = measure_damping(weights, [vectors], frames, measure, pairs=1, progress=done.append)
    assert done[0] == 0.0 and done[-1] == 1.0 and done == sorted(done)
    assert 0.5 < found.axes["x"].slope < 1.1 and found.axes["x"].fluctuation > 0.2 and found.simulated == 1
    again = measure_damping(weights, [vectors], frames, measure, pairs=1)
    assert again == found
    assert found.likeness is not None and found.likeness.deviation_voxel.recorded > 0
    assert "displacement_unbiased_x" in found.unbiased(vectors)
    with pytest.raises(ValueError, match="pairs"):
        measure_damping(weights, [vectors], frames, measure, pairs=0)
    with pytest.raises(ValueError, match="vectors"):
        measure_damping(weights, [], frames, measure)
