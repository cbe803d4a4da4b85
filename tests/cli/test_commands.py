"""The command line: exit status, one message per user error, no files after a failure."""

import importlib.resources
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import typer

import lfpiv
from lfpiv.cli import commands, terminal
from lfpiv.errors import InputError
from lfpiv.quantities import duration
from lfpiv.runs import memory, pipeline


def run(*arguments):
    """Run a process; return status, standard output and standard error."""
    command = [sys.executable, "-m", "lfpiv", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "COLUMNS": "80"})
    return done.returncode, done.stdout, done.stderr


def edit(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


SPOILERS = {
    "first pair truncated": (
        lambda e: os.truncate(e.parent / "particles/right/0000b.tif", 900),
        "--pairs 1:",
    ),
    "too little memory": (lambda e: edit(e, "voxel_mm = 0.05", "voxel_mm = 1e-3"), "GiB"),
    "more than any memory": (
        lambda e: edit(e, "voxel_mm = 0.05", "guard_mm = 1e5\nvoxel_mm = 0.05"),
        "at most 1e+11 voxels",
    ),
    "no such pair": (lambda e: None, "pairs"),
    "a million threads": (lambda e: edit(e, "pairs = 2", "pairs = 2\n[compute]\nthreads = 1000000"), "compute.threads"),
}


@pytest.mark.parametrize("case", SPOILERS)  # others: tests/contract/test_refusals.py, tests/experiment
def test_bad_input_is_status_2_with_one_line_and_nothing_left(tiny_experiment, tmp_path, capfd, case):
    spoil, named = SPOILERS[case]
    spoil(tiny_experiment)
    before = sorted(tmp_path.rglob("*"))
    pairs = ["--pairs", "1:3"] if case == "no such pair" else []
    status = commands.call(["run", str(tiny_experiment), "--out", str(tmp_path / "new" / "out"), *pairs])
    written, message = capfd.readouterr()
    assert status == 2 and written == ""
    assert message.count("\n") == 1 and message.startswith("lfpiv: ") and named in message, message
    assert "Traceback" not in message
    assert sorted(tmp_path.rglob("*")) == before


def test_many_warnings_are_counted(capfd, tmp_path):
    texts = [f"camera {number} sleeps" for number in range(terminal.LISTED_WARNINGS + 1234)]
    summary = {"calibration": {}, "pairs": [], "warnings": texts, "timings_s": {"total": 1.0}, "peak_memory_mib": 1.0}
    terminal.print_run(summary, tmp_path)
    lines = capfd.readouterr().out.splitlines()
    assert sum(line.startswith("warning: camera") for line in lines) == terminal.LISTED_WARNINGS
    assert f"1,234 more warnings are in {tmp_path / 'summary.json'}" in lines


@pytest.mark.parametrize("command", ["run", "calibrate", "reconstruct", "correlate", "report"])
def test_every_step_refuses_a_folder_it_cannot_write(tiny_experiment, tmp_path, capfd, command):
    (tmp_path / "file").write_text("not a folder")
    status = commands.call([command, str(tiny_experiment), "--out", str(tmp_path / "file" / "out")])
    message = capfd.readouterr().err
    assert status == 2 and message.count("\n") == 1 and str(tmp_path / "file" / "out") in message


@pytest.mark.parametrize(("name", "make"), [("vectors", "file"), ("volumes", "file"), ("calibration.h5", "folder")])
def test_a_place_for_results_that_is_taken_is_refused_before_work(tiny_experiment, tmp_path, capfd, name, make):
    place = tmp_path / "out" / name
    place.parent.mkdir()
    if make == "file":
        place.write_text("not a folder")
    else:
        place.mkdir()
    status = commands.call(["run", str(tiny_experiment), "--out", str(place.parent)])
    message = capfd.readouterr().err
    assert status == 2 and message.count("\n") == 1 and str(place) in message and "expected a" in message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run"], ["EXPERIMENT.toml"]),
        (["run", "x.toml"], ["--out"]),
        (["frobnicate"], ["frobnicate"]),
        (["run", "x.toml", "--out", "x", "--device", "tpu"], ["--device", "tpu"]),
        (["run", "x.toml", "--out", "x", "--pairs", "3-5"], ["--pairs", "A:B"]),
        (["run", "x.toml", "--out", "x", "--pairs", ""], ["--pairs", "A:B"]),
        (["run", "no-such-file.toml", "--out", "x"], ["no-such-file.toml", "no such file"]),
        (["run", ".", "--out", "x"], ["a folder"]),
    ],
)
def test_wrong_usage_is_status_2_with_one_line(tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert commands.call(arguments) == 2
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and all(word in message for word in words), message
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (ZeroDivisionError("by zero"), 1, ["unexpected ZeroDivisionError: by zero", "--debug"]),
        (KeyboardInterrupt(), 1, ["interrupted"]),
        (MemoryError(), 1, ["out of memory"]),
        (InputError("file.tif: expected light,\nfound none."), 2, ["file.tif: expected light, found none."]),
    ],
)
def test_a_failure_inside_is_one_line_and_a_traceback_only_on_request(monkeypatch, capfd, error, status, words):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(pipeline, "run", fail)
    assert commands.call(["run", "x.toml", "--out", "x"]) == status
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and all(word in message for word in words), message
    assert commands.call(["run", "x.toml", "--out", "x", "--debug"]) == status
    assert "Traceback" in capfd.readouterr().err


