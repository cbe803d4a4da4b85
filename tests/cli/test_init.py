"""`lfpiv init`: a commented experiment file by options or by questions, valid before any image exists."""

import io
import json
import shlex
import sys
from pathlib import Path

import pytest

import lfpiv
from lfpiv.cli import commands, questions
from lfpiv.experiment.toml import read_toml, tomllib
from lfpiv.settings.experiment import ExperimentTable

EXAMPLE = shlex.split(questions.EXAMPLE)


class Terminal(io.StringIO):
    """Standard input with a person's answers."""

    def isatty(self):
        return True


def call(path, *options):
    return commands.call(["init", str(path), *options])


def without(option):
    """Options of the example but one, if it is there; a value may stand behind "=" or alone."""
    words = list(EXAMPLE)
    names = [word.partition("=")[0] for word in words]
    if option not in names:
        return words
    index = names.index(option)
    del words[index : index + (1 if "=" in words[index] else 2)]
    return words


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())


def test_options_give_a_valid_commented_file(tmp_path, capfd):
    path = tmp_path / "jet" / "experiment.toml"
    assert call(path, *EXAMPLE) == 0
    shown = capfd.readouterr().out
    assert f"experiment: {path}" in shown and f"lfpiv check {path}" in shown and f"each with {path}" in shown
    missing = next(line for line in shown.splitlines() if line.startswith("not complete yet"))
    for name in ("white/left.tif", "white/right.tif", "board/right/plane_00.tif", "plane_08.tif (9 images)"):
        assert name in missing
    schema = json.loads((path.parent / "lfpiv-experiment.schema.json").read_text("utf-8"))
    assert "./lfpiv-experiment.schema.json" in path.read_text("utf-8").splitlines()[0] and schema["properties"]["dt_s"]
    table = read_toml(path, ExperimentTable)
    assert [(camera.name, camera.nominal_angle_deg) for camera in table.camera] == [("left", 45.0), ("right", -45.0)]
    assert table.name == "jet" and table.dt_s == 1e-4 and table.particles.pairs == 100
    assert {camera.pixel_um for camera in table.camera} == {5.5} and table.camera[1].white_image == "white/right.tif"
    assert table.board.dots == (7, 7) and table.board.planes_mm == (-2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2)
    assert table.volume.size_mm == (6.0, 6.0, 3.0)
    assert table.volume.voxel_mm == 0.1  # a microlens over the magnification
    rows = [line for line in path.read_text().splitlines() if " = " in line]
    assert rows and all(" # " in line for line in rows)


def test_its_optional_keys_are_valid_too(tmp_path):
    path = tmp_path / "experiment.toml"
    for images in ("p/{camera}/{pair}{frame}.tif", "p/{camera}/{instant}.tif"):
        path.unlink(missing_ok=True)
        assert call(path, *EXAMPLE, "--images", images) == 0
        text = "\n".join(
            line.removeprefix("# ") for line in path.read_text().splitlines() if "[" in line or " = " in line
        )
        table = ExperimentTable.model_validate(tomllib.loads(text))
        assert table.particles.instants == (100 if "instant" in images else None)
        assert table.correlation.overlap == 0.5 and table.camera[0].dark_image == "dark/left.tif"


def test_an_experiment_whose_images_exist_is_complete(tiny_experiment, capfd):
    path = tiny_experiment.parent / "new.toml"
    options = (
        "--cameras left=30,right=-30 --focal-length 100 --magnification -1 --f-number 4 --microlens-pitch 0.1 "
        "--microlens-focal-length 0.8 --pixel 10 --dots 5x5 --spacing 0.1 --dot-diameter 0.02 --planes=-0.2,0.2 "
        "--size 0.8x0.6x0.4 --voxel 0.05 --dt 1e-3 --name tiny "
        "--images particles/{camera}/{pair:04d}{frame}.tif"
    )
    assert call(path, *shlex.split(options)) == 0
    shown = capfd.readouterr().out
    assert "not complete yet" not in shown and "--pairs 2" in shown  # counted by the images
    made, given = lfpiv.open_experiment(path), lfpiv.open_experiment(tiny_experiment)
    assert made.board == given.board and made.grid.shape == given.grid.shape and made.dt_s == given.dt_s
    assert [camera.optics for camera in made.cameras] == [camera.optics for camera in given.cameras]


