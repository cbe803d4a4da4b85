"""Mutated, hostile and huge experiment and scene files: accepted, or refused in one short message, fast and small."""

import os
import re
import resource
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.mutations import mutated

import lfpiv
from lfpiv.errors import LONGEST_MESSAGE, InputError, printable
from lfpiv.experiment.opening import open_experiment, read_experiment
from lfpiv.experiment.toml import LARGEST_BYTES
from lfpiv.settings.experiment import ExperimentTable
from lfpiv.settings.volume import Box, HalfSpace
from lfpiv.simulation.scene import Scene, open_scene
from lfpiv.simulation.surfaces import solid

LONGEST_S = 2.0
"""Most time that a refused file may take [s]."""
MOST_KIB = 200 * 1024
"""Most memory that a refused file may take beside what the process has [KiB]."""

DEMO_SCENE = Path(lfpiv.__file__).parent / "cli" / "demo_scene.toml"
EVERY_TABLE = re.sub(r"(?m)^# (?=\[|\w+ = )", "", DEMO_SCENE.read_text("utf-8"))
"""The scene of the demonstration with its optional tables, which it has as comments."""


def outcome(read, path):
    """Return the message of a refused file, None for an accepted one. Fail for another exception or a slow one."""
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    try:
        read(path)
        message = None
    except InputError as error:
        message = str(error)
        assert 0 < len(message) <= LONGEST_MESSAGE and message == printable(message), message
    assert time.process_time() - start < LONGEST_S, message
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_KIB, message
    return message


fuzzed = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@fuzzed
@given(st.data())
def test_a_mutated_experiment_file_is_accepted_or_refused_in_one_message(tiny_experiment, data):
    file = tiny_experiment.with_name("mutated.toml")
    file.write_bytes(data.draw(mutated(tiny_experiment.read_text())))
    message = outcome(read_experiment, file)
    assert message is None or str(tiny_experiment.parent) in message


@fuzzed
@given(mutated(EVERY_TABLE))
def test_a_mutated_scene_file_is_accepted_or_refused_in_one_message(tmp_path, content):
    file = tmp_path / "scene.toml"
    file.write_bytes(content)
    outcome(open_scene, file)


