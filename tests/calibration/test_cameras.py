"""Calibration as a whole: the mapping against true rays, files read back, and warnings."""

import dataclasses
import json
import logging
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
from lightfield.test_lens_array import basis_of, render
from scipy import ndimage
from support.calibration_scene import CALIBRATION_SCENE as SCENE
from support.calibration_scene import MAPPING_AIM_PITCH, MAPPING_PITCH, mean_error_pitch, rays_in
from support.ideal_rig import rotation
from threadpoolctl import threadpool_info, threadpool_limits

import lfpiv
from lfpiv import warn
from lfpiv.calibration import checks, contradictions, coverage
from lfpiv.calibration.board import hypotheses
from lfpiv.calibration.board.board import agreeing_dots
from lfpiv.calibration.coverage import warn_outside
from lfpiv.calibration.measured_camera import input_errors
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.image_checks import APERTURE, microimage_px, stated_px
from lfpiv.runs import summary
from lfpiv.simulation.flows import Ring, window_mean
from lfpiv.simulation.scene import true_mapping
from lfpiv.simulation.simulator import simulate
from lfpiv.warn import Code

LABEL_PITCH = 0.005  # mean error of the labels; measured: 0.0026
INTERIOR_VOXEL = 0.45  # the project's limit for the mean displacement error of interior vectors
FINITE = 0.95  # the project's limit for the part of grid points with a finite vector
CORRECTION_SHARE = 0.1  # difference of two samples of rays: voxel centres against the whole volume
PLANE_MM = 0.01  # the error of one plane's depth, as one camera sees it
ROUND_TRIP_MM = 1e-9  # rounding of a calibration read back


@pytest.fixture(scope="module")
def rig(tmp_path_factory, device):
    """A misaligned camera's experiment, its true description and its calibration."""
    folder = tmp_path_factory.mktemp("calibration")
    (folder / "scene.toml").write_text(SCENE)
    experiment = lfpiv.open_experiment(simulate(folder / "scene.toml", folder / "data"))
    spec = json.loads((folder / "data" / "truth" / "spec.json").read_text())["camera"][0]
    return experiment, spec, lfpiv.calibrate(experiment.path)  # from its file, as scripts do


def test_a_fault_of_the_program_is_not_called_wrong_input():
    """NumPy's errors of shapes and axes are kinds of ValueError, as InputError is."""
    for fault in (lambda: np.zeros(3).sum(axis=2), lambda: np.zeros(3) + np.zeros(2)):
        with pytest.raises(ValueError) as raised, input_errors("rig.toml"):
            fault()
        assert not isinstance(raised.value, lfpiv.InputError)
    with pytest.raises(lfpiv.InputError, match=r"rig\.toml: few dots"), input_errors("rig.toml"):
        raise lfpiv.InputError("few dots")
    with pytest.raises(lfpiv.InputError, match=r"rig\.toml: .*determine no camera"), input_errors("rig.toml"):
        np.linalg.inv(np.zeros((2, 2)))  # as dots in a line make it


def test_the_mapping_meets_the_true_rays(rig):
    experiment, spec, calibration = rig
    camera = calibration.cameras["only"]
    error = mean_error_pitch(camera, spec)
    assert error <= MAPPING_AIM_PITCH
    report = camera.report
    assert report.dots_found == report.dots_expected == 125
    assert report["dots_found"] == 125  # by name, as in the summary
    assert error / 3 < report.sigma_nor_test < 10 * error  # users see the order of the error
    ideal = lfpiv.thin_lens(experiment).cameras["only"]
    assert mean_error_pitch(ideal, spec) > 10 * MAPPING_PITCH  # nominal angles


