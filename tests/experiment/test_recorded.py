"""Pairs and instants that are stated and not recorded are found before any work, whatever form the images have."""

import os
import re
import time

import h5py
import numpy as np
import pytest
import tifffile
from support.recordings import write_cine, write_mraw

from lfpiv.errors import InputError
from lfpiv.experiment import recorded
from lfpiv.experiment.opening import open_experiment, read_experiment

STATED, FOUND = 9, 7
PATTERN = '"particles/{camera}/{pair:04d}{frame}.tif"'
LONGEST_S = 3.0
"""Most time for a million stated pairs of which some thousand are there [s]."""


def stated(file, pattern, count=f"pairs = {STATED}", raw=""):
    """Write an experiment with another pattern and count, and return it."""
    text = file.read_text("utf-8").replace(PATTERN, f'"{pattern}"').replace("pairs = 2", count, 1)
    assert pattern in text and count in text
    if raw:
        text = text.replace("[board]", raw + "\n[board]", 1)
    file.write_text(text, "utf-8")
    return read_experiment(file)


def frames(count):
    return np.random.default_rng(1).integers(1, 4000, (count, 8, 8), np.uint16)


def files(*names):
    """Return a function that writes empty files for the numbers of pairs or instants that are there."""

    def write(folder, numbers):
        for camera in ("left", "right"):
            for number in numbers:
                for name in names:
                    fields = {"camera": camera, "n": number, "even": 2 * number, "odd": 2 * number + 1}
                    path = folder / name.format(**fields)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.touch()

    return write


def stack(suffix, write, per_number=1):
    """Return a function that writes one file for each camera, with the first images."""

    def write_all(folder, numbers):
        for camera in ("left", "right"):
            write(folder / f"{camera}{suffix}", frames(per_number * len(numbers)))

    return write_all


def write_tiff(path, images):
    tifffile.imwrite(path, images, photometric="minisblack", metadata=None)


def write_dataset(path, images):
    with h5py.File(path, "w") as file:
        file["images"] = images


def write_named(folder, numbers):
    for camera in ("left", "right"):
        with h5py.File(folder / f"{camera}.h5", "w") as file:
            for number in numbers:
                for frame in "ab":
                    file[f"p{number:03d}/{frame}"] = frames(1)[0]


FILES = {
    "file by pair and frame": (
        "raw/{camera}/{pair:04d}{frame}.tif",
        files("raw/{camera}/{n:04d}a.tif", "raw/{camera}/{n:04d}b.tif"),
    ),
    "folder by pair": ("run_{pair}/{camera}_{frame}.png", files("run_{n}/{camera}_a.png", "run_{n}/{camera}_b.png")),
    "number twice": (
        "{pair:02d}/{camera}{pair:02d}{frame}.tif",
        files("{n:02d}/{camera}{n:02d}a.tif", "{n:02d}/{camera}{n:02d}b.tif"),
    ),
    "image": ("{camera}_{image:05d}.tif", files("{camera}_{even:05d}.tif", "{camera}_{odd:05d}.tif")),
    "DaVis": ("{camera}/B{pair:05d}.im7#{frame}", files("{camera}/B{n:05d}.im7")),
    "named datasets": ("{camera}.h5#p{pair:03d}/{frame}", write_named),
}
"""Patterns, and functions that write images which may have gaps."""
STACKS = {
    "TIFF": ("{camera}.tif#{image}", stack(".tif", write_tiff, 2)),
    "HDF5": ("{camera}.h5#images[{image}]", stack(".h5", write_dataset, 2)),
    "cine": ("{camera}.cine#{image}", stack(".cine", write_cine, 2)),
    "mraw": ("{camera}.mraw#{image}", stack(".mraw", write_mraw, 2)),
}
"""Patterns, and functions that write files of many images."""


@pytest.mark.parametrize(("pattern", "write"), (FILES | STACKS).values(), ids=(FILES | STACKS).keys())
def test_pairs_missing_at_the_end_are_counted(pattern, write, tiny_experiment):
    experiment = stated(tiny_experiment, pattern)
    before = set(tiny_experiment.parent.rglob("*"))
    write(tiny_experiment.parent, range(STATED))
    assert recorded.missing(experiment) is None
    for path in set(tiny_experiment.parent.rglob("*")) - before:
        if path.is_file():
            path.unlink()
    write(tiny_experiment.parent, range(FOUND))
    found = recorded.missing(experiment)
    assert (found.complete, found.end, found.gaps) == (FOUND, range(FOUND, STATED), ())
    message = found.message()
    first = experiment.particle_path("left", FOUND, "a")
    words = ["particles.pairs", repr(pattern), f"of {STATED} pairs", f"those of {FOUND};", "pairs 7 to 8 at the end"]
    for word in (*words, str(first), f"State particles.pairs = {FOUND}"):
        assert word in message, message
    with pytest.raises(InputError, match=re.escape(message)):
        open_experiment(tiny_experiment)


