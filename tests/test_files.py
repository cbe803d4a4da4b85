"""Files of a run: whole-or-nothing writing, and the hash of settings."""

import errno
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lfpiv
from lfpiv import files
from lfpiv.errors import StorageError
from lfpiv.settings.processing import Smart


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "summary.json"
    files.write_json({"value": float("nan"), "array": np.arange(2), "path": (1, 2)}, path)
    old = path.read_text()
    assert json.loads(old) == {"value": None, "array": [0, 1], "path": [1, 2]}
    with pytest.raises(RuntimeError), files.replacing(path) as scratch:
        scratch.write_text("half")
        raise RuntimeError
    assert path.read_text() == old and list(tmp_path.iterdir()) == [path]


def test_a_folder_that_was_removed_meanwhile_is_named_and_nothing_said_to_be_complete(tmp_path):
    path = tmp_path / "results" / "report.html"
    with pytest.raises(StorageError, match="its folder was removed or renamed") as caught, files.writing(path):
        path.write_text("new")
    assert "complete" not in str(caught.value)
    with pytest.raises(StorageError, match="Finished results are complete"), files.writing(path):
        raise OSError(28, "No space left on device")
    with (
        pytest.raises(StorageError, match=r"file too large .*limit of this session \(ulimit -f\)"),
        files.writing(path),
    ):
        raise OSError(errno.EFBIG, "File too large")


def test_the_folder_of_a_killed_export_is_removed_by_the_next_one(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from lfpiv.files import scratch_folder\n"
        "with scratch_folder(Path(sys.argv[1])) as folder:\n    (folder / 'image.vti').touch(); os._exit(9)"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path / "pair_0000.vti")], check=False)
    (left,) = tmp_path.iterdir()
    assert ended.returncode == 9 and left.is_dir()
    with files.scratch_folder(tmp_path / "pair_0001.vti"):
        files.remove_leftovers(tmp_path)
        assert len(list(tmp_path.iterdir())) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("write", "content"), [("write_bytes", b"new"), ("write_text", "new"), ("write_json", "new")])
def test_a_written_file_appears_at_once_and_whole(tmp_path, monkeypatch, write, content):
    """A process that ends before the new file takes its place leaves the old file."""

    def end(*_):
        raise OSError("the process ended")

    path = tmp_path / "file"
    path.write_text("old")
    with monkeypatch.context() as patch:
        patch.setattr("os.replace", end)
        with pytest.raises(OSError):
            getattr(files, write)(content, path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    getattr(files, write)(content, path)
    assert "new" in path.read_text()


def test_settings_hash_sees_every_value_and_no_order():
    settings = Smart().model_dump()
    hashes = {files.settings_hash(smart=settings), files.settings_hash(smart=dict(reversed(settings.items())))}
    assert len(hashes) == 1
    for key, value in settings.items():
        hashes.add(files.settings_hash(smart=settings | {key: f"{value}, but another"}))
    assert len(hashes) == 1 + len(settings)


def test_an_unknown_public_name_is_refused():
    with pytest.raises(AttributeError, match="frobnicate"):
        _ = lfpiv.frobnicate


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path):
    write = "import os, sys; from lfpiv import files\nwith files.replacing(files.Path(sys.argv[1])) as path:\n"
    write += "    path.touch(); print(path, flush=True); os._exit(9)"
    done = subprocess.run([sys.executable, "-c", write, str(tmp_path / "a")], capture_output=True, text=True)
    left = tmp_path / Path(done.stdout.strip()).name
    assert left.exists()
    for path in (tmp_path / ".a.tmp", tmp_path / ".a.0123abcd-1-0123abcd.tmp"):  # nobody's, another machine's
        path.touch()
    with files.replacing(tmp_path / "b") as mine, files.replacing_folder(tmp_path / "c") as folder:
        mine.touch()
        folder.mkdir()
        files.remove_leftovers(tmp_path)
    assert not left.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.0123abcd-1-0123abcd.tmp", ".a.tmp", "b", "c"]
