"""Cards of warnings: the remedy, the image, and the page."""

import pytest

from lfpiv.warn import SENTENCES, Code, Warning


def test_a_stored_warning_names_image_and_region():
    from lfpiv.studio.warning_cards import card

    figures = {"top": 2, "bottom": 9, "left": 3, "right": 8, "others": "right"}
    warning = Warning(code=Code.DARK_PART, subject="left", figures=figures, pairs=(3,))
    found = card(warning.to_json() | {"text": warning.sentence}, ["right", "left"])
    assert found["place"] == {"camera": "left", "image": "pair 3, frame a", "region": [3, 2, 8, 9]}
    assert found["remedy"].startswith("Look at the particle images") and found["what"].endswith(
        "something stands before it."
    )


PAIR = "pair 4, frame b"


@pytest.mark.parametrize(
    ("warning", "image"),
    [
        (
            Warning(code=Code.SATURATED, subject="left, frame b", figures={"share": 0.2}, pairs=(4, 7)),
            "pair 4, frame b",
        ),
        (Warning(code=Code.EMPTY, subject="left, instant 5", figures={"structure": 0.1}), "instant 5"),
        (Warning(code=Code.PLANE_EMPTY, subject="left", figures={"plane": 2, "z_mm": 1.0, "path": "b.tif"}), "plane 2"),
        (Warning(code=Code.WHITE_SATURATED, subject="left", figures={"share": 0.1}), "white"),
        (Warning(code=Code.TONE_CURVE, subject="left, white image", figures={"exponent": 2.2}), "white"),
        (Warning(code=Code.TONE_CURVE, subject="left, plane 1", figures={"exponent": 2.2}), "plane 1"),
    ],
)
def test_a_line_of_the_log_names_the_same_as_the_stored_warning(warning, image):
    from lfpiv.studio.warning_cards import card

    stored = card(warning.to_json() | {"text": warning.sentence}, ["left"])
    logged = card({"text": warning.sentence}, ["left"])
    assert stored == logged and stored["place"]["image"] == image and stored["code"] == warning.code.value


def test_a_warning_about_no_camera_has_no_image():
    from lfpiv.studio.warning_cards import card

    assert card({"text": Warning(code=Code.ONE_CAMERA).sentence}, ["a", "one"])["place"] is None


def test_the_page_has_a_place_for_each_warning():
    from lfpiv.studio.warning_cards import page

    text = page("troubleshooting")
    assert all(f'id="{code.value}"' in text for code in SENTENCES if code is not Code.OTHER)
    assert page("no_such_page") is None and page("../README") is None