@pytest.mark.slow
def test_real_processes_end_with_the_same_status(tiny_experiment, tmp_path):
    assert run("--version") == (0, f"lfpiv {lfpiv.__version__}\n", "")
    (tiny_experiment.parent / "white/left.tif").unlink()
    status, written, message = run("run", tiny_experiment, "--out", tmp_path / "out")
    assert status == 2 and written == "" and message.count("\n") == 1 and "white/left.tif" in message
    assert not (tmp_path / "out").exists()


def test_json_is_all_of_standard_output_and_quiet_prints_nothing(monkeypatch, tmp_path, capfd):
    summary = {"failed": [{"pair": 1, "reason": "dark"}], "experiment": {"pairs": 2}, "value": np.float32("nan")}
    monkeypatch.setattr(pipeline, "run", lambda *args, **options: summary)
    command = ["run", "x.toml", "--out", str(tmp_path)]
    assert commands.call([*command, "--json"]) == 3
    written, message = capfd.readouterr()
    assert json.loads(written) == {**summary, "value": None} and "failed: pair 1: dark" in message
    monkeypatch.setattr(pipeline, "run", lambda *args, **options: {**summary, "failed": []})
    assert commands.call([*command, "--quiet"]) == 0 and capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("text", "pairs"),
    [("1", (1, 2)), ("0", (0, 1)), ("2:5", (2, 5)), ("2:", (2, None)), (":5", (0, 5)), (":", (0, None))],
)
def test_pairs_are_a_single_number_or_a_range(monkeypatch, tmp_path, text, pairs):
    asked = []
    monkeypatch.setattr(pipeline, "run", lambda file, out, **options: asked.append((out, options["pairs"])))
    commands.call(["run", "x.toml", "-o", str(tmp_path), "--quiet", "--pairs", text])
    assert asked == [(tmp_path, pairs)]


@pytest.mark.parametrize("command", ["run", "calibrate", "preview"])
def test_a_scene_is_named_as_such(tmp_path, capfd, command):
    scene = tmp_path / "scene.toml"
    scene.write_text((importlib.resources.files("lfpiv.cli") / "demo_scene.toml").read_text("utf-8"))
    assert commands.call([command, str(scene), "--out", str(tmp_path / "out")]) == 2
    message = capfd.readouterr().err
    assert (
        message.count("\n") == 1
        and f"`lfpiv simulate {scene} --out DIR`" in message
        and not (tmp_path / "out").exists()
    )


