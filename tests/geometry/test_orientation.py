"""Orientations of cameras: rotations, their conventions, and the angle about y as a special case."""

import numpy as np
import pytest
from support.ideal_rig import optics, rotation

from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.geometry.orientation import Orientation

ROUNDING = 1e-14
DIRECTIONS = [
    (0, 0.7, 0.7),
    (0.3, -0.8, 0.5),
    (-0.2, 0.9, -0.4),
    (5.0, 0.0, -1.0),
    (1e-9, 3e-9, 2e-9),
    (0, 1e200, 1e199),
]


@pytest.mark.parametrize("angle", [45.0, -30.0, 0.0, 150.0, -180.0, 90.0])
def test_an_angle_is_the_rotation_of_the_paper(angle):
    a = np.radians(angle)
    paper = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    assert (Orientation(angle).rotation == paper).all()
    same = Orientation.from_direction((np.sin(a), 0.0, np.cos(a)))
    assert np.allclose(same.rotation, paper, atol=ROUNDING)
    assert (thin_lens_model(optics(), angle).rotation == paper).all()
    assert np.allclose(Orientation(angle, -12.0, 31.0).rotation, rotation(angle, -12.0, 31.0), atol=ROUNDING)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_direction_points_to_the_camera_and_rows_are_normal_to_y(direction):
    turn = Orientation.from_direction(direction).rotation
    unit = np.array(direction) / np.abs(direction).max()
    assert np.allclose(turn[2], unit / np.linalg.norm(unit), atol=1e-12)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=ROUNDING) and np.linalg.det(turn) > 0
    assert abs(turn[0, 1]) < ROUNDING and turn[1, 1] > 0  # x of the camera is normal to y, and y is not upside down


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_straight_above_and_below_x_lies_along_the_rows(side):
    turn = Orientation.from_direction((0.0, side, -0.0)).rotation
    assert np.allclose(turn, [[1, 0, 0], [0, 0, -side], [0, side, 0]], atol=1e-12)
    near = Orientation.from_direction((0.0, side, 1e-4)).rotation
    assert np.allclose(turn, near, atol=2e-4)  # the limit of a camera that rises from +z


def test_a_roll_turns_the_picture_about_its_middle():
    plain, rolled = (Orientation.from_direction((0.2, 0.5, 0.8), roll).rotation for roll in (0.0, 90.0))
    assert np.allclose(rolled, [-plain[1], plain[0], plain[2]], atol=ROUNDING)


def test_the_angle_error_turns_the_axis_away_from_z():
    assert Orientation(45.0).away_from_z(1.0).yaw_deg == 46.0 and Orientation(-45.0).away_from_z(1.0).yaw_deg == -46.0
    for direction in ((0.1, 0.6, 0.7), (0.3, -0.8, -0.2)):
        before = Orientation.from_direction(direction, 20.0)
        after = before.away_from_z(2.0)
        old, new = before.rotation[2], after.rotation[2]
        assert np.degrees(np.arccos(new[2]) - np.arccos(old[2])) == pytest.approx(2.0)
        assert np.arctan2(new[1], new[0]) == pytest.approx(np.arctan2(old[1], old[0])) and after.roll_deg == 20.0


def test_what_is_no_direction_is_refused():
    for wrong in ((0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 1), (1, 2)):
        with pytest.raises(ValueError, match="direction: expected a finite vector"):
            Orientation.from_direction(wrong)
    with pytest.raises(ValueError, match="finite angles"):
        Orientation(np.nan)
