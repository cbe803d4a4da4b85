"""The task of a run for its workers: the same work after writing and reading, private, and refused once changed."""

import ast
import dataclasses
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

import lfpiv
from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.opening import read_experiment
from lfpiv.results.folder import Folder
from lfpiv.results.stamps import Inputs
from lfpiv.runs import task
from lfpiv.runs.pair import PairWork

SOLID = '[[volume.solid]]\nkind = "box"\ncentre_mm = [0, 0, 0.1]\nsize_mm = [0.2, 0.2, 0.2]\n'


@pytest.fixture(params=["pairs", "series with a mask"])
def work(request, tiny_experiment, tmp_path, monkeypatch):
    """The work on an experiment whose file is named relative to the working folder."""
    if request.param != "pairs":
        text = tiny_experiment.read_text().replace("[particles]", f"{SOLID}[particles]")
        text = text.replace("{pair:04d}{frame}", "{instant}").replace("pairs = 2", "instants = 4")
        tiny_experiment.write_text(text)
    monkeypatch.chdir(tiny_experiment.parent)
    experiment = read_experiment(tiny_experiment.name)
    return PairWork(
        experiment=experiment,
        folder=Folder(tmp_path / "out", experiment.recording),
        inputs=Inputs("a1", "b2", ((1, 2), (0, 0), (3, 4)), 1.25),
        weights=None,
        cameras={},
        keep_volumes=True,
    )


def test_a_worker_reads_the_work_that_the_run_wrote(work, tmp_path, monkeypatch):
    old = os.umask(0)
    try:
        shared = task.write_task(work, "cpu", 3)
    finally:
        os.umask(old)
    monkeypatch.chdir(tmp_path)  # a worker may run elsewhere
    read = task.read_task(shared)
    found = read.work(shared)
    assert (read.device, read.threads, read.weights) == ("cpu", 3, None)
    there = tmp_path / "tiny"
    assert found.experiment.path == there / "experiment.toml"
    for name in ("white_path", "dark_path"):
        paths = [getattr(camera, name) for camera in work.experiment.cameras]
        found_paths = [getattr(camera, name) for camera in found.experiment.cameras]
        assert found_paths == [path and there / path for path in paths]
    same = dataclasses.replace(
        found.experiment,
        path=work.experiment.path,
        cameras=work.experiment.cameras,
        mask=work.experiment.mask,
    )
    assert same == work.experiment
    if work.experiment.mask is not None:
        frame = work.experiment.pair_frames(0)[0]
        np.testing.assert_array_equal(found.experiment.solid(frame), work.experiment.solid(frame))
    for name in ("folder", "inputs", "keep_volumes", "vectors"):
        assert getattr(found, name) == getattr(work, name), name
    assert found.scratch is not None and found.scratch.parent == shared
    for path in (shared, shared.parent, work.folder.shared):
        assert path.stat().st_mode & 0o777 == 0o700
    assert list(work.folder.shared.iterdir()) == [shared.parent] and shared.parent.parent == work.folder.shared


def test_a_changed_task_is_refused_and_runs_no_code(work, tmp_path):
    """A pickle in its place would run a command when it is read."""

    class Command:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "ran"),)

    shared = task.write_task(work, "cpu", None)
    file = shared / task.TASK
    content = file.read_bytes()
    place = content.index(b"a1")
    for other in (pickle.dumps(Command()), b"", content[:place] + b"c3" + content[place + 2 :], content + b" "):
        file.write_bytes(other)
        with pytest.raises(InputError, match="was changed since"):
            task.read_task(shared)
    assert not (tmp_path / "ran").exists()
    file.write_bytes(content)


def test_a_folder_of_somebody_else_is_refused(work, tmp_path, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    work.folder.shared.parent.mkdir()
    work.folder.shared.symlink_to(elsewhere)
    with pytest.raises(InputError, match="found a link or a file"):
        task.write_task(work, "cpu", 1)
    work.folder.shared.unlink()
    work.folder.shared.mkdir(mode=0o777)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(InputError, match="found one of user"):
        task.write_task(work, "cpu", 1)
    assert list(elsewhere.iterdir()) == []


def test_sizes_of_missing_space_have_their_unit(work, tmp_path, monkeypatch):
    weights = type("Weights", (), {"memory_bytes": 3 << 20})()
    monkeypatch.setattr(task.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 5000})())
    with pytest.raises(StorageError, match=r"files of 3\.0 MiB, 4\.9 KiB are free"):
        task.write_task(dataclasses.replace(work, weights=weights), "cpu", 1)


def test_no_module_reads_pickles():
    """Neither by `pickle` nor by NumPy, whose default is to refuse them."""
    for path in Path(lfpiv.__file__).parent.rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        for node in ast.walk(tree):
            named = {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            module = node.module if isinstance(node, ast.ImportFrom) else None
            assert not {"pickle", "marshal", "shelve"} & (named | {module}), path
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert node.value.value is False, path
