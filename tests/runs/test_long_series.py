"""Campaigns of a hundred thousand pairs: found one after the other, cut for workers, summed up without lists of all."""

import json
import tracemalloc
from operator import length_hint

import pytest
from support.pair_figures import pair_figures
from support.small_run import PAIRS, write_empty_report

from lfpiv.runs import pipeline, summary, usable_images, work_units
from lfpiv.runs.finished_pairs import FinishedPairs
from lfpiv.runs.pending_pairs import PendingPairs
from lfpiv.runs.run import open_run
from lfpiv.warn import Code, Gathering, Warning

MANY = 100_000
BYTES_PER_PAIR = 40
"""Flags, places in a file and the like; a number in a list takes 36 bytes, a path 200."""


def make_todo(stored, changes=None, **options):
    """Return pairs to do and the list of those that were verified. `stored` has a flag per pair."""
    examined = []

    def verify(pair):
        examined.append(pair)
        return (changes or {}).get(pair)

    return PendingPairs(range(len(stored)), bytearray(stored), verify, lambda fraction: None, **options), examined


def test_pairs_without_a_file_come_first_and_every_file_is_verified_once():
    stored = [pair % 3 > 0 for pair in range(400)]
    todo, examined = make_todo(stored, {5: ["images"], 301: []})
    assert todo.ahead(4) == [0, 3, 6, 9] and examined == [] and not todo.whole
    missing = [pair for pair in range(400) if pair % 3 == 0]
    left, found = [], []
    for pair in todo:
        found.append(pair)
        left.append(length_hint(todo))
    assert found == [*missing, 5, 301] and left == sorted(left, reverse=True) and left[-1] == sum(stored[302:])
    assert examined == [pair for pair in range(400) if pair % 3] and todo.whole
    assert todo.finished[1] == len(examined) - 2 and not set(todo.finished[0]) & {5, 301}


def test_few_pairs_are_known_at_once_and_in_order(caplog):
    todo, _ = make_todo([1, 0, 1, 0, 1, 1], {2: ["dt_s"], 4: ["dt_s"]})
    with caplog.at_level("INFO", "lfpiv"):
        assert todo.ahead() == [1, 2, 3, 4] == list(todo) and todo.whole
    assert "dt_s changed: pairs 2, 4 made again" in caplog.text and "2 of 6 pairs: finished before" in caplog.text
    assert todo.finished == ([0, 5], 2) and todo.ahead() == []


def test_of_finished_files_no_more_are_verified_ahead_than_until_one_does_not_fit():
    todo, examined = make_todo([1] * 500, {300: ["dt_s"], 301: ["dt_s"]})
    assert todo.ahead(50) == [300] and examined[-1] == 300
    assert list(todo) == [300, 301]


def test_pairs_of_a_series_come_step_by_step():
    todo, _ = make_todo([0] * 7, step=3)
    assert list(todo) == [0, 3, 6, 1, 4, 2, 5]


def test_work_units_are_cut_as_they_are_needed():
    taken = []
    source = (taken.append(pair) or pair for pair in range(MANY))
    first = next(work_units.cut(source, 1, 2))
    assert first.pairs[0] == 0 and len(taken) <= 2 * work_units.MOST_INSTANTS


def figures(valid):
    return pair_figures(valid, warnings=(Warning(code=Code.DIM, subject="left", figures={"structure": valid}),))


def test_figures_of_finished_pairs_are_a_mapping_on_disk(tmp_path):
    kept = FinishedPairs(range(10, 20), tmp_path)
    for pair in (17, 12, 19, 12):
        kept.add(pair, figures(pair / 100 if pair != 12 else 0.5))
    assert list(kept) == [12, 17, 19] and len(kept) == 3 and 13 not in kept and 3 not in kept
    assert kept[17] == figures(0.17) and dict(kept.items())[12].valid_fraction == 0.5
    with pytest.raises(KeyError):
        kept[13]
    kept.clear()
    assert list(kept) == [] and list(tmp_path.iterdir()) == []


