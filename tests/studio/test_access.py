"""Trust: the studio opens nothing outside its folders, and runs are started once and stopped as by Ctrl-C."""

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from types import SimpleNamespace

import pytest

from lfpiv.cli import commands
from lfpiv.errors import InputError

LARGE_BYTES = 256 << 20
"""Size of a file that is no experiment; the start that is read takes less than a hundredth of it."""


def test_places_outside_the_folders_are_refused(tmp_path):
    from lfpiv.studio.access import Places

    inside, outside = tmp_path / "inside", tmp_path / "outside"
    for folder in (inside, outside):
        folder.mkdir()
    (inside / "link").symlink_to(outside)
    places = Places(inside.resolve())
    assert places.within("a/b") == inside.resolve() / "a" / "b"
    for wrong in ("..", str(outside), "link/results", "/etc/passwd", "a/../../outside"):
        with pytest.raises(InputError, match="expected a place in"):
            places.within(wrong)


def test_a_large_file_a_pipe_and_a_device_beside_the_results_are_no_obstacle(tmp_path):
    from lfpiv.studio.access import Places

    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "device.toml").symlink_to("/dev/zero")
    with (tmp_path / "large.toml").open("w") as file:
        file.write("[[camera]]\nwhite_image = 1\n[volume]\n")
        file.truncate(LARGE_BYTES)
    tracemalloc.start()
    try:
        found = Places(tmp_path).experiments()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found == [tmp_path / "large.toml"] and peak < LARGE_BYTES / 16, peak


@pytest.mark.parametrize(
    ("stated", "found"),
    [
        (None, {"rig/a.toml", "rig/b.toml"}),  # an unfinished run: both lie beside it
        ("a.toml", {"rig/a.toml"}),
        ("../other/a.toml", {"rig/a.toml"}),  # moved since
        ("away/a.toml", {"away/a.toml", "rig/a.toml"}),
        ("gone.toml", set()),
    ],
)
def test_results_belong_to_the_experiment_file_that_their_summary_names(tmp_path, stated, found):
    from lfpiv.studio.access import belongs

    results = tmp_path / "rig" / "results"
    results.mkdir(parents=True)
    if stated is not None:
        (results / "summary.json").write_text(json.dumps({"experiment": {"file": stated}}), "utf-8")
    files = ("rig/a.toml", "rig/b.toml", "away/a.toml", "faraway/a.toml")
    assert {file for file in files if belongs(tmp_path / file, results)} == found


def test_chosen_results_open_their_experiment_file_or_none_and_no_changes_are_lost(tmp_path):
    from lfpiv.errors import InputError
    from lfpiv.studio.access import Places
    from lfpiv.studio.session import Session

    for name, stated in (("a", "a/a.toml"), ("b", "b/b.toml"), ("c", "gone/c.toml")):
        (tmp_path / name / "run" / "vectors").mkdir(parents=True)
        (tmp_path / name / "run" / "vectors" / "pair_0000.nc").touch()
        (tmp_path / name / "run" / "summary.json").write_text(json.dumps({"experiment": {"file": stated}}), "utf-8")
    for name in "ab":
        (tmp_path / name / f"{name}.toml").write_text("[[camera]]\nwhite_image = 1\n[volume]\n", "utf-8")
    session = Session(SimpleNamespace(state={}), Places(tmp_path))
    told = []
    session.listeners.append(told.append)
    session.open(tmp_path)
    assert (session.experiment, session.results) == (tmp_path / "a" / "a.toml", tmp_path / "a" / "run")
    session.choose("b/run")
    assert session.experiment == tmp_path / "b" / "b.toml" and told == ["experiment", "results"]
    session.choose("a/a.toml")
    assert session.results == tmp_path / "a" / "run"
    session.draft = SimpleNamespace(changed=True)
    with pytest.raises(InputError, match="Save them first, or undo them"):
        session.choose("b/run")
    assert session.results == tmp_path / "a" / "run" and session.state["results_open"] == str(session.results)
    session.draft = None
    session.choose("c/run")
    assert session.experiment is None and session.state["results_name"] == "c/run"


@pytest.mark.slow
@pytest.mark.browser
def test_results_without_an_experiment_file_open_none(tmp_path, browser):
    from support.report_run import field
    from support.studio_page import served, until

    from lfpiv.results import netcdf

    netcdf.write_vectors(field(0), tmp_path / "run" / "vectors" / "pair_0000.nc", attributes={"pair": 0})
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "experiment.toml").write_text("[[camera]]\nwhite_image = 1\n[volume]\n", "utf-8")
    with served(tmp_path / "run") as address:
        browser.get(address)
        (note,) = until(lambda: browser.find_elements("id", "r-alone"), 60)
        until(lambda: "no experiment file of these results" in note.text)
        assert browser.execute_script("return trame.state.get('experiment_name')") == ""


def test_a_page_that_closes_while_pictures_come_logs_nothing(caplog):
    from aiohttp import web
    from aiohttp.test_utils import make_mocked_request

    from lfpiv.studio.access import guard
    from lfpiv.studio.server import quiet_closed_pages

    token, messages = "word", logging.getLogger("wslink.protocol")
    quiet_closed_pages()

    def fails(error):
        async def handler(request):
            try:
                raise error
            except type(error):
                messages.error("Exception raised")
                raise

        request = make_mocked_request("GET", f"/ws?token={token}", headers={"Host": "127.0.0.1:80"})
        return asyncio.run(guard(token)(request, handler))

    assert isinstance(fails(ConnectionResetError("Cannot write to closing transport")), web.Response)
    assert not caplog.records
    with pytest.raises(ValueError, match="a fault"):
        fails(ValueError("a fault"))
    assert [record.message for record in caplog.records] == ["Exception raised"]


