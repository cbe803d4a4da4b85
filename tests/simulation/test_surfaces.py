"""Bright surfaces, walls and faults of the array: kernels against slow twins in float64, and the truth files."""

import numpy as np
import pytest
from scipy.stats import qmc
from support.ray_twins import open_rays, pixel_rays, plane_light
from support.simulated_cameras import MONTE_CARLO, camera, lens_gain, small_scene

from lfpiv.simulation.camera_images import image_area, render_camera, static_light, white_image
from lfpiv.simulation.particles import place_particles
from lfpiv.simulation.scene import true_mapping
from lfpiv.simulation.simulator import simulate
from lfpiv.simulation.surfaces import Surface
from lfpiv_kernels.rendering import collect, render, surfaces

EDGE_SAMPLES = 2.5  # rays of one pixel that float32 may put on the other side of an edge
GLASS = {"point_mm": (0, 0, 20), "normal": (0.1, 0, 1), "thickness_mm": 5.0, "index": 1.5}
RIGS = {
    "misaligned": {"vignetting": 0, "lens_gain_sd": 0},
    "hexagonal": {},
    "real": {"window": (GLASS,), "aberrations": {"spherical_pitch": 0.3, "distortion_percent": 1.0}},
    "faulty": {"array": {"pitch_drift": (0.03, -0.02), "cats_eye": 0.5}, "true_array_roll_deg": 2.0},
    "drifting hexagonal": {"array": {"pitch_drift": (0.03, -0.02)}, "microlens_layout": "hexagonal"},
}
SMALL = {"sensor_width_px": 44, "sensor_height_px": 32}


def rig(name, **changes):
    base = name if name in ("misaligned", "hexagonal") else "ideal"
    return camera(base, **({"nominal_angle_deg": 30} | RIGS[name] | changes))


def patch_light(patch):
    """Return the light of a patch at places in its plane."""

    def light(places):
        arms = (places - patch.centre_mm) @ patch.axes.T
        return np.prod(
            [
                np.exp(-0.5 * (distance / half) ** 2) if edge == "gaussian" else np.abs(distance) < half
                for distance, half, edge in zip(arms.T, patch.half_mm, patch.edges, strict=True)
            ],
            axis=0,
        )

    return light


@pytest.mark.parametrize("name", RIGS)
def test_patch_equals_its_twin(device, name):
    scene_camera, samples = rig(name, **SMALL), 16
    patch = Surface(
        centre_mm=tuple(scene_camera.true_offset_mm + scene_camera.rotation.T @ (0.02, 0.01, -0.3)),
        normal=(0.3, -0.2, 1.0),
        along=(1.0, 1.0, 0.0),
        length_mm=0.25,
        width_mm=0.03,
        edges=("sharp", "gaussian"),
        counts=1.0,
    )
    renderer = render_camera(scene_camera, seed=2)
    table = qmc.Sobol(4, scramble=True, seed=np.random.default_rng(3)).random(samples) - 0.5
    gaussian = (False, True)
    found = surfaces.render_patch(
        renderer, np.asarray(patch.centre_mm), patch.axes, patch.half_mm, gaussian, samples=samples, seed=3
    )
    expected = plane_light(scene_camera, renderer, table, (patch.centre_mm, np.cross(*patch.axes)), patch_light(patch))
    assert expected.max() > 0.2 and (expected < 0.01).mean() > 0.1
    assert np.abs(found - expected).max() <= EDGE_SAMPLES / samples
    assert (np.abs(found - expected) < 1e-4).mean() > 0.95


def test_a_wide_patch_is_a_white_image_and_a_small_one_a_dot(device):
    """Two other kernels: uniform light, and a disc traced forward, whose light a square of its area has."""
    scene_camera = rig("hexagonal", sensor_width_px=150, sensor_height_px=110)
    renderer = render_camera(scene_camera)
    axes, centre = np.eye(3)[:2], np.array([0.05, 0.0, 0.2])
    wide = surfaces.render_patch(renderer, centre, axes, (50.0, 50.0), (False, False), samples=64, seed=0)
    assert np.abs(wide - collect.render_white(renderer, samples=64, seed=0)).max() < EDGE_SAMPLES / 64
    edge = 0.08
    small = surfaces.render_patch(renderer, centre, axes, (edge / 2, edge / 2), (False, False), samples=1024, seed=0)
    lenses = edge**2 * image_area(scene_camera, centre[None]) / abs(np.linalg.det(renderer.basis_mm))
    rays = render.ray_table(1 << 16, "disc", 0)
    dot = render.render_sources(
        renderer,
        centre[None],
        lenses * renderer.microimage_px,
        edge / np.sqrt(np.pi),
        rays,
        rng=np.random.default_rng(0),
    )
    assert small.sum() == pytest.approx(dot.sum(), rel=0.01)  # forward rays leave evenly, not by Lambert's law


