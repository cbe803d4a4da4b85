"""Mistakes in TOML files: the message names line and text, what is wrong, and what to write; no guess is wrong."""

import os
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfpiv.errors import InputError
from lfpiv.experiment.toml import parse, read_toml, tomllib
from lfpiv.settings.experiment import ExperimentTable
from lfpiv.simulation.scene import Scene

MISTAKES = {
    "decimal comma": ("voxel_mm = 0,7", ["a point in a decimal number", "`voxel_mm = 0.7`"]),
    "comma of thousands": ("pairs = 10,000", ["`pairs = 10.000`", "`pairs = 10000`"]),
    "comma of a list": ("dots = 31,21", ["31.21", "[31,21]"]),
    "thousands by blanks": ("pairs = 1 000", ["without separators", "Write `pairs = 1000`."]),
    "thousands by points": ("pairs = 1.000.000", ["Write `pairs = 1000000`."]),
    "three numbers": ("size_mm = 100,200,300", ["100200300", "[100,200,300]"]),
    "list without brackets": ("size_mm = 1.5, 2.5, 3", ["`size_mm = [1.5, 2.5, 3]`"]),
    "unit": ("focal_length_mm = 50 mm", ["a number alone, in the unit that the key states"]),
    "unit in a list": ("size_mm = [1 mm, 2 mm, 3 mm]", ["a number alone"]),
    "unit behind a list": ("size_mm = [1, 2, 3] mm", ["a number alone"]),
    "backslash": (r'a = "C:\data\x.tif"  # raw', ["backslash", '"C:/data/x.tif"', r"'C:\data\x.tif'"]),
    "backslash and U": (r'a = "C:\Users\piv.tif"', ["backslash", '"C:/Users/piv.tif"']),
    "backslash at the end": (r'a = "C:\data\"', ["backslash", '"C:/data/"']),
    "curly quotes": ("name = “jet”", ["straight quotes", '`name = "jet"`.']),
    "German quotes": ("name = „jet“", ['`name = "jet"`.']),
    "no quotes": ("white_image = white/{camera}.tif", ["text in quotes", '"white/{camera}.tif"']),
    "no quotes in a list": ("frames = [a, b]", ["text in quotes", "found 'a, b]'"]),
    "no closing quote": ('name = "jet', ['`name = "jet"`.']),
    "no closing single quote": ("name = 'jet", ["`name = 'jet'`."]),
    "True": ("accelerate = True", ["small letters", "`accelerate = true`."]),
    "yes": ("accelerate = yes", ["expected true or false"]),
    "None": ("dark_image = None", ["Leave the key out"]),
    "no zero before the point": ("f = .5", ["`f = 0.5`."]),
    "no zero after the point": ("f = 5.", ["`f = 5.0`."]),
    "leading zero": ("f = 05", ["leading zeros", "`f = 5`."]),
    "minus sign": ("z = −0.5", ["plain minus sign", "`z = -0.5`."]),
    "calculation": ("dt_s = 1/1000", ["one number, not a calculation"]),
    "parentheses": ("size_mm = (1, 2, 3)", ["`size_mm = [1, 2, 3]`."]),
    "semicolons": ("size_mm = [0,5; 0,5; 1]", ["`size_mm = [0.5, 0.5, 1]`."]),
    "blanks": ("size_mm = [1 2 3]", ["commas", "`size_mm = [1, 2, 3]`."]),
    "colon": ("voxel_mm: 0.7", ["expected = between key and value", "`voxel_mm = 0.7`"]),
    "nothing between": ("voxel_mm 0.7", ["expected = between key and value", "`voxel_mm = 0.7`"]),
    "blank in the key": ("voxel mm = 0.7", ["`voxel_mm = 0.7`"]),
    "no value": ("dt_s = # later", ["expected a number", "found none"]),
    "comment of C": ("dt_s = 1 // s", ["# before a comment", "`dt_s = 1 # s`"]),
    "semicolon": ("dt_s = 1;", ["`dt_s = 1`."]),
    "bracket of a table": ("[camera", ["`[camera]`, or `[[camera]]`"]),
    "hard blank": ("a\u00a0= 1", ["plain blanks", "`a = 1`"]),
    "full-width comma": ("a = 1，2", ["found '，2'"]),
    "table twice": ("[table]\n[table]", ["line 5, `[table]`", "each table once"]),
    "both kinds of tables": ("[camera]\n[[camera]]", ["line 5, `[[camera]]`"]),
    "key twice": ("a = 1\na = 2", ["line 5, `a = 2`", "each key"]),
    "list left open": ("size_mm = [1, 2\na = 1", ["line 5, `a = 1`", "its closing bracket"]),
}
"""What follows three lines, and what its message holds."""