def test_a_held_folder_gets_no_second_run(tmp_path):
    from lfpiv.results.folder import Folder
    from lfpiv.studio import run_process

    with Folder(tmp_path).held():
        assert run_process.holder(tmp_path).process == os.getpid()
        with pytest.raises(InputError, match=f"process {os.getpid()}"):
            run_process.start(tmp_path / "experiment.toml", tmp_path, [])
    assert run_process.holder(tmp_path) is None


def test_a_run_is_paused_resumed_and_stopped():
    from lfpiv.studio import run_process

    process = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(60)"],
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # tests in the background ignore it
    )
    run_process.control(process.pid, "pause")
    until_status(process.pid, "paused")
    run_process.control(process.pid, "resume")
    until_status(process.pid, "running")
    run_process.control(process.pid, "stop")
    assert process.wait(20) == -signal.SIGINT or process.returncode == 1
    assert run_process.status(process.pid) == "ended"


def until_status(process, wanted):
    from lfpiv.studio import run_process

    end = time.monotonic() + 20
    while run_process.status(process) != wanted:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_stages_tell_the_time_left(tmp_path):
    from lfpiv.studio import run_process

    lines = ['{"step": "weights", "fraction": 1.0, "at": 5.0}', '{"step": "image pairs", "fraction": 0.0, "at": 10.0}']
    lines += ['{"step": "image pairs", "fraction": 0.25, "at": 40.0}', '{"torn']
    (tmp_path / ".run.jsonl").write_text("\n".join(lines), "utf-8")
    weights, pairs = run_process.stages(tmp_path)
    assert weights["percent"] == 100 and pairs["percent"] == 25 and pairs["left"] == "about 2 min left"
    assert run_process.time_left(tmp_path) == "about 2 min left, report included"


def test_each_pair_has_a_bar_beside_its_stage(tmp_path):
    from lfpiv.studio import run_process

    lines = [
        {"step": "image pairs", "fraction": 0.0, "at": 10.0},
        {"step": "pair 0", "fraction": 0.0, "at": 10.0, "pair": 0},
        {"step": "pair 0", "fraction": 1.0, "at": 40.0, "pair": 0},
        {"step": "pair 1", "fraction": 0.0, "at": 40.0, "pair": 1},
        {"step": "pair 1", "fraction": 0.5, "at": 240.0, "pair": 1},
    ]
    (tmp_path / ".run.jsonl").write_text("\n".join(map(json.dumps, lines)), "utf-8")
    (stage,) = run_process.stages(tmp_path)
    assert [(one["name"], one["percent"]) for one in stage["pairs"]] == [("pair 0", 100), ("pair 1", 50)]
    assert stage["pairs"][1]["left"] == "about 3 min left"


@pytest.mark.slow
def test_a_run_records_each_pair(small_run, tmp_path, monkeypatch):
    from lfpiv.studio import run_process

    monkeypatch.setenv("LFPIV_PROGRESS_FILE", str(tmp_path / ".run.jsonl"))
    experiment = small_run.images(tmp_path / "rig")
    results = small_run.results(experiment.parent / "results")
    removed = sorted((results / "vectors").glob("pair_*.nc"))[0]
    removed.unlink()
    assert commands.call(["run", str(experiment), "--out", str(results), "--quiet"]) == 0
    (stage,) = [stage for stage in run_process.stages(tmp_path) if stage["name"] in run_process.PAIR_STEPS]
    assert [(one["name"], one["percent"]) for one in stage["pairs"]] == [("pair 0", 100)]


def test_progress_is_recorded_where_the_environment_asks(tmp_path, monkeypatch, tiny_experiment):
    from lfpiv.studio import run_process

    monkeypatch.setenv("LFPIV_PROGRESS_FILE", str(tmp_path / ".run.jsonl"))
    with commands.terminal.Output().progress() as progress:
        progress("calibration", 0.5)
        progress("calibration", 1.0)
    assert [stage["percent"] for stage in run_process.stages(tmp_path)] == [100]


def test_without_the_extra_one_message_names_it(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert commands.call(["studio", str(tmp_path), "--no-browser"]) == 2
    assert "pip install 'lfpiv[studio]'" in capsys.readouterr().err


def test_nothing_there_is_told(capsys, tmp_path):
    assert commands.call(["studio", str(tmp_path / "nothing"), "--no-browser"]) == 2
    assert "found nothing there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("modules", "later"),
    [
        ("lfpiv.studio.page, lfpiv.studio.access", {"pyvista", "xarray", "matplotlib", "lfpiv.settings.experiment"}),
        ("lfpiv.studio.results_tab, lfpiv.studio.images_tab", {"taichi", "warp", "scipy.optimize"}),
        ("lfpiv.studio.results_tab", {"tomlkit", "markdown_it", "lfpiv.studio.preview_tab"}),
    ],
)
def test_what_the_first_picture_does_not_need_is_imported_later(modules, later):
    asked = f"import sys, {modules}; print({later!r} & {{*sys.modules}} or '')"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