def test_a_calibration_read_back_is_the_same(rig, tmp_path):
    _, _, calibration = rig
    calibration.save(tmp_path / "calibration.h5")
    again = lfpiv.load_calibration(tmp_path / "calibration.h5").cameras["only"]
    camera = calibration.cameras["only"]
    points, pupil = rays_in([-1, -1, -1], [1, 1, 1], count=100)
    assert np.abs(again.map(points, pupil) - camera.map(points, pupil)).max() <= ROUND_TRIP_MM
    assert again.optics == camera.optics
    assert again.lattice == camera.lattice
    assert again.report == camera.report
    board = lfpiv.load_calibration(tmp_path / "calibration.h5").board
    assert board.to_json() == calibration.board.to_json()
    assert board.corrected == () and board.warnings == ()  # the board is perfect
    assert again.gain.tobytes() == camera.gain.tobytes()
    image = np.full(camera.optics.sensor_shape, 40.0)
    assert again.decoder.background(image) == camera.decoder.background(image)


def test_a_fan_of_rays_is_the_mapping(rig):
    _, _, calibration = rig
    camera = calibration.cameras["only"]
    points, pupil = rays_in([-1, -1, -1], [1, 1, 1], count=20)
    fan = camera.map_fan(points, pupil[:5])
    assert fan.shape == (20, 5, 2)
    for k in range(5):
        single = camera.map(points, np.repeat(pupil[k : k + 1], 20, axis=0))
        assert np.abs(fan[:, k] - single).max() <= 1e-5  # float32 of positions up to 2 mm after some sums


def test_thin_lens_is_direct_ray_tracing_at_the_nominal_angle(rig):
    experiment, _, _ = rig
    points, pupil = rays_in([-1, -1, -1], [1, 1, 1], count=200)
    for error, angle in ((0.0, -30.0), (1.0, -31.0)):  # Eqs. 11-12: every angle's magnitude is overestimated
        camera = lfpiv.thin_lens(experiment, angle_error_deg=error).cameras["only"]
        seen = points @ rotation(angle).T
        m = 200 / (200 - seen[:, 2:])
        expected = (1 - 200 / 100 + m) * pupil - m * seen[:, :2]
        assert np.abs(camera.map(points, pupil) - expected).max() <= ROUND_TRIP_MM


def test_a_volume_outside_the_board_is_warned_of_with_numbers(rig, caplog):
    _, _, calibration = rig
    with caplog.at_level(logging.WARNING):
        warn_outside(calibration, lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2, 2, 1.6), voxel_mm=0.1))
        camera = calibration.cameras["only"]
        fitted = dataclasses.replace(camera, region_mm=camera.region_mm * (1 - 1e-5))  # as a board's fit moves dots
        whole = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.2, 2.2, 1.6), voxel_mm=0.1)
        warn_outside(dataclasses.replace(calibration, cameras={"only": fitted}), whole)
        assert not caplog.records
        warn_outside(calibration, lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(4, 2, 1.6), voxel_mm=0.1))
    # 40 columns of voxels at -1.95 ... 1.95 mm; the board spans -1 ... 1 and half a voxel more, which holds 22 of them
    assert "only: 45 % of the volume lies outside" in caplog.text
    assert "by up to 0.90 mm" in caplog.text


def test_a_wrongly_named_dot_is_left_out(rig):
    _, _, calibration = rig
    dots = calibration.cameras["only"].dots
    rng = np.random.default_rng(0)
    departure = 0.0003 * rng.normal(size=dots.array_mm.shape) + 0.02 * dots.points_mm[:, :2] ** 2  # smooth distortion
    assert agreeing_dots(dots, departure, 0.1).all()
    wrong = dots.dot == dots.measured_dot[37]
    departure[wrong] += 0.5
    assert (agreeing_dots(dots, departure, 0.1) == ~wrong).all()


MISTAKES = {
    "planes": r"Set planes_mm = \[-",
    "unit": r"planes were 10 times as far apart as stated",
    "depths": r"planes were 0.1 times as far apart as stated",
    "angle": r'cameras? .only. are mirrored left to right .*Set image_flip = "horizontal"',
    "ordinary": r'Change the sign of nominal_angle_deg .*where x is meant.*board.axes = "left-handed"',
}


