"""Light of simulated scenes: brightness of particles, light sheet, stray light, background images."""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter
from support.simulated_cameras import MONTE_CARLO, ROUNDING, small_scene

from lfpiv.simulation.camera_images import expose, render_camera, static_light, white_image
from lfpiv.simulation.light import Brightness, Sheet, StrayLight
from lfpiv.simulation.particles import lit_particles, place_particles
from lfpiv.simulation.simulator import simulate
from lfpiv_kernels.rendering import render

MANY = 20_000


def many(**tables):
    return small_scene(particles={"per_microlens": None, "count": MANY}, **tables)


def test_brightness_is_log_normal_in_each_camera_and_of_mean_one():
    plain, scattered = place_particles(many(), 0), place_particles(many(brightness={"camera_log_sd": 0.6}), 0)
    for name in ("position_mm", "displacement_mm", "intensity"):
        assert np.array_equal(getattr(plain, name), getattr(scattered, name)), name
    logs = np.log(scattered.camera_factor)
    assert scattered.camera_factor.shape == (2, MANY) and (plain.camera_factor == 1).all()
    assert logs.std(axis=1) == pytest.approx(0.6, abs=MONTE_CARLO * 0.6 / np.sqrt(2 * MANY))
    assert logs.mean(axis=1) == pytest.approx(-0.18, abs=MONTE_CARLO * 0.6 / np.sqrt(MANY))  # then the mean is 1
    assert abs(np.corrcoef(logs)[0, 1]) < MONTE_CARLO / np.sqrt(MANY)
    assert not np.array_equal(
        place_particles(many(brightness={"camera_log_sd": 0.6}), 1).camera_factor, scattered.camera_factor
    )


def test_brightness_follows_the_diameter():
    table = Brightness(size_log_sd=0.25, size_exponent=2.0)
    diameter = table.diameters(MANY, np.random.default_rng(0))
    brightness = table.intensity_of(diameter)
    assert np.log(diameter).std() == pytest.approx(0.25, abs=MONTE_CARLO * 0.25 / np.sqrt(2 * MANY))
    spread = np.sqrt(np.exp(0.5**2) - 1)  # relative standard deviation of a log-normal value
    assert brightness.mean() == pytest.approx(1, abs=MONTE_CARLO * spread / np.sqrt(MANY))
    ratio = brightness / diameter**2
    assert np.ptp(ratio) < ROUNDING * ratio.mean()
    plain, sized = place_particles(many(), 0), place_particles(many(brightness=table.model_dump()), 0)
    assert np.allclose(sized.intensity, plain.intensity * table.intensity_of(sized.diameter), rtol=ROUNDING)


def test_sheet_has_its_thickness_position_and_direction():
    points = np.array([[0.0, 0.0, z] for z in (-0.4, -0.1, 0.1, 0.3, 0.6)])
    gaussian = Sheet(profile="gaussian", thickness_mm=(1.0, 0.4), position_mm=(0.1, 0.1))
    assert gaussian.light(points, 0) == pytest.approx(np.exp([-2, -0.32, 0, -0.32, -2]), rel=1e-12)
    assert gaussian.light(points, 1)[3] == pytest.approx(np.exp(-2), rel=1e-12)  # 1/e^2 at half the thickness
    top_hat = Sheet(profile="top_hat", thickness_mm=0.45, position_mm=0.1)
    assert top_hat.light(points, 1).tolist() == [0, 1, 1, 1, 0]
    turned = Sheet(profile="top_hat", thickness_mm=0.45, position_mm=0.1, direction=(0.0, 3.0, 0.0))
    assert turned.light(points[:, [0, 2, 1]], 0).tolist() == [0, 1, 1, 1, 0]
    assert (Sheet().light(points, 0) == 1).all()


def test_pulses_have_their_power_in_every_pair():
    sheet = Sheet(power=(1.0, 0.6), power_sd=0.05)
    drawn = np.array([sheet.powers(np.random.default_rng([7, pair])) for pair in range(4000)])
    assert drawn.mean(0) == pytest.approx((1, 0.6), rel=MONTE_CARLO * 0.05 / np.sqrt(4000))
    assert drawn.std(0) / drawn.mean(0) == pytest.approx(0.05, rel=MONTE_CARLO / np.sqrt(8000))
    table = {"profile": "gaussian", "thickness_mm": 0.3, "power": (1.0, 0.6)}
    placed, power, brightness = lit_particles(small_scene(sheet=table), 1)
    assert power.tolist() == [1, 0.6] and brightness.shape == (2, 2, len(placed.position_mm))
    for pulse, frame in enumerate("ab"):  # light at the place of that frame, not midway
        expected = power[pulse] * placed.intensity * np.exp(-2 * (placed.at_frame(frame)[:, 2] / 0.15) ** 2)
        assert np.allclose(brightness[:, pulse], expected, rtol=1e-9)


def test_particles_are_as_dense_beyond_the_volume():
    inner = place_particles(small_scene(particles={"per_microlens": 50.0}), 0).position_mm
    outer = place_particles(small_scene(particles={"per_microlens": 50.0, "margin_mm": (0.1, 0.0, 0.3)}), 0).position_mm
    assert len(outer) == round(len(inner) * (0.8 * 1.0) / (0.6 * 0.4))
    within = (np.abs(outer) <= np.array([0.3, 0.25, 0.2])).all(1).sum()
    assert abs(within - len(inner)) < MONTE_CARLO * np.sqrt(len(inner))
    assert np.abs(outer).max(0) == pytest.approx((0.4, 0.25, 0.5), rel=1e-2)


