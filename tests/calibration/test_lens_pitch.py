"""Pitch of the microlenses in the white image against the stated one."""

import numpy as np
import pytest
from lightfield.test_lens_array import basis_of, render
from scipy import ndimage

from lfpiv import warn
from lfpiv.calibration import checks
from lfpiv.experiment.experiment import CameraSetup
from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.lens_array import find_lens_array
from lfpiv.warn import Code


def warnings_of(white, path, wrong):
    """Return the warnings about a white image whose rig is stated with some keys wrong."""
    right = {"microlens_pitch_mm": 0.1, "pixel_mm": 0.005}
    optics = Optics(
        focal_length_mm=100, magnification=-1, f_number=4.4, microlens_focal_length_mm=0.8, sensor_shape=white.shape,
        **(right | wrong),
    )  # fmt: skip
    lattice = find_lens_array(white, None, nominal_pitch_px=optics.microimage_pitch_px, layout="square").lattice(optics)
    setup = CameraSetup(
        name="only", optics=optics, orientation=None, image_flip="none", white_path=path, dark_path=None
    )
    decoder = LightFieldDecoder.from_white(optics, lattice, white)
    with warn.collected() as found:
        checks.check_white(setup, white, None, decoder)
    return found


PITCH_PX = 20.08


def white_image(noise):
    side = 300
    light = render((side, side), np.array([150.0, 150.0]), basis_of(PITCH_PX, 0.4, "square"), 0.9 * PITCH_PX)
    return np.random.default_rng(0).normal(100 + 1500 * ndimage.gaussian_filter(light, 0.7), noise)


@pytest.mark.parametrize("wrong", [{}, {"pixel_mm": 0.0055}, {"microlens_pitch_mm": 0.109}], ids=str)
def test_a_wrong_pixel_size_or_lens_pitch_is_warned_of(tmp_path, wrong):
    """A tenth passes the search for the lattice, whose own tolerance is a fifth."""
    found = warnings_of(white_image(5), tmp_path, wrong)
    sentences = [one.sentence for one in found if one.code is Code.LENS_PITCH]
    assert len(sentences) == bool(wrong)
    if wrong:
        (sentence,) = sentences
        assert "20.08 px apart" in sentence
        assert ("pixel_um = 5 or" if "pixel_mm" in wrong else "microlens_pitch_mm = 0.1 would fit") in sentence


@pytest.mark.parametrize("gamma", [1, 2.2])
def test_a_white_image_behind_a_gamma_curve_is_named(tmp_path, gamma):
    stored = np.round(4095 * (np.round(white_image(20)) / 4095) ** (1 / gamma))
    curves = [one for one in warnings_of(stored, tmp_path, {}) if one.code is Code.TONE_CURVE]
    assert [one.subject for one in curves] == ["only, white image"] * (gamma > 1)
    assert all(abs(one.figures["exponent"] - gamma) < 0.1 for one in curves)
