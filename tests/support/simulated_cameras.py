"""Simulated cameras of several kinds, a small scene file, and a sensor that adds up rays by definition."""

import sys

import numpy as np
import pytest
from support import scenes

from lfpiv.errors import InputError
from lfpiv.simulation.scene import Scene, SceneCamera
from lfpiv.simulation.simulator import simulate

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROUNDING = 1e-12  # float64, a few operations on millimetres
MONTE_CARLO = 5.0  # standard errors; 1e-6 chance per comparison

TABLE_2 = scenes.camera("cam", 45, (150, 110), pixel_um=5.5)
RIGS = {
    "ideal": {"nominal_angle_deg": 0},
    "misaligned": {
        "true_yaw_deg": -43.0,
        "true_pitch_deg": 1.5,
        "true_roll_deg": -2.0,
        "true_offset_mm": (0.05, -0.04, 0.3),
        "true_array_roll_deg": 0.9,
        "true_array_offset_mm": (0.031, -0.022),
        "true_microlens_pitch_mm": 0.1013,
        "vignetting": 0.3,
        "lens_gain_sd": 0.1,
    },
    "hexagonal": {
        "microlens_layout": "hexagonal",
        "magnification": -0.8,
        "nominal_angle_deg": 20,
        "true_array_roll_deg": -7.0,
        "true_array_offset_mm": (-0.02, 0.045),
    },
    "overlapping": {"f_number": 2.6, "true_array_roll_deg": 3.0, "nominal_angle_deg": 150},
}

SMALL_SCENE = """
name = "small"
seed = 5
dt_s = 2e-4
[[camera]]
name = "one"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 5.5
sensor_width_px = 170
sensor_height_px = 130
nominal_angle_deg = 45
true_yaw_deg = 44.0
true_array_roll_deg = 0.5
[[camera]]
name = "two"
focal_length_mm = 60.0
magnification = -0.5
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.7
pixel_um = 5
sensor_width_px = 140
sensor_height_px = 150
nominal_angle_deg = -40
microlens_layout = "hexagonal"
vignetting = 0.2
lens_gain_sd = 0.02
dark_image = true
[board]
dots = [3, 2]
spacing_mm = 0.3
dot_diameter_mm = 0.05
planes_mm = [-0.2, 0.2]
[volume]
size_mm = [0.6, 0.5, 0.4]
voxel_mm = 0.1
[particles]
per_microlens = 0.5
pairs = 2
intensity_sd = 0.5
sigma_mm = 0.02
[flow]
kind = "swirl"
peak_mm = 0.05
core_mm = 0.2
[quality]
particle_rays = 16384
dot_rays = 4096
pixel_rays = 64
[smart]
iterations = 3
[correlation]
windows = [4]
"""
"""Scene file of two cameras, a board and a swirl, with a key of each kind."""


def small_scene(**tables):
    """Return the small scene with some tables added; keys of tables that it has already are replaced one by one."""
    content = tomllib.loads(SMALL_SCENE)
    for name, table in tables.items():
        content[name] = content.get(name, {}) | table if isinstance(table, dict) else table
    return Scene.model_validate(content)


def refusal(text, folder):
    """Return the one line by which a scene is refused before anything is written."""
    (folder / "scene.toml").write_text(text, "utf-8")
    with pytest.raises(InputError) as error:
        simulate(folder / "scene.toml", folder / "out")
    assert "\n" not in str(error.value)
    assert [path.name for path in folder.iterdir()] == ["scene.toml"]
    return str(error.value)


def camera(rig="misaligned", **changes):
    return SceneCamera.model_validate(TABLE_2 | RIGS[rig] | changes)


def points(count, seed=0):
    return np.random.default_rng(seed).uniform(-0.35, 0.35, (count, 3))


def lens_gain(renderer, index):
    """Return the transmission of lenses (i, j), zero outside the table."""
    i, j = (index - renderer.first_lens).astype(int).T
    inside = (i >= 0) & (i < renderer.lens_gain.shape[0]) & (j >= 0) & (j < renderer.lens_gain.shape[1])
    return np.where(inside, renderer.lens_gain[np.where(inside, i, 0), np.where(inside, j, 0)], 0)


def land(scene_camera, renderer, s_t, pupil, weight):
    """Add up weighted rays (s, t), (u, v) per pixel of the sensor by Eq. 9."""
    lattice, optics = scene_camera.lattice, scene_camera.optics
    index = lattice.nearest(s_t)
    place = lattice.centres_mm(index) + optics.microlens_focal_length_mm / optics.image_distance_mm * (s_t - pupil)
    rows, columns = optics.sensor_shape
    column, row = np.floor(place / optics.pixel_mm + [columns / 2, rows / 2]).T
    edges = (np.arange(rows + 1), np.arange(columns + 1))
    weight = weight * lens_gain(renderer, index) * (column < columns) * (row < rows)  # the last bin includes its end
    return np.histogram2d(row, column, bins=edges, weights=weight)[0]


def relative_difference(found, expected):
    return np.abs(found - expected).sum() / np.abs(expected).sum()


def snell(direction, normal, before, after):
    """Return the refracted unit direction by the vector form of Snell's law. `normal` points along the light."""
    cosine = direction @ normal
    across = before / after * (direction - cosine * normal)
    return across + np.sqrt(1 - across @ across) * normal
