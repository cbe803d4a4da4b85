"""The report as a file: well-formed, self-contained, bounded, and right in its numbers."""

import base64
import dataclasses
import gzip
import html.parser
import itertools
import json
import math
import re

import h5py
import numpy as np
import pytest
from scipy import ndimage
from support import report_run

import lfpiv
from lfpiv import quantities
from lfpiv.experiment.recording import Recording
from lfpiv.geometry.names import COMPONENTS
from lfpiv.report import calibration, flow, markup, overview, slice_panels, vectors, verdicts, volumes
from lfpiv.report import pairs as pairs_section
from lfpiv.report.dot_map import dot_map
from lfpiv.report.fields import (
    MOST_IN_FIELD,
    MOST_READ,
    MOST_SHOWN,
    MOST_VECTORS,
    NO_NUMBER,
    Survey,
    embed,
    evenly,
    survey,
)
from lfpiv.report.lens_map import lens_map
from lfpiv.report.light_sheet import find_sheet
from lfpiv.report.pairs import MOST_ROWS, group
from lfpiv.report.slice_panels import slice_panel
from lfpiv.report.summary import CameraFigures, Summary
from lfpiv.report.svg import cell_edges
from lfpiv.report.verdicts import Level

PLOTLY_BYTES, PAGE_BYTES, CAMERA_BYTES, VECTOR_BYTES = 2.4e6, 1.5e6, 0.7e6, 32
"""Largest size of a report: plotly.js packed (1.9 MB in version 7), pictures and tables, pictures of each camera, and
what one vector takes: nine values of two bytes in base64, hardly smaller when packed, and a third as much again."""

RMS_AGREEMENT = 0.15
"""Two estimates of the rms distance from the lattice over some hundred microimages, relative: 1/sqrt(2 n) each, and
another robust fit."""
SHIFT_PX = 0.3
SHIFT_TOLERANCE_PX = 0.02
"""A lattice moved by SHIFT_PX shows it in the mean of every cell, to the noise of few microimages (0.03 px each)."""

GRAIN = 0.05
"""Relative error of the brightness of a few planes of 168 voxels, each uneven by 0.2 of its mean, and of rounding."""
MISTAKEN = 3
"""Of 100 uneven volumes, those that by chance look like a light sheet."""
SHEET_EDGE_MM, SHEET_RATIO = 0.15, 0.15
"""One and a half planes, for an edge that is a plane or two wide; light beyond the margin, and noise of few counts."""

VOID = {"meta", "link", "input", "br", "img", "hr"}


