"""The page as a person uses it in Chromium: pointer, handles, keyboard, a series that plays, a run that is stopped."""

import time

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from support.studio_page import served, until

pytestmark = pytest.mark.browser

FIRST_S, RUN_S = 60, 120
"""Longest time until images are decoded, and until a run has begun or ended [s]."""
SETTLED_S = 0.5
"""Time until a view has turned [s]."""
FOCUSED = """
return [...document.querySelectorAll(`#${arguments[0]} :is(input, button, select, textarea, a[href], [tabindex="0"])`)]
  .filter((part) => part.offsetParent && part.tabIndex >= 0 && !part.disabled).map((part) => {
    part.focus({focusVisible: true});
    const named = part.labels?.[0]?.textContent || part.ariaLabel || part.textContent.trim() || part.title;
    const by = document.getElementById(part.getAttribute('aria-labelledby'))?.textContent;
    const ring = part.closest('.v-field, .v-selection-control') || part;
    return {
      tag: part.outerHTML.slice(0, 90), name: (named || by || part.closest('[role=group]')?.ariaLabel || '').trim(),
      outlined: document.activeElement === part && getComputedStyle(ring).outlineStyle === 'solid',
    };
  });
"""
"""Script that moves the focus through a tab, and tells the name of each part and whether the focus is seen."""
PLACES = [(dx, dy) for dx in (60, 120, -60, 0, -120) for dy in (150, 190, 110, 230)]
"""Places beside the middle of the view where a handle may be taken [pixel]."""


@pytest.fixture(scope="module")
def page(small_run, tmp_path_factory, browser):
    """Open the studio on a small experiment and its results."""
    folder = tmp_path_factory.mktemp("page") / "rig"
    small_run.results(small_run.images(folder).parent / "results")
    with served(folder) as address:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape(1440, 900))
        browser.get(address)
        until(
            lambda: browser.execute_script("return !!(window.trame && trame.state && trame.state.get('tab'))"), FIRST_S
        )
        yield Page(browser, folder)
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def shape(width, height):
    return {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}


class Page:
    """The page, its state and its parts."""

    def __init__(self, browser, folder):
        self.browser, self.folder = browser, folder

    def get(self, name):
        return self.browser.execute_script(f"return trame.state.get('{name}')")

    def open(self, tab):
        def shown():
            if not self.get(f"trame__template_{tab}"):
                return False  # tabs are built one after the other
            self.browser.execute_script(f"trame.state.set('tab', '{tab}')")
            return any(part.is_displayed() for part in self.browser.find_elements("id", f"tab-{tab}"))

        until(shown, FIRST_S)

    def find(self, name):
        return self.browser.find_element("id", name)

    def click(self, name):
        self.browser.execute_script("arguments[0].scrollIntoView()", self.find(name))
        self.find(name).click()


def test_the_view_through_the_pupil_follows_the_pointer(page):
    page.open("images")
    until(lambda: page.get("i_pupil") and not page.get("i_busy"), FIRST_S)
    seen = "return trame.state.get('i_pupil').values.join()"
    before = page.browser.execute_script(seen)
    picture = page.browser.find_element("css selector", "#tab-images .lf-image canvas")
    ActionChains(page.browser).move_to_element_with_offset(picture, 3, 2).move_by_offset(5, 3).perform()
    until(lambda: page.browser.execute_script(seen) != before)
    assert "column" in page.browser.find_element("class name", "lf-readout").text
    assert {mark["kind"] for mark in page.get("i_marks")} >= {"circles", "arrows"}


