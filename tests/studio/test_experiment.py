"""The experiment on the page: the file as a form, its images with what is seen in them, and the rig in space."""

import json

import numpy as np
import pytest

import lfpiv
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.settings.rig import CameraTable

ON_THE_LENS_PX = 0.5
"""Largest distance of a lattice's circle from the middle of its microimage [pixel]."""
DOT_PX = 3.0
"""Largest distance of a dot's mark from the dot's light [pixel]: a sixth of a microimage."""


@pytest.fixture
def draft(tiny_experiment):
    from lfpiv.studio.draft import Draft

    text = tiny_experiment.read_text("utf-8").replace("f_number = 4.0", "f_number = 4.0  # as set on its ring", 1)
    tiny_experiment.write_text(f"# the rig of May\n{text}", "utf-8")
    return Draft(tiny_experiment)


def test_values_change_and_comments_stay(draft):
    before = draft.text.splitlines()
    draft.write(("camera", 0, "f_number"), "5.6", plain=False)
    draft.write(("volume", "size_mm"), "[0.8, 0.6, 0.5]", plain=False)
    draft.write(("smart", "iterations"), "9", plain=False)
    assert draft.problems() == {}
    draft.save()
    after = draft.path.read_text("utf-8").splitlines()
    assert "f_number = 5.6  # as set on its ring" in after and after[0] == "# the rig of May"
    changed = {line for line in before if line not in after}
    assert changed == {"f_number = 4.0  # as set on its ring", "size_mm = [0.8, 0.6, 0.4]"}
    assert lfpiv.open_experiment(draft.path).smart.iterations == 9


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("camera.0.f_number", "-4", "expected a number above 0, found -4."),
        ("camera.1.focal_length_mm", "", "this key is missing. Add it."),
        ("volume.voxel_mm", "fine", "expected a number, found the text 'fine'."),
        ("correlation.overlap", "1.5", "expected a number below 1, found 1.5."),
    ],
)
def test_a_mistake_is_told_at_its_place_and_not_saved(draft, name, text, found):
    from lfpiv.studio.draft import location_of

    draft.write(location_of(name), text, plain=False)
    assert found in draft.problems()[name]
    with pytest.raises(InputError, match="not saved"):
        draft.save()


def test_a_file_that_another_program_changed_is_kept(draft):
    draft.write(("name",), "other", plain=True)
    draft.path.write_text(draft.read + "# by an editor\n", "utf-8")
    with pytest.raises(InputError, match="another program"):
        draft.save()


def test_every_key_of_the_file_has_a_field_with_its_meaning(draft):
    rows = [row for table in draft.tables() for row in table["rows"]]
    assert {"name", "camera.1.f_number", "board.planes_mm", "tracking.rounds", "compute.threads"} <= {
        r["id"] for r in rows
    }
    assert all(row["meaning"] for row in rows) and draft.texts()["camera.1.name"] == "right"
    (voxel,) = [row for row in rows if row["id"] == "volume.voxel_mm"]
    assert voxel["unit"] == "mm" and voxel["default"] == "required"


def test_a_key_that_lfpiv_does_not_have_is_shown_and_removed_by_emptying_its_field(draft):
    draft.write(("volume", "voxel_m"), "0.1", plain=False)
    assert draft.problems() == {"volume.voxel_m": "unknown key. Did you mean 'voxel_mm'?"}
    assert "volume.voxel_m" in draft.texts()
    draft.write(("volume", "voxel_m"), "", plain=True)
    assert draft.problems() == {} and not draft.changed


def test_a_trial_measures_a_pair_on_longer_voxels(small_run, tmp_path):
    from lfpiv.studio import trial
    from lfpiv.studio.draft import Draft

    draft = Draft(small_run.experiment)
    draft.set(("correlation", "windows"), [6])
    request = {"experiment": str(draft.path), "values": draft.values, "results": str(small_run.out), "pair": 0}
    answer = trial.measure(request | {"coarser": 1.3, "out": str(tmp_path)})
    vectors = lfpiv.open_results(tmp_path).isel(pair=0)
    assert answer["calibrated"] and vectors["valid"].size > 1
    assert vectors["u"].notnull().all() and vectors.attrs["voxel_mm"][0] == pytest.approx(
        1.3 * lfpiv.open_experiment(small_run.experiment).grid.voxel_mm
    )