def test_the_demonstration_ends_with_warnings_and_three_aligned_lines(tmp_path, capfd):
    found = {
        "mean_error_voxel": 0.234,
        "median_error_voxel": 0.2,
        "largest_displacement_voxel": 2.71,
        "voxel_m_per_s": 10.0,
        "vectors": 1234,
        "speed_m_per_s": 2.66,
    }
    summary = {"demo": found, "valid_fraction": 0.996, "timings_s": {"total": 41.2}, "warnings": ["camera left sleeps"]}
    terminal.print_demo(summary, tmp_path)
    warning, *lines = capfd.readouterr().out.splitlines()
    assert warning == "warning: camera left sleeps" and len(lines) == 3
    assert len({len(line) - len(line.split(maxsplit=1)[1]) for line in lines[:2]}) == 1
    assert all(word in lines[0] for word in ("1,234 vectors", "99.6 % valid", "2.7 m/s"))
    assert (
        "0.23 voxel (2.3 m/s)" in lines[1]
        and "2.7 voxel (27 m/s)" in lines[1]
        and str(tmp_path / "report.html") in lines[2]
    )


@pytest.mark.slow
def test_options_of_one_call_do_not_reach_the_next(capfd):
    assert commands.call(["doctor", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert {"item", "finding", "good"} == set(found[0]) and all(item["good"] for item in found)
    assert commands.call(["doctor"]) == 0
    assert found[0]["finding"] in capfd.readouterr().out.splitlines()[0]


def known_commands():
    """Each command by its name, those of a group by both names."""
    found = {}
    for name, command in typer.main.get_command(commands.app).commands.items():
        inner = getattr(command, "commands", None)
        found |= {name: command} if inner is None else {f"{name} {own}": inner[own] for own in inner}
    return found


@pytest.mark.parametrize("name", sorted(known_commands()))
def test_help_shows_examples_that_the_parser_takes(name, capfd, monkeypatch):
    names = name.split()
    assert commands.call([*names, "--help"]) == 0
    shown = capfd.readouterr().out
    examples = [line.split() for line in shown.split("Examples:")[1].splitlines() if line.strip()]
    assert examples and all(words[: len(names) + 1] == ["lfpiv", *names] for words in examples)
    for _, *words in examples:
        known_commands()[name].make_context(name, words[len(names) :])  # raises on what it does not know


def test_a_group_without_command_lists_its_commands(capfd):
    assert commands.call(["benchmark"]) == 0
    assert {"list", "make"} <= set(capfd.readouterr().out.split("Commands:")[1].split())


def test_the_shell_completes_commands():
    words = {"_LFPIV_COMPLETE": "complete_bash", "COMP_WORDS": "lfpiv re", "COMP_CWORD": "1"}
    done = subprocess.run([sys.executable, "-m", "lfpiv"], capture_output=True, text=True, env={**os.environ, **words})
    assert done.stdout.split() == ["reconstruct", "report", "reproduce"]


def test_log_lines_state_the_remaining_time(caplog, monkeypatch):
    clock = iter([0.0, 5.0, 60.0, 120.0])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(clock))
    with terminal.Output().progress() as progress, caplog.at_level("INFO", "lfpiv"):
        for fraction in (0.0, 0.05, 0.25, 1.0):
            progress("step", fraction)
    assert [record.getMessage() for record in caplog.records] == ["step: 0 %", "step: 25 %, about 3 min left"]
    assert [duration(s) for s in (40, 299, 7800)] == ["40 s", "5 min", "2 h 10 min"]


def test_memory_is_counted_before_the_work(tiny_experiment):
    experiment = lfpiv.open_experiment(tiny_experiment)
    needed = memory.worker_bytes(experiment)
    assert needed > 4 * experiment.grid.size
    memory.require(needed, experiment, "volumes of")
    with pytest.raises(InputError, match=r"8 x 12 x 16 voxels.* 1,024\.0 GiB"):
        memory.require(1024 * memory.GIB, experiment, "volumes of")
    edit(tiny_experiment, "pairs = 2", "pairs = 2\n[compute]\nmemory_gib = 0.001")
    with pytest.raises(InputError, match=r"compute\.memory_gib"):
        memory.require(needed, lfpiv.open_experiment(tiny_experiment), "volumes of")