def test_a_wall_is_dragged_and_its_numbers_reach_the_form(page):
    page.open("space")
    page.click("s-wall")
    point = "volume.solid.0.point_mm"
    before = until(lambda: page.get("x_texts").get(point))
    view = page.find("s-view")
    until(lambda: page.browser.execute_script("return !!document.querySelector('#s-view img')?.naturalWidth"), FIRST_S)
    for dx, dy in PLACES:
        page.click("s-look-volume")
        time.sleep(SETTLED_S)
        hold = ActionChains(page.browser).move_to_element_with_offset(view, dx, dy).click_and_hold()
        hold.move_by_offset(0, -20).pause(0.1).move_by_offset(0, -20).pause(0.1).release().perform()
        if page.get("x_texts")[point] != before:
            break
    until(lambda: page.get("x_texts")[point] != before, 5)
    page.open("experiment")
    until(lambda: f"+point_mm = {page.get('x_texts')[point]}" in page.get("x_diff"))  # the last numbers of the drag
    page.browser.execute_script("arguments[0].click()", page.find("x-undo"))
    until(lambda: point not in page.get("x_texts"))


def test_what_is_dragged_has_its_numbers_beside_it(page):
    page.open("space")
    page.browser.execute_script("trame.state.set('s_drag', 'volume')")
    field = until(
        lambda: page.find("s-volume.size_mm") if page.browser.find_elements("id", "s-volume.size_mm") else None
    )
    before = page.get("x_texts")["volume.size_mm"]
    field.send_keys(Keys.CONTROL + "a")
    field.send_keys("[0.5, 0.4, 0.3]" + Keys.ENTER)
    until(lambda: "+size_mm = [0.5, 0.4, 0.3]" in page.get("x_diff"))
    until(lambda: any("0.5 x 0.4 x 0.3 mm" in fact for fact in page.get("s_facts")))
    page.browser.execute_script("arguments[0].click()", page.find("x-undo"))
    until(lambda: page.get("x_texts")["volume.size_mm"] == before)


def test_sliders_have_names_and_move_by_keys(page):
    page.open("results")
    thumb = page.find("s-r_lines")
    assert thumb.accessible_name == "streamlines" and thumb.aria_role == "slider"
    thumb.send_keys(Keys.ARROW_RIGHT)
    until(lambda: page.get("r_lines") == 5)
    thumb.send_keys(Keys.HOME)
    until(lambda: page.get("r_lines") == 0)


@pytest.mark.parametrize("tab", ["images", "experiment", "space", "preview", "runs", "results"])
def test_all_that_takes_the_focus_has_a_name_and_shows_it(page, tab):
    page.open(tab)
    found = page.browser.execute_script(FOCUSED, f"tab-{tab}")
    assert len(found) > 4
    assert [item for item in found if not item["name"] or not item["outlined"]] == []


def test_a_warning_opens_the_image_in_which_it_is_seen(page):
    from lfpiv.studio import warning_cards

    text = "right, frame b, pair 0: rows 40 to 90, columns 20 to 60 show no particles where left would have them"
    figures = {"top": 40, "bottom": 90, "left": 20, "right": 60, "others": "left"}
    record = {"code": "dark_part", "subject": "right, frame b", "figures": figures, "pairs": [0], "text": text}
    page.browser.execute_script(
        "trame.state.set('p_warnings', arguments[0])", [warning_cards.card(record, ["left", "right"])]
    )
    page.open("runs")
    until(lambda: page.browser.find_elements("css selector", ".lf-see"))
    link = page.browser.find_element("css selector", "#tab-runs .lf-card a").get_property("href")
    page.browser.find_element("css selector", ".lf-see").send_keys(Keys.ENTER)
    until(lambda: page.get("tab") == "images" and page.get("i_name") == "pair 0, frame b", FIRST_S)
    until(lambda: page.get("i_camera") == "right" and len(page.get("i_region")) == 4)
    words = page.browser.execute_async_script("fetch(arguments[0]).then((a) => a.text()).then(arguments[1])", link)
    assert 'id="dark_part"' in words and link.endswith("#dark_part")


