"""Numbers and names of frames and pairs, of image pairs and of a time series."""

import itertools

import pytest

from lfpiv.experiment.recording import Recording

PAIRS, SERIES = Recording(pairs=3, names=("x", "y")), Recording.of_series(instants=7, first=5, step=2)


def test_each_frame_of_image_pairs_is_in_one_pair_and_named_by_it():
    frames = [frame for pair in PAIRS.numbers for frame in PAIRS.of_pair(pair)]
    assert [frame.number for frame in frames] == list(PAIRS.frames) == list(range(6))
    assert [frame.laser for frame in frames] == [0, 1] * 3 and PAIRS.shared_step is None
    last = frames[-1]
    assert (last.label, last.within, last.stem) == ("pair 2, frame y", "frame y", "pair_0002_b")
    assert last.fields == {"pair": 2, "frame": "y", "image": 5} and PAIRS.named(2, "y") == last


def test_an_instant_ends_a_pair_and_begins_the_one_a_step_later():
    assert list(SERIES.frames) == list(range(5, 12)) and list(SERIES.numbers) == list(range(5, 10))
    for pair, later in itertools.product(SERIES.numbers, repeat=2):
        assert (SERIES.of_pair(pair)[1] == SERIES.of_pair(later)[0]) == (later == pair + SERIES.shared_step)
    frame = SERIES.frame_of(5, 1)
    assert (frame.label, frame.within, frame.stem, frame.fields) == ("instant 7",) * 2 + (
        "instant_000007",
        {"instant": 7},
    )
    assert SERIES.frame_origin(frame, 1e-3) == {"instant": 7, "time_s": pytest.approx(1e-3)}


@pytest.mark.parametrize("recording", [PAIRS, SERIES], ids=["pairs", "series"])
def test_a_frame_is_new_in_one_pair_at_most(recording):
    new = [frame for pair in recording.numbers for frame in recording.new_frames(pair)]
    assert len(set(new)) == len(new) == recording.lasers * recording.pairs