def test_images_show_the_brightness_of_the_truth(device, tmp_path):
    """Each camera and frame re-rendered from ``truth/particles.npz``; the ideal images differ far more."""
    scene = small_scene(
        brightness={"camera_log_sd": 0.8},
        sheet={"profile": "gaussian", "thickness_mm": 0.5, "power": (1.0, 0.5)},
    )
    folder = simulate(scene, tmp_path / "set").parent
    with np.load(folder / "truth" / "particles.npz") as truth:
        position, moved, brightness = (
            truth[f"pair_0001_{key}"] for key in ("positions_mm", "displacement_mm", "brightness")
        )
        intensity, power = truth["pair_0001_intensity"], truth["pair_0001_power"]
    assert power.tolist() == [1, 0.5]
    rays = render.ray_table(16384, "gaussian", 99)
    for number, camera in enumerate(scene.camera):
        renderer = render_camera(camera, seed=[scene.seed, 3, number])
        for pulse, frame in enumerate("ab"):
            at = position + (pulse - 0.5) * moved
            recorded = tifffile.imread(folder / f"particles/{camera.name}/pair_0001_{frame}.tif") - 40.0
            errors = []
            for light in (brightness[number, pulse], intensity):
                image = render.render_sources(
                    renderer, at, 600 * renderer.microimage_px * light, 0.02, rays, rng=np.random.default_rng(1)
                )
                image = gaussian_filter(image, camera.blur_px)
                errors.append(np.linalg.norm(recorded - image) / np.linalg.norm(recorded))
            assert errors[0] < 0.25 and errors[1] > 2 * errors[0]  # rays of two tables, shot and read noise


def test_stray_light_varies_slowly_around_its_mean():
    stray = StrayLight(lens_counts=100.0, variation=0.2, length_mm=0.5)
    lens, ambient = stray.fields((300, 400), 0.02, np.random.default_rng(3))
    for field in (lens, ambient):
        assert field.mean() == pytest.approx(1, abs=1e-3) and field.std() == pytest.approx(0.2, rel=0.02)
        slope = np.hypot(*np.gradient(field, 0.02)).mean()
        assert 0.2 < slope * 0.5 / 0.2 < 3  # changes by its deviation over about its length
    assert abs(np.corrcoef(lens.ravel(), ambient.ravel())[0, 1]) < 0.7


def test_microlenses_modulate_stray_light_but_not_ambient_light(device):
    scene = small_scene(stray_light={"lens_counts": 300.0, "ambient_counts": 50.0, "variation": 0.1})
    white = white_image(scene, 0)
    static = static_light(scene, 0, white)
    first, second = static.at_powers(np.array([1.0, 0.5]))
    gaps, inside = white == 0, white > 0.95 * white.max()
    assert gaps.sum() > 50 and np.allclose(first[gaps], static.ambient[gaps])
    assert np.allclose(first - second, 0.5 * static.stray) and static.stray[gaps].max() == 0
    assert static.stray[inside].mean() == pytest.approx(300 * white[inside].mean(), rel=0.1)
    assert static.ambient.mean() == pytest.approx(50, rel=1e-3)


def test_background_images_are_the_particle_images_without_particles(device, tmp_path):
    tables = {"stray_light": {"lens_counts": 200.0}, "sheet": {"power": (1.0, 0.7)}}
    scene = small_scene(**tables, background={"averaged": 8})
    path = simulate(scene, tmp_path / "with")
    plain = simulate(small_scene(**tables), tmp_path / "without")
    extra = {"background/one_a.tif", "background/one_b.tif", "background/two_a.tif", "background/two_b.tif"}
    files = [{p.relative_to(f.parent).as_posix(): p for p in f.parent.rglob("*.tif")} for f in (path, plain)]
    assert set(files[0]) - set(files[1]) == extra
    assert all(np.array_equal(tifffile.imread(files[0][k]), tifffile.imread(files[1][k])) for k in files[1])
    assert 'background_image = "background/two_{frame}.tif"' in path.read_text()
    assert "background_image" not in plain.read_text()
    white = white_image(scene, 0)
    for frame, power in (("a", 1.0), ("b", 0.7)):
        light = 200 * power * gaussian_filter(white, scene.camera[0].blur_px)
        difference = tifffile.imread(files[0][f"background/one_{frame}.tif"]) - light - 40
        noise = np.sqrt((9 + light.mean() * 4095 / 10_000 + 1 / 12) / 8 + 1 / 12)
        assert abs(difference.mean()) < MONTE_CARLO * noise / np.sqrt(difference.size)
        assert difference.std() == pytest.approx(noise, rel=0.05)
    once = expose(np.zeros((4, 4)), scene.camera[0], scene.noise, np.random.default_rng(0))
    assert once.dtype == np.uint16


def test_a_sheet_beyond_the_seeded_region_is_reported(device, tmp_path, caplog):
    table = {"profile": "top_hat", "thickness_mm": 0.6}
    simulate(small_scene(sheet=table, particles={"margin_mm": (0.0, 0.0, 0.1)}), tmp_path / "seeded")
    assert "margin_mm" not in caplog.text
    simulate(small_scene(sheet=table), tmp_path / "not")
    assert "up to 0.1 mm beyond the seeded region" in caplog.text
