"""Errors of the board, fitted to labels by formula: recovery, what is not observable, outliers, and real optics."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfpiv import warn
from lfpiv.calibration import checks
from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.bundle.dot_rays import CameraLabels
from lfpiv.calibration.bundle.fit import fit_board
from lfpiv.calibration.thin_lens_model import fit_thin_lens
from lfpiv.errors import InputError
from lfpiv.simulation.scene_camera import Aberrations, SceneCamera, Window, true_mapping
from lfpiv.warn import Code

BOARD = DotBoard(dots=(6, 6), spacing_mm=0.8, diameter_mm=0.1, planes_mm=(-1.2, -0.7, -0.3, 0.2, 0.6, 1.2))
NOISE_MM = 2e-4  # error of a dot's chief ray, as the labels of rendered boards have it
LEFT_MM = {1: 6e-3, 2: 1e-3}  # error of corrected planes by number of cameras; one sees depth by its pupil only
LEFT_SHARE = 0.5  # of the errors of dots; those that bend lines of dots smoothly look like distortion of the lens
SIGMAS = 5.0  # 1e-6 chance for each of some dozens of comparisons
WINDOW = (Window(point_mm=(0, 0, 6.0), normal=(0.28, 0, 1.0), thickness_mm=10, index=1.52),)
LENS = Aberrations(coma_pitch=0.3, distortion_percent=1, spherical_pitch=0.2, astigmatism_pitch=0.2, centre_mm=(2, 1))
OPTICS = {
    "ideal": {},
    "window": {"window": (Window(point_mm=(0, 0, 5.0), normal=(0, 0, 1.0), thickness_mm=5, index=1.5),)},
    "aberrated": {"window": WINDOW, "aberrations": LENS},
}
ANGLES = {"two cameras": (40.8, -39.1), "one camera": (-33.0,), "one camera along z": (1.0,)}


def camera(angle, optics):
    return SceneCamera(
        name="cam", focal_length_mm=100.0, magnification=-1.0, f_number=4.0, microlens_pitch_mm=0.1,
        microlens_focal_length_mm=0.8, pixel_um=5.5, sensor_width_px=1200, sensor_height_px=1120,
        nominal_angle_deg=round(angle), true_yaw_deg=angle, true_pitch_deg=0.2, true_roll_deg=-0.3,
        true_offset_mm=(0.03, -0.05, 0.06), **OPTICS[optics],
    )  # fmt: skip


def errors_of(rng, stage_mm=0.0, tilt=0.0, dots_mm=0.0):
    """Random errors of planes (shift, rotation vector) and of dots."""
    planes = len(BOARD.planes_mm)
    return np.hstack([stage_mm * rng.standard_normal((planes, 3)), tilt * rng.standard_normal((planes, 3))]), (
        dots_mm * rng.standard_normal((BOARD.size, 2))
    )


def true_points(plane_errors, dot_errors, board=BOARD):
    points = []
    for plane, (error, depth) in enumerate(zip(plane_errors, board.planes_mm, strict=True)):
        flat = board.points_mm(plane) * (1, 1, 0)
        flat[:, :2] += dot_errors
        points.append(Rotation.from_rotvec(error[3:]).apply(flat) + error[:3] + (0, 0, depth))
    return np.concatenate(points)


def labels(angle, optics, points, rng, board=BOARD, wrong=0, along_s=1.0):
    """Labels of all dots at `points`; `wrong` dots carry the label of a place that is 0.8 mm away.

    Their noise is `along_s` times larger along s than along t.
    """
    scene_camera = camera(angle, optics)
    radius, count = scene_camera.optics.pupil_radius_mm, len(points)
    dot = np.repeat(np.arange(count), 37)
    length, turn = radius * np.sqrt(rng.random(len(dot))), 2 * np.pi * rng.random(len(dot))
    pupil = np.stack([length * np.cos(turn), length * np.sin(turn)], axis=1)
    noise = NOISE_MM * np.array([along_s, 1.0]) * rng.standard_normal((count, 3, 2))[dot]
    array = true_mapping(scene_camera)(points[dot], pupil)
    array += noise[:, 0] + noise[:, 1] * pupil[:, :1] / radius + noise[:, 2] * pupil[:, 1:] / radius
    array[np.isin(dot, rng.choice(count, wrong, replace=False))] += 0.8
    planes = np.full(len(board.planes_mm), board.size)
    dots = BoardDots(
        pupil_mm=pupil, array_mm=array, std_mm=np.full(len(dot), NOISE_MM), dot=dot, rejected_dot=np.zeros(0, int),
        measured_dot=np.arange(count), chief_mm=np.zeros((count, 2)), slope=np.zeros((count, 2, 2)),
        reduced_chi2=np.ones(count), response_share=1.0, diameter_mm=0.1, blur_px=0.4, points_mm=board.of_dots_mm(dot),
        found=planes, expected=planes, rejected=0 * planes, left_over_mm=np.zeros((4, 33, 2)),
        shared_error_mm=0.0,
    )  # fmt: skip
    lens = fit_thin_lens(dots.points_mm, pupil, array, scene_camera.optics, std=dots.std_mm)
    return CameraLabels(dots=dots, lens=lens, pupil_radius_mm=radius, pitch_mm=0.1)


def fitted(points, angles, optics="ideal", seed=0, board=BOARD, **faults):
    rng = np.random.default_rng(seed)
    return fit_board([labels(angle, optics, points, rng, board, **faults) for angle in angles], board)


def left_mm(found, true, board=BOARD):
    """Root mean square error of the dots along x, y, z, but for a common map that keeps lines straight.

    To the first order such a projective map is a + B x + x (c x), with 3, 9 and 3 coefficients.
    """
    at = found.points_mm(board, np.arange(len(true)))
    affine = np.einsum("ab,nj->nabj", np.eye(3), np.hstack([np.ones((len(at), 1)), at])).reshape(-1, 12)
    columns = np.hstack([affine, (at[:, :, None] * at[:, None]).reshape(-1, 3)])
    error = (true - at).ravel()
    rest = error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
    return np.sqrt((rest.reshape(-1, 3) ** 2).mean(0))


@pytest.mark.slow(but="one camera along z")
@pytest.mark.parametrize("optics", OPTICS)
@pytest.mark.parametrize("cameras", ANGLES)
def test_a_perfect_board_is_not_corrected(cameras, optics):
    found = fitted(true_points(*errors_of(np.random.default_rng(0))), ANGLES[cameras], optics)
    assert found.corrected == ()
    assert not found.plane.any() and not found.dot_mm.any()
    assert (found.plane_std[:, 2] > 0).all()  # what the labels could have shown


@pytest.mark.slow(but="0-one camera along z")
@pytest.mark.parametrize("cameras", ANGLES)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_perfect_board_is_not_corrected_where_dots_are_seen_worse_along_rows(cameras, seed):
    """Dots of a row a whole number of lenses apart, each within a lens, show little of their place along the row."""
    found = fitted(true_points(*errors_of(np.random.default_rng(0))), ANGLES[cameras], seed=seed, along_s=8.0)
    assert found.corrected == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_perfect_board_is_not_corrected_where_all_dots_stand_at_one_place_within_their_lenses(seed):
    """Dots are five lenses apart along both directions, to a camera that looks along z."""
    board = DotBoard(dots=(5, 5), spacing_mm=0.5, diameter_mm=0.1, planes_mm=(-1.0, -0.5, 0.0, 0.5, 1.0))
    none = np.zeros((len(board.planes_mm), 6)), np.zeros((board.size, 2))
    assert fitted(true_points(*none, board), (0.0,), seed=seed, board=board).corrected == ()


@pytest.mark.slow(but="two cameras-aberrated")
@pytest.mark.parametrize("optics", ["ideal", "aberrated"])
@pytest.mark.parametrize("cameras", ANGLES)
@pytest.mark.parametrize("dots_mm", [0.0, 0.005])
def test_planes_and_dots_are_found_and_the_lens_is_not(cameras, optics, dots_mm):
    true = true_points(*errors_of(np.random.default_rng(4), stage_mm=0.03, tilt=0.003, dots_mm=dots_mm))
    found = fitted(true, ANGLES[cameras], optics)
    assert {"depth", "shift"} <= set(found.corrected)
    assert ("dots" in found.corrected) == (dots_mm > 0)
    stated = BOARD.of_dots_mm(np.arange(len(true)))
    assert np.sqrt(((stated - true) ** 2).mean()) > 0.015
    assert (left_mm(found, true) < LEFT_MM[len(ANGLES[cameras])] + LEFT_SHARE * dots_mm).all()


@pytest.mark.parametrize("wrong", [0, 10])
def test_depths_lie_within_their_standard_errors(wrong):
    """Ten of 216 dots of each camera carry the label of another place."""
    plane, dots = errors_of(np.random.default_rng(2), stage_mm=0.02)
    found = fitted(true_points(plane, dots), ANGLES["two cameras"], wrong=wrong)
    line = np.stack([np.ones(len(plane)), BOARD.planes_mm], axis=1)
    for component in range(3):
        error = found.plane[:, component] - plane[:, component]
        error -= line @ np.linalg.lstsq(line, error, rcond=None)[0]
        assert (np.abs(error) < SIGMAS * found.plane_std[:, component]).all()
        assert found.plane_std[:, component].max() < 1e-3


def test_a_moved_scaled_or_sheared_world_is_not_observable():
    points = true_points(*errors_of(np.random.default_rng(0)))
    sheared = points @ np.array([[1, 0, 0], [0, 1, 0], [0.01, -0.02, 1.02]])
    moved = Rotation.from_rotvec([0.002, -0.001, 0.003]).apply(sheared) + (0.05, -0.03, 0.1)
    found = fitted(moved, ANGLES["two cameras"])
    assert found.corrected == ()


def test_one_plane_far_off_leaves_the_others_where_they_are():
    plane, dots = errors_of(np.random.default_rng(0))
    plane[2, 2] = 0.12
    found = fitted(true_points(plane, dots), ANGLES["two cameras"])
    assert np.abs(found.plane[:, :3] - plane[:, :3]).max() < 2e-3
    with warn.collected() as warnings:
        checks.check_board(found, BOARD, 0.1, Path("experiment.toml"))
    (warning,) = warnings
    assert warning.code is Code.PLANE_OFF
    assert "plane 2 of the board stands at z = -0.180 mm, not at -0.3 mm" in warning.sentence


@pytest.mark.parametrize("wrong", range(4))
def test_one_of_four_planes_off_leaves_the_others_where_they_are(wrong):
    """Three planes outvote it. The others were moved by up to half of its error, with the depth of all vectors."""
    board = DotBoard(dots=(6, 6), spacing_mm=0.8, diameter_mm=0.1, planes_mm=(-0.8, -0.2, 0.4, 0.9))
    plane = np.zeros((4, 6))
    plane[wrong, 2] = 0.15
    found = fitted(true_points(plane, np.zeros((board.size, 2)), board), ANGLES["two cameras"], board=board)
    assert np.abs(found.plane[:, :3] - plane[:, :3]).max() < 4e-3


def test_a_plane_that_no_stage_tilts_is_refused():
    """Rays bent at the surface of a liquid, which one camera cannot tell from a tilt, left 0.6 pitch unseen."""
    plane, dots = errors_of(np.random.default_rng(0))
    plane[1, 4] = np.radians(6)
    found = fitted(true_points(plane, dots), ANGLES["two cameras"])
    with pytest.raises(InputError, match=r"experiment.toml: board.planes_mm: .* plane 1 .* tilted by [56]\.\d degrees"):
        checks.check_board(found, BOARD, 0.1, Path("experiment.toml"))


def test_the_image_of_another_plane_is_not_taken_for_an_error_of_the_stage():
    """The plane is left where it is stated, so that its dots disagree with their neighbours and are left out."""
    plane, dots = errors_of(np.random.default_rng(0))
    plane[2, 2] = 0.5
    found = fitted(true_points(plane, dots), ANGLES["two cameras"])
    assert not found.plane[2].any() and np.isnan(found.plane_std[2]).all()
    assert np.abs(found.plane[:, :3]).max() < 2e-3


@pytest.mark.parametrize(("dots", "planes"), [((6, 6), (-0.8, 0.8)), ((2, 2), (-0.8, 0.0, 0.8))])
def test_too_few_planes_or_dots_are_used_as_stated(dots, planes):
    board = DotBoard(dots=dots, spacing_mm=0.8, diameter_mm=0.1, planes_mm=planes)
    errors = 0.02 * np.random.default_rng(1).standard_normal((len(planes), 6)) * (1, 1, 1, 0, 0, 0)
    found = fitted(true_points(errors, np.zeros((board.size, 2)), board), ANGLES["two cameras"], board=board)
    assert found.corrected == () and not found.plane.any()
    assert np.isnan(found.plane_std).all()
