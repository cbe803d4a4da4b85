"""What people see at the prompt: one screen of what matters, as text and as HTML, and public names only."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from support.ideal_rig import two_cameras
from support.public_names import public_modules

import lfpiv
from lfpiv import prompt
from lfpiv.lightfield.lens_array import LensArray

LINES, COLUMNS = 24, 200
"""One screen."""
NOTEBOOK = "_repr_html_"
"""Name under which notebooks look for the HTML of a value."""


def shown(value):
    """Text of a value after the checks that hold for all."""
    text, page = repr(value), getattr(value, NOTEBOOK)()
    assert len(text.splitlines()) <= LINES and max(map(len, text.splitlines())) <= COLUMNS
    words = " ".join(ElementTree.fromstring(page).itertext())
    for word in re.findall(r"\S+", text):
        assert word in words, word
    return text


@pytest.fixture(scope="module")
def small_weights():
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.0, 1.2, 0.8), voxel_mm=0.1)
    return lfpiv.build_weights(two_cameras(), grid)


def test_an_experiment_shows_its_cameras_volume_and_stated_settings(tiny_experiment):
    tiny_experiment.write_text(tiny_experiment.read_text("utf-8") + "\n[smart]\niterations = 8\n", "utf-8")
    text = shown(lfpiv.open_experiment(tiny_experiment))
    for part in ("'tiny': 2 cameras, 2 image pairs", "1 ms between frames", "8 x 12 x 16 voxels (z, y, x) of 0.05 mm"):
        assert part in text
    assert re.search(r"\[smart\] +iterations = 8$", text, re.MULTILINE) and "[correlation]" not in text
    assert re.search(r"right +56 x 40 +100 +-1 +4 +square, 100 um +-30 deg", text)


def test_a_calibration_shows_how_good_each_camera_is(small_run):
    calibration = lfpiv.load_calibration(small_run.out / "calibration.h5")
    text = shown(calibration)
    for name, camera in calibration.cameras.items():
        assert name in text and f"{camera.report.sigma_nor_test:.4f}" in text
        assert f"{camera.report.dots_found} of {camera.report.dots_expected}" in shown(camera)


def test_weights_show_their_voxels_and_forms(small_weights):
    text = shown(small_weights)
    assert "960 voxels on 2 cameras" in text and "8 x 12 x 10 (z, y, x) of 0.1 mm" in text and "-0.6 to 0.6 mm" in text
    for name, form in small_weights.forms.items():
        assert re.search(rf"^  {name} .*{form}$", text, re.MULTILINE)


def test_a_lens_array_shows_its_lattice():
    array = LensArray(
        centres_px=np.zeros((5000, 2)),
        index=np.zeros((5000, 2), int),
        origin_px=(3.0, 4.0),
        basis_px=((10.0, 0.0), (0.0, 10.0)),
        layout="square",
        rms_px=0.01,
        measured=4000,
        sensor_shape=(700, 800),
    )
    text = shown(array)
    assert "5,000 microimages, square" in text and "10.0000 pixel" in text and "over 4,000 microimages" in text


def test_html_is_escaped():
    card = prompt.Card("a < b", (("<i>", "&"),), (("<b>",), ("1 < 2",)))
    assert "".join(ElementTree.fromstring(card.html()).itertext()) == "a < b<i>&<b>1 < 2"


@pytest.mark.parametrize(("value", "text"), [(5e-5, "50 us"), (1e-3, "1 ms"), (2.0, "2 s"), (1e-10, "0.1 ns")])
def test_times_are_in_the_unit_that_people_use(value, text):
    assert prompt.seconds(value) == text


def test_the_package_shows_public_names_only():
    assert set(dir(lfpiv)) == {"__version__", *lfpiv.__all__, *public_modules()}
