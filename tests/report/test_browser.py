"""The report in a real browser: the slider, the view in space, every width and scheme, keys, and what stands in."""

import base64
import json
import time

import cv2
import numpy as np
import pytest
from support import report_run

from lfpiv.report import flow, markup

pytestmark = [pytest.mark.browser, pytest.mark.slow]

LAPTOP, PHONE = (1366, 768), (390, 844)
PATIENCE_S = 90
"""Longest wait for something drawn: software WebGL on a busy machine takes seconds."""
CONTRAST_AA = 4.5
"""Least contrast of text that WCAG 2.1 AA asks for."""
COLOURS_DRAWN = 500
"""Different colours in a picture of shaded cones; an empty view has a few dozen of axes and text."""

NOT_INSIDE = """
const width = document.documentElement.clientWidth;
const exempt = (element) => element.closest('.scroll table') || element.closest('#js-plotly-tester, .unseen');
return [...document.body.querySelectorAll('*')].filter((element) => {
  const box = element.getBoundingClientRect();
  return box.width > 0 && !exempt(element) && (box.right > width + 0.5 || box.left < -0.5);
}).map((element) => `${element.tagName}#${element.id}.${element.getAttribute('class')}`);
"""

TOO_WIDE = """
return [...document.querySelectorAll('.scroll')]
  .filter((frame) => !frame.closest('details:not([open])') && frame.scrollWidth > frame.clientWidth)
  .map((frame) => `${frame.querySelector('caption').textContent}: ${frame.scrollWidth} in ${frame.clientWidth}`);
"""
"""Tables that are open and have to be scrolled sideways."""

FAINT = """
const channel = (value) => (value <= 0.03928 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
const light = ([r, g, b]) => 0.2126 * channel(r / 255) + 0.7152 * channel(g / 255) + 0.0722 * channel(b / 255);
const parts = (colour) => (colour.match(/[\\d.]+/g) || [0, 0, 0, 0]).map(Number);
const ground = (element) => {
  for (let up = element; up; up = up.parentElement) {
    const colour = parts(getComputedStyle(up).backgroundColor);
    if (colour.length < 4 || colour[3] === 1) return colour;
  }
  return [255, 255, 255];
};
const found = [];
for (const element of document.body.querySelectorAll('main *')) {
  const own = [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
  if (!own || element.closest('.js-plotly-plot') || element.tagName === 'OPTION') continue;
  const style = getComputedStyle(element);
  const ink = light(parts(element.closest('svg') ? style.fill : style.color)), back = light(ground(element));
  const contrast = (Math.max(ink, back) + 0.05) / (Math.min(ink, back) + 0.05);
  if (contrast < arguments[0]) found.push([element.tagName, element.textContent.slice(0, 30), contrast]);
}
return found;
"""

CONTROLS = """
return [...document.querySelectorAll('a[href], button, input, select, summary, [tabindex]')]
  .filter((element) => element.checkVisibility()).map((element) => element.id || element.tagName);
"""
"""Names of all controls on the page, in the order of the document."""
FOCUSED = """
const element = document.activeElement;
return [element.id || element.tagName, getComputedStyle(element).outlineStyle];
"""


