"""Time series in the experiment file: numbers of pairs, names of images and results, refused forms."""

import re
from pathlib import Path

import pytest

from lfpiv.errors import InputError
from lfpiv.experiment.opening import open_experiment, read_experiment
from lfpiv.experiment.recording import Recording
from lfpiv.results.folder import Folder


def replace(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.fixture
def tiny_series(tiny_experiment):
    """A copy of the tiny experiment with its four images of each camera as instants 7 to 10."""
    for camera in ("left", "right"):
        for number, name in enumerate(("0000a", "0000b", "0001a", "0001b")):
            image = tiny_experiment.parent / "particles" / camera / f"{name}.tif"
            image.rename(tiny_experiment.parent / f"{camera}_{7 + number:03d}.tif")
    replace(tiny_experiment, "particles/{camera}/{pair:04d}{frame}.tif", "{camera}_{instant:03d}.tif")
    replace(tiny_experiment, "pairs = 2", "instants = 4\nfirst = 7")
    return tiny_experiment


def test_pairs_of_a_series_have_the_number_of_their_first_instant(tiny_series):
    experiment = open_experiment(tiny_series)
    assert experiment.recording == Recording.of_series(instants=4, first=7, step=1)
    assert experiment.numbers == range(7, 10) and experiment.pairs == 3
    names = [[image.path.name for image in experiment.pair_images(pair)] for pair in experiment.numbers]
    assert names[0] == ["left_007.tif", "right_007.tif", "left_008.tif", "right_008.tif"]
    assert names[2][2] == "left_010.tif"
    assert set(experiment.spread_pairs(2)) <= set(experiment.numbers)


def test_step_is_the_distance_of_the_instants_of_a_pair(tiny_series):
    replace(tiny_series, "first = 7", "first = 7\nstep = 3")
    experiment = open_experiment(tiny_series)
    assert experiment.numbers == range(7, 8)
    assert experiment.particle_path("left", 7, "b").name == "left_010.tif"


def test_results_of_a_series_are_named_by_instant():
    folder = Folder(Path("out"), Recording.of_series(instants=9, first=3, step=2))
    assert folder.vectors(4).name == "instant_000004.nc"
    assert folder.volume(4, 1) == folder.volume(6, 0) == Path("out/volumes/instant_000006.nc")


def test_missing_instant_is_named(tiny_series):
    (tiny_series.parent / "right_009.tif").unlink()
    with pytest.raises(InputError, match=r"right_009\.tif \(particles\.images, camera 'right', instant 9\)"):
        open_experiment(tiny_series)


def test_images_of_pairs_count_through_a_recording(tiny_experiment):
    replace(tiny_experiment, "particles/{camera}/{pair:04d}{frame}.tif", "{camera}_{image}.tif")
    experiment = read_experiment(tiny_experiment)
    assert experiment.particle_path("left", 3, "a").name == "left_6.tif"
    assert experiment.particle_path("left", 3, "b").name == "left_7.tif"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("first = 7", "pairs = 3", "particles: expected either pairs or instants"),
        ("first = 7", 'frames = ["a", "b"]', "particles: expected frames only with pairs"),
        ("first = 7", "step = 4", "particles: expected more instants than step"),
        ("instants = 4", "pairs = 2", "particles: expected first and step only with instants"),
        ("{instant:03d}", "{pair}_{frame}", "expected only {camera}, {instant}"),
        ("_{instant:03d}", "", "expected {instant} in the path"),
        (
            "[particles]",
            '[smart]\nestimate = "joint"\n[particles]',
            "smart.estimate: expected 'correlation' for a time",
        ),
    ],
)
def test_forms_that_are_no_series_are_refused(tiny_series, old, new, message):
    replace(tiny_series, old, new)
    with pytest.raises(InputError, match=re.escape(message)):
        read_experiment(tiny_series)
