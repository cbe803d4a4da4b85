"""Pairs made of frames of neighbouring pairs, in all cameras."""

import pytest

import lfpiv
from lfpiv.runs import belonging


@pytest.mark.whole_run
@pytest.mark.slow(but="one missing")
@pytest.mark.parametrize(
    ("image_of", "told"),
    [
        pytest.param(lambda image: image, None, id="sound"),
        pytest.param(lambda image: image + 1, "frame b of each pair shows the particles of frame a", id="one missing"),
        pytest.param(lambda image: image - 1, "frame b of each pair shows the particles of frame a", id="one too many"),
        pytest.param(lambda image: image - 2 * (image % 2), "frame a of each pair shows", id="second frames late"),
    ],
)
def test_frames_of_neighbouring_pairs_are_named(small_run, tmp_path, image_of, told):
    """Images are numbered in the order in which they were recorded: two for each pair."""
    file = small_run.images(tmp_path / "data")
    for folder in (file.parent / "particles").iterdir():
        paths = sorted(folder.iterdir())
        recorded = [path.read_bytes() for path in paths]
        for number, path in enumerate(paths):
            path.write_bytes(recorded[image_of(number) % len(paths)])
    experiment = lfpiv.open_experiment(file)
    weights = lfpiv.build_weights(lfpiv.load_calibration(small_run.out / "calibration.h5"), experiment.grid)
    found = [str(one.figures["found"]) for one in belonging.check(experiment, weights, [0]).refusals]
    assert [one[: len(told)] for one in found] == [told] if told else found == []
