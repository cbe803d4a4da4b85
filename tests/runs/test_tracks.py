"""Tracks of a run on a time series: kept while they fit, removed where none are asked for."""

from types import SimpleNamespace

import pytest

from lfpiv.experiment.recording import Recording
from lfpiv.results.folder import Folder
from lfpiv.results.provenance import Stamp
from lfpiv.runs import tracks

PAIRS = [3, 4, 5]


def experiment(*, tracking=True, step=1):
    """Return what is asked of an experiment."""
    return SimpleNamespace(
        tracking=object() if tracking else None,
        recording=Recording.of_series(6, 3, step),
        pair_frames=Recording.of_series(6, 3, step).of_pair,
    )


def stamp(*, images="known"):
    return lambda pairs: Stamp({"images": images, "tracks": list(pairs)})


def unwanted():
    raise AssertionError("no weights are needed")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder whose stored tracks are of `PAIRS`."""
    found = Folder(tmp_path)
    found.tracks.write_bytes(b"stored")
    monkeypatch.setattr(
        tracks.provenance,
        "read_marks",
        lambda path: SimpleNamespace(
            settings_hash=stamp()(PAIRS).hash, depends_on=stamp()(PAIRS).attributes["depends_on"]
        ),
    )
    return found


def kept(folder, pairs=PAIRS, **changed):
    images = changed.pop("images", "known")
    tracks.keep_or_make(experiment(**changed), folder, stamp(images=images), pairs, unwanted, lambda fraction: None)
    return folder.tracks.is_file()


def test_tracks_that_fit_are_kept(folder):
    assert kept(folder)


def test_tracks_that_nobody_asks_for_or_that_cannot_be_are_removed(folder):
    assert not kept(folder, tracking=False)
    folder.tracks.write_bytes(b"stored")
    assert not kept(folder, pairs=[3]), "two instants are no track"


def test_other_pairs_need_new_tracks_and_missing_images_leave_them(folder, caplog):
    with pytest.raises(AssertionError, match="weights"):
        kept(folder, pairs=[*PAIRS, 6])
    assert kept(folder, pairs=[*PAIRS, 6], images=None) and "missing" in caplog.text
