"""Cameras in any orientation: from above, rolled, with unlike optics; dots named by a direction, or by a mark."""

from dataclasses import replace

import numpy as np
import pytest
from support import scenes
from support.calibration_scene import MAPPING_AIM_PITCH, mean_error_pitch
from support.ideal_rig import optics, rotation

import lfpiv
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.mark import TURNS, name_by_mark, search_board
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.calibration.board.unposed import rotations_of
from lfpiv.geometry.orientation import Orientation
from lfpiv.simulation.simulator import simulate
from lfpiv.warn import Code

ROUNDING = 1e-12
MARK = ((1, 1), (2, 1), (1, 3))
BOX_MM = (-1, -1, -0.6), (1, 1, 0.6)
"""Corners of the box that the mapping is compared in."""
OFF = {"true_yaw_deg": 1.5, "true_pitch_deg": -2.0, "true_roll_deg": 1.1, "true_offset_mm": (0.05, -0.04, 0.1)}
"""Departure of the cameras from their nominal directions."""
ABOVE = {"nominal_direction": (0.0, 0.7, 0.7)}
OTHER_LENS = {
    "microlens_layout": "hexagonal",
    "focal_length_mm": 75.0,
    "magnification": -0.8,
    "f_number": 4.5,
    "microlens_pitch_mm": 0.08,
    "microlens_focal_length_mm": 0.64,
}


def looking(name, *, angle=None, **more):
    table = scenes.camera(name, angle, (340, 340), **OFF | more)
    return {key: value for key, value in table.items() if value is not None}


def board_scene(cameras, **board):
    return scenes.scene(
        "orientations",
        cameras,
        planes_mm=(),
        particles={"count": 20},
        displacement_mm=(0.05, 0.0, 0.0),
        network={"hidden": (8,), "epochs": 60},
        quality={"dot_rays": 16384, "pixel_rays": 64},
        board={"dots": (5, 5), "spacing_mm": 0.5, "dot_diameter_mm": 0.1, "planes_mm": (-0.6, 0.0, 0.6)} | board,
    )


def experiment_of(scene, folder, *, stated=True, flip=None):
    """Simulate; leave the nominal orientations out of the file, or state mirrored images."""
    path = simulate(scene, folder / "data")
    lines = path.read_text("utf-8").split("\n")
    if not stated:
        lines = [line for line in lines if not line.startswith("nominal_")]
    if flip:
        lines = [f'image_flip = "{flip}"' if line.startswith("image_flip") else line for line in lines]
    path.write_text("\n".join(lines), "utf-8")
    return lfpiv.open_experiment(path)


RIG = (
    looking("above", **ABOVE),
    looking("steep", nominal_direction=(0.0, 0.87, 0.5)),  # 60 degrees
    looking("hexagonal", nominal_direction=(-0.3, 0.6, 0.7), **OTHER_LENS),
    looking("rolled", angle=35.0, nominal_roll_deg=180.0, true_yaw_deg=36.5),
    looking("below", nominal_direction=(0.4, -0.5, 0.7), nominal_roll_deg=90.0),
    looking("behind", nominal_direction=(0.2, 0.5, -0.8), nominal_roll_deg=-45.0),
)


@pytest.mark.slow
def test_unlike_cameras_anywhere_around_the_volume(tmp_path):
    scene = board_scene(RIG[:4])
    calibration = lfpiv.calibrate(experiment_of(scene, tmp_path))
    for truth in scene.camera:
        camera = calibration.cameras[truth.name]
        assert not camera.warnings, truth.name
        assert mean_error_pitch(camera, truth, *BOX_MM) < MAPPING_AIM_PITCH, truth.name
        assert 2.0 < camera.report.turn_from_nominal_deg < 3.5  # of the angles of `OFF`


@pytest.mark.slow
def test_a_mark_names_the_dots_of_cameras_without_a_nominal_orientation(tmp_path):
    scene = board_scene(RIG[4:], mark=MARK)
    calibration = lfpiv.calibrate(experiment_of(scene, tmp_path, stated=False))
    for truth in scene.camera:
        camera = calibration.cameras[truth.name]
        assert not camera.warnings, truth.name
        assert mean_error_pitch(camera, truth, *BOX_MM) < MAPPING_AIM_PITCH, truth.name
        assert np.isnan(camera.report.turn_from_nominal_deg)
        assert not np.isin(camera.dots.dot % 25, [row * 5 + column for column, row in MARK]).any()


@pytest.mark.slow
def test_a_mark_shows_mirrored_pictures(tmp_path):
    """Upside down as well, which equal dots do not show."""
    experiment = experiment_of(
        board_scene([looking("one", angle=35.0, true_yaw_deg=36.5)], mark=MARK), tmp_path, flip="vertical"
    )
    with pytest.raises(lfpiv.InputError, match=r"camera 'one'.*mirror image.*image_flip"):
        lfpiv.calibrate(experiment)