def test_what_is_no_regular_file_of_text_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")  # nobody writes into it
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(tmp_path / "socket.toml"))
    os.symlink("/dev/zero", tmp_path / "device.toml")
    os.symlink("loop.toml", tmp_path / "loop.toml")
    with open(tmp_path / "huge.toml", "wb") as huge:
        huge.truncate(160 << 30)
    (tmp_path / "long.toml").write_text("# comment\n" * (LARGEST_BYTES // 10 + 1))
    (tmp_path / "binary.toml").write_bytes(bytes(range(256)))
    said = {
        "pipe": "a pipe, a socket or a device",
        "socket": "cannot be read",
        "device": "a pipe, a socket or a device",
        "loop": "symbolic links",
        "huge": "found 167,772,160 KiB",
        "long": "at most 256 KiB",
        "binary": "UTF-8",
    }
    for name, words in said.items():
        for read in (open_experiment, open_scene):
            assert words in outcome(read, tmp_path / f"{name}.toml")
    listening.close()
    for name in ("a\0b.toml", "\ud800.toml", f"{'n' * 300}.toml", f"{'d/' * 3000}x.toml"):
        assert "cannot be read" in outcome(open_experiment, tmp_path / name)


CHANGES = {
    "nested lists": ("pairs = 2", "pairs = " + "[" * 5000 + "2" + "]" * 5000, "nested at most 16 deep"),
    "nested tables": ("pairs = 2", "pairs = " + "{a = " * 200 + "2" + "}" * 200, "nested at most 16 deep"),
    "dotted key": ("pairs = 2", ".".join("a" * 60_000) + " = 2", "nested at most 16 deep"),
    "digits": ("pairs = 2", "pairs = " + "2" * 5000, "thousands of digits"),
    "hexadecimal": ("pairs = 2", "pairs = 0x" + "f" * 5000, "below 2^63"),
    "many keys": ("pairs = 2", "\n".join(f"k{n} = 1" for n in range(9000)), "more."),
    "long key": ("pairs = 2", "k" * 9000 + " = 1", "unknown key"),
    "gigabyte of digits": ("{pair:04d}", "{pair:1000000000d}", "width up to 20"),
    "gigabyte of blanks": ("{pair:04d}", "{pair!r:>99999999}", "width up to 20"),
    "width of text": ("{camera}/{pair", "{camera:9999999999}/{pair", "expected {camera}, found"),
    "attribute": ("{camera}/{pair", "{camera.__class__}/{pair", "only {camera}, {pair}, {frame}"),
    "index": ("{camera}/{pair", "{camera[0]}/{pair", "only {camera}, {pair}, {frame}"),
    "nested field": ("{pair:04d}", "{pair:{frame}}", "width up to 20"),
    "NUL": ("white/left.tif", "white\\u0000.tif", "control characters"),
    "escape": ('name = "tiny"', 'name = "\\u001b[2J"', "control characters"),
    "long name": ("white/left.tif", "w" * 300 + ".tif", "at most 255 bytes"),
    "long name of bytes": ("white/left.tif", "é" * 200 + ".tif", "at most 255 bytes"),
    "long pattern": ("{camera}/{pair:04d}{frame}", "{camera}" * 60 + "{pair}{frame}", "at most 255 bytes"),
    "huge length": (
        "focal_length_mm = 100.0",
        "focal_length_mm = 1e308",
        "focal_length_mm: expected 100000 or less",
    ),
    "tiny length": ("spacing_mm = 0.1", "spacing_mm = 1e-300", "spacing_mm: expected 1e-06 or more"),
    "tiny magnification": ("magnification = -1.0", "magnification = 1e-300", "magnitude 0.0001 to 1000"),
    "tiny f-number": ("f_number = 4.0", "f_number = 0.1", "f_number: expected microimages from 1 pixel to 4 times"),
    "large f-number": ("f_number = 4.0", "f_number = 10000", "f_number: expected microimages from 1 pixel"),
    "huge volume": ("size_mm = [0.8, 0.6, 0.4]", "size_mm = [1e4, 1e4, 1e4]", "Lengths are in millimetres"),
    "huge guard layers": ("voxel_mm = 0.05", "voxel_mm = 0.05\nguard_mm = 1e6", "at most 1e+11 voxels"),
    "solids beyond memory": (
        "voxel_mm = 0.05",
        'voxel_mm = 0.05\nguard_mm = 80\n[[volume.solid]]\nkind = "box"\ncentre_mm = [0, 0, 0]\nsize_mm = [1, 1, 1]',
        "fit into memory",
    ),
    "no direction": (
        "voxel_mm = 0.05",
        'voxel_mm = 0.05\n[[volume.solid]]\nkind = "half_space"\npoint_mm = [0, 0, 0]\nnormal = [1e-300, 0, 0]',
        "direction of length",
    ),
    "many dots": (
        "dots = [5, 5]\nspacing_mm = 0.1\ndot_diameter_mm = 0.02\nplanes_mm = [-0.2, 0.2]",
        "dots = [900, 900]\nspacing_mm = 0.1\ndot_diameter_mm = 0.02\nplanes_mm = [-90, 90]",
        "1,000,000 dots in all planes, found 1,620,000",
    ),
    "plane behind the lens": ("planes_mm = [-0.2, 0.2]", "planes_mm = [-0.2, 900]", "behind the lens"),
    "far search": ("pairs = 2", "pairs = 2\n[correlation]\nmax_displacement_voxel = 16", "less than the volume's 16"),
    "huge network": ("pairs = 2", "pairs = 2\n[network]\nhidden = [200, 200]", "at most 10000 weights"),
    "many cameras": ("[board]", "[[camera]]\n" * 5000 + "[board]", "more: these keys are missing"),
    "many planes": ("[-0.2, 0.2]", str(list(range(3000))), "planes_mm: expected at most 1000 value(s)"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_would_take_all_memory_or_overflow_is_named(tiny_experiment, change):
    old, new, words = CHANGES[change]
    text = tiny_experiment.read_text()
    assert old in text
    tiny_experiment.write_text(text.replace(old, new, 1))
    message = outcome(open_experiment, tiny_experiment)
    assert message and words in message, message


@pytest.mark.parametrize("count", ["pairs = 1000000", "pairs = 1000000000", "pairs = 2_000"])
def test_a_long_campaign_is_opened_without_looking_at_each_image(tiny_experiment, count):
    tiny_experiment.write_text(tiny_experiment.read_text().replace("pairs = 2", count))
    start = time.process_time()
    assert read_experiment(tiny_experiment).pairs == int(count.split()[-1])
    assert "no such file" in outcome(open_experiment, tiny_experiment)  # of a pair far behind the two that there are
    assert time.process_time() - start < LONGEST_S


def test_experiments_and_scenes_have_the_same_solids():
    """A point on a face, and a voxel whose centre lies there, is not inside: no more than half of it is solid."""
    wall = HalfSpace(point_mm=(0, 0, 1), normal=(0, 0, -2))
    box = Box(centre_mm=(1, 0, 0), size_mm=(2, 2, 2))
    points = [[0, 0, 1], [0, 0, 1.1], [2, 0, 0], [1.9, 0, 0], [1, 0.9, 0.9]]
    assert wall.contains(*np.transpose(points)).tolist() == [False, True, False, False, False]
    assert box.contains(*np.transpose(points)).tolist() == [False, False, False, True, True]
    assert solid((wall, box), np.array(points)).tolist() == [False, True, False, True, True]


def unbounded(entry, name, definitions, above=frozenset()):
    """Yield the keys below an entry of a JSON schema whose numbers, texts or lists have no bound."""
    if "$ref" in entry:
        table = entry["$ref"].rpartition("/")[2]
        if table not in above:
            yield from unbounded(definitions[table], name, definitions, above | {table})
    for part in (*entry.get("anyOf", ()), *entry.get("oneOf", ()), *entry.get("prefixItems", ())):
        yield from unbounded(part, name, definitions, above)
    for key, part in entry.get("properties", {}).items():
        yield from unbounded(part, f"{name}.{key}", definitions, above)
    needed = {
        "array": [{"maxItems"}] if "items" in entry else [],
        "string": [{"maxLength", "enum", "const"}],
        "number": [{"minimum", "exclusiveMinimum", "enum"}, {"maximum", "exclusiveMaximum", "enum"}],
    }
    needed["integer"] = needed["number"]
    if not all(one & set(entry) for one in needed.get(entry.get("type"), [])):
        yield name
    if isinstance(entry.get("items"), dict):
        yield from unbounded(entry["items"], f"{name}[]", definitions, above)


@pytest.mark.parametrize("model", [ExperimentTable, Scene])
def test_every_value_of_a_file_has_bounds(model):
    """But the magnification, whose magnitude has."""
    schema = model.model_json_schema()
    assert set(unbounded(schema, "", schema["$defs"])) == {".camera[].magnification"}