class Page(html.parser.HTMLParser):
    """Elements of a page, their nesting checked while they are read."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.text = [], [], {}
        self.feed(text)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        if self.open:
            self.text[self.open[-1]] = self.text.get(self.open[-1], "") + data

    def all(self, *tags):
        return [attributes for tag, attributes in self.elements if tag in tags]


@pytest.fixture(scope="module")
def text(reported):
    return reported.page.read_text("utf-8")


def figures(summary):
    counts = {"pairs_finished": len(summary["pairs"]), "pairs_failed": len(summary["failed"])}
    return Summary.model_validate(summary | counts)


def unpacked(text, name):
    data = re.search(rf'id="{name}">([^<]*)</script>', text)[1]
    return gzip.decompress(base64.b64decode(data))


def test_the_page_is_well_formed_and_whole(text):
    page = Page(text)
    names = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(names) == len(set(names)), "an identifier is used twice"
    referred = [attributes["href"][1:] for _, attributes in page.elements if attributes.get("href", "").startswith("#")]
    referred += re.findall(r"url\(#([^)]+)\)", text)
    for key in ("aria-describedby", "aria-labelledby", "for"):
        referred += [attributes[key] for _, attributes in page.elements if key in attributes]
    assert len(referred) > 20 and set(referred) <= set(names)
    assert all(attributes.get("aria-label") for attributes in page.all("svg"))
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1 and all(b - a <= 1 for a, b in itertools.pairwise(levels)) and levels.count(1) == 1
    for _, attributes in page.elements:
        for key in ("src", "href"):
            assert re.match("data:|#", attributes.get(key, "#")), "the page refers to something outside itself"
    # truth, raw, board, cameras, volumes, slice, profile, depths, space, streams, vorticity, uncertainty,
    # histograms, pairs
    assert len(page.all("svg")) == 3 + 2 + 1 + 2 * 9 + 3 + 2 + 1 + 1 + 5 + 1 + 3 + 3 + 3 + 3 + 3
    assert "figure" not in page.open and len(page.all("figure")) == len(page.all("figcaption"))


def test_names_and_texts_of_others_stay_texts(text):
    page = Page(text)
    assert report_run.NAME in page.text["h1"] and report_run.NAME in page.text["title"]
    assert page.text["li"].count(report_run.EVIL) == 2
    assert not page.all("b") and not any("onerror" in attributes for _, attributes in page.elements)


def test_failed_pairs_come_first_among_the_warnings_and_long_lists_end(reported, text):
    assert (
        text.index('id="warnings"')
        < text.index("Pair 7 failed")
        < text.index("left: &lt;/script")
        < text.index('"run"')
    )
    failed = [{"pair": pair, "reason": "no light"} for pair in range(2000)]
    section = overview.warnings(figures(reported.summary | {"failed": failed}))
    assert section.index("Pair 0 failed: no light") < section.index("<details>")
    assert section.count("failed: no light") == overview.WARNINGS_MOST
    assert f"{2001 - overview.WARNINGS_MOST:,} more are in summary.json" in section
    assert overview.warnings(figures(reported.summary | {"failed": [], "warnings": []})) == ""


@pytest.mark.slow
def test_a_series_is_reported_by_instant(reported, tmp_path):
    recording = Recording.of_series(report_run.PAIRS + 2, step=2)
    images = "particles/{camera}/{instant:06d}.tif"
    experiment = dataclasses.replace(reported.experiment, recording=recording, particle_images=images)
    text = reported.write(tmp_path / "report.html", experiment=experiment)
    page = Page(text)
    shown = re.sub(r"<script.*?</script>|<style.*?</style>|<[^>]*>", " ", text, flags=re.DOTALL)
    assert not re.findall(r".{30}\b[Pp]airs?\b.{20}|.{30}\bframe [ab]\b", shown)
    assert "All instants" in page.text["h2"] and "Instant 7 failed" in text
    assert "instants 0 to 4; vectors of 3 of the 3 that have a partner 2 instants later" in text
    assert "1 ms, from each to the one 2 later" in text
    listed = json.loads(re.search(r'id="field-list">([^<]*)</script>', text)[1])
    labels = [entry["label"] for entry in listed["fields"]]
    assert labels[0] == "instant 0" and labels[3] == "mean of 3 instants"
    # instants 0 to 4: the volume of instant 2 is in two vector fields and counts once
    assert sum(int(count) for count in re.findall(r">(\d+)</t[hd]><td[^>]*>(?:iteration|misfit)", text)) == 5


def test_fields_are_stored_to_a_65000th_of_their_range(text):
    listed = json.loads(re.search(r'id="field-list">([^<]*)</script>', text)[1])
    block = unpacked(text, "field-values")
    labels = [entry["label"] for entry in listed["fields"]]
    assert labels[:3] == ["pair 0", "pair 1", "pair 2"] and labels[3].startswith("mean of 3 pairs") and len(labels) == 5
    for number, entry in enumerate(listed["fields"][:3]):
        truth = report_run.field(number)
        assert np.frombuffer(block, "<i2", truth["u"].size, entry["valid"]).astype(bool).tolist() == [
            *truth["valid"].values.ravel()
        ]
        expected = {name: truth[name].values for name in "uvw"}
        expected["vorticity_z"] = np.full(truth["u"].shape, 2 * report_run.OMEGA * (1 + 0.1 * number))
        expected |= {} if number == report_run.PAIRS - 1 else {"uncertainty": truth["uncertainty"].values}  # none valid
        for name, values in expected.items():
            stored = np.frombuffer(block, "<i2", values.size, entry["values"][name]["offset"])
            scale = entry["values"][name]["scale"]
            known, largest = np.isfinite(values.ravel()), np.nanmax(np.abs(values))
            assert ((stored != NO_NUMBER) == known).all()
            np.testing.assert_allclose(
                stored[known] * scale, values.ravel()[known], atol=0.51 * scale + 1e-6 * largest
            )  # half a step, and float32
            assert scale * 65_000 < 2 * largest


def test_mean_and_fluctuation_are_those_of_the_valid_vectors(reported):
    found = survey(reported.vectors, Recording())
    every = [report_run.field(pair) for pair in reported.vectors]
    masked = np.array([np.where(item["valid"], item["u"], np.nan) for item in every])[:2]  # the third has none
    with np.errstate(invalid="ignore"):
        counts = np.isfinite(masked).sum(0)
        mean = np.nansum(masked, axis=0) / np.where(counts, counts, np.nan)
    np.testing.assert_allclose(found.mean["u"].values, mean, rtol=1e-6, atol=1e-9)
    both = counts == 2
    np.testing.assert_allclose(found.fluctuation["u"].values[both], masked.std(0, ddof=1)[both], rtol=1e-4, atol=1e-8)
    assert np.isnan(found.fluctuation["u"].values[~both]).all()
    assert (found.mean["valid"].values == (counts > 0)).all() and found.read == 3


@pytest.mark.slow
def test_size_and_reading_are_bounded_for_thousands_of_pairs(reported, text, monkeypatch):
    """Five thousand pairs, the files of two: the page hardly grows, and a sample of files is read."""
    pairs = 5000
    files = {pair: reported.vectors[pair % 2] for pair in range(pairs)}
    items = [reported.summary["pairs"][pair % 3] | {"pair": pair} for pair in range(pairs)]
    noted = {"pairs": items, "warnings": ["few valid vectors"] * pairs, "reused": [f"pair {k}" for k in range(pairs)]}
    opened, sections = [], {}

    class CountedFile(h5py.File):
        def __init__(self, name, *arguments, **options):
            opened.append(name)
            super().__init__(name, *arguments, **options)

    monkeypatch.setattr(h5py, "File", CountedFile)
    for name, content, paths in (
        ("few", reported.summary, reported.vectors),
        ("many", reported.summary | noted, files),
    ):
        opened.clear()
        summary = figures(content)
        sections[name] = "".join(
            [
                overview.warnings(summary),
                overview.timings(summary),
                overview.head(reported.experiment),
                overview.verdict(reported.experiment, summary),
                vectors.section(paths, Recording(), None),
                volumes.section(summary.pairs, paths, Recording()),
                pairs_section.section(summary.pairs, summary.failed, len(summary.pairs), Recording()),
            ]
        )
        assert (
            min(len(paths), MOST_READ) <= len(opened) <= MOST_READ + MOST_SHOWN + 2
        )  # its volumes, the first once more
    assert len(sections["many"]) - len(sections["few"]) < 0.2 * PAGE_BYTES
    assert f"holds 6 of {pairs:,} pairs" in sections["many"]
    assert f"those of {MOST_READ} evenly chosen pairs" in sections["many"]
    assert len(text) < PLOTLY_BYTES + PAGE_BYTES + len(reported.calibration.cameras) * CAMERA_BYTES
    Page(sections["many"])


def test_large_fields_are_thinned_out():
    large = report_run.field(0, (40, 120, 110))
    html_text, step = embed(
        Survey(shown={0: large}, mean=None, fluctuation=None, read=1), flow.best_view(large), Recording()
    )
    (entry,) = json.loads(re.search(r'id="field-list">([^<]*)</script>', html_text)[1])["fields"]
    kept = len(entry["x"]) * len(entry["y"]) * len(entry["z"])
    assert len(entry["z"]) == 40 and step == math.ceil(math.sqrt(large["u"].size / MOST_IN_FIELD))
    assert kept <= 1.1 * MOST_IN_FIELD < large["u"].size and len(html_text) < 1.1 * MOST_IN_FIELD * VECTOR_BYTES
    assert MOST_VECTORS * VECTOR_BYTES < 6e6
    np.testing.assert_allclose(entry["x"], large["x"].values[::step], atol=1e-6)


def test_pairs_are_put_together_without_loss(reported):
    first = figures(reported.summary).pairs[0]
    items = [first.model_copy(update={"number": 2 * pair, "valid_fraction": pair / 1000}) for pair in range(1001)]
    groups = group(items)
    assert len(groups.pairs) <= MOST_ROWS and groups.pairs.sum() == 1001
    assert (groups.first[1:] > groups.last[:-1]).all() and groups.first[0] == 0 and groups.last[-1] == 2000
    assert np.average(groups.mean["valid"], weights=groups.pairs) == pytest.approx(0.5)
    assert groups.low["valid"].min() == 0 and groups.high["valid"].max() == 1
    assert [len(group(items[:n]).pairs) for n in (1, 2, 99, 100, 101)] == [1, 2, 99, 100, 100]
    assert evenly(range(5000), 6) == [0, 1000, 2000, 2999, 3999, 4999] and evenly([3, 5], 6) == [3, 5]


def test_a_lattice_in_the_wrong_place_shows_in_every_cell(reported):
    camera, experiment = reported.calibration.cameras["left"], reported.experiment
    white, optics = experiment.white("left"), experiment.camera("left").optics
    right = lens_map(white, None, optics, camera.lattice)
    assert right.total_rms_px == pytest.approx(camera.report.lens_array_rms_px, rel=RMS_AGREEMENT)
    move = SHIFT_PX * optics.pixel_mm / (1 + optics.sensor_per_pupil)
    origin = camera.lattice.origin_mm[0] + move, camera.lattice.origin_mm[1]
    wrong = lens_map(white, None, optics, dataclasses.replace(camera.lattice, origin_mm=origin))
    known = wrong.count >= 3
    assert known.sum() > 20
    difference = (wrong.mean_px - right.mean_px)[known & (right.count >= 3)]
    np.testing.assert_allclose(difference.mean(0), (-SHIFT_PX, 0), atol=SHIFT_TOLERANCE_PX)
    assert wrong.total_rms_px == pytest.approx(math.hypot(SHIFT_PX, right.total_rms_px), abs=SHIFT_TOLERANCE_PX)


def test_a_dot_in_the_wrong_place_shows_where_it_is(reported):
    camera = reported.calibration.cameras["left"]
    before = dot_map(camera)
    victim = before.number[7]
    moved = camera.dots.array_mm + 0.5 * camera.lattice.pitch_mm * (camera.dots.dot == victim)[:, None]
    after = dot_map(dataclasses.replace(camera, dots=dataclasses.replace(camera.dots, array_mm=moved)))
    assert after.number[after.error.argmax()] == victim
    assert after.error[7] == pytest.approx(math.sqrt(0.5), abs=before.error[7])
    np.testing.assert_array_equal(np.delete(after.error, 7), np.delete(before.error, 7))
    np.testing.assert_array_equal(after.position_mm[7], camera.dots.points_mm[camera.dots.dot == victim][0])


def slice_of(field, quantity="w", normal="z", place=0, overlay="arrows"):
    kinds = flow.describe(field)
    return slice_panel(flow.shown(field, kinds), kinds, normal, place, quantity, overlay)


def test_arrows_have_the_scale_that_is_stated_and_stay_inside(monkeypatch):
    """The longest arrow drawn is as long as the scale in the title says of its speed; a field at rest has no scale."""
    paths, titles = [], []
    draw, style = slice_panels.arrows, slice_panels.style
    monkeypatch.setattr(slice_panels, "arrows", lambda *parts: paths.append(draw(*parts)) or paths[-1])
    monkeypatch.setattr(slice_panels, "style", lambda axes, **kw: titles.append(kw["title"]) or style(axes, **kw))
    moving = report_run.field(0)
    moving["valid"][:] = True
    slice_of(moving)
    length, speed = map(float, re.search(r"an arrow of (\S+) mm is (\S+) mm/s", titles[0]).groups())
    shafts = paths[0].vertices.reshape(-1, 5, 2)
    longest = np.linalg.norm(shafts[:, 1] - shafts[:, 0], axis=1).max()
    fastest = float(np.hypot(moving["u"], moving["v"]).max()) * 1000
    assert longest / fastest == pytest.approx(length / speed, rel=0.05)  # the title rounds to two digits
    centres = np.stack(np.meshgrid(moving["x"], moving["y"]), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose((shafts[:, 0] + shafts[:, 1]) / 2, centres, atol=1e-9)
    for k, axis in enumerate("xy"):
        low, high = cell_edges(moving[axis].values)
        assert low <= shafts[..., k].min() and shafts[..., k].max() <= high
    still = moving.assign({name: 0 * moving[name] for name in "uvw"})
    titles.clear()
    assert slice_of(still) and "m/s" not in titles[0]
    assert [slice_panels.round_below(value) for value in (0.0, 0.0199, 1.0, 7e3, np.nan)] == [0, 0.01, 1, 5000, 0]


def vortex(normal, noise=0.0, seed=0, shape=(9, 11, 13)):
    """Return a vortex along an axis, off the middle, with random errors [m/s] and their stated uncertainty."""
    field = report_run.field(0, shape)
    across, up = flow.IN_SLICE[normal]
    places = np.meshgrid(*(field[axis].values for axis in "zyx"), indexing="ij")
    z, y, x = (part - 0.2 for part in places)
    from_axis = {"x": x, "y": y, "z": z}
    speed = np.exp(-(from_axis[across] ** 2 + from_axis[up] ** 2 + (from_axis[normal] / 2) ** 2) / 0.2)
    parts = {name: np.zeros(shape) for name in "uvw"}
    parts[COMPONENTS[across]] = -0.1 * from_axis[up] * speed
    parts[COMPONENTS[up]] = 0.1 * from_axis[across] * speed
    rng = np.random.default_rng(seed)
    for name, part in parts.items():
        field[name] = field[name].dims, part + noise * rng.standard_normal(shape)
    field["uncertainty"] = field["u"].dims, np.full(shape, max(noise, 1e-6) / flow.voxel_velocity(field))
    return field.assign(valid=field["valid"] | True)


@pytest.mark.parametrize("normal", ["x", "y", "z"])
def test_the_best_slice_goes_through_the_vortex_across_its_axis(normal):
    field = vortex(normal, noise=0.002)
    view = flow.best_view(field)
    assert (view.normal, view.quantity) == (normal, f"vorticity_{normal}")
    assert {axis: field[axis].values[place] for axis, place in view.place.items()} == pytest.approx(
        dict.fromkeys("xyz", 0.2), abs=0.21
    )
    assert view.along in flow.IN_SLICE[normal]


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_not_shown_as_vorticity(seed):
    field = vortex("z", seed=seed)
    rng = np.random.default_rng(seed)
    for name, mean in zip("uvw", (0.02, 0.01, 0.0), strict=True):
        field[name] = field[name].dims, mean + 0.002 * rng.standard_normal(field[name].shape)
    field["uncertainty"] = field["u"].dims, np.full(field["u"].shape, 0.002 / flow.voxel_velocity(field))
    view = flow.best_view(field)
    assert (view.normal, view.quantity) == ("z", "speed")


def test_thin_fields_and_fields_without_valid_vectors_are_shown_by_speed():
    thin = report_run.field(0, (2, 6, 7))
    assert flow.best_view(thin).quantity == "speed" and "vorticity" not in flow.describe(thin)
    nothing = report_run.field(report_run.PAIRS - 1)
    assert flow.best_view(nothing).quantity == "speed"
    for field in (thin, nothing):
        for overlay in ("arrows", "streamlines", "none"):
            assert "<svg" in slice_of(field, "speed", overlay=overlay)


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (5e-05, "s", "50 µs"),
        (9.999e-4, "s", "1 ms"),
        (120.0, "s", "120 s"),
        (0.02, "m/s", "20 mm/s"),
        (0.5, "m/s", "0.5 m/s"),
        (-2e-5, "m/s", "−20 µm/s"),
        (2430.0, "1/s", "2430 1/s"),
        (1.88e6, "1/s²", "1.88 1/ms²"),
        (5939.2, "MiB", "5.8 GiB"),
        (0.0, "s", "0 s"),
        (None, "s", "–"),
        (math.nan, "m/s", "–"),
    ],
)
def test_quantities_in_the_units_of_people(value, unit, text):
    assert quantities.quantity(value, unit) == text


def tiles_of(run, **changed):
    found = verdicts.tiles(run.experiment, figures(run.summary | changed))
    return {tile.label.split(":")[0]: tile for tile in found}


def test_tiles_judge_the_figures_of_the_run(reported):
    good = tiles_of(reported, failed=[], valid_fraction=verdicts.GOOD_SHARE)
    assert good["pairs finished"].level is good["valid vectors"].level is Level.GOOD
    assert tiles_of(reported)["pairs finished"].level is Level.LOOK  # three finished, one failed
    levels = [tiles_of(reported, valid_fraction=share)["valid vectors"].level for share in (0.79, 0.31, 0.29, None)]
    assert levels == [Level.LOOK, Level.LOOK, Level.BAD, Level.BAD]
    uncertainty = good["median uncertainty"]
    assert (uncertainty.value, uncertainty.level) == ("0.10 voxel", Level.GOOD)
    assert uncertainty.label == "median uncertainty: 10 mm/s"  # a tenth of 0.1 mm in 1 ms
    pairs = [pair | {"residual": {"a": [0.9, 0.7]}} for pair in reported.summary["pairs"]]
    assert tiles_of(reported, valid_fraction=0.997)["valid vectors"].value == "99.7 %"  # not all of them
    residual = tiles_of(reported, pairs=pairs)["of the images unexplained, worst volume"]
    assert (residual.value, residual.level) == ("70 %", Level.LOOK)
    assert all(tile.limits.startswith("good: ") and "; bad: " in tile.limits for tile in good.values())


def test_the_flow_comes_before_volumes_and_calibration_is_folded(text):
    places = [
        text.index(f'<h2 id="{name}"') for name in ("warnings", "truth", "vectors", "volumes", "pairs", "calibration")
    ]
    assert places == sorted(places) and text.index('class="cards"') < places[1]
    assert text.index('id="calibration-fold"') < text.index("Microlens array of left")
    assert "<details open" not in text and 'href="#top"' in text and "1e-0" not in Page(text).text["p"]


def test_damping_is_tabulated(reported):
    axis = {"slope": 0.87, "slope_error": 0.01, "offset": 0.0, "offset_error": 0.02, "applied": True}
    axis |= {"raw_error": 0.123, "unbiased_error": 0.111}
    damping = {"axes": {"x": axis, "z": axis | {"applied": False}}, "simulated": 16}
    text = vectors.damping_table(figures(reported.summary | {"damping": damping}).damping)
    assert "Damping by ghosts" in text and text.count("0.870 ± 0.010") == 2
    assert ">taken off" in text and "not taken off" in text and text.count("0.123") == text.count("0.111") == 2
    assert vectors.damping_table(None) == ""


def test_tracked_particles_are_tabulated(reported):
    tracked = {"found": [1115, 116], "linked": 102, "valid_links": 99, "per_microlens": [0.04, 0.06]}
    tracked |= {"sigma_voxel": [0.2, 0.3]}
    pairs = [pair | {"particles": tracked} for pair in reported.summary["pairs"][:2]]
    table = pairs_section.particle_table(figures(reported.summary | {"pairs": pairs}).pairs, "pair")
    rows = re.findall(r"<tr>(.*?)</tr>", table)
    cells = [re.findall(r">([^<]+)<", row) for row in rows]
    assert cells[1:] == [[str(pair), "1,115 and 116", "102", "99", "0.050", "0.25"] for pair in (0, 1)]
    assert pairs_section.particle_table(figures(reported.summary).pairs, "pair") == ""


def test_vectors_from_links_are_told(reported):
    links = {"number": 420, "form": "incompressible", "length": 9.04, "strength": 1.2, "scatter": 0.1}
    pairs = [pair | {"links": links} for pair in reported.summary["pairs"][:1]] + reported.summary["pairs"][1:]
    row = overview.run_facts(reported.experiment, figures(reported.summary | {"pairs": pairs}))
    assert "Vectors from links" in row and "420 links, structures of 9.0 voxel (medians), incompressible in 1" in row
    assert "Vectors from links" not in overview.run_facts(reported.experiment, figures(reported.summary))


def test_the_brightness_outside_the_light_sheet_tells_the_level_of_ghosts(reported, text):
    low, high, ratio = re.search(
        r"lies between z = (\S+) and (\S+) mm; .* is (\S+) times as bright inside as outside", text
    ).groups()
    assert (float(low.replace("−", "-")), float(high)) == (-report_run.SHEET_MM, report_run.SHEET_MM)
    assert abs(1 / float(ratio) - report_run.EDGE_LEVEL) < GRAIN * report_run.EDGE_LEVEL


def uneven(kind, rng):
    """Brightness over the depth of a volume that is lit all through, particles at random."""
    planes = int(rng.integers(12, 120))
    profile = ndimage.uniform_filter(rng.poisson(rng.integers(20, 400), planes).astype(float), 3)
    ramp = np.minimum(np.arange(planes), np.arange(planes)[::-1])
    return (
        profile
        * {
            "even": 1.0,
            "slope": np.linspace(1, rng.uniform(1, 1.8), planes),
            "bright end": 1 + rng.uniform(0, 1) * np.exp(-np.arange(planes) / 2),
            "dark ends": np.minimum(1, (ramp + 2) / 5),
        }[kind]
    )


@pytest.mark.parametrize("kind", ["even", "slope", "bright end", "dark ends"])
def test_no_light_sheet_is_found_where_none_ends(kind):
    rng = np.random.default_rng(4)
    found = [find_sheet(np.arange(len(p)) * 0.1, p) for p in (uneven(kind, rng) for _ in range(100))]
    assert sum(sheet is not None for sheet in found) <= MISTAKEN
    assert find_sheet(np.arange(5.0), np.zeros(5)) is None and find_sheet(np.zeros(1), np.ones(1)) is None


@pytest.mark.parametrize("sides", [1, 2])
def test_a_light_sheet_with_soft_edges_is_found(sides):
    rng = np.random.default_rng(sides)
    for _ in range(100):
        planes, ratio, soft = int(rng.integers(24, 120)), rng.uniform(2, 10), rng.uniform(0.2, 0.5)
        k = np.arange(planes)
        low, high = (rng.integers(0.2 * planes, 0.3 * planes), planes - rng.integers(0.2 * planes, 0.3 * planes))
        steps = 1 / (1 + np.exp((k - high + 0.5) / soft))
        if sides == 2:
            steps = steps / (1 + np.exp((low - 0.5 - k) / soft))
        sheet = find_sheet(k * 0.1, rng.poisson(2000 * (1 + (ratio - 1) * steps) / ratio).astype(float))
        assert sheet is not None and abs(sheet.high_mm - (high - 0.5) * 0.1) <= SHEET_EDGE_MM
        assert sheet.ratio == pytest.approx(ratio, rel=SHEET_RATIO)


def test_a_report_before_any_pair_is_finished(reported, tmp_path, monkeypatch):
    monkeypatch.setattr("lfpiv.report.calibration.section", lambda *parts: "")  # tested elsewhere
    nothing = reported.summary | {"pairs": [], "pairs_finished": 0, "valid_fraction": None}
    page = Page(reported.write(tmp_path / "none.html", summary=nothing, vectors={}))
    assert "No pair is finished yet." in page.text["p"] and not page.all("canvas")


@pytest.mark.slow
def test_ray_tracing_at_nominal_angles_is_reported_without_dots(reported):
    traced = lfpiv.thin_lens(reported.experiment)
    cameras = {name: CameraFigures.model_validate(camera.report.to_json()) for name, camera in traced.cameras.items()}
    page = Page(calibration.section(reported.experiment, traced, cameras))
    assert "Microlens array of left" in page.text["figcaption"] and "eld-out" not in page.text["figcaption"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (2443.2, "2440"),
        (-0.012345, "−0.0123"),
        (1.5e-7, "1.5e−7"),
        (123456789.0, "1.23e8"),
        (math.nan, "–"),
    ],
)
def test_numbers_in_words(value, text):
    assert markup.significant(value) == text