@pytest.mark.slow
def test_a_mark_corrects_a_wrong_orientation_and_a_warning_says_so(tmp_path):
    scene = board_scene([looking("one", true_yaw_deg=0.0, **ABOVE)], mark=MARK)
    path = experiment_of(scene, tmp_path).path
    path.write_text(path.read_text("utf-8").replace("[0.0, 0.7, 0.7]", "[0.7, 0.0, 0.7]"), "utf-8")
    camera = lfpiv.calibrate(lfpiv.open_experiment(path)).cameras["one"]
    assert mean_error_pitch(camera, scene.camera[0], *BOX_MM) < MAPPING_AIM_PITCH
    assert [warning.code for warning in camera.warnings] == [Code.TURNED]
    assert "where it is stated to be, at 45°" in camera.warnings[0].sentence


def marked(**changes):
    values = {"dots": (7, 6), "spacing_mm": 0.4, "diameter_mm": 0.1, "planes_mm": (0.0, 0.5), "mark": MARK}
    return DotBoard(**values | changes)


def seen(board, turn, shift, view):
    """Occupied sites of a lattice that the board lies on, turned and shifted, and those in a square view."""
    edge = search_board(board).dots[0] + 4
    row, column = np.indices((edge, edge)) - (edge - 1) // 2
    place = np.stack([column, row], axis=-1) @ turn.T + shift + (np.array(board.dots) - 1) / 2
    i, j = np.moveaxis(np.rint(place).astype(int), -1, 0)
    on_board = (i >= 0) & (i < board.dots[0]) & (j >= 0) & (j < board.dots[1])
    found = on_board & board.occupied[np.where(on_board, j, 0), np.where(on_board, i, 0)]
    in_view = np.maximum(abs(row), abs(column)) <= view
    return (np.repeat(part[None], len(board.planes_mm), axis=0) for part in (found & in_view, in_view))


@pytest.mark.parametrize("turn", range(len(TURNS)))
@pytest.mark.parametrize("view", [3, 6])
def test_a_mark_is_found_in_every_turn_and_mirror(turn, view):
    board, rng = marked(), np.random.default_rng(turn)
    shift = np.array([1.0, -0.5])  # the middle of six rows lies between sites
    found, in_view = seen(board, TURNS[turn], shift, view)
    found[rng.random(found.shape) < 0.02] = False  # dots that one plane does not show
    naming = name_by_mark(found, in_view, board)
    assert np.array_equal(naming.turn, TURNS[turn]) and np.array_equal(naming.shift, shift)
    assert naming.mirrored == (turn >= 4)


def test_a_mark_that_is_not_seen_names_nothing():
    board = marked(dots=(9, 9), mark=((0, 0), (1, 0), (0, 2)))
    for parts in (seen(board, TURNS[0], np.zeros(2), 2), seen(marked(mark=()), TURNS[0], np.array([0, -0.5]), 6)):
        with pytest.raises(lfpiv.InputError, match=r"board\.mark: expected the 3 places without a dot in view"):
            name_by_mark(*parts, board)


def test_the_picture_of_a_board_is_the_corner_of_two_rotations():
    turn = rotation(25.0, -40.0, 70.0)
    both = list(rotations_of(turn[:2, :2]))
    assert len(both) == 2
    assert min(abs(one - turn).max() for one in both) < ROUNDING
    assert all(np.allclose(one @ one.T, np.eye(3)) and np.linalg.det(one) > 0 for one in both)
    assert all(np.allclose(one[:2, :2], turn[:2, :2]) for one in both)


@pytest.mark.parametrize("orientation", [Orientation(30.0), Orientation.from_direction((0.1, 1.0, 0.2), 90.0)])
def test_a_pose_is_fitted_about_any_orientation(orientation):
    """Straight from above, too: the free angles are small rotations about the nominal pose."""
    camera, rng = optics(), np.random.default_rng(0)
    points = rng.uniform(-1, 1, (300, 3))
    plan = CameraPose.from_plan(camera, orientation)
    true = CameraPose(
        parameters=(0.05, -0.06, 0.04, 0.1, -0.2, 0.15, 0.0, 0.0, 0.0),
        nominal_rotation=orientation.rotation,
        nominal=plan.nominal,
    )
    fitted = plan.fitted(points, true.rays(points)[0], camera, true.rays(points)[1])
    assert abs(fitted.rotation - true.rotation).max() < 2e-3  # of the weak prior


def test_errors_of_dots_do_not_carry_a_pose_far_from_its_plan():
    """Aberrations displace dots by up to half a pitch. A fifth of the distance would fit these 0.1 pitch better."""
    camera = optics()
    plan = CameraPose.from_plan(camera, Orientation(28.0))
    x, y, z = np.meshgrid(*[np.linspace(-1.3, 1.3, 7)] * 2, (-0.8, -0.2, 0.4))
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    odd = replace(plan, parameters=(0, 0.01, 0, -0.88, -0.02, -1.66, -0.03, np.log(0.2), 0))
    chief = odd.rays(points)[0]
    fitted = plan.fitted(points, chief, camera)
    misses = np.linalg.norm(fitted.rays(points)[0] - chief, axis=1) / camera.microlens_pitch_mm
    assert np.sqrt((misses**2).mean()) < 0.15
    assert abs(fitted.parameters[7]) < 0.1  # logarithm of the distance: twice the spread of rigs about their plans