def test_it_tells_how_many_vectors_a_run_measures(tmp_path, capfd):
    assert call(tmp_path / "thick.toml", *EXAMPLE) == 0
    said = capfd.readouterr().out
    assert "a run measures 9 x 9 x 4 vectors (x, y, z)" in said and "warning" not in said
    assert call(tmp_path / "thin.toml", *EXAMPLE, "--size", "6x6x1.5") == 0
    said = capfd.readouterr().out
    assert "9 x 9 x 1 vectors" in said and "warning: few vectors: 1 along z" in said and "vorticity" in said


def test_an_existing_file_is_kept(tmp_path, capfd):
    path = tmp_path / "experiment.toml"
    path.write_text("mine")
    assert call(path, *EXAMPLE) == 2
    assert path.read_text() == "mine" and str(path) in capfd.readouterr().err


def test_without_a_terminal_all_missing_options_are_named(tmp_path, capfd):
    path = tmp_path / "experiment.toml"
    assert call(path, "--name", "jet") == 2
    message = capfd.readouterr().err
    required = {one.option for one in questions.QUESTIONS if one.default is None} - {"--name", "--voxel"}
    assert message.count("\n") == 1 and all(option in message for option in required)
    assert call(path, *without("--pixel")) == 2
    message = capfd.readouterr().err
    assert "--pixel" in message and "--dots" not in message
    assert not path.exists()


@pytest.mark.parametrize(
    ("option", "answer", "words"),
    [
        ("--pixel", "5,5", ["a number", "decimal point", "'5,5'"]),
        ("--pixel", "-5.5", ["--pixel", "greater than"]),
        ("--focal-length", "long", ["--focal-length", "'long'"]),
        ("--magnification", "0", ["--magnification"]),
        ("--image-flip", "sideways", ["--image-flip", "none, horizontal, vertical or both"]),
        ("--cameras", "left,right", ["--cameras", "NAME=ANGLE"]),
        ("--cameras", "left=45,left=-45", ["camera"]),
        ("--dots", "7", ["--dots", "expected two whole numbers, such as 7x7, found '7'"]),
        ("--dots", "1x7", ["two whole numbers, such as 7x7 (greater than or equal to 2), found"]),
        ("--planes", "-1:1:0.3", ["--planes", "FIRST:LAST:STEP"]),
        ("--planes", "0:1:0", ["--planes"]),
        ("--dot-diameter", "1.5", ["dot_diameter_mm smaller than spacing_mm"]),
        ("--dt", "0", ["--dt"]),
    ],
)
def test_wrong_answers_are_named_and_nothing_is_written(tmp_path, capfd, option, answer, words):
    assert call(tmp_path / "experiment.toml", *without(option), f"{option}={answer}") == 2
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and all(word in message for word in words), message
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["7x8", "7 x 8", "7, 8", "[7, 8]", "7 8"])
def test_sizes_are_read_as_people_write_them(text):
    (dots,) = (one for one in questions.QUESTIONS if one.key == "dots")
    (planes,) = (one for one in questions.QUESTIONS if one.key == "planes_mm")
    assert dots.value(text) == (7, 8) and planes.value("[-1, 0.5]") == (-1.0, 0.5)


def test_a_terminal_is_asked_for_what_is_left_out_until_the_answer_can_be_read(tmp_path, capfd, monkeypatch):
    path = tmp_path / "experiment.toml"
    answers = {"cameras": "a=30,b=-30", "pixel_um": "5,5\n5.5", "count": "20"}
    words = list(EXAMPLE)
    for option in ("--cameras", "--pixel", "--pairs"):
        index = words.index(option)
        del words[index : index + 2]
    given = {word.partition("=")[0] for word in words}
    text = "".join(
        f"{answers[one.key]}\n" for one in questions.QUESTIONS if one.option not in given and one.key in answers
    )
    monkeypatch.setattr(sys, "stdin", Terminal(text))
    assert call(path, *words) == 0
    said, asked = capfd.readouterr()
    assert "--image-flip horizontal" in said and "Pictures show" not in asked  # what has a default is not asked
    assert asked.count("Pixel pitch") == 2 and "decimal point" in asked and "Focal length of the main" not in asked
    table = read_toml(path, ExperimentTable)
    assert [camera.name for camera in table.camera] == ["a", "b"] and table.particles.pairs == 20
    assert table.board.images == "board/{camera}/plane_{plane:02d}.tif"


def test_an_interrupted_dialogue_writes_nothing(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(sys, "stdin", Terminal("left=45\n"))
    assert call(tmp_path / "experiment.toml") == 1
    assert "nothing is written" in capfd.readouterr().err and not any(Path(tmp_path).iterdir())
