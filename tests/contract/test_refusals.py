"""Wrong input ends by one message that names it, without a traceback, before any file is written."""

import functools
import os
import shutil
import signal

import numpy as np
import pytest
import tifffile
from contract.command import edit, finish, start

import lfpiv

USAGE, OTHER = 2, 1
"""Exit status."""


def replaced(old, new):
    return lambda file: edit(file, old, new)


def image(name, change):
    return lambda file: change(file.parent / name)


def dark(path):
    tifffile.imwrite(path, np.zeros_like(tifffile.imread(path)))


def narrow(path):
    tifffile.imwrite(path, tifffile.imread(path)[:, :-8])


def halved(path):
    os.truncate(path, path.stat().st_size // 2)


WHITE, PARTICLES = "white/left.tif", "particles/right/pair_0000_a.tif"
WRONG = {
    "unknown table": (replaced("[smart]", "[optics]\n[smart]"), ["optics"]),
    "misspelt key": (replaced("iterations", "iteration"), ["iteration"]),
    "text for a number": (replaced("voxel_mm = 0.1", 'voxel_mm = "fine"'), ["volume.voxel_mm"]),
    "voxels of nothing": (replaced("voxel_mm = 0.1", "voxel_mm = -0.1"), ["volume.voxel_mm"]),
    "window beyond the volume": (replaced("[8, 10, 10]", "[40, 10, 10]"), ["correlation.windows"]),
    "no TOML": (replaced("dt_s = ", "dt_s "), ["line"]),
    "missing image": (image(PARTICLES, os.remove), [PARTICLES]),
    "cut image": (image(PARTICLES, halved), [PARTICLES]),
    "narrow image": (image(WHITE, narrow), [WHITE]),
    "dark white image": (image(WHITE, dark), [WHITE]),
    "volume out of view": (replaced("centre_mm = [0.0,", "centre_mm = [60.0,"), ["volume.centre_mm"]),
    "too many voxels": (replaced("voxel_mm = 0.1", "voxel_mm = 0.0005"), ["volume.voxel_mm"]),
}


def wrong(killed_run, folder, name):
    """Return a wrong experiment and the words that a message about it must hold."""
    file = shutil.copytree(killed_run.experiment.parent, folder / "data") / killed_run.experiment.name
    spoil, words = WRONG[name]
    spoil(file)
    return file, words


@pytest.mark.parametrize("name", WRONG)
def test_wrong_experiment_is_named(killed_run, tmp_path, name):
    file, words = wrong(killed_run, tmp_path, name)
    with pytest.raises(lfpiv.InputError) as refusal:
        lfpiv.run(file, tmp_path / "out")
    assert all(word in str(refusal.value) for word in words), refusal.value
    assert not (tmp_path / "out").exists()


@pytest.mark.slow(but="missing image")
@pytest.mark.parametrize("name", ["misspelt key", "missing image"])
def test_command_line_shows_one_message(killed_run, tmp_path, name):
    file, words = wrong(killed_run, tmp_path, name)
    found = finish(start("-m", "lfpiv", "run", file, "--out", tmp_path / "out"))
    assert found.status == USAGE, found.errors
    assert "Traceback" not in found.errors
    assert all(word in found.errors for word in words), found.errors
    assert found.errors.count("lfpiv: ") == 1, found.errors


def test_wrong_folders_and_formats_are_named(killed_run, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    for call in (lfpiv.open_results, lfpiv.open_tracks, lfpiv.open_particles):
        with pytest.raises(lfpiv.InputError, match="empty"):
            call(empty)
    with pytest.raises(lfpiv.InputError, match=r"nothing\.toml"):
        lfpiv.open_experiment(tmp_path / "nothing.toml")
    with pytest.raises(lfpiv.InputError, match="empty"):
        lfpiv.open_experiment(empty)
    with pytest.raises((lfpiv.InputError, ValueError), match="docx"):
        lfpiv.export_results(killed_run.out, "docx")


def test_damaged_results_are_named(killed_run, tmp_path):
    out = shutil.copytree(killed_run.out, tmp_path / "out")
    path = out / "vectors" / "pair_0001.nc"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    found = finish(start("-m", "lfpiv", "export", out, "--to", "csv"))
    assert found.status == USAGE
    assert "pair_0001.nc" in found.errors
    assert "Traceback" not in found.errors


def test_interrupt_ends_a_run_at_once(killed_run, tmp_path):
    default = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # jobs in the background ignore it
    process = start("-m", "lfpiv", "run", killed_run.experiment, "--out", tmp_path / "out", preexec_fn=default)
    assert "kernels run on" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    found = finish(process)
    assert found.status == OTHER
    assert "lfpiv: interrupted" in found.errors
    assert "Traceback" not in found.errors
