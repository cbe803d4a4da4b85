"""A scene file of one camera and a board for tests of the calibration, and the error of its mapping with limits."""

import numpy as np

from lfpiv.simulation.scene import true_mapping

MAPPING_PITCH = 0.015  # the project's limit for the mean error over the board's volume
MAPPING_AIM_PITCH = 0.006  # the project's aim for the mean mapping error, reached on clean images

CALIBRATION_SCENE = """
name = "rig"
seed = 9
dt_s = 1e-3
[board]
dots = [5, 5]
spacing_mm = 0.5
dot_diameter_mm = 0.1
planes_mm = [-0.8, -0.4, 0.0, 0.4, 0.8]
[volume]
size_mm = [2.0, 2.0, 1.2]
voxel_mm = 0.1
[particles]
count = 40
pairs = 1
[flow]
kind = "uniform"
displacement_mm = [0.05, 0.0, 0.0]

[[camera]]
name = "only"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 8.0
sensor_width_px = 420
sensor_height_px = 400
nominal_angle_deg = -30.0
true_yaw_deg = -33.0
true_pitch_deg = 0.8
true_roll_deg = -1.1
true_offset_mm = [0.05, -0.04, 0.1]
true_array_roll_deg = 0.4
true_array_offset_mm = [0.02, 0.03]
"""


def rays_in(low, high, count=50_000, radius=12.5, seed=0):
    """Return random points in a box, and random points of the pupil."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    length, angle = radius * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return points, np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)


def mean_error_pitch(camera, truth, low=(-1, -1, -0.8), high=(1, 1, 0.8)):
    """Return the mean error of a camera's mapping of rays through a box, against its true one."""
    points, pupil = rays_in(low, high, radius=camera.optics.pupil_radius_mm)
    error = camera.map(points, pupil) - true_mapping(truth)(points, pupil)
    return np.linalg.norm(error, axis=1).mean() / camera.optics.microlens_pitch_mm
