"""Tables of imperfections: without strength they change nothing, and what cannot be is refused."""

import os

import numpy as np
import pytest
import tifffile
from support.simulated_cameras import SMALL_SCENE, refusal, small_scene

from lfpiv.errors import InputError
from lfpiv.simulation.simulator import simulate

NEUTRAL = {
    "brightness": {},
    "sheet": {},
    "stray_light": {},
    "surface": (),
    "sensor": {},
    "array": {},
    "wall": (),
    "background": {"averaged": 2},
    "board": {"errors": {}},
    "particles": {"margin_mm": (0.0, 0.0, 0.0)},
}
"""Every table of imperfections with the strength of its defaults."""


def images(folder):
    return {path.relative_to(folder).as_posix(): tifffile.imread(path) for path in folder.rglob("*.tif")}


def test_tables_without_strength_change_no_pixel(device, tmp_path):
    plain = images(simulate(small_scene(), tmp_path / "plain").parent)
    neutral = images(simulate(small_scene(**NEUTRAL), tmp_path / "neutral").parent)
    assert set(neutral) - set(plain) == {f"background/{name}_{frame}.tif" for name in ("one", "two") for frame in "ab"}
    for name, image in plain.items():
        assert np.array_equal(image, neutral[name]), name
    with (
        np.load(tmp_path / "plain/truth/particles.npz") as before,
        np.load(tmp_path / "neutral/truth/particles.npz") as after,
    ):
        assert set(before) < set(after)
        assert all(np.array_equal(before[key], after[key]) for key in before)


def test_equal_seeds_give_equal_imperfections(device, tmp_path):
    tables = {
        "brightness": {"camera_log_sd": 0.5, "size_log_sd": 0.2},
        "sheet": {"profile": "gaussian", "thickness_mm": 0.4, "power_sd": 0.1},
        "stray_light": {"lens_counts": 50.0, "ambient_counts": 20.0, "variation": 0.2},
        "sensor": {"gain_sd": 0.02, "column_sd_counts": 4.0, "dark_counts": 10.0, "hot_share": 0.01},
        "array": {"dead_share": 0.05},
        "board": {"errors": {"stage_z_sd_mm": 0.02, "dot_sd_mm": 0.01, "uneven_light": 0.3}},
    }
    first, again, other = (
        images(simulate(small_scene(seed=seed, **tables), tmp_path / name).parent)
        for seed, name in ((5, "first"), (5, "again"), (6, "other"))
    )
    for name, image in first.items():
        assert np.array_equal(image, again[name]) and not np.array_equal(image, other[name]), name


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[brightness]\ncamera_log_sd = -0.1", "brightness.camera_log_sd: expected 0 or more, found -0.1"),
        ("[brightness]\nlog_sd = 0.1", "brightness.log_sd: unknown key. Did you mean"),
        ('[sheet]\nprofile = "round"', "sheet.profile: expected one of 'even', 'top_hat', 'gaussian'"),
        ('[sheet]\nprofile = "gaussian"', 'thickness_mm with profile = "gaussian"'),
        ("[sheet]\nthickness_mm = 1.0", "thickness_mm only with profile"),
        ("[sheet]\npower = [1.0]", "sheet.power"),
        ("[sheet]\ndirection = [0, 0, 0]", "a direction other than (0, 0, 0)"),
        ("[stray_light]\nvariation = 0.9", "stray_light.variation: expected 0.5 or less"),
        ("[[surface]]\ncentre_mm = [0, 0, 0]\nlength_mm = 1\nwidth_mm = 1", "counts: this key is missing"),
        (
            "[[surface]]\ncentre_mm = [0, 0, 0]\nlength_mm = 1\nwidth_mm = 1\ncounts = 1\nalong = [0, 0, 2]",
            "a direction in the plane",
        ),
        (
            "[[wall]]\npoint_mm = [0, 0, 0]\nnormal = [0, 0, 1]",
            "wall[0]: expected kind = 'half_space' or 'box', found a table without kind",
        ),
        (
            '[[wall]]\nkind = "box"\ncentre_mm = [0, 0, 0]\nsize_mm = [1, 1, 0]',
            "wall[0].size_mm[2]: expected a number above",
        ),
        ('[[wall]]\nkind = "half_space"\npoint_mm = [0, 0, 0]\nnormal = [0, 0, 0]', "a direction other than"),
        ("[sensor]\nbits = 17", "sensor.bits: expected 16 or less"),
        ("[sensor]\nbits = 8\nsaturation_counts = 1000", "saturation_counts up to 255"),
        ("[sensor]\nhot_share = 1.5", "sensor.hot_share"),
        ("[array]\npitch_drift = 0.01", "array.pitch_drift"),
        ("[array]\ncats_eye = 1.5", "array.cats_eye: expected 1 or less"),
        ("[background]\naveraged = 0", "background.averaged: expected 1 or more"),
        ("[board.errors]\ntilt_sd_deg = 9", "board.errors.tilt_sd_deg: expected 5 or less"),
        ("[board.errors]\nmissing_share = 0.9", "board.errors.missing_share"),
    ],
)
def test_bad_tables_are_refused_before_any_work(tmp_path, table, message):
    assert message in refusal(SMALL_SCENE + table + "\n", tmp_path)


def test_errors_of_a_board_with_dark_dots_are_refused(tmp_path):
    text = SMALL_SCENE.replace("[board]", "[board]\ninverted = true") + "[board.errors]\nstage_z_sd_mm = 0.01\n"
    assert "bright dots only" in refusal(text, tmp_path)


def test_a_scene_whose_walls_leave_no_particle_is_refused(tmp_path):
    wall = {"kind": "box", "centre_mm": (0.0, 0.0, 0.0), "size_mm": (5.0, 5.0, 5.0)}
    with pytest.raises(InputError, match="wall: expected fluid in the volume"):
        simulate(small_scene(wall=(wall,)), tmp_path / "out")
    assert os.listdir(tmp_path) == []
