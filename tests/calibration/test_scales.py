"""Scales of the board: a wrong spacing and a wrong stage are told apart; right ones raise nothing."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.ideal_rig import optics

from lfpiv import warn
from lfpiv.calibration.bundle.dot_rays import CameraLabels
from lfpiv.calibration.scales import check_scales
from lfpiv.calibration.thin_lens_model import fit_thin_lens, thin_lens_model
from lfpiv.warn import Code

SCALE = 0.002
"""Accuracy of the scales with labels of 0.005 pitch."""


def labels(angle_deg, stated):
    """Labels of a camera at an angle; `stated` are the stated over the true lengths along x, y and z."""
    camera, rng = optics(), np.random.default_rng(3)
    x, y, z = np.meshgrid(*(np.linspace(-1.5, 1.5, 5),) * 2, np.linspace(-1, 1, 5))
    points = np.repeat(np.stack([x, y, z], -1).reshape(-1, 3), 8, axis=0)
    pupil = rng.normal(0, camera.pupil_radius_mm / 3, (len(points), 2))
    array = thin_lens_model(camera, angle_deg)(points, pupil) + rng.normal(0, 5e-4, pupil.shape)
    points = points * stated
    dots = SimpleNamespace(points_mm=points, pupil_mm=pupil, array_mm=array, dot=np.arange(len(points)) // 8)
    lens = fit_thin_lens(points, pupil, array, camera)
    return CameraLabels(dots=dots, lens=lens, pupil_radius_mm=camera.pupil_radius_mm, pitch_mm=0.1)


def told(angles, stated):
    cameras = tuple(SimpleNamespace(optics=optics()) for _ in angles)
    experiment = SimpleNamespace(cameras=cameras, board=SimpleNamespace(spacing_mm=0.75))
    with warn.collected() as warnings:
        check_scales(experiment, [labels(angle, stated) for angle in angles])
    return warnings


@pytest.mark.parametrize("angles", [(45.0, -45.0), (30.0, 5.0)])
def test_right_scales_raise_nothing(angles):
    assert not told(angles, (1, 1, 1))


@pytest.mark.parametrize(("wrong", "angles"), [(1.08, (40.0, -40.0)), (0.93, (-45.0,)), (0.8, (40.0, -40.0))])
def test_the_scale_of_the_stage_is_told(wrong, angles):
    (warning,) = told(angles, (1, 1, wrong))
    assert warning.code is Code.SCALES and "scale of the stage" in warning.sentence
    assert warning.figures["planes"] == pytest.approx(1 / wrong - 1, abs=SCALE)
    assert abs(warning.figures["dots"]) < SCALE < warning.figures["planes_std"]


def test_a_wrong_spacing_of_the_dots_is_told():
    (warning,) = told((40.0, -40.0), (0.967, 0.967, 1))
    assert f"board.spacing_mm = {0.75 / 0.967:.4g}" in warning.sentence
    assert warning.figures["dots"] == pytest.approx(1 / 0.967 - 1, abs=SCALE)


def test_cameras_along_z_tell_nothing():
    assert not told((0.0,), (1, 1, 1.08))
