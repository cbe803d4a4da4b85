"""Results on the page: a first picture, planes, surfaces, and the script that draws what is seen."""

import asyncio
import json
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from selenium.webdriver.common.keys import Keys
from support.report_run import field
from support.studio_page import served, until

from lfpiv.results import netcdf
from lfpiv.warn import Code, Warning

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


@pytest.mark.slow
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


def test_fewer_arrows_and_shorter_lines_are_drawn_while_something_moves(results):
    import lfpiv
    from lfpiv.studio import layers, look

    grid = layers.grid_of(layers.field_at(lfpiv.open_results(results), "0"))
    assert layers.arrows(grid, 1, 1.5, "u", moving=True).n_points <= layers.arrows(grid, 1, 1.5, "u").n_points
    picture, seen = look.Picture.empty((80, 60)), look.Look(lines=60)
    drawn, points = [], []
    for moving in (True, True, False, True):
        picture.show(grid, seen, {}, "", moving)
        drawn.append(picture.plotter.actors["lines"])
        points.append(drawn[-1].mapper.dataset.n_points)
    assert drawn[0] is drawn[1] and drawn[2] is drawn[3]  # what is at rest stays where nothing else is asked for
    assert 0 < points[0] < points[2]


def test_results_are_built_before_other_tabs_and_stresses_can_be_chosen(results, tmp_path, monkeypatch):
    from lfpiv.studio import delivery, page

    monkeypatch.setattr("lfpiv.studio.runs_tab.LOOK_EVERY_S", 60)
    monkeypatch.setattr(delivery, "SENT", asyncio.Event())
    shutil.copytree(results / "vectors", tmp_path / "vectors")
    summary = {"warning_records": [Warning(code=Code.ONE_CAMERA).to_json()]}
    (tmp_path / "summary.json").write_text(json.dumps(summary), "utf-8")

    async def until_so(condition):
        while not condition():
            await asyncio.sleep(0.01)

    async def see():
        server = page.opened()
        server.state.ready()  # as a server that listens
        state, filling = server.state, asyncio.ensure_future(page.fill(server, tmp_path, []))

        def built():
            return [name for name in page.TABS if state[f"trame__template_{name}"]]

        await until_so(lambda: state.tab)
        await asyncio.sleep(0.2)
        assert built() == ["results"] and state.tab == "results"
        delivery.SENT.set()  # the page has the first picture
        await filling
        assert built() == list(page.TABS)
        assert [card["code"] for card in state.p_warnings] == ["one_camera"]  # of results that are opened

        await until_so(lambda: state.r_facts)
        assert "vectors are valid" in state.r_facts[0] and state.r_facts[-1].startswith("speed [m/s] at (")
        with state:
            state.r_moment = "fluctuations"
        await until_so(lambda: state.r_colour == "turbulent_kinetic_energy" and not state.r_busy)
        listed = {field["value"]: field["title"] for field in state.r_fields}
        assert listed["uv"] == "uv [m²/s²]" and listed["u_rms"] == "u rms [m/s]"
        with state:
            state.r_colour = "uv"
        await until_so(lambda: any(fact.startswith("uv [m²/s²] at (") for fact in state.r_facts))
        with state:
            state.r_moment = "0"
        await until_so(lambda: state.r_colour == "speed")

    asyncio.run(asyncio.wait_for(see(), 60))


def test_fields_are_read_and_derived_when_they_are_asked_for(results):
    import lfpiv
    from lfpiv.studio import layers

    vectors = layers.field_at(lfpiv.open_results(results), "0")
    grid, whole = layers.grid_of(vectors, ()), layers.grid_of(vectors)
    assert {"u", "v", "w", "valid", "velocity", "speed"} <= {
        *grid.array_names
    } and "q_criterion" not in grid.array_names
    layers.add_fields(grid, vectors, ["q_criterion", "peak_ratio", "no such field"])
    assert {*grid.array_names} <= {*whole.array_names} and "divergence" not in grid.array_names
    assert all(np.array_equal(grid[name], whole[name], equal_nan=True) for name in grid.array_names)


@pytest.fixture
def damaged(tmp_path):
    """Return results whose first file is no file of lfpiv, whose third has a wrong byte, and whose last is foreign."""
    folder = tmp_path / "vectors"
    for pair in range(5):
        others = {"settings": "others"} if pair == 4 else {}
        netcdf.write_vectors(field(pair), folder / f"pair_{pair:04d}.nc", attributes={"pair": pair, **others})
    (folder / "pair_0000.nc").write_bytes(b"no vectors")
    third = folder / "pair_0002.nc"
    content = bytearray(third.read_bytes())
    content[len(content) // 2] ^= 255
    third.write_bytes(content)
    return tmp_path


def test_a_bad_file_is_left_out_by_name(damaged):
    from lfpiv.results.reader import open_readable

    found, left_out = open_readable(damaged)
    assert found.pair.values.tolist() == [1, 3] and found["u"].notnull().any()
    assert {path.name: why.partition(", found ")[2][:9] for path, why in left_out.items()} == {
        "pair_0000.nc": "a damaged", "pair_0002.nc": "a damaged", "pair_0004.nc": "settings ",
    }  # fmt: skip


@pytest.mark.browser
def test_bad_files_have_cards_and_the_others_are_shown(damaged, browser):
    with served(damaged) as address:
        browser.get(address)
        shown = f"const i = document.querySelector('{VIEW}'); return !!i && i.naturalWidth > 50"
        until(lambda: browser.execute_script(shown))
        cards = [card.text for card in browser.find_elements("css selector", "#tab-results .lf-left")]
        assert [text.partition(" ")[0] for text in cards] == ["pair_0000.nc", "pair_0002.nc", "pair_0004.nc"]


@pytest.mark.slow
@pytest.mark.browser
def test_a_file_that_is_damaged_behind_its_head_is_left_out_of_the_mean(results, tmp_path, browser):
    folder = tmp_path / "run"
    shutil.copytree(results / "vectors", folder / "vectors")
    shutil.copy(folder / "vectors" / "pair_0001.nc", folder / "vectors" / "pair_0002.nc")
    bad = folder / "vectors" / "pair_0001.nc"
    content = bytearray(bad.read_bytes())
    content[len(content) // 2] ^= 255
    bad.write_bytes(content)
    with served(folder) as address:
        browser.get(address)
        until(lambda: browser.execute_script("return !!(window.trame && trame.state && trame.state.get('r_moments'))"))
        browser.execute_script("trame.state.set('r_moment', 'mean')")
        until(lambda: "pair_0001.nc" in browser.page_source)
        assert not browser.execute_script("return trame.state.get('message')")


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
        third = until(lambda: (now := browser.execute_script(shown)) != second and now)
        browser.find_element("css selector", "#tab-results .lf-view [tabindex]").send_keys(Keys.ARROW_UP)
        until(lambda: browser.execute_script(shown) != third)
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