def test_cameras_and_solids_are_added_and_removed(draft):
    draft.add_camera()
    draft.add_solid("half_space", {"point_mm": [0.0, -0.2, 0.0], "normal": [0.0, 1.0, 0.0]})
    assert draft.problems() == {} and draft.get(("camera", 2, "focal_length_mm")) == 100.0
    draft.remove(("camera", 2))
    draft.remove(("volume", "solid", 0))
    assert len(draft.values["camera"]) == 2 and draft.problems() == {}


def test_the_schema_names_every_key(tmp_path, capsys):
    assert commands.call(["schema", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "lfpiv-experiment.schema.json").read_text("utf-8"))
    table = found["$defs"]["CameraTable"]["properties"]
    assert table["f_number"]["description"] and table["f_number"]["maximum"] == 1e4
    assert json.loads((tmp_path / "lfpiv-scene.schema.json").read_text("utf-8"))["properties"]["flow"]


def test_circles_lie_on_microimages_and_marks_on_dots(small_run):
    from lfpiv.studio.raw_images import RawImages

    experiment = lfpiv.open_experiment(small_run.experiment)
    images = RawImages(experiment, small_run.out)
    white = images.recorded("left", images.read("left", "white"))
    centres = images.lattice_px("left")
    inner = centres[((centres > 20) & (centres < 380)).all(1)][::7]
    window = np.mgrid[-6:7, -6:7]
    for column, row in inner:
        at = np.rint((row, column)).astype(int)
        light = white[at[0] - 6 : at[0] + 7, at[1] - 6 : at[1] + 7]
        middle = at + (window * (light - light.min())).sum((1, 2)) / (light - light.min()).sum()
        assert np.hypot(*(middle - (row, column))) < ON_THE_LENS_PX
    places, names, arrows = images.dots("left", 1)
    assert len(places) == len(names) and len(arrows)
    predicted = np.array([place for place in places if (place > 15).all() and (place < 385).all()])
    board = images.recorded("left", images.read("left", "plane 1"))
    lit = [board[int(r) - 9 : int(r) + 10, int(c) - 9 : int(c) + 10].max() for c, r in predicted]
    assert np.median(lit) > 5 * np.median(board)


def test_a_view_through_the_pupil_follows_the_pixel(small_run):
    from lfpiv.studio.raw_images import RawImages

    images = RawImages(lfpiv.open_experiment(small_run.experiment), small_run.out)
    centre = min(images.lattice_px("left"), key=lambda place: np.hypot(*(place - 200)))
    u, v = images.pupil_at("left", tuple(centre))
    right = images.pupil_at("left", (centre[0] + 4, centre[1]))
    radius = images.calibrated("left").optics.pupil_radius_mm
    assert np.hypot(u, v) < 0.15 * radius and abs(right[0] - u) > 0.2 * radius > 5 * abs(right[1] - v)
    view = images.pupil_view("left", "white", (u, v))
    assert np.median(view[view > 0]) == pytest.approx(1, abs=0.05)  # as bright as the white scene
    plane = images.refocused("left", "plane 1", 0.0)
    assert plane.max() > 4 * np.median(plane)


def test_cameras_see_what_they_look_at():
    from lfpiv.studio import rig_space

    def view(**nominal):
        camera = {
            "focal_length_mm": 100.0, "magnification": -1.0, "f_number": 4.0, "microlens_pitch_mm": 0.1,
            "microlens_focal_length_mm": 0.8, "pixel_um": 5.5, "name": "a", "white_image": "white.tif",
        }  # fmt: skip
        return rig_space.View.from_table(CameraTable(**camera, **nominal), (2000, 1000))

    aside = view(nominal_angle_deg=30.0)
    assert np.allclose(aside.camera.position, 200 * np.array([0.5, 0, np.sqrt(0.75)]))
    # 2000 pixels of 5.5 um at M = -1
    points = np.array([[0, 0, 0], [0, 5.4, 0], [0, 5.6, 0], [0, 0, 300]], float)
    assert aside.sees(points).tolist() == [True, True, False, False]
    focus = aside.pyramid(50.0).points
    assert any(np.allclose(abs(point[1]), 5.5) and np.hypot(*point[::2]) < 2.8 for point in focus)
    assert np.allclose(view(nominal_direction=[0, 0, 1]).camera.position, [0, 0, 200])
    rolled = view(nominal_angle_deg=0.0, nominal_roll_deg=30.0).camera
    assert np.allclose(np.cross(rolled.up, rolled.position) / 200, [np.sqrt(0.75), -0.5, 0])  # x_c cos r - y_c sin r