@pytest.mark.slow(but="angle")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_mistake_that_explains_the_board_is_named(rig, mistake):
    experiment, _, calibration = rig
    board, camera = experiment.board, experiment.cameras[0]
    turned = Orientation(-camera.orientation.yaw_deg)
    if mistake == "planes":
        board = board.model_copy(update={"planes_mm": tuple(-z for z in board.planes_mm)})
    elif mistake in ("unit", "depths"):
        stretch = {"unit": 0.1, "depths": 10.0}[mistake]
        board = board.model_copy(update={"planes_mm": tuple(stretch * z for z in board.planes_mm)})
    elif mistake == "angle":
        camera = dataclasses.replace(camera, orientation=turned)
    else:  # the stored pictures are read as they are, as if a flip had made them so
        camera = dataclasses.replace(camera, orientation=turned, stated_flip="horizontal")
    wrong = dataclasses.replace(experiment, board=board, cameras=(camera,))
    decoder = calibration.cameras["only"].decoder
    aperture = {"unit": 1.4, "depths": 0.4}.get(mistake, 1.0)  # as a camera fitted to wrong depths shows it
    stretches = contradictions.likely_stretches(SimpleNamespace(pupil_scale=aperture))
    assert re.search(MISTAKES[mistake], contradictions.cause(wrong, lambda setup: decoder, lambda *_: None, stretches))


@pytest.mark.slow
def test_what_is_right_has_no_mistake(rig):
    experiment, _, calibration = rig
    decoder = calibration.cameras["only"].decoder
    for stretches in ([], contradictions.likely_stretches(None)):
        assert contradictions.cause(experiment, lambda setup: decoder, lambda *_: None, stretches) is None


def test_no_depths_are_doubted_where_the_dots_show_the_stated_aperture():
    for aperture in (0.75, 1.0, 1.1):  # a liquid shows the first
        assert not contradictions.likely_stretches(SimpleNamespace(pupil_scale=aperture))


@pytest.mark.slow
def test_a_board_that_no_such_camera_can_see_is_refused(rig):
    experiment, _, _ = rig
    camera = dataclasses.replace(experiment.cameras[0], orientation=Orientation(30.0))
    wrong = dataclasses.replace(experiment, cameras=(camera,))
    with pytest.raises(lfpiv.InputError, match="image_flip"):
        lfpiv.calibrate(wrong)


@pytest.mark.parametrize(
    ("direction", "seen"),
    [
        ((0, 0, 1), {(False, False)}),
        ((1, 0, 1), {(False, False), (True, False)}),  # upside down it looks the same
        ((0, 1, 1), {(False, False), (False, True)}),
        ((1, 1, 1), {(False, False), (True, False), (False, True), (True, True)}),
    ],
)
def test_mirrors_that_the_dots_of_a_camera_show(direction, seen):
    tried = hypotheses.mistakes(Orientation.from_direction(direction), (0.0, 1.0))
    assert {(one.left_right, one.up_down) for one in tried} == seen
    assert tried[0] == hypotheses.RIGHT
    assert {one.planes for one in tried} == {"", "reversed", "negated"}


def test_a_flip_that_nothing_shows_is_asked_for(rig):
    experiment, _, _ = rig
    front = dataclasses.replace(experiment.cameras[0], orientation=Orientation(0.0), stated_flip=None)
    for stated, codes in ((None, [Code.FLIP_UNSTATED]), ("none", [])):
        camera = dataclasses.replace(front, stated_flip=stated)
        with warn.collected() as warnings:
            contradictions.warn_unstated(dataclasses.replace(experiment, cameras=(camera,)))
        assert [warning.code for warning in warnings] == codes


