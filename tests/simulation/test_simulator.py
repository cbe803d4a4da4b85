"""Simulator: kernels against slow twins and geometric rays, radiometry, noise, sample data."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter
from scipy.stats import qmc
from support import ray_twins
from support.simulated_cameras import MONTE_CARLO, RIGS, ROUNDING, camera, land, points, relative_difference

from lfpiv.simulation.camera_images import expose, render_camera
from lfpiv.simulation.scene import Noise, SceneCamera, true_mapping
from lfpiv_kernels.rendering import collect, render

MOVED_RAYS = (
    2e-3  # share of the light in other pixels: float32 places rays to 2e-4 px, pixel edges pass each lens often
)
EDGE_SAMPLES = 2.5  # rays of one pixel that float32 may put on the other side of an edge


@pytest.mark.parametrize("rig", RIGS)
def test_true_mapping_is_a_thin_lens(rig):
    """A ray through pupil point u meets the array on the line to the thin-lens image of the point."""
    scene_camera = camera(rig)
    optics, at = scene_camera.optics, 5 * points(200, 1)
    pupil = np.random.default_rng(2).uniform(-10, 10, (200, 2))
    seen = (at - scene_camera.true_offset_mm) @ scene_camera.rotation.T
    distance = optics.object_distance_mm - seen[:, 2:]
    image_distance = 1 / (1 / optics.focal_length_mm - 1 / distance)
    image_point = -seen[:, :2] * image_distance / distance
    expected = pupil + (image_point - pupil) * optics.image_distance_mm / image_distance
    assert np.abs(true_mapping(scene_camera)(at, pupil) - expected).max() < ROUNDING * 1e2  # image distances of 200 mm
    assert np.array_equal(true_mapping(scene_camera.model_dump())(at, pupil), true_mapping(scene_camera)(at, pupil))


@pytest.mark.parametrize("shape", render.SOURCES)
def test_ray_tables_fill_pupil_and_source_evenly(shape):
    """Second moments of a disc (R^2/4 per axis), ball (R^2/5), Gaussian (1); pupil and source uncorrelated."""
    table = render.ray_table(1 << 14, shape, 3).astype(float)
    assert table.shape == (1 << 14, 5)
    variance = {"disc": [0.25, 0.25, 0], "ball": [0.2] * 3, "gaussian": [1] * 3}[shape]
    moments = table.T @ table / len(table)
    quasi_random = 5e-3  # 16,384 Sobol points; random ones would be at 1/128
    assert np.abs(moments - np.diag([0.25, 0.25, *variance])).max() < quasi_random
    assert (table[:, :2] ** 2).sum(1).max() <= 1 + 1e-6


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("shape", render.SOURCES)
def test_sources_equal_their_twin(device, rig, shape):
    scene_camera = camera(rig)
    renderer = render_camera(scene_camera, seed=4)
    centres, counts = points(12), np.random.default_rng(1).uniform(5e4, 2e5, 12)
    rays = render.ray_table(4096, shape, 0)
    found = render.render_sources(renderer, centres, counts, 0.03, rays, rng=np.random.default_rng(2))
    expected = ray_twins.sources(scene_camera, renderer, centres, counts, 0.03, rays, np.random.default_rng(2))
    assert expected.sum() > 0.1 * counts.sum()  # the sensor sees them
    assert relative_difference(found, expected) < MOVED_RAYS


@pytest.mark.parametrize("rig", RIGS)
def test_white_equals_rays_of_uniform_light(device, rig):
    """Backward coverage against forward rays: (s, t) anywhere on the array, (u, v) anywhere on the pupil."""
    scene_camera = camera(rig, sensor_width_px=60, sensor_height_px=44)
    renderer, optics, rng = render_camera(scene_camera, seed=4), scene_camera.optics, np.random.default_rng(5)
    rows, columns = optics.sensor_shape
    half = np.array([columns, rows]) * optics.pixel_mm / 2 + 0.2
    rays = 500_000
    s_t = rng.uniform(-half, half, (rays, 2))
    radius, angle = optics.pupil_radius_mm * np.sqrt(rng.random(rays)), rng.uniform(0, 2 * np.pi, rays)
    pupil = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    count = land(scene_camera, renderer, s_t, pupil, np.ones(rays))
    # rays per wholly lit pixel: each cell of the array spreads its share over one microimage
    cell = abs(np.linalg.det(scene_camera.lattice.basis_mm))
    full = rays * cell / np.prod(2 * half) / renderer.microimage_px
    found = collect.render_white(renderer, samples=256, seed=0)
    assert found.max() > (3.9 if rig == "overlapping" else 0.9)  # there four microimages share the corners' pixels
    score = (count / full - found) / np.sqrt((found + 0.05) / full)  # gains below 1 make it narrower still
    assert abs(score.mean()) < MONTE_CARLO / np.sqrt(score.size)
    assert np.sqrt((score**2).mean()) < 1.1  # pure Poisson noise of the rays; the samples' own noise is 1 %
    assert np.abs(score).max() < 1.5 * MONTE_CARLO


@pytest.mark.parametrize("rig", ["misaligned", "hexagonal", "overlapping"])
def test_board_equals_its_twin(device, rig):
    scene_camera = camera(rig, sensor_width_px=44, sensor_height_px=32, vignetting=0, lens_gain_sd=0)
    board = {"dots": (3, 2), "spacing_mm": 0.12, "dot_diameter_mm": 0.08}
    renderer, samples = render_camera(scene_camera), 64
    table = qmc.Sobol(4, scramble=True, seed=np.random.default_rng(3)).random(samples) - 0.5
    expected = ray_twins.board(scene_camera, renderer, 0.15, **board, table=table)
    found = collect.render_board(renderer, 0.15, **board, dot_light=1, board_light=0, samples=samples, seed=3)
    assert expected.max() > 0.3
    assert np.abs(found - expected).max() <= EDGE_SAMPLES / samples
    assert (found == expected).mean() > 0.95  # the same rays: only float32 at an edge makes a difference
    # dark dots are the complement, up to a ray that lands exactly on an edge
    inverse = collect.render_board(renderer, 0.15, **board, dot_light=0, board_light=1, samples=samples, seed=3)
    white = collect.render_white(renderer, samples=samples, seed=3)
    assert np.abs(found + inverse - white).max() <= EDGE_SAMPLES / samples


@pytest.mark.slow
def test_images_add_exactly_and_do_not_depend_on_threads(device, tmp_path):
    renderer, rays = render_camera(camera(), seed=4), render.ray_table(4096, "ball", 0)
    centres, counts = points(40), np.random.default_rng(1).uniform(5e4, 2e5, 40)
    whole = render.render_sources(renderer, centres, counts, 0.02, rays, rng=np.random.default_rng(9))
    rng = np.random.default_rng(9)
    parts = [
        render.render_sources(renderer, centres[part], counts[part], 0.02, rays, rng=rng)
        for part in (slice(0, 17), slice(17, None))
    ]
    assert np.array_equal(whole, parts[0] + parts[1])
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import numpy as np, hashlib\n"
        "from support import simulated_cameras\n"
        "from lfpiv.simulation.camera_images import render_camera\n"
        "from lfpiv_kernels import runtime\n"
        "from lfpiv_kernels.rendering import render\n"
        "runtime.start(sys.argv[2], threads=1)\n"
        "camera, points = simulated_cameras.camera(), simulated_cameras.points(40)\n"
        "renderer, rays = render_camera(camera, seed=4), render.ray_table(4096, 'ball', 0)\n"
        "counts = np.random.default_rng(1).uniform(5e4, 2e5, 40)\n"
        "image = render.render_sources(renderer, points, counts, 0.02, rays, rng=np.random.default_rng(9))\n"
        "print(hashlib.sha256(image.tobytes()).hexdigest())"
    )
    command = [sys.executable, "-c", program, str(Path(__file__).parents[1]), device.kind]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
    assert done.stdout.split()[-1] == hashlib.sha256(whole.tobytes()).hexdigest()


def test_exposure_has_the_stated_noise():
    """The mean is unchanged. Variance = read noise^2 + signal / (electrons per count) + rounding."""
    level = np.repeat(np.array([0.0, 300.0, 2500.0]), 200_000).reshape(600, 1000)
    noise = Noise(background=50.0, read_noise=4.0, full_well_e=8190.0)  # two electrons per count
    image = expose(level, camera(blur_px=0.0), noise, np.random.default_rng(0)).astype(float)
    for value in (0.0, 300.0, 2500.0):
        sample = image[level == value]
        variance = 4.0**2 + value / 2 + 1 / 12
        assert abs(sample.mean() - 50 - value) < MONTE_CARLO * np.sqrt(variance / len(sample))
        assert abs(sample.var() / variance - 1) < MONTE_CARLO * np.sqrt(2 / len(sample))
    silent = expose(
        level,
        camera(blur_px=0.0),
        Noise(background=7.0, read_noise=0.0, full_well_e=0.0),
        np.random.default_rng(0),
    )
    assert np.array_equal(silent, level + 7)
    assert expose(level * 10, camera(), noise, np.random.default_rng(0)).max() == 4095


def shift_px(model, image):
    """Fit the sub-pixel shift (column, row) of an image against a model, by least squares on the gradient."""
    slope_y, slope_x = np.gradient(model)
    design = np.stack([model.ravel(), np.ones(model.size), -slope_x.ravel(), -slope_y.ravel()], 1)
    solved = np.linalg.lstsq(design.T @ design, design.T @ image.ravel(), rcond=None)[0]
    return solved[2:] / solved[0], (image.ravel() - design @ solved).reshape(image.shape), solved


SHIFT_PX = 0.01  # the agreement asked of two renderers of one model
LEVEL_ERROR = 1.0  # count; the model's own ray noise, 4 %, squared lowers the fitted slope by 0.2 % of the mean signal
SAMPLE_NOISE = 12.0  # count: variance per count of the sample's images, most of it the noise of its own few rays


@pytest.mark.slow
def test_reproduces_the_sample_data(device, sample_data, number=1):
    """White, board and particle images equal those of an independent ray tracer with the same specification."""
    folder = sample_data / "ring-vortex-2cam"
    scene_camera = SceneCamera.model_validate(
        json.loads((folder / "truth" / "spec.json").read_text())["camera"][number]
    )
    renderer, name = render_camera(scene_camera), scene_camera.name
    dots = np.stack([*(g.ravel() for g in np.meshgrid(np.arange(-3.0, 4), np.arange(-3.0, 4))), np.full(49, 2.0)], 1)
    with np.load(folder / "truth" / "particles.npz") as truth:
        position = truth["pair_0000_positions_mm"] + truth["pair_0000_displacement_mm"] / 2
        intensity = truth["pair_0000_intensity"]
    rng = np.random.default_rng(0)
    disc, blob = render.ray_table(1 << 16, "disc", 0), render.ray_table(1 << 15, "gaussian", 0)
    images = {
        f"white/{name}.tif": collect.render_white(renderer, samples=128, seed=0),
        f"board/{name}/plane_08.tif": render.render_sources(renderer, dots, np.full(49, 200.0), 0.05, disc, rng=rng),
        f"particles/{name}/pair_0000_b.tif": render.render_sources(
            renderer, position, intensity * 200, 0.02, blob, rng=rng
        ),
    }
    for path, image in images.items():
        recorded = tifffile.imread(folder / path).astype(float)
        model = gaussian_filter(image, scene_camera.blur_px)
        shift, residual, (gain, level, *_) = shift_px(model, recorded)
        assert np.abs(shift).max() < SHIFT_PX, path
        expected = 9 + SAMPLE_NOISE * np.maximum(gain * model, 0)
        assert (residual**2).mean() < expected.mean(), path
        assert level == pytest.approx(40, abs=LEVEL_ERROR), path  # the dark level the sample was made with
        for low, high in ((0.02, 0.1), (0.1, 0.4), (0.4, 1.0)):  # no bias at any brightness
            part = (model > low * model.max()) & (model <= high * model.max())
            noise = np.sqrt(expected[part].mean() / part.sum())
            assert abs(residual[part].mean()) < MONTE_CARLO * noise + 0.003 * gain * model[part].mean(), path
