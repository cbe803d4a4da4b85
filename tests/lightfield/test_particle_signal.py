"""Separation of particle images from noise: rendered seedings against several kinds of camera noise."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support import scenes

import lfpiv
from lfpiv.lightfield.image_checks import signal_warnings
from lfpiv.lightfield.particle_signal import EMPTY, NOISE, measure_structure, near_pixel_correlation
from lfpiv.simulation.simulator import simulate
from lfpiv.warn import gather

PARTICLES = 4 * NOISE  # least structure of particles; 0.27 and more at ten times the noise

BACKGROUND, READ_NOISE = 40.0, 3.0  # counts, as simulated


def scene(layout, count, sigma_mm, brightness):
    imperfect = {"true_array_roll_deg": 0.4, "lens_gain_sd": 0.02, "vignetting": 0.2}
    camera = scenes.camera("only", 35.0, (420, 400), pixel_um=6.5, microlens_layout=layout, **imperfect)
    return scenes.scene(
        "structure",
        [camera],
        planes_mm=(),
        size_mm=(2.0, 2.0, 1.4),
        particles={"count": count} | ({} if sigma_mm is None else {"sigma_mm": sigma_mm}),
        displacement_mm=(0.05, 0.0, 0.0),
        seed=count,
        board={"dots": (3, 3), "spacing_mm": 0.5, "dot_diameter_mm": 0.1, "planes_mm": (-0.5, 0.5)},
        exposure={"particle_counts": brightness},
        noise={"background": BACKGROUND, "read_noise": READ_NOISE},
    )


def light_and_decoder(scene, folder):
    experiment = lfpiv.open_experiment(simulate(scene, folder))
    decoder = lfpiv.thin_lens(experiment).cameras["only"].decoder
    return experiment, decoder


def structure_of(image, decoder):
    image = np.asarray(image, np.float32)
    return measure_structure(image - np.float32(decoder.background(image)[0]), decoder)


@pytest.mark.slow(but="square-20-0.05")
@pytest.mark.parametrize(
    ("layout", "count", "sigma_mm", "brightness"),
    [
        ("square", 20, None, 30.0),  # 0.05 particles per microlens, ten times the read noise
        ("square", 20, 0.05, 600.0),
        ("hexagonal", 40, None, 600.0),
        ("square", 400, 0.07, 30.0),  # 1 per microlens, as blobs: the smoothest images
        ("hexagonal", 400, None, 600.0),
    ],
)
def test_particles_at_any_seeding_are_no_noise(tmp_path, device, layout, count, sigma_mm, brightness):
    experiment, decoder = light_and_decoder(scene(layout, count, sigma_mm, brightness), tmp_path / "data")
    image = experiment.particle_image("only", 0, "a")
    assert structure_of(image, decoder) > PARTICLES
    hot = image.copy()
    hot.ravel()[np.random.default_rng(0).integers(0, hot.size, hot.size // 500)] = 4095
    assert structure_of(hot, decoder) > PARTICLES


def test_one_bright_particle_on_a_large_sensor_is_no_noise(tmp_path, device):
    """Clipping removes a single particle as it removes hot pixels."""
    experiment, decoder = light_and_decoder(scene("square", 1, None, 600.0), tmp_path / "data")
    image = experiment.particle_image("only", 0, "a") - np.float32(BACKGROUND)
    row, column = np.unravel_index(gaussian_filter(image, 5).argmax(), image.shape)
    near = np.zeros(image.shape, bool)
    near[max(row - 6, 0) : row + 6, max(column - 6, 0) : column + 6] = True
    noise = READ_NOISE * np.random.default_rng(2).standard_normal(image.shape).astype(np.float32)
    few = np.where(near, image, noise)
    assert near_pixel_correlation(few, decoder) < NOISE < PARTICLES < measure_structure(few, decoder)
    assert measure_structure(noise, decoder) < EMPTY


def test_noise_of_every_kind_is_noise(tmp_path, device):
    experiment, decoder = light_and_decoder(scene("square", 20, None, 600.0), tmp_path / "data")
    rng = np.random.default_rng(1)
    white = np.maximum(experiment.white("only") - BACKGROUND, 0)
    shape = white.shape
    read = BACKGROUND + READ_NOISE * rng.standard_normal(shape)
    noises = {
        "read noise": np.rint(read),
        "less than a count": np.rint(BACKGROUND + 0.4 * rng.standard_normal(shape)),
        "any number": rng.integers(0, 4096, shape),
        "even light through the lenses": read + rng.poisson(0.3 * white),
        "light that fades across": read + rng.poisson(np.linspace(0, 0.3, shape[1]) * white),
        "hot pixels": np.where(rng.random(shape) < 0.002, 4095, read),
        "stripes both ways": read + 5 * rng.standard_normal((shape[0], 1)) + 5 * rng.standard_normal(shape[1]),
        "smoothed by the camera": gaussian_filter(100 * rng.standard_normal(shape), 0.7),
    }
    found = {name: structure_of(image, decoder) for name, image in noises.items()}
    assert max(found.values()) < EMPTY, found


def test_images_without_particles_and_dim_ones_are_named():
    found = signal_warnings({"left": 0.6, "right": 0.001}, "b") + signal_warnings({"left": 0.03}, "a")
    gathered = gather(warning.of_pair(3) for warning in found)
    dim, empty = (warning.sentence for warning in gathered)
    assert empty.startswith("right, frame b, pair 3: no particles, only noise") and "0.001" in empty
    assert dim.startswith("left, frame a, pair 3: particles hardly rise above the noise") and "0.03" in dim