@pytest.mark.slow
@pytest.mark.parametrize("stated", [(6, 6), (8, 5), (4, 4)])
def test_a_board_stated_larger_or_smaller_than_it_is_is_refused(rig, stated):
    """An even number for an odd one shifts all dots by half a spacing, and no other check finds it."""
    experiment, _, _ = rig
    board = experiment.board.model_copy(update={"dots": stated})
    with pytest.raises(lfpiv.InputError, match=r"planes 0-4: 5 x 5.* Set dots = \[5, 5\]"):
        lfpiv.calibrate(dataclasses.replace(experiment, board=board))


def spoiled(experiment, folder, images):
    """The experiment with other images in some planes of its board."""
    shutil.copytree(experiment.path.parent, folder)
    for plane, image in images.items():
        tifffile.imwrite(folder / experiment.board_path("only", plane).relative_to(experiment.path.parent), image)
    return lfpiv.open_experiment(folder / experiment.path.name)


@pytest.mark.slow
def test_planes_without_dots_are_named_and_left_out(rig, tmp_path, caplog):
    experiment, spec, _ = rig
    rng = np.random.default_rng(0)
    noise = [np.rint(40 + 3 * rng.standard_normal((400, 420))).astype(np.uint16) for _ in range(4)]
    with caplog.at_level(logging.WARNING):
        camera = lfpiv.calibrate(spoiled(experiment, tmp_path / "one", {2: noise[0]})).cameras["only"]
    assert "plane 2 of the board (z = 0 mm)" in caplog.text and "plane_02.tif" in caplog.text
    assert camera.report.dots_found_per_plane == [25, 25, 0, 25, 25]
    assert mean_error_pitch(camera, spec) <= MAPPING_AIM_PITCH
    with pytest.raises(lfpiv.InputError, match=r"dots in 2 planes or more, found them in 1 of 5.*plane_00\.tif"):
        lfpiv.calibrate(spoiled(experiment, tmp_path / "four", dict(enumerate(noise))))


def some_planes(experiment, *planes_mm):
    """The experiment with these depths of its first planes."""
    return dataclasses.replace(experiment, board=experiment.board.model_copy(update={"planes_mm": planes_mm}))


@pytest.mark.slow
def test_saturated_dots_are_left_out_with_a_dark_image_too(rig, tmp_path):
    """Dots are five times too bright. A subtracted dark image makes the saturated pixels differ."""
    experiment, spec, _ = rig
    rng = np.random.default_rng(0)
    bright = {}
    for plane in range(3):
        image = experiment.board_image("only", plane)
        level = np.median(image)
        bright[plane] = np.clip(np.rint(level + 5 * (image - level)), 0, 4095).astype(np.uint16)
    experiment = some_planes(spoiled(experiment, tmp_path / "data", bright), -0.8, -0.4, 0.0)
    dark = tmp_path / "dark.tif"
    tifffile.imwrite(dark, np.rint(level + 3 * rng.standard_normal((400, 420))).astype(np.uint16))
    setup = dataclasses.replace(experiment.cameras[0], dark_path=dark)
    camera = lfpiv.calibrate(dataclasses.replace(experiment, cameras=(setup,))).cameras["only"]
    assert mean_error_pitch(camera, spec, [-1, -1, -0.8], [1, 1, 0]) <= MAPPING_AIM_PITCH
    assert any(warning.code is Code.BOARD_SATURATED for warning in camera.warnings)