class Tab:
    """The report in one tab."""

    def __init__(self, browser, path):
        self.browser, self.path, self.added = browser, path, []

    def open(self, size=LAPTOP, scheme="light", first=""):
        if first:
            added = self.browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": first})
            self.added.append(added["identifier"])
        self.show(size, scheme)
        self.browser.get(self.path.as_uri())

    def show(self, size, scheme, media=""):
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": features})

    def js(self, script, *arguments):
        return self.browser.execute_script(script, *arguments)

    def wait(self, condition):
        end = time.monotonic() + PATIENCE_S
        while not (found := self.js(f"return {condition}")):
            assert time.monotonic() < end, f"waited in vain for {condition}; {self.errors()}"
            time.sleep(0.1)
        return found

    def draw_space(self):
        self.js("document.getElementById('space').scrollIntoView()")
        self.wait("document.getElementById('space').dataset.drawn")

    def keys(self, *keys):
        """Press keys, one after the other: names of selenium's `Keys`, or characters."""
        from selenium.webdriver import ActionChains
        from selenium.webdriver.common.keys import Keys

        for key in keys:
            ActionChains(self.browser, duration=0).send_keys(getattr(Keys, key, key)).perform()

    def of(self, name):
        return self.js("return document.getElementById(arguments[0]).textContent", name)

    def choose(self, name, label):
        script = """const list = document.getElementById(arguments[0]);
        list.value = [...list.options].find((option) => option.text.startsWith(arguments[1])).value;
        list.dispatchEvent(new Event('change'));"""
        self.js(script, name, label)

    def shown(self, selector):
        return self.js(
            "return [...document.querySelectorAll(arguments[0])].some((e) => e.getClientRects().length > 0)", selector
        )

    def errors(self):
        return [entry for entry in self.browser.get_log("browser") if entry["level"] == "SEVERE"]


@pytest.fixture
def tab(browser, reported):
    browser.get("about:blank")  # a page of the studio goes on to say that its server has ended
    tab = Tab(browser, reported.page)
    tab.errors()
    yield tab
    for identifier in tab.added:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", {"identifier": identifier})