@pytest.mark.parametrize(("pattern", "write"), FILES.values(), ids=FILES.keys())
def test_gaps_are_named(pattern, write, tiny_experiment):
    experiment = stated(tiny_experiment, pattern)
    write(tiny_experiment.parent, [0, 1, 3, 6, 7, 8])
    found = recorded.missing(experiment)
    assert (found.complete, list(found.end), found.gaps) == (6, [], (range(2, 3), range(4, 6)))
    message = found.message()
    assert "missing: pair 2 within, pairs 4 to 5 within" in message and "at the end" not in message
    assert str(experiment.particle_path("left", 2, "a")) in message


def test_an_image_of_one_camera_that_is_missing_is_a_gap_even_at_the_end(tiny_experiment):
    pattern, write = FILES["file by pair and frame"]
    experiment = stated(tiny_experiment, pattern)
    write(tiny_experiment.parent, range(STATED))
    lost = experiment.particle_path("right", STATED - 1, "b")
    lost.unlink()
    found = recorded.missing(experiment)
    assert not found.end and found.gaps == (range(STATED - 1, STATED),) and f"{lost} (particles.images, " in found.first


def test_raw_files_are_counted_by_their_length(tiny_experiment):
    layout = '[camera.raw]\nshape = [8, 8]\ndtype = "uint16"'
    experiment = stated(tiny_experiment, "{camera}.raw#{image}")
    text = tiny_experiment.read_text("utf-8").replace(
        '[[camera]]\nname = "right"', f'{layout}\n[[camera]]\nname = "right"'
    )
    tiny_experiment.write_text(text.replace("[board]", f"{layout}\n\n[board]"), "utf-8")
    experiment = read_experiment(tiny_experiment)
    for camera in ("left", "right"):
        frames(2 * FOUND).tofile(tiny_experiment.parent / f"{camera}.raw")
    assert recorded.missing(experiment).end == range(FOUND, STATED)


def test_instants_of_a_series_are_counted_and_their_pairs_named(tiny_experiment):
    experiment = stated(tiny_experiment, "{camera}_{instant:03d}.tif", f"instants = {STATED}\nfirst = 4\nstep = 2")
    files("{camera}_{n:03d}.tif")(tiny_experiment.parent, range(4, 4 + FOUND))
    found = recorded.missing(experiment)
    assert found.end == range(11, 13) and found.pairs_at_end == range(9, 11)
    assert "particles.instants" in found.message() and "State particles.instants = 7" in found.message()
    assert "left_011.tif (particles.images, camera 'left', instant 11)" in found.message()


def test_files_that_count_from_one_are_told_apart(tiny_experiment):
    pattern, write = FILES["file by pair and frame"]
    experiment = stated(tiny_experiment, pattern)
    write(tiny_experiment.parent, range(1, STATED + 1))
    found = recorded.missing(experiment)
    assert found.counts_from_one and f"count from 1 to {STATED}, pairs count from 0" in found.message()


def test_nothing_is_said_where_no_image_is_found_or_nothing_can_be_listed(tiny_experiment, monkeypatch):
    pattern, write = FILES["file by pair and frame"]
    experiment = stated(tiny_experiment, pattern)
    assert recorded.missing(experiment) is None, "another path is meant"
    write(tiny_experiment.parent, range(FOUND))

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "scandir", refuse)
    assert recorded.missing(experiment) is None


def test_names_that_only_look_alike_do_not_count(tiny_experiment):
    pattern, write = FILES["file by pair and frame"]
    experiment = stated(tiny_experiment, pattern)
    write(tiny_experiment.parent, range(FOUND))
    for name in ("00007a.tif", "7a.tif", "0007a.tif.part", "0008A.tif", "x0008a.tif", "9" * 40 + "a.tif"):
        (tiny_experiment.parent / "raw/left" / name).touch()
    assert recorded.missing(experiment).complete == FOUND


def test_a_long_campaign_is_compared_by_the_files_there_are(tiny_experiment):
    pattern, write = FILES["file by pair and frame"]
    experiment = stated(tiny_experiment, pattern, "pairs = 1000000000")
    write(tiny_experiment.parent, range(500))
    start = time.process_time()
    found = recorded.missing(experiment)
    assert found.end == range(500, 10**9) and time.process_time() - start < LONGEST_S