@pytest.mark.slow
def test_a_copied_board_image_is_refused_and_a_wrong_place_of_a_plane_is_named(rig, tmp_path):
    experiment, spec, _ = rig
    copy = experiment.board_image("only", 2).astype(np.uint16)
    with pytest.raises(lfpiv.InputError, match=r"plane_03\.tif.*found the same image as .*plane_02\.tif"):
        lfpiv.calibrate(spoiled(experiment, tmp_path / "data", {3: copy}))
    camera = lfpiv.calibrate(some_planes(experiment, -0.8, -0.4, 0.3, 0.4, 0.8)).cameras["only"]
    (text,) = (warning.sentence for warning in camera.warnings if warning.code is Code.PLANE_LEFT_OUT)
    assert "25 of 25 dots of plane 2" in text and "z = 0.3 mm" in text and "plane_02.tif" in text
    assert mean_error_pitch(camera, spec) <= MAPPING_AIM_PITCH  # without these dots
    found = lfpiv.calibrate(some_planes(experiment, -0.8, -0.4, 0.13, 0.4, 0.8))
    (warning,) = found.board.warnings
    assert warning.code is Code.PLANE_OFF and "plane 2 of the board" in warning.sentence
    assert abs(found.board.depth_mm[2]) < PLANE_MM
    camera = found.cameras["only"]
    assert camera.warnings == () and camera.report.dots_rejected == 0
    assert mean_error_pitch(camera, spec) <= MAPPING_PITCH
    assert camera.report.sigma_nor_stated > 10 * camera.report.sigma_nor_test  # the stage's part and the lens's


@pytest.mark.slow
def test_planes_whose_images_are_exchanged_are_named(rig, tmp_path):
    experiment, _, _ = rig
    one, other = (experiment.board_image("only", plane).astype(np.uint16) for plane in (1, 2))
    with pytest.raises(lfpiv.InputError, match=r"plane_02\.tif.*planes 1 and 2 come into focus in each other's place"):
        lfpiv.calibrate(spoiled(experiment, tmp_path / "data", {1: other, 2: one}))


def test_an_angle_in_radians_is_shown_beside_the_fitted_one(rig):
    experiment, _, calibration = rig
    setup = dataclasses.replace(experiment.cameras[0], orientation=Orientation(np.radians(-30.0)))
    with warn.collected() as found:
        checks.compare_with_nominal(setup, calibration.cameras["only"].baseline, 0.0)
    assert found[0].code is Code.TURNED and "at -0.523599°; its axis stands in the direction" in found[0].sentence


def test_few_dots_and_a_poor_mapping_are_warned_of(rig):
    """Six training dots have many labels, but contribute only the values of six ray models."""
    experiment, _, calibration = rig
    camera = calibration.cameras["only"]
    assert camera.warnings == ()
    for training_dots, sigma, expected in ((88, 0.004, []), (6, 0.09, ["72 values for its 162", "0.090 pitch off"])):
        quality = dataclasses.replace(camera.report, sigma_nor_test=sigma)
        with warn.collected() as found:
            checks.check_mapping(experiment.cameras[0], quality, camera.network, "lens_integral", training_dots)
        assert all(part in warning.sentence for part, warning in zip(expected, found, strict=True))


def test_dots_whose_light_stays_within_a_microlens_are_warned_of(rig):
    """Small dots in focus, at the middles of microlenses; half a pitch away, or larger, they light two of them."""
    experiment, _, _ = rig
    setup, optics = experiment.cameras[0], experiment.cameras[0].optics
    pitch_mm = optics.microlens_pitch_mm
    lattice = LensLattice(origin_mm=(0.0, 0.0), basis_mm=((pitch_mm, 0.0), (0.0, pitch_mm)))
    lens = lfpiv.thin_lens(experiment).cameras["only"].baseline
    spacing_mm = 2 * pitch_mm / abs(optics.magnification)

    def told(diameter_pitches, *, shift_pitches=0.0):
        places = spacing_mm * np.stack(np.meshgrid(*[np.arange(-3, 4)] * 2), -1).reshape(-1, 2)
        places = places + shift_pitches * spacing_mm / 2
        facing = places @ rotation(-30.0)[:2]  # in the plane in focus of a camera at -30 degrees
        dots = SimpleNamespace(points_mm=facing, diameter_mm=diameter_pitches * spacing_mm / 2)
        with warn.collected() as found:
            checks.check_dot_size(setup, dots, lens, lattice)
        return [warning.code for warning in found]

    assert told(0.6) == [Code.SMALL_DOTS]
    assert told(0.6, shift_pitches=0.5) == told(1.4) == []


