"""What a user takes along: pictures, films, fields, tables and a script; particles, tracks, two runs side by side."""

import csv
import subprocess
import sys

import cv2
import numpy as np
import pytest
import xarray as xr
from selenium.webdriver.common.by import By
from support.report_run import field
from support.studio_page import served, until

from lfpiv.results import netcdf, particles, track_files
from lfpiv.results.provenance import Stamp

pytestmark = pytest.mark.browser

SAME_PICTURE = 1.0
"""Largest mean difference of pictures by the same calls [grey level]: fonts may be a pixel apart."""
ABOVE_SCALE = 0.85
"""Rows above the colour scale, as a share: VTK aligns its numbers by the size of the window when it was first drawn."""
OTHER_PICTURE = 0.02
"""Least mean difference of the page's pictures where something was added [grey level]."""
PAIRS = 3
POINTS = 40
VIEW = "#tab-results .lf-view img"


def table(units, **own):
    """Return a table of points that fill the volume, other columns at 1."""
    rng = np.random.default_rng(3)
    columns = {name: np.ones(POINTS) for name in units} | {name: rng.uniform(-0.3, 0.3, POINTS) for name in "xyz"}
    columns |= {name: values for name, values in own.items() if name in (*units, "valid", "track")}
    return xr.Dataset({name: ("particle", values, {"units": units.get(name, "1")}) for name, values in columns.items()})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make two runs, of which the first has particles and tracks."""
    folder = tmp_path_factory.mktemp("along")
    for name, faster in (("first", 0), ("second", 4)):
        for pair in range(PAIRS):
            vectors = folder / name / "vectors" / f"pair_{pair:04d}.nc"
            netcdf.write_vectors(field(pair + faster), vectors, attributes={"pair": pair})
    good = np.ones(POINTS, bool)
    for pair in range(PAIRS):
        found = table(particles.PARTICLE_UNITS, valid=good)
        path = folder / "first" / "particles" / f"pair_{pair:04d}.nc"
        particles.write_particles(found, path, attributes={"pair": pair, "dt_s": 1e-3, "voxel_mm": 0.1})
    tracks = table(
        track_files.TRACK_UNITS, track=np.repeat(np.arange(POINTS // 4), 4), valid=good, instant=np.arange(POINTS) % 4
    )
    track_files.write_tracks(tracks, folder / "first" / "tracks.nc", stamp=Stamp({"tracks": [0, 1]}))
    return folder


@pytest.fixture(scope="module")
def page(folder, browser, tmp_path_factory):
    """Open the results of the first run; downloads go to a folder."""
    browser.downloads = tmp_path_factory.mktemp("downloads")
    allowed = {"behavior": "allow", "downloadPath": str(browser.downloads)}
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", allowed)
    with served(folder / "first") as address:
        browser.get(address)
        until(lambda: browser.execute_script(f"return document.querySelector('{VIEW}')?.naturalWidth > 50"))
        yield browser


def state(page, **values):
    """Set values of the state, and wait for the picture that they change."""
    shown = f"return document.querySelector('{VIEW}').src"
    before = page.execute_script(shown)
    page.execute_script("trame.state.update(arguments[0])", values)
    until(lambda: page.execute_script(shown) != before)


def download(page, kind, name):
    """Click a button and return the file that it downloads."""
    path = page.downloads / name
    path.unlink(missing_ok=True)
    page.execute_script("arguments[0].click()", page.find_element(By.ID, f"r-{kind}"))
    until(path.exists, 40)
    until(lambda: not list(page.downloads.glob("*.crdownload")))
    return path


def picture(page):
    return cv2.imread(str(download(page, "png", "lfpiv.png")))


def test_fields_and_tables_are_those_of_the_moment(page, folder):
    import pyvista as pv

    state(page, r_moment="1")
    vectors = netcdf.read_vectors(folder / "first" / "vectors" / "pair_0001.nc")
    grid = pv.read(download(page, "vti", "field.vti"))
    assert np.allclose(grid["u"], vectors["u"].values.ravel(), atol=1e-6) and "vorticity_z" in grid.array_names
    rows = list(csv.DictReader(download(page, "csv", "field.csv").open()))
    assert len(rows) == vectors["u"].size and {"u [m/s]", "valid"} <= set(rows[0])


def test_films_show_every_moment_and_one_turn(page):
    import imageio_ffmpeg

    moment = page.execute_script("return trame.state.get('r_moment')")
    for kind, count in (("series", PAIRS), ("turn", 60)):
        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(download(page, kind, f"{kind}.mp4")))
        assert frames == count
    assert page.execute_script("return trame.state.get('r_moment')") == moment


@pytest.mark.slow
def test_the_script_makes_the_picture_that_is_downloaded(page, tmp_path):
    state(page, r_particles=True, r_tracks=True, r_arrows=True)
    seen = picture(page)
    page.execute_script("arguments[0].click()", page.find_element(By.ID, "r-copy"))
    script = until(lambda: page.execute_script("return trame.state.get('r_script')"))
    (tmp_path / "script.py").write_text(script, "utf-8")
    subprocess.run([sys.executable, "script.py"], cwd=tmp_path, check=True, capture_output=True)
    rows = int(ABOVE_SCALE * seen.shape[0])
    again = cv2.imread(str(tmp_path / "picture.png"))[:rows, : seen.shape[1]]
    assert np.abs(again.astype(int) - seen[:rows]).mean() < SAME_PICTURE
    state(page, r_particles=False, r_tracks=False, r_arrows=False)
    page.execute_script("trame.state.set('r_script_shown', false)")


def test_particles_tracks_and_a_second_run_are_seen(page, folder):
    before = picture(page)
    for name in ("r_particles", "r_tracks"):
        state(page, **{name: True})
        assert np.abs(picture(page).astype(int) - before).mean() > OTHER_PICTURE, name
        state(page, **{name: False})
    others = [item["value"] for item in page.execute_script("return trame.state.get('r_others')")]
    (second,) = (path for path in others if path.endswith("second"))
    state(page, r_other=second)
    until(lambda: len([one for one in page.find_elements(By.CSS_SELECTOR, VIEW) if one.is_displayed()]) == 2)
    left, right = np.hsplit(picture(page), 2)
    assert np.abs(left.astype(int) - right).mean() > OTHER_PICTURE
    page.execute_script("arguments[0].click()", page.find_element(By.ID, "r-copy"))

    def of_both():
        script = page.execute_script("return trame.state.get('r_script') || ''")
        return "limits=(" in script and "second'" in script  # colours mean the same in both

    until(of_both)  # the script of an earlier view may still stand there
    page.execute_script("trame.state.set('r_script_shown', false)")
    page.execute_script("arguments[0].click()", page.find_element(By.ID, "r-turn-left"))
    page.execute_script("trame.state.set('r_surface', 'q_criterion')")
    until(lambda: page.execute_script("return trame.state.get('r_level') > 0"))  # where a vortex is
    for half, turned in zip((left, right), np.hsplit(picture(page), 2), strict=True):
        assert np.abs(turned.astype(int) - half).mean() > OTHER_PICTURE