def test_a_mistake_is_told_as_one_types_and_the_keyboard_saves(page):
    page.open("experiment")
    page.browser.execute_script("trame.state.set('x_shown', [0])")
    field = until(lambda: page.find("x-dt_s") if page.browser.find_elements("id", "x-dt_s") else None)
    until(field.is_displayed)
    field.send_keys(Keys.CONTROL + "a")
    field.send_keys("-1")
    until(lambda: "expected a number above 0" in page.get("x_wrong").get("dt_s", ""))
    field.send_keys(Keys.CONTROL + "a")
    field.send_keys("0.002")
    until(lambda: not page.get("x_wrong") and page.get("x_changed"))
    page.find("x-save").send_keys(Keys.ENTER)
    until(lambda: not page.get("x_changed"))
    assert "dt_s = 0.002" in (page.folder / "experiment.toml").read_text("utf-8")


def test_a_file_with_a_slip_is_told_where_it_was_opened_and_leaves_no_other_form(page):
    wrong = page.folder / "wrong.toml"
    wrong.write_text((page.folder / "experiment.toml").read_text("utf-8").replace("[volume]", "[volume"), "utf-8")
    page.browser.execute_script("trame.state.set('experiment_open', arguments[0])", str(wrong))
    until(lambda: "expected the name of a table" in "".join(page.get("x_elsewhere")))
    assert page.get("x_tables") == []
    wrong.unlink()
    page.browser.find_element("css selector", ".lf-message button").click()
    until(lambda: not page.get("message_shown"))
    page.browser.execute_script(
        "trame.state.set('experiment_open', arguments[0])", str(page.folder / "experiment.toml")
    )
    until(lambda: page.get("x_tables") and not page.get("x_elsewhere"))


def test_sliders_that_were_moved_alone_reach_the_form(page):
    page.browser.execute_script("trame.state.update({t_smart_iterations: 9, t_correlation_overlap: 0.75})")

    def kept():  # while the server opens a file, a click is faster than the values
        page.open("preview")
        page.click("t-keep")
        return page.get("x_changed")

    until(kept)
    added = [line for line in page.get("x_diff").splitlines() if line.startswith(("+", "-")) and "=" in line]
    assert added == ["-iterations = 8", "+iterations = 9", "+overlap = 0.75"]  # the file has 8
    page.browser.execute_script("arguments[0].click()", page.find("x-undo"))
    until(lambda: not page.get("x_changed"))


@pytest.mark.slow
def test_the_cost_of_the_campaign_is_told(page):
    page.open("preview")
    page.click("t-plan")
    until(lambda: any(line.strip().startswith("in all") for line in page.get("t_plan")), RUN_S)


def test_a_series_plays_and_stops(page):
    page.open("results")
    page.click("r-play")
    seen = set()
    until(lambda: seen.add(page.get("r_step")) or len(seen) > 2)
    page.click("r-play")
    until(lambda: not page.get("r_playing"))


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_a_narrow_page_has_no_part_beside_it(page, theme):
    page.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape(390, 844))
    try:
        page.browser.execute_script(f"trame.state.set('theme', '{theme}')")
        for tab in ("images", "experiment", "space", "preview", "runs", "results"):
            page.open(tab)
            wide = page.browser.execute_script(f"return document.getElementById('tab-{tab}').scrollWidth")
            assert wide <= 390, tab
        until(lambda: page.browser.execute_script(f"return !!document.querySelector('.v-theme--{theme}')"))
    finally:
        page.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape(1440, 900))


def test_a_run_is_started_and_stopped(page):
    page.open("runs")
    assert page.get("p_out") == "results"  # of the open results, as the page calls them
    page.browser.execute_script("trame.state.set('p_out', 'again')")
    page.click("p-start")
    until(lambda: page.get("p_status") == "running" and page.get("p_log"), RUN_S)
    page.click("p-stop")
    until(lambda: page.get("p_status") not in ("running", "paused"), RUN_S)
    assert "lfpiv run" in page.get("p_log") and not (page.folder / "again" / ".lock").exists()