@pytest.mark.parametrize(
    ("pitch_px", "layout", "fill", "blur", "dark"),
    [
        (12.5, "square", 1.0, 1.0, False),
        (12.6, "square", 0.5, 0.6, False),
        (12.6, "square", 1.1, 0.7, True),
        (23.3, "hexagonal", 0.85, 1.5, False),
        (9.1, "hexagonal", 1.0, 1.0, True),
        (7.0, "square", 0.75, 0.5, False),
        (18.25, "square", 0.18, 0.6, True),
        (10.0, "hexagonal", 0.3, 0.6, False),
    ],
)
def test_the_white_image_shows_the_diameter_of_the_microimages(pitch_px, layout, fill, blur, dark):
    """The stated aperture does not matter, nor do dead lenses and vignetting."""
    rng = np.random.default_rng(4)
    side, level = max(220, int(14 * pitch_px)), 100
    lenses = {"brightness": lambda centres: (rng.random(len(centres)) > 0.03) * (1.2 - centres[:, 0] / side)}
    basis = basis_of(pitch_px, 0.4, layout)
    light = render((side, side), np.array([side / 2, side / 2]), basis, fill * pitch_px, **lenses)
    white = rng.normal(level + 1500 * ndimage.gaussian_filter(light, blur), 5)
    capped = np.full(white.shape, float(level)) if dark else None
    for stated in (0.85, 1.0, 1.15, 1.4):
        pixel_mm = 0.1 / pitch_px
        optics = Optics(
            focal_length_mm=100, magnification=-1, f_number=100 * 0.8 / 200 / (stated * fill * 0.1),
            microlens_pitch_mm=0.1 / 1.004, microlens_focal_length_mm=0.8, pixel_mm=pixel_mm,
            sensor_shape=white.shape, layout=layout,
        )  # fmt: skip
        origin = optics.sensor_mm(np.array([side / 2, side / 2])) / 1.004
        vectors = tuple(map(tuple, basis * pixel_mm / 1.004))
        lattice = LensLattice(origin_mm=tuple(origin), basis_mm=vectors, layout=layout)
        decoder = LightFieldDecoder.from_white(optics, lattice, white, capped)
        assert stated_px(optics) == pytest.approx(stated * fill * pitch_px)
        wrong = microimage_px(white, capped, decoder) / (fill * pitch_px) - 1
        assert abs(wrong) < APERTURE  # the right optics raise no warning


def test_a_wrong_f_number_is_refused_or_warned_of(rig):
    experiment, _, _ = rig

    def with_f_number(number):
        setup = experiment.cameras[0]
        optics = dataclasses.replace(setup.optics, f_number=number)
        wrong = dataclasses.replace(experiment, cameras=(dataclasses.replace(setup, optics=optics),))
        return lfpiv.thin_lens(wrong).cameras["only"].warnings

    assert with_f_number(4.0) == ()
    (warning,) = with_f_number(3.6)
    assert re.search(r"not 13\.9 px as f_number = 3\.6 .*; f_number = (3\.9\d|4|4\.0\d) would fit", warning.sentence)
    for number in (0.4, 2.8, 5.6):
        with pytest.raises(lfpiv.InputError, match="white"):
            with_f_number(number)