def test_images_that_stand_in_two_pairs_under_two_names_are_copies(tmp_path):
    kept = FinishedPairs(range(10, 20), tmp_path)
    assert kept.copies() == {}
    kept.add(18, figures(0.5), [("a18", "one"), ("b18", "two")])
    kept.add(12, figures(0.5), [("a12", "three"), ("b12", "two")])
    kept.add(13, figures(0.5), [("b12", "two"), ("b13", "four")])  # of a series: the same instant
    kept.add(15, figures(0.5), [("a15", "three"), ("b15", "five")])
    kept.add(15, figures(0.5), [("a15", "three"), ("b15", "five")])
    assert kept.copies() == {15: 12, 18: 12}
    kept.clear()
    assert kept.copies() == {}


@pytest.mark.slow
def test_memory_is_bytes_per_pair(tmp_path):
    """Figures, warnings and the search of a hundred thousand pairs, half of them finished."""
    tracemalloc.start()
    kept, found = FinishedPairs(range(MANY), tmp_path), Gathering()
    todo = PendingPairs(range(MANY), bytearray([0, 1]) * (MANY // 2), lambda pair: None, lambda fraction: None)
    one = figures(0.5)
    start = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    for pair in todo:
        if pair % 10 == 0:  # as many as take a second
            kept.add(pair, one)
            found.add(warning.of_pair(pair) for warning in one.warnings)
    peak = tracemalloc.get_traced_memory()[1] - start
    tracemalloc.stop()
    assert len(kept) == MANY // 10 and len(found.merged()[0].pairs) == MANY // 10
    assert peak < BYTES_PER_PAIR * MANY + 5e6  # of the file up to 4 MiB are in memory


def test_a_long_experiment_starts_with_its_first_pairs(tiny_experiment, tmp_path, monkeypatch):
    """A hundred thousand pairs, said to have images: only those of the first pairs are opened."""
    text = tiny_experiment.read_text()
    assert "pairs = 2" in text
    tiny_experiment.write_text(text.replace("pairs = 2", f"pairs = {MANY}"))
    asked = []
    monkeypatch.setattr("lfpiv.runs.usable_images.recorded.missing", lambda experiment: None)
    monkeypatch.setattr(usable_images, "check_pairs", lambda experiment, pairs: asked.extend(pairs) or iter(()))
    with open_run(tiny_experiment, tmp_path / "out", "cpu", None) as run:
        monkeypatch.setattr(type(run), "files", lambda self, pair: pytest.fail(f"pair {pair} is looked at"))
        monkeypatch.setattr(type(run), "has_volumes", lambda self, pair: False)
        tracemalloc.start()
        todo = run.unfinished()
        assert usable_images.check_images(run, todo) is None and run.need_weights(todo) and next(todo) == 0
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert 0 < len(asked) <= 100 and length_hint(todo) == MANY - 1 and peak < BYTES_PER_PAIR * MANY


@pytest.mark.slow
@pytest.mark.whole_run
def test_a_summary_of_many_pairs_lists_some_and_names_the_file_of_all(small_run, tmp_path, monkeypatch):
    out = small_run.results(tmp_path / "out")
    monkeypatch.setattr(summary, "MOST_LISTED", 2)
    found = pipeline.report(small_run.experiment, out)
    assert found["pairs_finished"] == PAIRS and found["pairs_file"] == "pairs.jsonl"
    listed = [json.loads(line) for line in (out / "pairs.jsonl").read_text().splitlines()]
    assert listed == json.loads((out / "summary.json").read_text())["pairs"][:0] + small_run.summary["pairs"]
    assert [entry["pair"] for entry in found["pairs"]] == [0, PAIRS - 1]
    assert found["valid_fraction"] == pytest.approx(small_run.summary["valid_fraction"], rel=1e-12)
    assert f"{PAIRS} pairs finished, of which 2, evenly chosen" in (out / "report.html").read_text("utf-8")
    monkeypatch.undo()
    monkeypatch.setattr("lfpiv.report.page.write_report", write_empty_report)
    again = pipeline.report(small_run.experiment, out)
    assert again["pairs"] == small_run.summary["pairs"] and again["pairs_file"] is None
    assert not (out / "pairs.jsonl").exists()
