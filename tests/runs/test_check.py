"""`lfpiv check`: the board of each camera with arrows along x and y, and what contradicts it."""

import tifffile
from matplotlib import image

import lfpiv
from lfpiv.cli import commands
from lfpiv.runs.check import check


def test_the_board_is_drawn_and_a_contradiction_ends_the_command(small_run, tmp_path, monkeypatch, capsys):
    path = small_run.images(tmp_path / "data")
    monkeypatch.setattr("lfpiv.runs.check.likely_cause", lambda experiment, stretches: None)
    found = check(path, tmp_path / "out")
    rows, columns = image.imread(found["picture"]).shape[:2]
    assert rows > columns > 800  # one row a camera
    assert "x points left and y up for 'left' and 'right'" in found["axes"] and "right-handed" in found["axes"]
    monkeypatch.setattr("lfpiv.runs.check.likely_cause", lambda experiment, stretches: "planes reversed")
    assert commands.call(["check", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "planes reversed" in capsys.readouterr().err


def test_the_arrows_follow_the_recorded_pictures(small_run, tmp_path, monkeypatch):
    path = small_run.images(tmp_path / "data")
    path.write_text(path.read_text("utf-8").replace('image_flip = "none"', 'image_flip = "horizontal"'), "utf-8")
    for file in [*path.parent.glob("white/*.tif"), *path.parent.glob("board/*/*.tif")]:
        tifffile.imwrite(file, tifffile.imread(file)[:, ::-1])
    drawn = []
    monkeypatch.setattr("lfpiv.runs.check.draw", lambda views, said, picture: drawn.extend(views))
    monkeypatch.setattr("lfpiv.runs.check.likely_cause", lambda experiment, stretches: None)
    assert "x points right and y up" in check(lfpiv.open_experiment(path), tmp_path / "out")["axes"]
    for view in drawn:
        middle, x_tip, y_tip = view.arrows_px
        assert x_tip[0] > middle[0] + 20 and y_tip[1] < middle[1] - 20  # right and up in the picture
