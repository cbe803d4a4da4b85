"""Boards in a liquid: calibrated as any other, and told; labels that contradict each other are still refused."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support import scenes
from support.calibration_scene import CALIBRATION_SCENE, MAPPING_PITCH, mean_error_pitch
from support.ideal_rig import optics

import lfpiv
from lfpiv.calibration import checks
from lfpiv.calibration.board.hypotheses import RIGHT, Mistake
from lfpiv.calibration.liquid import liquid_surface, mistake_in_liquid
from lfpiv.calibration.thin_lens_model import fit_thin_lens, thin_lens_model
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.geometry.orientation import Orientation
from lfpiv.simulation.scene import true_mapping
from lfpiv.simulation.scene_camera import SceneCamera
from lfpiv.simulation.simulator import simulate
from lfpiv.warn import Code, collected

OPTICS = optics(1000, 1200)
LABEL_MM = 0.0005
INDEX = 0.03  # the liquid's index, from depth and defocus with prior knowledge of the optics


def fitted_through(index):
    """Fit a thin lens to labels of a board behind a plane surface that faces the camera: its depth is z / index."""
    rng, camera = np.random.default_rng(0), thin_lens_model(OPTICS, 45.0)
    points = np.stack(np.meshgrid(*[np.linspace(-2, 2, 7)] * 2, np.linspace(-2, 2, 5)), -1).reshape(-1, 3).repeat(20, 0)
    pupil = rng.uniform(-8, 8, (len(points), 2))
    seen = points @ camera.rotation.T / (1, 1, index) @ camera.rotation
    array = camera(seen, pupil) + LABEL_MM * rng.standard_normal((len(points), 2))
    fitted = fit_thin_lens(points, pupil, array, OPTICS)
    return fitted, float(np.median(np.linalg.norm(array - fitted(points, pupil), axis=1))) / OPTICS.microlens_pitch_mm


class Setup:
    name, optics, orientation = "left", OPTICS, None


class HalfFound:
    found = np.array([60])
    expected = np.array([100])


class Of:
    path = "experiment.toml"


@pytest.mark.parametrize("index", [1.0, 1.333, 1.5])
def test_the_medium_is_told_and_is_no_reason_to_refuse(index):
    fitted, residual_pitch = fitted_through(index)
    checks.check_pupil(Of, Setup, HalfFound, fitted, residual_pitch)
    with collected() as warnings:
        checks.compare_with_nominal(Setup, fitted, residual_pitch)
    if index == 1:
        assert not warnings
        return
    (warning,) = warnings
    assert warning.code == Code.MEDIUM and warning.figures["index"] == pytest.approx(index, abs=INDEX)
    assert "refractive index 1." in warning.sentence


def test_labels_that_no_thin_lens_fits_are_refused():
    fitted, residual_pitch = fitted_through(1.0)
    other_pupil, far = replace(fitted, pupil_scale=0.3), 2 * checks.FITTED_PITCH  # as of planes in the wrong order
    with pytest.raises(lfpiv.InputError, match=r"60 of 100 dots were found.* 0\.30 times"):
        checks.check_pupil(Of, Setup, HalfFound, other_pupil, far)
    assert residual_pitch < checks.FITTED_PITCH


def tank(index, height_mm=20.0):
    """Return a window of 6 mm, normal to z, in front of a liquid."""
    window = {"point_mm": (0.0, 0.0, height_mm), "normal": (0.0, 0.0, 1.0)}
    return {"window": (window | {"thickness_mm": 6.0, "index": 1.49, "medium_index": index},)}


def labels_of(angle, window, depth=1.0):
    """Return labels and optics of a camera before a board whose planes stand at `depth` times the stated depths."""
    rng, count = np.random.default_rng(0), 20
    camera = SceneCamera.model_validate(scenes.camera("left", angle, (400, 400), true_pitch_deg=0.8, **window))
    points = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2, np.linspace(-0.8, 0.8, 5)), -1).reshape(-1, 3)
    points, radius = points.repeat(count, 0), camera.optics.pupil_radius_mm
    pupil = random_on_pupil(radius, len(points), rng)
    array = true_mapping(camera)(points * (1, 1, depth), pupil) + LABEL_MM * rng.standard_normal(pupil.shape)
    return SimpleNamespace(points_mm=points, pupil_mm=pupil, array_mm=array), camera.optics


def surface_of(angle, window, depth=1.0):
    """Look for a liquid's surface in these labels."""
    labels, optics = labels_of(angle, window, depth)
    lens = fit_thin_lens(labels.points_mm, labels.pupil_mm, labels.array_mm, optics)
    return liquid_surface(labels, lens, optics)