@pytest.mark.parametrize("name", ["faulty", "drifting hexagonal"])
def test_faults_of_the_array_are_in_both_kernels(device, name):
    """A white image against rays from everywhere, and a particle's rays against the nearest drifted lens."""
    scene_camera = rig(name, **SMALL)
    renderer = render_camera(scene_camera)
    table = qmc.Sobol(4, scramble=True, seed=np.random.default_rng(1)).random(32) - 0.5
    white = collect.render_white(renderer, samples=32, seed=1)
    expected = sum(open_rays(scene_camera, s_t, pupil).mean(-1) for _, s_t, pupil in pixel_rays(scene_camera, table))
    assert np.abs(white - expected).max() <= EDGE_SAMPLES / 32
    plain = render_camera(rig(name, array=None, **SMALL))
    assert np.abs(white - collect.render_white(plain, samples=32, seed=1)).max() > 0.3

    centre = scene_camera.axis_point_mm + [(0.02, -0.03, 0.4)] @ scene_camera.rotation
    rays = render.ray_table(1 << 14, "disc", 0)
    found = render.render_sources(renderer, centre, np.array([1e6]), 0.0, rays, rng=np.random.default_rng(2))
    turn = np.random.default_rng(2).uniform(0, 2 * np.pi, (1, 2))[0, 0]
    pupil = rays[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    pupil = scene_camera.optics.pupil_radius_mm * pupil
    s_t = true_mapping(scene_camera)(np.broadcast_to(centre, (len(pupil), 3)), pupil)
    image = np.zeros(found.shape)
    lattice, drift, optics = scene_camera.lattice, scene_camera.faults[:2], scene_camera.optics
    regular = lattice.centres_mm(lattice.nearest(2 * s_t / (1 + np.sqrt(1 + 4 * drift * s_t))))
    scale = optics.microlens_focal_length_mm / optics.image_distance_mm
    place = regular + drift * regular**2 + scale * (s_t - pupil)
    column, row = np.floor(place / optics.pixel_mm + np.array(found.shape[::-1]) / 2).astype(int).T
    kept = open_rays(scene_camera, s_t, pupil) & (column >= 0) & (row >= 0)
    kept &= (column < found.shape[1]) & (row < found.shape[0])
    np.add.at(image, (row[kept], column[kept]), 1e6 / len(rays))
    assert image.sum() > 1e5 and np.abs(found - image).sum() < 5e-3 * image.sum()


def test_dead_lenses_have_their_share_and_their_place(device, tmp_path):
    scene = small_scene(array={"dead_share": 0.1, "pitch_drift": (0.01, 0.0)})
    folder = simulate(scene, tmp_path / "set").parent
    for number, scene_camera in enumerate(scene.camera):
        renderer = render_camera(scene_camera, seed=[scene.seed, 3, number])
        count = renderer.lens_gain.size
        with np.load(folder / "truth" / f"array_{scene_camera.name}.npz") as truth:
            centres, index = truth["dead_centre_mm"], truth["dead_index"]
        assert abs(len(centres) - 0.1 * count) < MONTE_CARLO * np.sqrt(0.09 * count)
        assert (lens_gain(renderer, index) == 0).all()
        white, optics = white_image(scene, number), scene_camera.optics
        scale = 1 + optics.microlens_focal_length_mm / optics.image_distance_mm
        column, row = np.floor(centres * scale / optics.pixel_mm + np.array(white.shape[::-1]) / 2).astype(int).T
        inside = (row >= 0) & (column >= 0) & (row < white.shape[0]) & (column < white.shape[1])
        assert inside.sum() > 3 and white[row[inside], column[inside]].max() < 0.3 * np.percentile(white, 90)


def test_surfaces_follow_the_pulses_or_their_own_power(device):
    table = {"centre_mm": (0.0, 0.0, 0.0), "length_mm": 0.4, "width_mm": 0.1, "counts": 1500.0}
    scene = small_scene(surface=(table, table | {"power": (1.0, 3.0)}), sheet={"power": (1.0, 0.5)})
    static = static_light(scene, 0, white_image(scene, 0))
    image = static.surfaces[0][1]
    assert np.array_equal(image, static.surfaces[1][1]) and image.max() == pytest.approx(1500, rel=0.05)
    first, second = static.at_powers(np.array([1.0, 0.5]))
    assert np.allclose(first, 2 * image) and np.allclose(second, 3.5 * image)
    assert small_scene(surface=table).surface[0].axes.tolist() == [[1, 0, 0], [0, 1, 0]]


def test_no_particle_is_in_a_wall_at_any_time_and_the_others_stay(tmp_path):
    walls = (
        {"kind": "half_space", "point_mm": (0.1, 0.0, 0.0), "normal": (-2.0, 0.0, 0.0)},
        {"kind": "box", "centre_mm": (-0.15, 0.0, 0.0), "size_mm": (0.1, 0.2, 0.4)},
    )
    seeded = {"per_microlens": 60.0}
    every = place_particles(small_scene(particles=seeded), 0)
    scene = small_scene(particles=seeded, wall=walls)
    left = place_particles(scene, 0)
    x, y, _ = every.position_mm.T
    near = (x > 0.1) | ((np.abs(x + 0.15) < 0.05) & (np.abs(y) < 0.1))
    assert np.array_equal(scene.solid(every.position_mm), near) and 0.3 < near.mean() < 0.6
    for at in (left.position_mm, left.at_frame("a"), left.at_frame("b")):
        assert not scene.solid(at).any()
    kept = np.isin(every.position_mm[:, 0], left.position_mm[:, 0])
    for name in ("position_mm", "displacement_mm", "intensity"):
        assert np.array_equal(getattr(every, name)[kept], getattr(left, name)), name
    crossing = ~near & ~kept
    assert 0 < crossing.mean() < 0.1  # they reach a wall before or after the middle of the time
    folder = simulate(small_scene(wall=walls), tmp_path / "set").parent
    with np.load(folder / "truth" / "walls.npz") as truth:
        assert truth["solid"].shape == (4, 5, 6)
        assert truth["solid"][0, 2].tolist() == [False, True, False, False, True, True]
        assert truth["x_mm"] == pytest.approx(np.arange(6) / 10 - 0.25)
