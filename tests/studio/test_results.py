"""Results on the page: a first picture, planes, surfaces, and the script that draws what is seen."""

import subprocess
import sys
import urllib.error
import urllib.request
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.report_run import field
from support.studio_page import served, until

from lfpiv.results import netcdf

SAME_PICTURE = 1.0
"""Largest mean difference of pictures by the same calls [grey level]: fonts may be a pixel apart."""

SAME_GREY = 4.0
"""The same for a picture with two thirds of the pixels: edges and letters are blurred."""

VIEW = "#tab-results .lf-view img"
"""The picture in the tab of results."""


@pytest.fixture(scope="session")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio") / "run <b>"
    for pair in range(2):
        netcdf.write_vectors(field(pair), folder / "vectors" / f"pair_{pair:04d}.nc", attributes={"pair": pair})
    return folder


def test_a_surface_has_its_level_and_a_plane_its_place(results):
    import lfpiv
    from lfpiv.studio import layers

    grid = layers.grid_of(layers.field_at(lfpiv.open_results(results), "0"))
    surface = layers.surface(grid, "u", 0.0, "u")
    assert surface.n_points and np.allclose(surface["u"], 0.0, atol=1e-6)
    plane = layers.slice_at(grid, "y", 0.1, "u")
    assert np.allclose(np.asarray(plane.points)[:, 1], 0.1)
    hidden = layers.trusted(grid, True, None)
    assert np.array_equal(np.isnan(hidden["u"]), grid["valid"] < 0.5) and hidden["valid"].min() == 0
    grid["uncertainty"] = np.arange(grid.n_points, dtype=np.float32)
    assert np.array_equal(np.isnan(layers.trusted(grid, False, 7.5)["uncertainty"]), grid["uncertainty"] > 7.5)


def test_a_pair_that_a_run_does_not_have_is_told(results):
    import lfpiv
    from lfpiv.studio import layers

    with pytest.raises(ValueError, match="pair 7: expected one of these results"):
        layers.field_at(lfpiv.open_results(results), "7")


def test_the_script_draws_what_is_seen(results, tmp_path):
    import cv2

    import lfpiv
    from lfpiv.studio import layers, look

    seen = look.Look(surface="u", level=0.001, arrows=1, slices=(0.1, None, 0.0), lines=10, colour="v", theme="dark")
    picture = look.Picture.empty((400, 300))
    picture.show(layers.grid_of(layers.field_at(lfpiv.open_results(results), "0")), seen, {}, "v [m/s]")
    image = picture.image()
    camera = [tuple(map(float, vector)) for vector in picture.plotter.camera_position]
    script = look.script(seen, [str(results)] * 2, "v [m/s]", camera, (400, 300))
    (tmp_path / "script.py").write_text(script, "utf-8")
    subprocess.run([sys.executable, "script.py"], cwd=tmp_path, check=True, capture_output=True)
    for name in ("picture.png", "picture1.png"):
        again = cv2.imread(str(tmp_path / name))[..., ::-1]
        assert image.std() > 10 and np.abs(again.astype(int) - image[..., :3]).mean() < SAME_PICTURE


@pytest.mark.browser
def test_the_page_shows_and_turns_results(results, browser):
    with served(results) as address:
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address.partition("?")[0])
        browser.get(address)
        shown = f"const i = document.querySelector('{VIEW}'); return i && i.naturalWidth > 50 ? i.src : ''"
        first = until(lambda: browser.execute_script(shown))
        assert browser.find_element("css selector", "#tab-results .lf-name").text == "run <b>"
        browser.find_element("id", "r-on-x").send_keys(" ")
        second = until(lambda: (now := browser.execute_script(shown)) != first and now)
        browser.find_element("id", "r-turn-left").click()
        until(lambda: browser.execute_script(shown) != second)
        browser.find_element("id", "r-copy").click()
        script = until(lambda: "".join(one.get_property("value") for one in browser.find_elements("id", "r-script")))
        assert "slices=(" in script and "camera_position" in script


def test_pictures_that_move_have_fewer_pixels_and_show_the_same():
    import pyvista as pv

    from lfpiv.studio import delivery, look

    picture = look.Picture.empty((1000, 800))
    picture.plotter.add_mesh(pv.Sphere(), color="red")
    picture.plotter.show_bounds()
    window, part = picture.plotter.render_window, SimpleNamespace(still_render=None, views_in_animations=[])
    part.get_view = lambda name: window
    delivery.send_at_once(SimpleNamespace(getLinkProtocols=lambda: [part]))

    def asked():
        image = part.still_render({"view": "1", "size": [1000, 800]})["image"]
        return image and cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)

    still = asked()
    window.lfpiv_moving = True
    moving = asked()
    assert still.shape == (800, 1000, 3) and moving.shape[0] * moving.shape[1] <= 1.01 * delivery.MOVING_PX
    assert tuple(window.GetSize()) == (1000, 800)  # what is taken along has all its pixels
    assert np.abs(cv2.resize(moving, (1000, 800)).astype(int) - still).mean() < SAME_GREY
    window.lfpiv_moving = False
    assert np.array_equal(asked(), still)
    part.views_in_animations.append("1")
    assert asked() is None  # nothing changed since
    picture.plotter.camera.Azimuth(20)
    assert asked() is not None
