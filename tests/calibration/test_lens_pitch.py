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


@pytest.mark.parametrize("wrong", [{}, {"pixel_mm": 0.0055}, {"microlens_pitch_mm": 0.109}], ids=str)
def test_a_wrong_pixel_size_or_lens_pitch_is_warned_of(tmp_path, wrong):
    """A tenth passes the search for the lattice, whose own tolerance is a fifth."""
    side, pitch_px = 300, 20.08
    light = render((side, side), np.array([150.0, 150.0]), basis_of(pitch_px, 0.4, "square"), 0.9 * pitch_px)
    white = np.random.default_rng(0).normal(100 + 1500 * ndimage.gaussian_filter(light, 0.7), 5)
    right = {"microlens_pitch_mm": 0.1, "pixel_mm": 0.005}
    optics = Optics(
        focal_length_mm=100, magnification=-1, f_number=4.4, microlens_focal_length_mm=0.8, sensor_shape=white.shape,
        **(right | wrong),
    )  # fmt: skip
    lattice = find_lens_array(white, None, nominal_pitch_px=optics.microimage_pitch_px, layout="square").lattice(optics)
    setup = CameraSetup(
        name="only", optics=optics, orientation=None, image_flip="none", white_path=tmp_path, dark_path=None
    )
    decoder = LightFieldDecoder.from_white(optics, lattice, white)
    with warn.collected() as found:
        checks.check_white(setup, white, None, decoder)
    sentences = [one.sentence for one in found if one.code is Code.LENS_PITCH]
    assert len(sentences) == bool(wrong)
    if wrong:
        (sentence,) = sentences
        assert "20.08 px apart" in sentence
        assert ("pixel_um = 5 or" if "pixel_mm" in wrong else "microlens_pitch_mm = 0.1 would fit") in sentence