@pytest.mark.slow
def test_small_microimages_leave_enough_pixels(rig, tmp_path):
    """Microimages at f/8 are six pixels wide."""
    small = SCENE.replace("f_number = 4.0", "f_number = 8.0").replace("[-0.8, -0.4, 0.0, 0.4, 0.8]", "[-0.8, 0.0, 0.8]")
    (tmp_path / "scene.toml").write_text(small)
    experiment = lfpiv.open_experiment(simulate(tmp_path / "scene.toml", tmp_path / "data"))
    spec = json.loads((tmp_path / "data" / "truth" / "spec.json").read_text())["camera"][0]
    camera = lfpiv.calibrate(experiment).cameras["only"]
    assert camera.report.dots_found >= 0.9 * 75
    points, pupil = rays_in([-1, -1, -0.8], [1, 1, 0.8], radius=6.25)
    miss = np.linalg.norm(camera.map(points, pupil) - true_mapping(spec)(points, pupil), axis=1)
    assert miss.mean() / 0.1 <= MAPPING_AIM_PITCH


def test_the_image_of_a_plane_that_lies_beside_the_white_image_is_named(rig, tmp_path):
    experiment, _, _ = rig
    beside = np.roll(experiment.board_image("only", 1).astype(np.uint16), 3, axis=1)
    with pytest.raises(lfpiv.InputError, match=r"plane_01\.tif.*light lies 3\.. px.*Only plane 1 does not fit"):
        lfpiv.calibrate(spoiled(experiment, tmp_path / "data", {1: beside}))


@pytest.mark.parametrize("noise", [0, 20])
def test_a_plane_that_shows_the_image_of_another_is_named(rig, tmp_path, noise):
    experiment, _, _ = rig
    image = experiment.board_image("only", 1)
    again = np.rint(1.1 * image + noise * np.random.default_rng(1).random(image.shape)).astype(np.uint16)
    with pytest.raises(lfpiv.InputError, match=r"plane_03\.tif.*plane 3 shows, but for noise, what plane 1 shows"):
        lfpiv.calibrate(spoiled(experiment, tmp_path / "data", {3: again}))