def test_the_slider_moves_through_all_depths(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    tab.js(
        "const s = document.getElementById('slice-slider'); s.value = 0; s.focus(); s.dispatchEvent(new Event('input'))"
    )
    truth, pictures = report_run.field(0), set()
    for k, depth in enumerate(truth["z"].values):
        slab = truth.isel(z=k)
        good = slab["valid"].values
        means = [markup.significant(1000 * float(slab[name].values[good].mean())) for name in "uvw"]  # mm/s
        place = f"z = {markup.number(depth, 3)} mm"
        assert tab.of("slice-place") == place
        assert tab.of("slice-reading").startswith(
            f"{place}: {good.sum()} of {good.size} vectors valid; mean u {means[0]}, "
        )
        row = tab.js(
            "return [...document.querySelectorAll('#depth-table tr')[arguments[0]].children].map((c) => c.textContent)",
            k + 1,
        )
        assert row[3:6] == means
        pictures.add(tab.js("return document.getElementById('slice-canvas').toDataURL()"))
        tab.keys("ARROW_RIGHT")
    assert len(pictures) == truth.sizes["z"]
    tab.choose("slice-axis", "y")
    assert (
        tab.of("slice-place").startswith("y = ")
        and int(tab.js("return document.getElementById('slice-slider').max")) == 5
    )
    for label, said in (
        ("pair 2", "0 of 35 vectors valid"),
        ("fluctuation", "mean u′"),
        ("mean of 3", "vectors valid"),
    ):
        tab.choose("slice-field", label)
        assert said in tab.of("slice-reading") and tab.of("depth-field").startswith(label)
    assert not tab.errors()


def test_a_vector_can_be_read_by_keys(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    tab.js("document.getElementById('slice-canvas').focus()")
    tab.keys("ARROW_RIGHT", "ARROW_RIGHT", "ARROW_UP")  # the first one goes to the middle
    vector = report_run.field(0).isel(z=2, y=4, x=4)
    speed = float(np.sqrt(sum(float(vector[name]) ** 2 for name in "uvw")))
    said = tab.of("slice-reading")
    where = ", ".join(markup.number(float(vector[axis]), 3) for axis in "xyz")
    assert said.startswith(f"(x, y, z) = ({where}) mm: u {markup.significant(1000 * float(vector['u']))} mm/s")
    assert f"speed {markup.significant(1000 * speed)} mm/s, vorticity {2 * report_run.OMEGA:g} 1/s, " in said
    assert f"vorticity x 0 1/s, vorticity y 0 1/s, vorticity z {2 * report_run.OMEGA:g} 1/s" in said
    assert f"uncertainty {'0.1' if bool(vector['valid']) else '–'} voxel" in said
    assert said.endswith("; valid." if bool(vector["valid"]) else "; replaced after validation.")
    tab.js("document.getElementById('slice-slider').focus()")
    assert tab.of("slice-reading").startswith("z = ")


PICTURE = "return document.getElementById('slice-canvas').toDataURL()"


def test_the_slices_open_at_the_best_view_and_show_what_is_chosen(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    view = flow.best_view(report_run.field(0))
    value = "return document.getElementById(arguments[0]).value"
    chosen = {name: tab.js(value, f"slice-{name}") for name in ("axis", "colour", "along", "slider")}
    place = str(view.place[view.normal])
    assert chosen == {"axis": view.normal, "colour": view.quantity, "along": view.along, "slider": place}
    pictures = {tab.js(PICTURE)}
    for name, label in (("overlay", "streamlines"), ("overlay", "nothing"), ("colour", "vorticity z"), ("axis", "x")):
        tab.choose(f"slice-{name}", label)
        pictures.add(tab.js(PICTURE))
    tab.choose("slice-colour", "speed")
    smooth = tab.js(PICTURE)
    tab.js("document.getElementById('slice-smooth').click()")
    assert len(pictures) == 5 and tab.js(PICTURE) != smooth and not tab.errors()


def test_a_click_puts_the_profile_through_a_vector(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    truth, profile = report_run.field(0), "return document.getElementById('profile-canvas').toDataURL()"
    before = tab.js(profile)
    tab.js(
        """const frame = document.getElementById('slice-canvas').getBoundingClientRect();
        const [x, y] = slices.centre(slices.box, 1, 4);
        const where = { clientX: frame.left + x, clientY: frame.top + y, bubbles: true };
        document.getElementById('slice-canvas').dispatchEvent(new MouseEvent('click', where));"""
    )
    middle = truth.sizes["z"] // 2
    y, z = markup.number(float(truth["y"][4]), 3), markup.number(float(truth["z"][middle]), 3)
    assert tab.of("profile-reading").startswith(f"u, v, w along x at y = {y} mm, z = {z} mm; bands are ± 2")
    assert tab.js(profile) != before
    points = tab.js("return slices.profile.values(slices.field, slices.place, 'x')")
    line = truth.isel(y=4, z=middle)
    for k, name in enumerate("uvw"):
        found = [point["velocity"][k] for point in points]
        np.testing.assert_allclose(found, 1000 * line[name].values, rtol=1e-3, atol=2e-3)
    error = 2 * 0.1 * 1000 * flow.voxel_velocity(truth)  # two standard deviations of 0.1 voxel, in mm/s
    assert [point["error"] for point in points if point["valid"]] == pytest.approx([error] * int(line["valid"].sum()))
    tab.choose("slice-along", "y")
    x = markup.number(float(truth["x"][1]), 3)
    assert tab.of("profile-reading").startswith(f"u, v, w along y at x = {x} mm, z = {z} mm")
    assert not tab.errors()


def test_streamlines_of_a_rotation_are_circles(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    found = tab.js(
        """const sample = ([x, y]) => (Math.hypot(x - 10, y - 10) < 9 ? [10 - y, x - 10] : null);
        return streamlines(sample, [21, 21], 2, 9, 100);"""
    )
    radii = [np.hypot(*(np.array(places) - 10).T) for places in found]
    assert len(found) > 4 and max(np.ptp(radius) for radius in radii) < 0.02  # of the midpoint rule
    assert all(len(places) > 20 for places in found)


def test_the_contents_stay_in_view_and_lead_back(tab):
    tab.open(PHONE)
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    tab.js(
        "document.documentElement.style.scrollBehavior = 'auto'; document.querySelector('nav a[href=\"#run\"]').click()"
    )
    tab.wait("window.scrollY > 500")
    nav, head = "document.querySelector('nav').getBoundingClientRect()", "document.getElementById('run')"
    assert tab.js(f"return {nav}.top") == 0
    assert tab.js(f"return {head}.getBoundingClientRect().top >= {nav}.bottom")
    tab.wait("document.querySelector('nav a[aria-current]')?.hash === '#run'")
    assert not tab.js("return document.querySelector('#calibration-fold svg').checkVisibility()")
    tab.js("document.querySelector('nav a[href=\"#calibration\"]').click()")
    tab.wait("document.getElementById('calibration-fold').open")
    tab.js("document.querySelector('nav .up').click()")
    tab.wait("window.scrollY === 0")


def test_numbers_read_as_in_the_tables(tab):
    tab.open()
    values = [0, 2443.2, -0.012345, 1.5e-7, 123456789.0, 999.6, 0.00009996, 1e6, -3.0]
    shown = tab.js("return arguments[0].map((value) => significant(value))", values)
    assert shown == [*map(markup.significant, values)]


def test_the_view_in_space_draws_turns_and_fits_every_page(tab):
    tab.open(PHONE)
    tab.draw_space()
    assert tab.js("return document.querySelectorAll('#space-scene canvas').length") >= 1 and not tab.shown(
        "#space .still"
    )
    for size, scheme in ((PHONE, "light"), (PHONE, "dark"), (LAPTOP, "dark"), (LAPTOP, "light")):
        tab.show(size, scheme)
        tab.wait(f"window.innerWidth === {size[0]}")
        assert tab.js("return document.documentElement.scrollWidth") <= size[0]
        assert tab.js(NOT_INSIDE) == []
        assert tab.js(FAINT, CONTRAST_AA) == []
        if size == LAPTOP:
            tab.js("document.querySelectorAll('details').forEach((details) => { details.open = true; })")
        assert tab.js(TOO_WIDE) == []
    buttons = tab.js("return [...document.querySelectorAll('.modebar-btn')].map((button) => button.dataset.title)")
    assert len(buttons) == 6 and not any("hare" in title or "loud" in title for title in buttons)  # nothing is uploaded
    picture = tab.browser.execute_async_script(
        "Plotly.toImage('space-scene', {format: 'png', width: 500, height: 400}).then(arguments[0])"
    )
    image = cv2.imdecode(np.frombuffer(base64.b64decode(picture.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > COLOURS_DRAWN

    eye = "return JSON.stringify(document.getElementById('space-scene')._fullLayout.scene.camera.eye)"
    before = json.loads(tab.js(eye))
    tab.js("document.getElementById('space-scene').focus()")
    tab.keys("ARROW_LEFT", "+")
    after = json.loads(tab.js(eye))
    assert np.linalg.norm(list(after.values())) == pytest.approx(np.linalg.norm(list(before.values())) / 1.12)
    assert np.arctan2(after["y"], after["x"]) == pytest.approx(np.arctan2(before["y"], before["x"]) - 0.12)

    tab.browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    takes = "return getComputedStyle(document.querySelector('#space-scene > *')).pointerEvents"
    assert tab.js(takes) != "none"  # the view has the focus
    tab.js("document.activeElement.blur()")
    assert tab.js(takes) == "none", "a finger on the view does not scroll the page"
    tab.browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})

    level = "return document.getElementById('space-scene').data.find((trace) => trace.type === 'isosurface').isomin"
    tab.choose("space-quantity", "vorticity")
    start = tab.js(level)
    assert start == pytest.approx(report_run.OMEGA, rel=1e-3)  # half of the vorticity, which is the same everywhere
    tab.js("document.getElementById('space-level').focus()")
    tab.keys("ARROW_RIGHT")
    tab.wait(f"document.getElementById('space-scene').data.some((trace) => trace.isomin > {start})")
    for label in ("pair 2", "fluctuation", "mean of"):
        tab.choose("space-field", label)
    tab.choose("space-quantity", "none")
    tab.choose("space-field", "pair 0")
    tab.js("document.getElementById('space-lines').click()")
    tab.wait("document.getElementById('space-scene').data.some((trace) => trace.name === 'streamlines')")
    time.sleep(0.5)  # drawing goes on after the event
    assert not tab.errors()


def walk(tab):
    """Press Tab from the first to the last element of the page; return [name, outline style] of each focused element.

    The walk starts at a focused element in front of the page: all browsers continue from the focus. Without a focus
    they differ: Chromium 150 continues from the element that `scrollIntoView` showed last.
    """
    tab.js(
        """for (const [id, place, index] of [['walk-start', 'prepend', -1], ['walk-end', 'append', 0]]) {
          const end = Object.assign(document.createElement('span'), { id, tabIndex: index });
          document.body[place](end);
        }
        document.getElementById('walk-start').focus();"""
    )
    focused, most = [], 2 * len(tab.js(CONTROLS))
    while not focused or focused[-1][0] != "walk-end":
        assert len(focused) < most, f"the Tab key does not come to the end of the page: {focused}"
        tab.keys("TAB")
        focused.append(tab.js(FOCUSED))
    tab.js("for (const id of ['walk-start', 'walk-end']) document.getElementById(id).remove()")
    return focused[:-1]


def open_for_keys(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    tab.draw_space()


def test_every_control_is_reached_by_the_tab_key_and_shows_it(tab):
    open_for_keys(tab)
    controls = tab.js(CONTROLS)
    named = [
        *("slice-field", "slice-colour", "slice-axis", "slice-overlay", "slice-along", "slice-smooth"),
        *("slice-slider", "slice-canvas"),
        *("space-field", "space-quantity", "space-level", "space-arrows", "space-lines", "space-scene"),
    ]
    assert [name for name in controls if name in named] == named and {"A", "SUMMARY"} <= set(controls)
    focused = walk(tab)
    assert [name for name, _ in focused] == controls
    assert [name for name, outline in focused if outline == "none"] == []


@pytest.mark.parametrize(
    ("fault", "unreached", "invisible"),
    [
        ("document.getElementById('slice-axis').tabIndex = -1", ["slice-axis"], []),
        ("document.getElementById('space-scene').style.outline = 'none'", [], ["space-scene"]),
    ],
    ids=["skipped", "without outline"],
)
def test_the_walk_by_the_tab_key_finds_faults(tab, fault, unreached, invisible):
    open_for_keys(tab)
    tab.js(fault)
    focused = walk(tab)
    names = [name for name, _ in focused]
    assert [name for name in tab.js(CONTROLS) if name not in names] == unreached
    assert [name for name, outline in focused if outline == "none"] == invisible


@pytest.mark.parametrize(
    ("missing", "slices", "note"),
    [
        (
            "const f = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext ="
            " function (kind, ...more) { return kind.startsWith('webgl') ? null : f.call(this, kind, ...more); };",
            True,
            "WebGL is missing",
        ),
        ("delete window.DecompressionStream;", False, "too old"),
    ],
    ids=["webgl", "unpacking"],
)
def test_still_pictures_stand_in(tab, missing, slices, note):
    tab.open(first=missing)
    tab.js("document.getElementById('space').scrollIntoView()")
    tab.wait("document.getElementById('space-note').textContent")
    assert note in tab.of("space-note")
    assert tab.shown("#space .still svg") and not tab.shown("#space .live")
    assert tab.shown("#slices .live") == slices and tab.shown("#slices .still svg") != slices
    assert not tab.errors()


def test_paper_shows_the_still_pictures(tab):
    tab.open()
    tab.wait("document.getElementById('slices').classList.contains('ready')")
    tab.show(LAPTOP, "light", media="print")
    assert tab.shown("#slices .still svg") and not tab.shown("#slices .live") and not tab.shown("nav")
    tab.show(LAPTOP, "light")