@pytest.mark.slow(but="30.0-1.333-20.0")
@pytest.mark.parametrize(
    ("angle", "index", "height_mm"),
    [(-40.0, 1.333, 20.0), (30.0, 1.333, 20.0), (45.0, 1.5, 20.0), (-40.0, 1.333, 60.0), (-45.0, 1.5, 60.0)],
)
def test_the_surface_of_a_liquid_that_a_camera_looks_through_obliquely_explains_its_labels(angle, index, height_mm):
    surface = surface_of(angle, tank(index, height_mm))
    assert surface.index == pytest.approx(index, abs=INDEX)
    assert surface.residual_pitch < 3 * LABEL_MM / OPTICS.microlens_pitch_mm


@pytest.mark.slow(but="window1")
@pytest.mark.parametrize(
    ("window", "depth"), [*(({}, depth) for depth in (1.0, 0.93, 0.5, 2.0, 10.0)), (tank(1.0), 1.0), (tank(1.333), 0.5)]
)
def test_no_liquid_is_found_in_air_whatever_the_scale_of_the_stage(window, depth):
    assert surface_of(-40.0, window, depth) is None


@pytest.mark.slow(but="mistake0")
@pytest.mark.parametrize("mistake", [Mistake(stretch=2.0), Mistake(left_right=True)])
def test_the_mistake_with_which_a_liquid_explains_the_labels_is_found(mistake):
    """Stated are half of the true depths, or the angle of a mirror image."""
    stated = Orientation(40.0 if mistake.left_right else -40.0)

    def dots_of(tried):
        return labels_of(-40.0, tank(1.333), mistake.stretch / tried.stretch)[0]

    tried = [RIGHT, Mistake(left_right=True), Mistake(stretch=0.5), Mistake(stretch=2.0)]
    optics = labels_of(-40.0, tank(1.333))[1]
    assert mistake_in_liquid(dots_of, tried, stated, optics) == mistake


@pytest.fixture(scope="module")
def in_water(tmp_path_factory):
    """Folder of a camera that looks obliquely into water."""
    folder = tmp_path_factory.mktemp("water")
    camera = scenes.camera("only", -40.0, (420, 400), true_yaw_deg=-42.0, **tank(1.333))
    more = {"particles": {"count": 10, "pairs": 1}, "displacement_mm": (0.05, 0, 0)}
    simulate(scenes.scene("tank", [camera], planes_mm=(-0.8, -0.4, 0.0, 0.4, 0.8), **more), folder)
    return folder


@pytest.mark.slow
def test_pictures_that_are_mirrored_in_water_are_told_as_such(in_water):
    """Three of the planes show it."""
    path, text = in_water / "mirrored.toml", (in_water / "experiment.toml").read_text("utf-8")
    for old, new in (
        ("nominal_angle_deg = -40", "nominal_angle_deg = 40"),
        ("[-0.8, -0.4, 0.0, 0.4, 0.8]", "[-0.8, -0.4, 0.0]"),
    ):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, "utf-8")
    with pytest.raises(lfpiv.InputError, match=r"mirrored left to right.*nominal_angle_deg has the wrong sign"):
        lfpiv.calibrate(path)


@pytest.mark.slow
def test_a_camera_that_looks_obliquely_into_water_is_calibrated(in_water):
    camera = lfpiv.calibrate(in_water / "experiment.toml").cameras["only"]
    (medium,) = camera.warnings
    assert medium.code is Code.MEDIUM
    assert medium.figures["index"] == pytest.approx(1.333, abs=INDEX)
    assert camera.report["dots_found"] == 5 * 25
    spec = json.loads((in_water / "truth" / "spec.json").read_text("utf-8"))["camera"][0]
    assert mean_error_pitch(camera, spec, *camera.region_mm) < MAPPING_PITCH


@pytest.mark.slow
def test_three_planes_in_water_are_not_taken_for_tilted(in_water):
    """What the surface bends looks like tilts of 4.8 degrees where few planes are compared with a thin lens in air."""
    path, text = in_water / "three.toml", (in_water / "experiment.toml").read_text("utf-8")
    path.write_text(text.replace("[-0.8, -0.4, 0.0, 0.4, 0.8]", "[-0.8, -0.4, 0.0]"), "utf-8")
    calibration = lfpiv.calibrate(path)
    assert calibration.board.corrected == ()
    assert calibration.cameras["only"].report["dots_found"] == 3 * 25


@pytest.mark.slow
def test_a_camera_that_looks_into_oil_is_calibrated(tmp_path, device):
    window = """
[camera.window]
point_mm = [-8.17, 0.0, 12.58]
normal = [-0.5446, 0.0, 0.8387]
thickness_mm = 3.0
index = 1.5
medium_index = 1.5
"""
    (tmp_path / "scene.toml").write_text(CALIBRATION_SCENE + window)
    experiment = lfpiv.open_experiment(simulate(tmp_path / "scene.toml", tmp_path / "data"))
    camera = lfpiv.calibrate(experiment).cameras["only"]
    spec = json.loads((tmp_path / "data" / "truth" / "spec.json").read_text())["camera"][0]
    assert [warning.code for warning in camera.warnings] == [Code.MEDIUM]
    assert mean_error_pitch(camera, spec) < MAPPING_PITCH