def test_particle_images_in_place_of_boards_are_refused(rig, tmp_path):
    experiment, _, _ = rig
    frames = [experiment.particle_image("only", 0, frame).astype(np.uint16) for frame in "ab"]
    wrong = {plane: frames[plane % 2][:: 1 - 2 * (plane // 2 % 2), :: 1 - 2 * (plane // 4)] for plane in range(5)}
    with pytest.raises(lfpiv.InputError, match="board images"):
        lfpiv.calibrate(spoiled(experiment, tmp_path / "data", wrong))


def test_a_volume_that_the_calibrated_camera_does_not_see_is_refused(rig, caplog):
    experiment, _, calibration = rig
    sees = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2, 2, 1), voxel_mm=0.1)
    assert coverage.seen_share(calibration.cameras["only"], sees) == 1
    beside = lfpiv.Grid.from_extent(centre_mm=(0, 4.0, 0), size_mm=(2, 2, 1), voxel_mm=0.1)
    with pytest.raises(
        lfpiv.InputError, match=r"around \(0, 4, 0\) mm that camera 'only', as calibrated, does not see"
    ):
        coverage.require_seen(experiment.path, calibration, beside)
    half = lfpiv.Grid.from_extent(centre_mm=(0, 2.2, 0), size_mm=(2, 2, 1), voxel_mm=0.1)
    with caplog.at_level(logging.WARNING):
        coverage.require_seen(experiment.path, calibration, half)
    assert "% of the volume" in caplog.text


def test_the_summary_gives_the_networks_correction_of_the_thin_lens(rig):
    experiment, _, calibration = rig
    camera = calibration.cameras["only"]
    points, pupil = rays_in([-1, -1, -0.6], [1, 1, 0.6], count=20_000)
    added = camera.map(points, pupil) - camera.baseline(points, pupil)
    expected = np.sqrt((added**2).sum(1).mean()) / camera.lattice.pitch_mm
    assert summary.network_correction(camera, experiment.grid) == pytest.approx(expected, rel=CORRECTION_SHARE)
    assert summary.network_correction(lfpiv.thin_lens(experiment).cameras["only"], experiment.grid) is None


def test_wrong_arguments_are_named(rig, tmp_path):
    experiment, _, calibration = rig
    for angle in (np.nan, np.inf):
        with pytest.raises(ValueError, match="angle_error_deg: expected a finite angle"):
            lfpiv.thin_lens(experiment, angle_error_deg=angle)
    with pytest.raises(ValueError, match="angle_deg: expected a finite"):
        thin_lens_model(calibration.cameras["only"].optics, np.nan)
    with pytest.raises(ValueError, match=r"expected shapes \(n, 3\) and \(n, 2\)"):
        calibration.cameras["only"].map(np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(lfpiv.InputError, match="could not read it"):
        lfpiv.load_calibration(tmp_path / "missing.h5")
    (tmp_path / "damaged.h5").write_bytes(b"no calibration")
    with pytest.raises(lfpiv.InputError, match=r"damaged one \(it has no seal.*\)\. Calibrate again"):
        lfpiv.load_calibration(tmp_path / "damaged.h5")


@pytest.mark.slow
@pytest.mark.sample_data
def test_the_sample_experiment_reaches_the_projects_figures(sample_data, tmp_path, device, brief_run):
    """Compare labels and mapping of the sample data with the true rays, and the vectors with the true flow."""
    import xarray as xr

    folder = sample_data / "ring-vortex-2cam"
    summary = lfpiv.run(folder / "experiment.toml", tmp_path, pairs=(0, 1), device=device.kind)
    spec = json.loads((folder / "truth" / "spec.json").read_text())
    calibration = lfpiv.load_calibration(tmp_path / "calibration.h5")
    for truth in spec["camera"]:
        camera = calibration.cameras[truth["name"]]
        dots = camera.dots
        assert (dots.found == 49).all()
        off = np.linalg.norm(dots.array_mm - true_mapping(truth)(dots.points_mm, dots.pupil_mm), axis=1) / 0.1
        assert off.mean() < LABEL_PITCH and np.percentile(off, 99) < 8 * LABEL_PITCH
        assert mean_error_pitch(camera, truth, [-3, -3, -2], [3, 3, 2]) <= MAPPING_AIM_PITCH
        assert summary["calibration"][truth["name"]]["sigma_nor_test"] <= 0.03
    vectors = xr.open_dataset(tmp_path / "vectors" / "pair_0000.nc")
    flow = Ring(**spec["flow"])
    z, y, x = np.meshgrid(vectors.z, vectors.y, vectors.x, indexing="ij")
    window_mm = 0.1 * json.loads(vectors.attrs["settings"])["windows"][-1][0]
    expected = window_mean(flow, np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), window_mm) / 0.1
    measured = np.stack([vectors[f"displacement_{axis}"].values.ravel() for axis in "xyz"], axis=1)
    error = np.linalg.norm(measured - expected, axis=1).reshape(z.shape)
    assert np.isfinite(measured).all(1).mean() >= FINITE
    assert error[1:-1, 1:-1, 1:-1].mean() <= INTERIOR_VOXEL
    for name, axis in (("u", "x"), ("v", "y"), ("w", "z")):
        metres = vectors[f"displacement_{axis}"].values * 0.1e-3 / spec["dt_s"]
        assert np.allclose(vectors[name].values, metres, rtol=1e-5)
        assert vectors[name].attrs["units"] == "m/s"


@pytest.mark.parametrize("calibrate", [lfpiv.calibrate, lfpiv.thin_lens])
def test_blas_takes_one_thread_whatever_it_may_take_outside(tiny_experiment, monkeypatch, calibrate):
    """Sums of BLAS depend on its number of threads: a script and a run on another machine must agree."""
    seen = []

    def read_image(*_):
        seen.extend(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")
        raise KeyboardInterrupt

    experiment = lfpiv.open_experiment(tiny_experiment)
    monkeypatch.setattr(Experiment, "white", read_image)
    with threadpool_limits(2, "blas"), pytest.raises(KeyboardInterrupt):
        calibrate(experiment)
    assert seen and set(seen) == {1}