def refused(text, tmp_path):
    with pytest.raises(InputError) as caught:
        parse(text, tmp_path / "experiment.toml")
    return str(caught.value)


@pytest.mark.parametrize(("line", "words"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_explained_in_the_files_own_words(line, words, tmp_path):
    before, after = '# jet\nname = "jet"\n\n', '\n\n[board]\nspacing_mm = 1.0\nimages = "b.tif"\n'
    for text in (before + line + after, before + line, (before + line + after).replace("\n", "\r\n")):
        message = refused(text, tmp_path)
        assert f"experiment.toml: line {4 + line.count(chr(10))}, `" in message, message
        assert all(word in message for word in words), message


@pytest.mark.parametrize(("line", "words"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_line_that_is_right_is_not_blamed_for_another(line, words, tmp_path):
    """The same text is no mistake in a comment or in quotes, and the message names the line that is wrong."""
    line = line.partition("\n")[0]
    quoted = "'''" + line + "'''"
    message = refused(f"# {line}\na = {quoted}\nb = ?\n{line}\n", tmp_path)
    assert "line 3, `b = ?`" in message, message


SAID = st.sampled_from(list("0123456789.,;:'\"[](){}+-eEx mm°/\\# =αtrue"))


@given(st.text(SAID, min_size=1, max_size=12))
def test_a_value_is_said_to_be_another_only_if_that_is_toml(value):
    """Whatever is proposed in place of a value, a message proposes it only where the parser takes it."""
    line = f"voxel_mm = {value}"
    try:
        tomllib.loads(line + "\n")
    except tomllib.TOMLDecodeError:
        pass
    else:
        return
    with pytest.raises(InputError) as caught:
        parse(line, "file")
    message = str(caught.value)
    assert message.startswith("file: line 1, `") or "\n" in value
    for proposed in re.findall("`([^`]*)`", message.partition(". Write ")[2]):
        assert tomllib.loads(proposed + "\n")


def replaced(file, old, new, encoding="utf-8"):
    text = file.read_text("utf-8")
    assert old in text
    file.write_bytes(text.replace(old, new).encode(encoding))
    with pytest.raises(InputError) as caught:
        read_toml(file, ExperimentTable)
    return str(caught.value)


def test_values_that_are_toml_but_were_meant_otherwise(tiny_experiment):
    text = tiny_experiment.read_text("utf-8")
    voxel = next(line for line in text.splitlines() if line.startswith("voxel_mm"))
    centre = next(line for line in text.splitlines() if line.startswith("centre_mm"))
    white = next(line for line in text.splitlines() if line.startswith("white_image"))

    def message(old, new):
        found = replaced(tiny_experiment, old, new)
        tiny_experiment.write_text(text, "utf-8")
        return found

    assert "found the text '0,7'. Write it without quotes, with a point." in message(voxel, 'voxel_mm = "0,7"')
    assert "write decimals with a point" in message(centre, "centre_mm = [0,5, 0,5, 0,5]")
    assert "Write [board]." in message("[board]", "[[board]]")
    assert "control characters" in message(white, r'white_image = "raw\new\table.tif"')
    first, _, rest = text.partition("[[camera]]")
    one = first + "[camera]" + rest.partition("[[camera]]")[0] + text[text.index("[board]") :]
    assert "Write [[camera]]." in message(text, one)
    assert "found bytes of value 0, as UTF-16" in replaced(tiny_experiment, text, text, "utf-16-le")


def test_a_path_of_windows_is_explained_where_no_file_is_found(tiny_experiment):
    from lfpiv.experiment.opening import read_experiment

    if os.sep != "/":
        pytest.skip("a backslash separates folders here")
    text = tiny_experiment.read_text("utf-8")
    tiny_experiment.write_text(text.replace('"white/left.tif"', r"'white\left.tif'"), "utf-8")
    with pytest.raises(InputError, match="separated by / here, not by a backslash"):
        read_experiment(tiny_experiment)


def test_mistakes_in_a_scene_are_explained_alike(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text("name = 'jet'\npairs = 3\nseed = 1 000\n")
    with pytest.raises(InputError, match=r"scene\.toml: line 3, `seed = 1 000`: .* Write `seed = 1000`\."):
        read_toml(scene, Scene)
